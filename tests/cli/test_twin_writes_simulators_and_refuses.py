"""greybox twin: what it writes, and one clear line for each kind of bad input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from greybox.cli import main
from greybox.model.verdict import Outcome, Verdict
from greybox.residual.files import save_model
from tests.simulators.identified import identified


def written(folder: Path, values: dict[str, float], outcome: Outcome | None = None) -> str:
    model = identified({"motor_lag.tau": 0.05, **values})
    if outcome is not None:
        verdict = Verdict(
            outcome=outcome,
            line="NOT USABLE: worse than holding the last value",
            useful_seconds=0.0,
            judged_seconds=1.0,
            judged_on="flights",
            flights=("a",),
            groups=(),
        )
        model = replace(model, verdict=verdict)
    path = folder / "model.json"
    save_model(model, path)
    return str(path)


def test_a_vehicle_file_alone_is_enough(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    vehicle = str(tmp_path / "v.toml")
    assert main(["vehicle", "new", "--template", "crazyflie", "--out", vehicle]) == 0
    assert main(["twin", vehicle, "--target", "rotorpy", "--out", str(tmp_path / "t")]) == 0
    said = capsys.readouterr()
    assert "no flight was fitted" in said.err
    assert "RotorPy" in said.out
    assert (tmp_path / "t" / "rotorpy" / "vehicle.py").exists()


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"inertia.zz": 1.0}, "no body has the principal moments"),
        ({"inertia.xx": -0.01}, "no body has the principal moments"),
        ({"thrust.c2": -1.0}, "cannot hover"),
    ],
)
def test_what_no_body_is_like_is_refused_in_one_line(
    values: dict[str, float], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, values)
    assert main(["twin", path, "--target", "rotorpy", "--out", str(tmp_path / "t")]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert line in said[-1]
    assert not (tmp_path / "t").exists()


def test_an_unknown_target_gets_the_nearest_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, {})
    assert main(["twin", path, "--target", "mujocco", "--out", str(tmp_path / "t")]) == 2
    assert "did you mean mujoco" in capsys.readouterr().err


def test_a_model_that_is_not_usable_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, {}, Outcome.NOT_USABLE)
    out = str(tmp_path / "t")
    assert main(["twin", path, "--target", "rotorpy", "--out", out]) == 1
    assert "--even-so" in capsys.readouterr().err
    assert not Path(out).exists()
    assert main(["twin", path, "--target", "rotorpy", "--out", out, "--even-so"]) == 0
