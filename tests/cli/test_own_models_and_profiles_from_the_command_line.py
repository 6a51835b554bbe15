"""Claim: a user's own model needs no vehicle anywhere; what a command cannot do with it is one line
and exit code 2."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from importlib import resources
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import greybox as gb
from greybox.cli import main
from greybox.commands import front_door
from greybox.commands.front_door import profile
from greybox.commands.ulog_out import write_ulog
from greybox.data import Segment
from greybox.estimation.profile import Profile
from greybox.estimation.result import Fit
from greybox.model.dynamics import StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.parameter import Parameter, ParameterValues
from greybox.symbolic import Layout, Signal
from tests.one_run import results_of_one_run
from tests.validation.test_validate_judges_causally import dataset

PROGRAM = """
import greybox as gb
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.symbolic import Layout, Signal
S = Layout([Signal(name="level", unit="m")])
def build():
    return StateSpaceModel(
        name="tank", states=S, outputs=S, inputs=Layout([Signal(name="pump", unit="V")]),
        parameters=(Parameter(name="gain", unit="m/(V s)", nominal=0.1, lower=0.0, scale=0.1),
                    Parameter(name="leak", unit="1/s", nominal=0.2, lower=0.0, scale=0.1)),
        dynamics=lambda t, x, u, p: [p["gain"] * u[0] - p["leak"] * x[0]], measurement=lambda t, x, u, p: [x[0]],
        sensor_sigma={"level": 0.01},
    )
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tank")
    (folder / "tank.py").write_text(PROGRAM)
    rng = np.random.default_rng(0)
    for name in ("a", "b"):
        pump = np.repeat(rng.uniform(0, 2, 20), 20)
        level, rows = 0.0, []
        for k, u in enumerate(pump):
            rows.append((0.1 * k, u, level + 0.01 * rng.standard_normal()))
            level += 0.1 * (0.3 * u - 0.5 * level)
        np.savetxt(folder / f"{name}.csv", rows, delimiter=",", header="t,pump,level", comments="")
    fit = [
        "fit",
        "--model-file",
        f"{folder}/tank.py:build",
        "--train",
        f"{folder}/a.csv",
        "--test",
        f"{folder}/b.csv",
    ]
    with results_of_one_run(
        folder / "fit", "report.html", "validate.json", "fit.json", "model.json"
    ):
        assert main(["--quiet", *fit, "--out", f"{folder}/fit"]) == 0
    return folder


def test_the_fit_is_judged_on_the_test_record_and_comes_back_by_load(bench: Path) -> None:
    content = json.loads((bench / "fit" / "fit.json").read_text())
    assert content["verdict"]["outcome"] == "usable"
    assert content["verdict"]["judged_on"].startswith("flights that it was not")
    assert abs(content["parameters"]["leak"]["value"] - 0.5) < 0.03
    assert (bench / "fit" / "report.html").read_text().count("level") > 3
    model = gb.load(bench / "fit" / "model.json")
    assert isinstance(model, IdentifiedModel) and model.name == "tank"


def test_flight_review_is_refused_a_tank_in_one_line_before_any_work(
    bench: Path, capsys: pytest.CaptureFixture[str]
):
    words = [
        "validate",
        f"{bench}/fit/model.json",
        "--log",
        f"{bench}/none_such.csv",
        "--ulog",
        f"{bench}/b.ulg",
    ]
    assert main(words) == 2
    said = capsys.readouterr().err.strip()
    assert "Flight Review draws none of this model's outputs" in said and "level" in said
    assert len(said.splitlines()) == 1 and not (bench / "b.ulg").exists()


def test_a_spinning_body_without_numbered_commands_has_rates_and_no_motors(tmp_path: Path):
    pyulog = pytest.importorskip("pyulog")
    rates = Layout([Signal(name=n, unit="rad/s") for n in "pqr"])
    dynamics = StateSpaceModel(
        name="top",
        states=rates,
        outputs=rates,
        inputs=Layout([Signal(name="push", unit="rad/s^2")]),
        parameters=(Parameter(name="drag", unit="1/s", nominal=0.5, scale=0.1),),
        dynamics=lambda t, x, u, p: [u[0] - p["drag"] * x[i] for i in range(3)],
        measurement=lambda t, x, u, p: [x[i] for i in range(3)],
        noise_states=("p", "q", "r"),
    )
    model = IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues({"drag": 0.5}),
        process_noise=np.ones(3),
        sensor_noise=np.full(3, 0.1),
        weak=np.full(3, 1e4),
        reference_state=np.zeros(3),
        reference_inputs=np.zeros(1),
        sample_time=0.01,
        flight_spread={},
        per_flight={},
    )
    channels = {n: np.sin(0.01 * np.arange(200) + i) for i, n in enumerate(("p", "q", "r", "push"))}
    write_ulog(
        tmp_path / "top.ulg",
        model,
        dataset(Segment(t=0.01 * np.arange(200), channels=channels, flight="f")),
    )
    topics = {d.name for d in pyulog.ULog(str(tmp_path / "top.ulg")).data_list}
    assert topics == {"vehicle_angular_velocity", "vehicle_angular_velocity_groundtruth"}


