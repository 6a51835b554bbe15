"""`greybox compare` that was interrupted goes on with the method that it was at: none that has ended
is trained again, nor the fit that several share, and the table is that of a run that nobody
stopped."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from greybox.baselines import compare
from greybox.baselines.compare_bench import Bench, Outcome
from greybox.baselines.compare_methods import METHODS
from greybox.cli import main
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.journal import FILE
from greybox.plants.flight_log import write_log
from greybox.plants.vehicle_file import write_vehicle
from tests.automatic.craft import RATES, flown, plant

COLUMNS = ("t", "u1", "u2", "u3", "u4", *RATES)
CHOSEN = ("persistence", "linear SISO PEM", "LSTM", "nonlinear PEM")
TIMED = ("train_seconds", "microseconds_per_sample")


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command but for its folder."""
    folder = tmp_path_factory.mktemp("flights")
    for columns, name in zip(flown((0, 1), 5.0), "ab", strict=True):
        write_log(folder / f"{name}.csv", {k: v for k, v in columns.items() if k in COLUMNS})
    write_vehicle(folder / "v.toml", plant(), sigma={"inertia": 0.2, "thrust.c2": 0.2})
    train, test, vehicle = (str(folder / n) for n in ("a.csv", "b.csv", "v.toml"))
    words = ["compare", "--vehicle", vehicle, "--train", train, "--test", test]
    return [*words, "--methods", ",".join(CHOSEN), "--max-iterations", "3", "--adapt", "0", "--out"]


class Counted:
    """The methods of a comparison, of which "LSTM" only asks for the fitted model, and is
    interrupted after that as long as `stops`."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.ran, self.solved, self.stops = list[str](), 0, True
        solve = LevenbergMarquardt.solve

        def solved(solver: LevenbergMarquardt, *rest: Any, **more: Any) -> Any:
            self.solved += 1
            return solve(solver, *rest, **more)

        patch.setattr(LevenbergMarquardt, "solve", solved)
        patch.setattr(compare, "METHODS", {n: self.counted(n) for n in METHODS})

    def counted(self, name: str) -> Any:
        def method(bench: Bench) -> Outcome:
            self.ran.append(name)
            if name != "LSTM":
                return METHODS[name](bench)
            model, seconds = bench.physics
            if self.stops:
                raise KeyboardInterrupt
            return bench.physical(model, seconds, settings={})

        return method


def table(folder: Path) -> list[dict[str, Any]]:
    rows = json.loads((folder / "compare.json").read_text())["methods"]
    assert [r["status"] for r in rows] == ["done"] * len(CHOSEN)
    return [{k: v for k, v in r.items() if k not in TIMED} for r in rows]


def test_what_has_ended_is_not_done_again(
    given: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, counted = tmp_path / "out", Counted(monkeypatch)
    assert main([*given, str(out)]) == 130
    said = capsys.readouterr().err
    assert "2 of 4 methods are in" in said and "the same command goes on: greybox compare" in said
    assert counted.ran == list(CHOSEN[:3]) and counted.solved == 1
    counted.ran, counted.stops = [], False
    assert main([*given, str(out)]) == 0
    assert "going on where it was stopped" in capsys.readouterr().err
    assert counted.ran == list(CHOSEN[2:]) and counted.solved == 1
    assert not (out / FILE).exists()
    whole = tmp_path / "whole"
    assert main([*given, str(whole)]) == 0
    assert table(out) == table(whole)
