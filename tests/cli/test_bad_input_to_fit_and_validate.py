"""Bad input to fit, validate and cite: one clear line with the usual fix, exit code 2, nothing
half-written."""

from __future__ import annotations

import json
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from greybox.cli import main
from greybox.excitation.hover import Hover
from greybox.excitation.injection import rich_excitation
from greybox.plants.flight_log import fly, member, write_log
from greybox.plants.presets import controller_for
from greybox.plants.vehicle_file import write_vehicle
from scenarios.studies.recovery import plant


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bad")
    true_plant = plant()
    log = fly(
        true_plant,
        controller_for(true_plant),
        Hover(),
        rich_excitation(),
        3.0,
        seed=[1, 2],
        warm_up=0.5,
    )
    write_log(folder / "a.csv", member(log, 0), drop=["omega"])
    write_log(folder / "b.csv", member(log, 1), drop=["omega"])
    write_vehicle(folder / "v.toml", true_plant, sigma={"inertia": 0.2, "thrust.c2": 0.2})
    return folder


def _edit(source: Path, target: Path, change: Callable[[list[str]], list[str]]) -> Path:
    target.write_text("\n".join(change(source.read_text().splitlines())) + "\n")
    return target


def _drop(name: str) -> Callable[[list[str]], list[str]]:
    def change(lines: list[str]) -> list[str]:
        at = lines[0].split(",").index(name)
        return [",".join(c for i, c in enumerate(line.split(",")) if i != at) for line in lines]

    return change


def _blank(name: str) -> Callable[[list[str]], list[str]]:
    def change(lines: list[str]) -> list[str]:
        at = lines[0].split(",").index(name)
        rows = [line.split(",") for line in lines]
        return [
            ",".join("" if i == at and k else c for i, c in enumerate(row))
            for k, row in enumerate(rows)
        ]

    return change


def _only(names: list[str]) -> Callable[[list[str]], list[str]]:
    def change(lines: list[str]) -> list[str]:
        at = [lines[0].split(",").index(n) for n in names]
        return [",".join(line.split(",")[i] for i in at) for line in lines]

    return change


def _slower(lines: list[str]) -> list[str]:
    rows = [line.split(",") for line in lines]
    return [
        rows[0] and ",".join(rows[0]),
        *(",".join([repr(2 * float(r[0])), *r[1:]]) for r in rows[1:]),
    ]


