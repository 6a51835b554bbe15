import argparse
import json
from importlib.resources import files

import jsonschema
import numpy as np
import pytest
from scipy.signal import lfilter

from greybox.commands import linear
from greybox.errors import GreyboxError
from greybox.model.linear import LinearModel
from scenarios.plants.linear_systems import random_system, simulate


def run(*words):
    parser = argparse.ArgumentParser()
    linear.add(parser.add_subparsers())
    arguments = parser.parse_args(["linear", *map(str, words)])
    return arguments.run(arguments)


def write(path, seed=0, count=900, dt=0.02, spoil=None, header="t,volt,flow,speed,temp"):
    truth = random_system(np.random.default_rng(1), 3, 2, 2)
    u, y = simulate(np.random.default_rng(seed), truth, count)
    table = np.column_stack([dt * np.arange(count), u, y + 3.0])
    if spoil is not None:
        table = spoil(table)
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.9g")
    return path


BOTH = ("--inputs", "volt,flow", "--outputs", "speed,temp")


def test_any_csv_with_a_time_column_gives_three_valid_files(tmp_path, capsys):
    a, b, c = (write(tmp_path / f"{n}.csv", i, 700 + 100 * i) for i, n in enumerate("abc"))
    code = run("--train", a, b, "--test", c, *BOTH, "--max-order", 4, "--out", tmp_path / "out")
    assert code == 0
    schema = files("greybox.schemas")
    fit = json.loads((tmp_path / "out/fit.json").read_text())
    jsonschema.validate(fit, json.loads((schema / "linear_fit.json").read_text()))
    model = json.loads((tmp_path / "out/model.json").read_text())
    jsonschema.validate(model, json.loads((schema / "linear_model.json").read_text()))
    assert fit["models"][0]["fit"]["order"] == 3
    assert LinearModel.load(tmp_path / "out/model.json").order == 3
    html = (tmp_path / "out/report.html").read_text()
    assert "Why this order" in html
    assert "free run" in html
    rows = fit["models"][0]["test"]["rows"]
    one = next(r for r in rows if r["horizon"] == 1)
    assert one["rmse"]["speed"] < 0.3 * one["persistence_rmse"]["speed"]
    assert "BIC" in capsys.readouterr().out


def test_siso_gives_one_model_per_output(tmp_path):
    a = write(tmp_path / "a.csv")
    assert run("--train", a, *BOTH, "--siso", "--order", 2, "--out", tmp_path / "out") in (0, 1)
    fit = json.loads((tmp_path / "out/fit.json").read_text())
    assert [m["name"] for m in fit["models"]] == ["linear-speed", "linear-temp"]


def test_a_channel_may_be_a_sum_of_columns(tmp_path):
    a = write(tmp_path / "a.csv")
    out = tmp_path / "out"
    code = run(
        "--train",
        a,
        "--inputs",
        "d=volt-0.5*flow",
        "--outputs",
        "speed",
        "--order",
        2,
        "--out",
        out,
    )
    assert code in (0, 1)
    assert json.loads((out / "fit.json").read_text())["inputs"][0]["terms"] == [
        [1.0, "volt"],
        [-0.5, "flow"],
    ]


def constant(table):
    table[:, 1] = 2.0
    return table


def dependent(table):
    table[:, 2] = 3 * table[:, 1]
    return table


def jump(table):
    table[300:, 0] -= 1.0
    return table


def blank(table):
    table[:, 3] = np.nan
    return table


BAD = [
    ("constant input", constant, BOTH, "constant"),
    ("rank-deficient inputs", dependent, BOTH, "linearly dependent"),
    ("time goes back", jump, BOTH, "time goes back"),
    ("empty output", blank, BOTH, "no value"),
    ("unknown column", None, ("--inputs", "volts", "--outputs", "speed"), "volts"),
    ("too short", lambda t: t[:12], (*BOTH, "--order", "6"), "few|short"),
    (
        "both in and out",
        None,
        ("--inputs", "volt,speed", "--outputs", "speed"),
        "both input and output",
    ),
    ("twice", None, ("--inputs", "volt,volt", "--outputs", "speed"), "twice"),
    ("order zero", None, (*BOTH, "--order", "0"), "--order"),
    ("order word", None, (*BOTH, "--order", "many"), "--order"),
    ("bad formula", None, ("--inputs", "a=volt**2", "--outputs", "speed"), "channel"),
    ("siso counts", None, ("--inputs", "volt", "--outputs", "speed,temp", "--siso"), "--siso"),
    ("bad delay", None, (*BOTH, "--delay", "1,2,3"), "--delay"),
    ("negative delay", None, (*BOTH, "--delay=-1"), "--delay"),
    ("bad horizon", None, (*BOTH, "--horizons", "0"), "--horizons"),
    (
        "two equal outputs",
        lambda t: np.column_stack([t[:, :4], t[:, 3]]),
        BOTH,
        "combination|without error|copies",
    ),
]


