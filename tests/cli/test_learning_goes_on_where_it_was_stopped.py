"""`greybox learn` that was interrupted goes on at what it was at: nothing that had ended is done again,
and the result is that of a run that nobody stopped, to the last digit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from greybox.cli import main
from greybox.files import read_json
from greybox.journal import FILE
from greybox.plants.flight_log import write_log
from greybox.residual.files import save_model
from tests.residual.hybrid_cases import pendulum_model, swings

TIMES = {"seconds", "command"}
LONG = {
    "a process": "greybox.residual.candidates.train_gp",
    "weights": "greybox.residual.learn.fit_open_loop",
    "noise": "greybox.estimation.solvers.levenberg_marquardt.LevenbergMarquardt.solve",
}


def resolved(path: str) -> tuple[Any, str]:
    import importlib

    owner, _, name = path.rpartition(".")
    module, _, last = owner.rpartition(".")
    try:
        return importlib.import_module(owner), name
    except ModuleNotFoundError:
        return getattr(importlib.import_module(module), last), name


class Calls:
    """Counts calls of what takes long; the call `stop` of `what` is interrupted."""

    def __init__(self, patch: pytest.MonkeyPatch, what: str = "", stop: int = 0) -> None:
        self.made = dict.fromkeys(LONG, 0)
        for name, path in LONG.items():
            owner, attribute = resolved(path)
            real = getattr(owner, attribute)
            patch.setattr(owner, attribute, self._counted(name, real, stop if name == what else 0))

    def _counted(self, name: str, real: Callable[..., Any], stop: int) -> Callable[..., Any]:
        def call(*args: Any, **choices: Any) -> Any:
            self.made[name] += 1
            if self.made[name] == stop:
                raise KeyboardInterrupt
            return real(*args, **choices)

        return call


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command but for the learner and the folder."""
    folder = tmp_path_factory.mktemp("swings")
    train, logs = swings(3, 1, hidden=0.35, period=4.0, seconds=8.0), []
    for flight in train:
        (segment,) = flight.segments
        logs.append(str(folder / f"{flight.name}.csv"))
        write_log(logs[-1], {"t": segment.t, **segment.channels})
    save_model(replace(pendulum_model(), trained_on=train.names), folder / "model.json")
    return ["learn", str(folder / "model.json"), "--points", "6", "--train", *logs]


def timeless(value: Any) -> Any:
    """Without what depends on the clock."""
    if isinstance(value, dict):
        return {k: timeless(v) for k, v in value.items() if k not in TIMES}
    return [timeless(v) for v in value] if isinstance(value, list) else value


def results(out: Path) -> list[Any]:
    return [timeless(read_json(out / n)) for n in ("hybrid.json", "learn.json")]


@pytest.mark.parametrize(
    ("learner", "what", "stop", "again"),
    [
        ("gp", "a process", 2, {"a process": 1, "weights": 1, "noise": 1}),
        ("gp", "noise", 1, {"a process": 0, "weights": 0, "noise": 1}),
        ("random-features", "noise", 1, {"a process": 0, "weights": 0, "noise": 1}),
    ],
)
def test_what_had_ended_is_not_done_again(
    learner: str,
    what: str,
    stop: int,
    again: dict[str, int],
    given: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    line = [*given, "--learner", learner, "--out"]
    code = main([*line, str(tmp_path / "whole")])
    assert code in (0, 1) and not (tmp_path / "whole" / FILE).exists()
    with monkeypatch.context() as patch:
        Calls(patch, what, stop)
        assert main([*line, str(tmp_path / "out")]) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert "kept; the same command goes on: greybox learn" in said
    assert [p.name for p in (tmp_path / "out").iterdir()] == [FILE]
    with monkeypatch.context() as patch:
        more = Calls(patch)
        assert main([*line, str(tmp_path / "out")]) == code
    assert "going on where it was stopped, after" in capsys.readouterr().err
    assert more.made == again
    assert results(tmp_path / "out") == results(tmp_path / "whole")
    assert not (tmp_path / "out" / FILE).exists()
