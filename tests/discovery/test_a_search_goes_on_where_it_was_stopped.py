"""A search that was stopped at any of its fits goes on from there: no fit is done twice, and the
result is that of a search that was not stopped, to the last digit."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from greybox.discovery import evidence
from greybox.discovery.evidence import Solution, Task
from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from greybox.estimation.problem import Problem
from greybox.files import dump_json
from greybox.journal import kept_in
from tests.discovery import small_world
from tests.discovery.small_world import DAMPING, shorten, vehicle

GIVEN = {"flights": "damped"}
solution = evidence.solution


@pytest.fixture(scope="module", autouse=True)
def short() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        yield


class Interrupted:
    """Fits, of which the last of `most` is interrupted before it ends."""

    def __init__(self, patch: pytest.MonkeyPatch, most: float = float("inf")) -> None:
        self.count, self.most = 0, most
        patch.setattr(evidence, "solution", self)

    def __call__(self, problem: Problem, task: Task) -> Solution:
        self.count += 1
        if self.count >= self.most:
            raise KeyboardInterrupt
        return solution(problem, task)


def searched(**how: Any) -> Discovery:
    return discover(
        vehicle(),
        small_world.flown(DAMPING),
        small_world.flown(DAMPING, seeds=(11,), name="test"),
        **how,
    )


def told(found: Discovery) -> str:
    """All of a result but how long it took."""
    model = found.model.to_dict()
    return dump_json({**found.to_dict(), "seconds": 0.0}) + dump_json(model)


@pytest.fixture(scope="module")
def whole() -> tuple[str, int]:
    """What a search says that was not stopped, and how many fits it did."""
    with pytest.MonkeyPatch.context() as patch:
        fits = Interrupted(patch)
        return told(searched()), fits.count


@pytest.mark.parametrize(
    "share", [pytest.param(s, marks=pytest.mark.slow) for s in (0.0, 0.2, 0.6, 1.0)]
)
def test_no_fit_is_done_twice_and_nothing_else_comes_out(
    share: float, whole: tuple[str, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected, count = whole
    most = 1 + round(share * (count - 1))
    stopped = Interrupted(monkeypatch, most)
    with pytest.raises(KeyboardInterrupt), kept_in(tmp_path / "j", GIVEN):
        searched()
    assert stopped.count == most
    more = Interrupted(monkeypatch)
    with kept_in(tmp_path / "j", GIVEN):
        assert told(searched()) == expected
    assert more.count == count - (most - 1)
    assert not list(tmp_path.iterdir())


def test_fits_side_by_side_are_kept_one_by_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = [(frozenset({n}), ()) for n in ("gyro_bias", "rotational_damping")]
    expected = [f.known for f in small_world.damped().fits(asked, [0.1, 0.1])]
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        flights, _ = small_world.damped(), Interrupted(monkeypatch, 2)
        flights.executor = pool
        with pytest.raises(KeyboardInterrupt), kept_in(tmp_path / "j", GIVEN):
            flights.fits(asked, [0.1, 0.1])
    fits = Interrupted(monkeypatch)
    with kept_in(tmp_path / "j", GIVEN):
        assert [f.known for f in small_world.damped().fits(asked, [0.1, 0.1])] == expected
    assert fits.count == 1