@pytest.mark.parametrize(("spoil", "words", "line"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_bad_input_is_one_clear_line_and_writes_nothing(tmp_path, spoil, words, line):
    a = write(tmp_path / "a.csv", spoil=spoil)
    extra = () if "--order" in words else ("--order", "2")
    with pytest.raises(GreyboxError, match=line) as error:
        run("--train", a, *words, *extra, "--out", tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_the_same_log_is_never_train_and_test(tmp_path):
    a = write(tmp_path / "a.csv")
    with pytest.raises(GreyboxError, match="both train and test"):
        run("--train", a, "--test", a, *BOTH, "--order", 2, "--out", tmp_path / "out")


def test_jittering_clock_and_missing_cells_are_taken_and_said(tmp_path):
    def spoil(table):
        rng = np.random.default_rng(0)
        table[:, 0] += 0.004 * rng.uniform(-1, 1, len(table))
        table[100:104, 3] = np.nan
        table[500, 1] = np.nan
        return table

    a = write(tmp_path / "a.csv", spoil=spoil)
    assert run("--train", a, *BOTH, "--order", 3, "--out", tmp_path / "out") in (0, 1)
    fit = json.loads((tmp_path / "out/fit.json").read_text())
    assert any("clock" in n for n in fit["notes"])


def test_profile_intervals_and_what_was_done_to_the_log_are_told(tmp_path, capsys):
    def spoil(table):
        table[500:502, 1] = np.nan
        return table

    a = write(tmp_path / "a.csv", spoil=spoil)
    assert run("--train", a, *BOTH, "--order", 3, "--profile", "--out", tmp_path / "out") == 0
    fit = json.loads((tmp_path / "out/fit.json").read_text())
    jsonschema.validate(fit, json.loads((files("greybox.schemas") / "linear_fit.json").read_text()))
    poles = [p for p in fit["models"][0]["fit"]["poles"] if p["imag"] >= 0]
    intervals = fit["models"][0]["profile_intervals"]
    assert len(intervals) == sum(1 if p["imag"] == 0 else 2 for p in poles)
    for i in intervals:
        assert i["lower"] < i["estimate"] < i["upper"]
    said = capsys.readouterr().out
    assert "profile interval" in said
    assert "note: a: 2 missing input samples held" in said
    assert "not used" not in said


def test_held_out_data_too_short_to_tell_orders_apart_have_no_say(tmp_path, capsys):
    """18 samples are two blocks, whose ranks can never say that an order is worse: order 1 of a
    damped oscillator was taken, with an unstable pole."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.choice([-1.0, 1.0], 12), 5)
    y = lfilter([0, 7.9e-4, 7.8e-4], [1, -1.9747, 0.97629], u) + 0.01 * rng.standard_normal(60)
    columns = np.column_stack([0.02 * np.arange(60), u, y])
    a = tmp_path / "a.csv"
    np.savetxt(a, columns, delimiter=",", header="t,u,y", comments="")
    run("--train", a, "--inputs", "u", "--outputs", "y", "--out", tmp_path / "out")
    choice = json.loads((tmp_path / "out/fit.json").read_text())["models"][0]["fit"]["order_choice"]
    assert choice["order"] == min(choice["table"], key=lambda r: r["bic"])["order"] == 2
    assert "too short to tell one order from another" in capsys.readouterr().out


def test_a_column_may_have_any_name(tmp_path):
    a = write(tmp_path / "a.csv", header="t,valve one,débit,speed (rpm),2nd")
    words = ("--inputs", "valve one,débit", "--outputs", "speed (rpm),2nd", "--order", 3)
    assert run("--train", a, *words, "--out", tmp_path / "out") == 0
    model = LinearModel.load(tmp_path / "out/model.json")
    assert model.inputs.names == ("valve one", "débit")
    with pytest.raises(GreyboxError, match="unknown column 'valve two'"):
        run("--train", a, "--inputs", "valve two", "--outputs", "2nd", "--out", tmp_path / "no")


def test_test_errors_say_where_they_are_those_of_the_start(tmp_path, capsys):
    """Noise on the output alone: the predictor of a slow plant never forgets its start."""
    for i, name in enumerate(("a", "b")):
        rng = np.random.default_rng(i)
        u = np.repeat(rng.choice([-1.0, 1.0], 40), 50)
        y = lfilter([0, 2e-3], [1, -0.998], u) + 1e-2 * rng.standard_normal(2000)
        columns = np.column_stack([0.02 * np.arange(2000), u, y + 2 * i])
        np.savetxt(tmp_path / f"{name}.csv", columns, delimiter=",", header="t,u,y", comments="")
    words = ("--train", tmp_path / "a.csv", "--test", tmp_path / "b.csv", "--inputs", "u")
    words = (*words, "--outputs", "y", "--order", 1, "--out", tmp_path / "out")
    run(*words)
    assert "errors may be those of unknown start states" in capsys.readouterr().out
    run(*words, "--adapt", 5)
    assert "errors may be those of unknown start states" not in capsys.readouterr().out
