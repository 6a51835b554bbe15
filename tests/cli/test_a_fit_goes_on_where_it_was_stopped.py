"""`greybox fit` that was interrupted goes on at the solution that it was in: none is sought twice,
and the result is that of a fit that nobody stopped, to the last digit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from greybox.cli import main
from greybox.estimation.solver import Objective, Progress
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.estimation.status import Status
from greybox.journal import FILE
from greybox.plants.flight_log import write_log
from greybox.plants.vehicle_file import write_vehicle
from greybox.symbolic import FloatArray
from tests.automatic.craft import RATES, flown, plant

COLUMNS = ("t", "u1", "u2", "u3", "u4", *RATES)
TIMES = {"seconds", "command", "written", "created"}
solve = LevenbergMarquardt.solve


class Interrupted:
    """Solutions, of which the last of `most` is interrupted before it ends."""

    def __init__(self, patch: pytest.MonkeyPatch, most: float = float("inf")) -> None:
        self.count, self.most = 0, most
        told = self

        def counted(
            solver: LevenbergMarquardt,
            problem: Objective,
            start: FloatArray,
            progress: Progress | None = None,
        ) -> tuple[FloatArray, Status]:
            told.count += 1
            if told.count >= told.most:
                raise KeyboardInterrupt
            return solve(solver, problem, start, progress)

        patch.setattr(LevenbergMarquardt, "solve", counted)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command but for its folder."""
    folder = tmp_path_factory.mktemp("flights")
    (columns,) = flown((1,), 6.0)
    write_log(folder / "a.csv", {k: v for k, v in columns.items() if k in COLUMNS})
    write_vehicle(folder / "v.toml", plant(), sigma={"inertia": 0.2, "thrust.c2": 0.2})
    return ["fit", "--vehicle", str(folder / "v.toml"), "--train", str(folder / "a.csv"), "--out"]


def timeless(value: Any) -> Any:
    """Without what depends on the clock."""
    if isinstance(value, dict):
        return {k: timeless(v) for k, v in value.items() if k not in TIMES}
    return [timeless(v) for v in value] if isinstance(value, list) else value


def results(out: Path) -> list[Any]:
    names = ("fit.json", "model.json", "validate.json")
    return [timeless(json.loads((out / n).read_text())) for n in names if (out / n).exists()]


def test_no_solution_is_sought_twice(
    given: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    whole = Interrupted(monkeypatch)
    code = main([*given, str(tmp_path / "whole")])
    assert not (tmp_path / "whole" / FILE).exists()
    stopped = Interrupted(monkeypatch, whole.count - 1)
    assert main([*given, str(tmp_path / "out")]) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert "the same command goes on: greybox fit" in said
    more = Interrupted(monkeypatch)
    assert main([*given, str(tmp_path / "out")]) == code
    assert "going on where it was stopped, after" in capsys.readouterr().err
    assert more.count == whole.count - (stopped.count - 1) < whole.count
    assert results(tmp_path / "out") == results(tmp_path / "whole")
    assert not (tmp_path / "out" / FILE).exists()