def test_a_level_is_held_inside_its_limits(
    bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The limit is what is asked for: half of all plans would pass it."""
    words = ["mpc", f"{bench}/fit/model.json", "--model-file", f"{bench}/tank.py:build"]
    words += ["--hold", "level=0.4,0.6", "--limit", "level=0,0.6", "--range", "pump=0,2"]
    words += ["--flights", "2", "--horizon", "8", "--seconds", "10", "--out", str(tmp_path)]
    assert main(words) == 0
    content = json.loads((tmp_path / "mpc_own.json").read_text())
    schema = (resources.files("greybox.schemas") / "mpc_own.json").read_text()
    jsonschema.validate(content, json.loads(schema))
    found = content["controllers"]
    assert found["mean"]["beyond"]["count"] == 2 and found["tube"]["beyond"]["count"] == 0
    assert found["tube"]["settled"]["level"] < 0.05 and not found["tube"]["failures"]
    assert content["verdict"] in capsys.readouterr().out
    page = (tmp_path / "report.html").read_text()
    assert ET.fromstring(page[len("<!DOCTYPE html>") :]) is not None and page.count("<svg") == 2
    rows = (tmp_path / "flights.jsonl").read_text()
    assert main(words) == 0
    assert (tmp_path / "flights.jsonl").read_text() == rows
    assert json.loads((tmp_path / "mpc_own.json").read_text()) == content


def test_profiles_give_intervals_with_the_truth_inside(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = [
        "profile",
        f"{bench}/fit/model.json",
        "--train",
        f"{bench}/a.csv",
        "--of",
        "leak,gain",
        "--out",
        f"{bench}/p",
    ]
    assert main(model) == 0
    assert "leak: 0." in capsys.readouterr().out
    found = {
        p["name"]: p for p in json.loads((bench / "p" / "profile.json").read_text())["profiles"]
    }
    # The simulated step is Euler's, the model's Runge-Kutta's: rates differ by a little.
    assert found["leak"]["lower"] < 0.513 and found["leak"]["upper"] > 0.5
    assert (
        found["leak"]["lower"] < found["leak"]["estimate"] < found["leak"]["upper"]
        and not found["leak"]["at_bound"]
    )
    assert (
        main([*model[:2], "--train", f"{bench}/b.csv", "--of", "leak", "--out", f"{bench}/p"]) == 2
    )
    assert "not the flights of the fit" in capsys.readouterr().err


def test_profiles_that_were_stopped_go_on(
    bench: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["profile", f"{bench}/fit/model.json", "--train", f"{bench}/a.csv", "--of", "leak,gain"]
    assert main([*words, "--out", f"{bench}/whole"]) == 0

    def stopped(fit: Fit, name: str, **how: float) -> Profile:
        if name == "gain":
            raise KeyboardInterrupt
        return profile(fit, name, **how)

    with monkeypatch.context() as patch:
        patch.setattr(front_door, "profile", stopped)
        assert main([*words, "--out", f"{bench}/q"]) == 130
    assert "fits kept; the same command goes on: greybox profile" in capsys.readouterr().err
    assert main([*words, "--out", f"{bench}/q"]) == 0
    assert "going on where it was stopped" in capsys.readouterr().err
    whole, again = (json.loads((bench / n / "profile.json").read_text()) for n in ("whole", "q"))
    assert again["profiles"] == whole["profiles"]
    assert {p.name for p in (bench / "q").iterdir()} == {"profile.json", "report.html"}


def test_planned_inputs_keep_ranges_and_limits(
    bench: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = [
        "--quiet",
        "plan",
        "--model",
        f"{bench}/fit/model.json",
        "--range",
        "pump=0,2",
        "--limit",
        "level=-1,1",
    ]
    assert main([*plan, "--seconds", "1e9", "--out", f"{bench}/plan"]) == 2
    assert "too long an experiment; expected 20 samples <= " in capsys.readouterr().err
    assert main([*plan, "--seconds", "40", "--piece", "10", "--out", f"{bench}/plan"]) == 0
    columns = np.genfromtxt(bench / "plan" / "experiment_1.csv", delimiter=",", names=True)
    assert (
        columns["pump"].min() >= 0 and columns["pump"].max() <= 2 and np.ptp(columns["pump"]) > 0.5
    )
    assert columns["level"].max() <= 1.0 and len(columns) == 400
    content = json.loads((bench / "plan" / "plan.json").read_text())
    assert content["efficiency"] > 0.8 and all(
        p["std"] < 0.01 for p in content["parameters"].values()
    )


HOLD = ("--hold", "level=0.4")
WRONG = {
    "fit without a model": (["fit", "--train", "{b}/a.csv"], "one of --vehicle and --model-file"),
    "effects on an own model": (
        [
            "fit",
            "--model-file",
            "{b}/tank.py:build",
            "--effects",
            "motor_lag",
            "--train",
            "{b}/a.csv",
        ],
        "for vehicles",
    ),
    "a log without its columns": (
        ["validate", "{b}/fit/model.json", "--log", "{b}/c.csv"],
        "unknown column 'level'",
    ),
    "another program": (
        [
            "validate",
            "{b}/fit/model.json",
            "--log",
            "{b}/a.csv",
            "--model-file",
            "{b}/other.py:build",
        ],
        "is not the model",
    ),
    "no range": (
        ["plan", "--model-file", "{b}/tank.py:build", "--rate", "10"],
        "no range of the input pump",
    ),
    "an effect of vehicles": (
        [
            "discover",
            "--model-file",
            "{b}/tank.py:build",
            "--train",
            "{b}/a.csv",
            "--kinematic-noise",
        ],
        "a parameter with a null",
    ),
    "two models": (
        [
            "discover",
            "--vehicle",
            "V.toml",
            "--model-file",
            "{b}/tank.py:build",
            "--train",
            "{b}/a.csv",
        ],
        "one of --vehicle, --model-file and --from",
    ),
    "nothing to hold": (["mpc", "{b}/fit/model.json"], "needs something to hold"),
    "a course": (
        ["mpc", "{b}/fit/model.json", *HOLD, "--pace", "2"],
        "--pace belongs to a vehicle",
    ),
    "an output that is none": (["mpc", "{b}/fit/model.json", "--hold", "lebel=1"], "level"),
    "a value beyond its limit": (
        ["mpc", "{b}/fit/model.json", *HOLD, "--limit", "level=0,0.3"],
        "--hold level asks for what --limit forbids",
    ),
    "a range that is none": (
        ["mpc", "{b}/fit/model.json", *HOLD, "--range", "pump=2,1"],
        "--range pump",
    ),
    "one output held twice": (
        ["mpc", "{b}/fit/model.json", *HOLD, "level=0.5"],
        "--hold names level more than once",
    ),
    "one range twice": (
        ["mpc", "{b}/fit/model.json", *HOLD, "--range", "pump=0,2", "pump=0,1"],
        "--range names pump more than once",
    ),
    "control by another program": (
        ["mpc", "{b}/fit/model.json", *HOLD, "--model-file", "{b}/other.py:build"],
        "is not the model of this file",
    ),
    "a place": (
        ["learn", "{b}/fit/model.json", "--train", "{b}/a.csv", "--place"],
        "feature of vehicles",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_done_is_one_line(
    case: str, bench: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (bench / "c.csv").write_text("t,pump\n0,1\n0.1,1\n0.2,1\n0.3,1\n")
    (bench / "other.py").write_text(PROGRAM.replace("nominal=0.1", "nominal=0.2"))
    (bench / "other.py").write_text(PROGRAM.replace("0.1, lower", "0.15, lower"))
    words, said = WRONG[case]
    out = [] if words[0] == "validate" else ["--out", str(tmp_path / "out")]
    assert main([*(w.format(b=bench) for w in words), *out]) == 2
    line = capsys.readouterr().err.strip().splitlines()
    assert said in line[-1] and line[-1].startswith(f"greybox {words[0]}:")
    assert not (tmp_path / "out").exists()
