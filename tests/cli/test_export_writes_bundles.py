"""greybox export: what it writes and what it refuses, each in one line with exit code 2."""

from __future__ import annotations

import json

import jsonschema
import pytest

from greybox.cli import main
from greybox.residual.files import save_model
from tests.mpc_export import cases, compiled


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    save_model(cases.physics(), folder / "physics.json")
    save_model(cases.hybrid(), folder / "hybrid.json")
    cases.linear().save(folder / "linear.json")
    return folder


def test_every_kind_of_model_file_is_exported(models, tmp_path, capsys):
    for kind, groups in (("physics", "filter"), ("hybrid", "covariance"), ("linear", "")):
        out = tmp_path / kind
        command = [
            "export",
            str(models / f"{kind}.json"),
            "--out",
            str(out),
            "--with",
            groups,
            "--no-cache",
        ]
        assert main([*command, "--json", str(tmp_path / f"{kind}-manifest.json")]) == 0
        said = capsys.readouterr().out
        assert "f_d_jac" in said and "kB of source" in said
        manifest = json.loads((out / "manifest.json").read_text())
        jsonschema.validate(manifest, compiled.manifest_schema())
        assert manifest == json.loads((tmp_path / f"{kind}-manifest.json").read_text())
        assert manifest["model"]["kind"] == kind
        assert (out / "c" / f"{kind}_model.h").exists()


def test_options_reach_the_bundle(models, tmp_path, capsys):
    command = [
        "export",
        str(models / "physics.json"),
        "--out",
        str(tmp_path / "b"),
        "--float",
        "--name",
        "nano",
        "--dt",
    ]
    command += [
        "0.02",
        "--runtime",
        "mass, motor_lag.tau",
        "--target",
        "c",
        "--no-cache",
        "--json",
        "-",
    ]
    assert main(command) == 0
    manifest = json.loads(capsys.readouterr().out)
    assert (manifest["name"], manifest["sample_time"], manifest["c"]["real"]) == (
        "nano",
        0.02,
        "float",
    )
    assert [p["name"] for p in manifest["parameters"]] == ["mass", "motor_lag.tau"]
    assert not (tmp_path / "b" / "casadi").exists()


BAD = {
    "no such file": ("nowhere.json", [], "no such file"),
    "not an identifier": ("linear.json", ["--name", "my-model"], "C identifier"),
    "unknown target": ("linear.json", ["--target", "c,simulink"], "simulink"),
    "no target": ("linear.json", ["--target", ","], "--target"),
    "unknown group": ("linear.json", ["--with", "hessien"], "hessien"),
    "unknown parameter": ("physics.json", ["--runtime", "masss"], "masss"),
    "bad sample time": ("physics.json", ["--dt", "-1"], "--dt"),
    "discrete at another rate": ("linear.json", ["--dt", "0.5"], "discrete"),
    "no learned part": ("physics.json", ["--points", "10"], "learned part"),
    "no points": (
        "hybrid.json",
        ["--points", "0"],
        "--points; expected 1 support point or more; got 0",
    ),
    "weights without a learned part": ("physics.json", ["--runtime", "gp.weights"], "gp.weights"),
}


@pytest.mark.parametrize("case", list(BAD))
def test_bad_input_is_one_line(models, tmp_path, capsys, case):
    file, options, word = BAD[case]
    assert main(["export", str(models / file), "--out", str(tmp_path / "b"), *options]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert len(said.err.strip().splitlines()) == 1
    assert word in said.err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_somebody_else_is_left_alone(models, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["export", str(models / "linear.json"), "--out", str(tmp_path), "--name", "b"]) == 2
    assert "something else" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_an_edited_file_stops_the_next_export(models, tmp_path, capsys):
    command = ["export", str(models / "linear.json"), "--out", str(tmp_path / "b")]
    assert main(command) == 0
    (tmp_path / "b" / "README.md").write_text("mine")
    capsys.readouterr()
    assert main(command) == 2
    said = capsys.readouterr().err.strip()
    assert "README.md" in said and "--force" in said and len(said.splitlines()) == 1
    assert (tmp_path / "b" / "README.md").read_text() == "mine"
    assert main([*command, "--force"]) == 0
    assert (tmp_path / "b" / "README.md").read_text() != "mine"