CASES: dict[str, tuple[list[str], Callable[[Path], None] | None, str]] = {
    "unknown effect": (["--train", "a.csv", "--effects", "motor_leg"], None, "motor_lag"),
    "unknown fixed parameter": (["--train", "a.csv", "--fixed", "inertia.xy"], None, "inertia"),
    "unknown per-flight parameter": (
        ["--train", "a.csv", "--per-flight", "thrust.c9"],
        None,
        "thrust.c",
    ),
    "unknown predictor": (["--train", "a.csv", "--predictor", "inovation"], None, "innovation"),
    "unknown criterion": (["--train", "a.csv", "--criterion", "gauss"], None, "gaussian"),
    "unknown solver": (["--train", "a.csv", "--solver", "newton"], None, "gauss-newton"),
    "unknown start": (["--train", "a.csv", "--init", "noises"], None, "noise"),
    "unknown disturbance": (["--train", "a.csv", "--disturbance", "forces"], None, "force"),
    "horizon zero": (["--train", "a.csv", "--horizons", "0,10"], None, "horizons"),
    "horizon text": (["--train", "a.csv", "--horizons", "short"], None, "horizons"),
    "train is test": (["--train", "a.csv", "--test", "a.csv"], None, "both train and test"),
    "same flight twice": (["--train", "a.csv", "a.csv"], None, "a"),
    "missing log": (["--train", "nowhere.csv"], None, "nowhere.csv"),
    "effect needs voltage": (
        ["--train", "c.csv", "--effects", "battery_sag"],
        lambda d: _edit(d / "a.csv", d / "c.csv", _drop("vbat")) and None,
        "vbat",
    ),
    "command column missing": (
        ["--train", "c.csv"],
        lambda d: _edit(d / "a.csv", d / "c.csv", _drop("u3")) and None,
        "u3",
    ),
    "command column empty": (
        ["--train", "c.csv"],
        lambda d: _edit(d / "a.csv", d / "c.csv", _blank("u3")) and None,
        "u3",
    ),
    "nothing measured": (
        ["--train", "c.csv"],
        lambda d: _edit(d / "a.csv", d / "c.csv", _only(["t", "u1", "u2", "u3", "u4"])) and None,
        "p, q, r",
    ),
    "two sample times": (
        ["--manual", "--train", "a.csv", "c.csv"],
        lambda d: _edit(d / "b.csv", d / "c.csv", _slower) and None,
        "sample time",
    ),
    "speed input without speeds": (["--train", "a.csv", "--input", "speed"], None, "omega1"),
    "effect that speed input cannot use": (
        ["--train", "a.csv", "--input", "speed", "--effects", "motor_lag"],
        None,
        "motor_lag",
    ),
}


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.replace(" ", "-"))
def test_fit_refuses_in_one_line(
    case: str,
    files: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arguments, prepare, word = CASES[case]
    monkeypatch.chdir(files)
    if prepare:
        prepare(files)
    out = tmp_path / "out"
    code = main(["fit", "--vehicle", "v.toml", *arguments, "--out", str(out)])
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert code == 2
    assert error.startswith("greybox fit: ")
    assert word in error
    assert "Traceback" not in error
    assert not out.exists()


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("", "not JSON"),
        ("[]", "not a JSON object"),
        ('{"schema": "greybox.fit/1"}', "wrong schema"),
        ('{"schema": "greybox.model/1"}', "kind"),
        ('{"schema": "greybox.model/1", "kind": "physics"}', "checksum"),
        ('{"schema": "greybox.model/1", "kind": "physics", "checksum": "0"}', "checksum"),
        ("\x00\x01", "not JSON"),
        ("[" * 100000, "not JSON"),
    ],
    ids=["empty", "list", "fit", "kind", "no-checksum", "bad-checksum", "binary", "nested"],
)
@pytest.mark.parametrize("command", ["validate", "cite"])
def test_a_bad_model_file_is_refused_in_one_line(
    command: str,
    content: str,
    word: str,
    files: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if command == "cite" and word in ("kind", "checksum"):
        pytest.skip("cite reads names only, so that it also works on models of a later version")
    model = tmp_path / "model.json"
    model.write_text(content)
    tail = ["--log", str(files / "a.csv")] if command == "validate" else []
    code = main([command, str(model), *tail])
    error = capsys.readouterr().err.strip().splitlines()
    assert code == 2
    assert len(error) == 1
    assert word in error[0] or "expected" in error[0]


def test_a_result_that_cannot_be_written_says_so(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)
    (tmp_path / "taken").write_text("a file, not a folder")
    code = main(
        [
            "fit",
            "--vehicle",
            "v.toml",
            "--train",
            "a.csv",
            "--init",
            "nominal",
            "--out",
            str(tmp_path / "taken" / "x"),
        ]
    )
    assert code == 2
    assert "cannot write" in capsys.readouterr().err.splitlines()[-1]


def test_fit_then_validate_on_another_flight(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)
    doubt = "doubtful: no body has these moments"
    monkeypatch.setattr("greybox.commands.fit_said.sanity_lines", lambda result: [doubt])
    out = tmp_path / "out"
    code = main(
        [
            "fit",
            "--vehicle",
            "v.toml",
            "--train",
            "a.csv",
            "--test",
            "b.csv",
            "--effects",
            "motor_lag,command_delay,rotor_drag,rotational_damping",
            "--out",
            str(out),
        ]
    )
    assert code == 0
    fit = json.loads((out / "fit.json").read_text())
    assert fit["schema"] == "greybox.fit/1"
    assert fit["status"]["converged"]
    assert abs(fit["parameters"]["motor_lag.tau"]["value"] - 0.05) < 0.005
    page = (out / "report.html").read_text()
    assert "<html" in page
    assert doubt in page and doubt in capsys.readouterr().out
    assert "How it answers to commands" in page and "p after a step of roll by" in page
    for name in ("fit", "model", "validate"):
        schema = json.loads(resources.files("greybox.schemas").joinpath(f"{name}.json").read_text())
        jsonschema.validate(json.loads((out / f"{name}.json").read_text()), schema)
    capsys.readouterr()
    assert (
        main(
            [
                "validate",
                str(out / "model.json"),
                "--log",
                "b.csv",
                "--horizons-samples",
                "1,10,50",
                "--json",
                "-",
            ]
        )
        == 0
    )
    result = json.loads(capsys.readouterr().out)
    groups = result["horizons"][0]["groups"]
    assert set(groups) == {"position", "velocity", "rotation", "rate"}
    rows = {row["h"]: row["groups"]["rate"]["rmse"] for row in result["horizons"]}
    floor = {row["h"]: row["groups"]["rate"]["rmse"] for row in result["persistence"]["horizons"]}
    assert rows[10] < floor[10]
    assert np.isfinite(result["simerr"]["position"])


def test_a_fit_outlives_a_validation_that_cannot_be_made(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)
    _edit(files / "b.csv", files / "short.csv", lambda lines: lines[:40])
    out = tmp_path / "out"
    code = main(
        [
            "fit",
            "--vehicle",
            "v.toml",
            "--train",
            "a.csv",
            "--test",
            "short.csv",
            "--effects",
            "motor_lag,command_delay,rotor_drag,rotational_damping",
            "--out",
            str(out),
        ]
    )
    assert code == 0
    assert "no validation" in capsys.readouterr().err
    assert "no validation" in json.loads((out / "fit.json").read_text())["warnings"][0]
    assert (out / "model.json").exists()
    assert not (out / "validate.json").exists()
