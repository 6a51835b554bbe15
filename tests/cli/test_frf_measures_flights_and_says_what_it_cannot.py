"""Claim: `greybox frf` goes from logs to frf.json, frf.csv and a page, with exit codes that tell; a
model lies over it."""

from __future__ import annotations

import csv
import json
from importlib import resources
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from greybox.cli import main
from greybox.examples import flight_path, vehicle_path
from tests.linear.test_frequency_responses_of_flights import linear_model
from tests.one_run import results_of_one_run
from tests.statistics.test_frequency_responses_have_honest_bands import DT, flown

SCHEMA = json.loads(resources.files("greybox.schemas").joinpath("frf.json").read_text())


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two records of a plain CSV, a noisy one, a short one, and the model of the plant."""
    folder = tmp_path_factory.mktemp("frf")
    for i, name in enumerate("ab"):
        u, y, _ = flown(i).T
        rows = np.column_stack([DT * np.arange(len(u)), 0.2 * u, y])
        np.savetxt(
            folder / f"{name}.csv", rows, delimiter=",", header="t,roll_command,p", comments=""
        )
    rows[:, 2] = np.random.default_rng(0).standard_normal(len(rows))
    np.savetxt(folder / "noise.csv", rows, delimiter=",", header="t,roll_command,p", comments="")
    np.savetxt(
        folder / "short.csv", rows[:200], delimiter=",", header="t,roll_command,p", comments=""
    )
    linear_model().save(folder / "model.json")
    return folder


def test_a_real_flight_in_a_closed_loop_gives_nothing_to_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    vehicle, log = str(vehicle_path("arpl_crazyflie")), str(flight_path("arpl_crazyflie", "log10"))
    command = [
        "frf",
        "--vehicle",
        vehicle,
        "--train",
        log,
        "--input",
        "roll",
        "--output",
        "p",
        "--rate",
        "250",
    ]
    with results_of_one_run(tmp_path, "frf.json", "frf.csv", "report.html"):
        assert main([*command, "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert said.startswith(
        "not measured: roll follows the outputs (a closed loop, or outputs with later samples), "
        "and no reference is named"
    )
    assert "warning: roll follows the outputs (a closed loop)" in said
    assert "not usable, the loop is closed" in said and "roll shows in p" not in said
    content = json.loads((tmp_path / "frf.json").read_text())
    jsonschema.validate(content, SCHEMA)
    pair = content["pairs"][0]
    assert content["closed_by"] == ["roll"] and not content["measured"]
    assert pair["form"] is None and not any(pair["usable"])
    assert max(pair["coherence"]) > 0.6, "coherence is no proof in a closed loop"
    rows = list(csv.DictReader((tmp_path / "frf.csv").read_text().splitlines()))
    assert len(rows) == len(content["frequency"]) and float(rows[3]["coherence"]) <= 1
    assert {r["usable"] for r in rows} == {"False"}
    page = (tmp_path / "report.html").read_text()
    assert page.count("<svg") == 1 and "p over roll" in page


def test_a_model_lies_over_the_flights(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["frf", "--model", f"{logs}/model.json", "--train", f"{logs}/a.csv", f"{logs}/b.csv"]
    assert main([*command, "--inputs", "roll=roll_command", "--out", str(tmp_path)]) == 0
    assert "the model is inside the 95 % circle at" in capsys.readouterr().out
    content = json.loads((tmp_path / "frf.json").read_text())
    jsonschema.validate(content, SCHEMA)
    assert content["model"] == "plant" and content["pairs"][0]["model"]["outside"].count(True) < 6


def test_no_coherence_is_exit_code_one(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = [
        "frf",
        "--train",
        f"{logs}/noise.csv",
        "--inputs",
        "roll_command",
        "--outputs",
        "p",
        "--out",
        str(tmp_path),
    ]
    assert main([*command, "--json", "-"]) == 1
    content = json.loads(capsys.readouterr().out)
    jsonschema.validate(content, SCHEMA)
    assert content["line"] == "not measured: no frequency has coherence above 0.6"
    assert "not measured" in (tmp_path / "report.html").read_text()


WRONG = {
    "nothing named": (["--train", "{b}/a.csv"], "which inputs and outputs?"),
    "a short flight": (
        ["--train", "{b}/short.csv", "--inputs", "roll_command", "--outputs", "p"],
        "too short: 4 s",
    ),
    "a column that is not there": (
        ["--train", "{b}/a.csv", "--inputs", "elevator", "--outputs", "p"],
        "'elevator'",
    ),
    "a mixed command without rotors": (
        ["--train", "{b}/a.csv", "--inputs", "pitch", "--outputs", "p"],
        "--vehicle V.toml",
    ),
    "a flight twice": (
        ["--train", "{b}/a.csv", "{b}/a.csv", "--inputs", "roll_command", "--outputs", "p"],
        "given twice",
    ),
    "no model file": (["--train", "{b}/a.csv", "--model", "{b}/a.csv"], "a.csv"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_done_is_one_line(
    case: str, logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words, said = WRONG[case]
    assert main(["frf", *(w.format(b=logs) for w in words), "--out", str(tmp_path / "out")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and said in lines[0] and lines[0].startswith("greybox frf:")
    assert not (tmp_path / "out").exists()
