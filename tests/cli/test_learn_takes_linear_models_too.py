"""`greybox linear`, then `greybox learn` on its model file: a hybrid that is better where the plant
is not linear."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.resources import files

import jsonschema
import numpy as np
import pytest

import greybox as gb
from greybox.baselines.output_residual import OutputHybrid, read_linear
from greybox.cli import main
from greybox.data.logs import read_log
from greybox.errors import FileFormatError
from greybox.files import read_json
from greybox.residual.weight_space import silent
from tests.one_run import results_of_one_run

pytest.importorskip("gpytorch")
SCHEMA = json.loads(files("greybox").joinpath("schemas/output_residual.json").read_text())


def write_log(path, seed, n=1500):
    """Two decoupled plants: volt = a - b drives speed through a bent spring, load drives temp,
    which is linear."""
    rng = np.random.default_rng(seed)
    a, b, load = (np.repeat(rng.uniform(-1, 1, n // 15), 15) for _ in range(3))
    speed, temp = np.zeros(n), np.zeros(n)
    for k in range(1, n):
        speed[k] = (
            0.9 * speed[k - 1]
            + 0.2 * (a - b)[k - 1]
            - 0.15 * np.sin(2 * speed[k - 1])
            + 0.01 * rng.standard_normal()
        )
        temp[k] = 0.95 * temp[k - 1] + 0.1 * load[k - 1] + 0.01 * rng.standard_normal()
    rows = np.column_stack([0.01 * np.arange(n), a, b, load, speed, temp])
    np.savetxt(path, rows, delimiter=",", header="t,a,b,load,speed,temp", comments="")
    return str(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("linear")
    train = [write_log(out / f"train{i}.csv", i) for i in (1, 2)]
    test = write_log(out / "test.csv", 9)
    common = ["--inputs", "volt=a-b,load", "--outputs", "speed,temp", "--order", "1", "--json", "-"]
    assert main(["linear", "--train", *train, *common, "--siso", "--out", str(out / "siso")]) == 0
    learn = [
        "learn",
        str(out / "siso" / "model.json"),
        "--train",
        *train,
        "--test",
        test,
        "--points",
        "30",
    ]
    with results_of_one_run(out / "hybrid", "report.html", "learn.json", "hybrid.json"):
        assert main([*learn, "--horizons-samples", "1,5", "--out", str(out / "hybrid")]) == 0
    return out, train, test


def test_it_learns_what_is_bent_and_leaves_what_is_linear(folder):
    content = json.loads((folder[0] / "hybrid" / "learn.json").read_text())
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    jsonschema.validate(content, SCHEMA)
    assert content["kind"] == "output"
    assert content["features"] == ["speed", "temp", "a[t-1]", "b[t-1]", "load[t-1]"]
    before, after = (content["validation"][k]["one_step"]["channels"] for k in ("before", "after"))
    assert after["speed"]["mse"] < 0.25 * before["speed"]["mse"]
    assert after["temp"]["mse"] < 1.05 * before["temp"]["mse"]
    assert {o["name"]: o["learned"] for o in content["outputs"]} == {"speed": True, "temp": False}
    assert 0.92 < after["speed"]["coverage95"] < 0.98


def test_the_page_is_there_and_the_file_predicts_what_was_reported(folder):
    out, _, test = folder
    page = (out / "hybrid" / "report.html").read_text()
    assert "speed" in page
    hybrid = OutputHybrid.load(out / "hybrid" / "hybrid.json")
    assert hybrid.base.channels["volt"] == ((1.0, "a"), (-1.0, "b"))
    segment = read_log(test, None).segments[0]
    mean, _ = hybrid.one_step(segment)
    rmse = np.sqrt(np.nanmean((segment.column("speed") - mean[:, 0])[200:] ** 2))
    told = json.loads((out / "hybrid" / "learn.json").read_text())["validation"]["after"][
        "one_step"
    ]["channels"]["speed"]
    assert rmse == pytest.approx(told["mse"] ** 0.5, rel=0.1)


def test_where_nothing_was_learned_a_bundle_is_the_linear_model_alone(folder, tmp_path):
    """Without states and parameters of features that nobody looks at, and without the name."""
    hybrid = OutputHybrid.load(folder[0] / "hybrid" / "hybrid.json")
    assert hybrid.name.endswith("+ output GP(speed)")
    null = replace(hybrid, posterior=silent(hybrid.posterior))
    assert null.name.endswith("+ output GP(nothing)")
    told = read_json(gb.export(null, tmp_path / "null", targets=["casadi"]) / "manifest.json")
    alone = read_json(
        gb.export(hybrid.base, tmp_path / "base", targets=["casadi"]) / "manifest.json"
    )
    for part in ("states", "parameters", "functions"):
        assert [x["name"] for x in told[part]] == [x["name"] for x in alone[part]]
    assert told["learned"] == []


def test_channels_come_from_the_fit_or_from_the_user(folder, tmp_path):
    model = folder[0] / "siso" / "model.json"
    _, inputs, outputs, trained = read_linear(model)
    assert {s.name: s.terms for s in inputs} == {
        "volt": ((1.0, "a"), (-1.0, "b")),
        "load": ((1.0, "load"),),
    }
    assert [s.name for s in outputs] == ["speed", "temp"]
    assert trained == ("train1", "train2")
    alone = tmp_path / "model.json"
    alone.write_text(model.read_text())
    assert read_linear(alone)[1][0].terms == ((1.0, "volt"),)
    assert read_linear(alone, channels="volt=2*a")[1][0].terms == ((2.0, "a"),)
    with pytest.raises(FileFormatError, match="linear model"):
        read_linear(folder[0] / "siso" / "fit.json")


def test_bad_input_is_one_line(folder, tmp_path, capsys):
    out, train, _ = folder
    alone = tmp_path / "model.json"
    alone.write_text((out / "siso" / "model.json").read_text())
    common = ["--train", train[0], "--out", str(tmp_path / "o")]
    for arguments, text in (
        (["learn", str(alone), *common], "volt"),
        (["learn", str(out / "siso" / "model.json"), *common, "--inputs", "nonsense"], "nonsense"),
        (
            ["learn", str(out / "siso" / "model.json"), *common, "--inputs", "speed[t]"],
            "predicted instant",
        ),
        (
            ["learn", str(out / "siso" / "model.json"), *common, "--test", train[0]],
            "both train and test",
        ),
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err.strip().splitlines()
        assert len(error) == 1
        assert text in error[0]
