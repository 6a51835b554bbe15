"""Rivals are carried on from where their first iterations led, against the best that these found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import pytest

from greybox.discovery.nested import OPENING, ROOM, ROUGH, Nest, Refit, Task
from greybox.estimation.options import FitOptions
from greybox.estimation.status import Code, Status

SAMPLES = 1000


def task(name: str, *, marginal: bool = False) -> Task:
    return Task(
        effects=(name,), model=cast(Any, None), options=FitOptions(free=()), starts=({},), marginal=marginal
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Scripted(Nest):
    """A nest whose fits end as `ends` says: effect -> (BIC, code) of every call in turn."""

    ends: Mapping[str, list[tuple[float, Code]]]
    bounds: tuple[str, ...] = ()
    asked: list[list[Task]] = field(default_factory=list)

    def refits(self, tasks: Sequence[Task]) -> list[Refit]:
        self.asked.append(list(tasks))
        out = []
        for t in tasks:
            bic, code = self.ends[t.effects[0]].pop(0)
            name = f"{t.effects[0]}.k"
            out.append(Refit(
                task=t, theta={(name, None): 1.0}, status=Status(code=code, iterations=1, evaluations=1, decrement=0.0),
                loglik=-0.5 * (bic - np.log(SAMPLES)), n_samples=SAMPLES, n_parameters=1,
                bounds=frozenset({name} if t.effects[0] in self.bounds else ()),
            ))  # fmt: skip
        return out


def nest(bounds: tuple[str, ...] = (), **ends: list[tuple[float, Code]]) -> Scripted:
    none = cast(Any, None)
    return Scripted(candidates=none, data=none, ends=ends, bounds=bounds)


def test_what_is_slow_goes_on_against_the_best() -> None:
    own = nest(
        fast=[(100.0, Code.CONVERGED), (100.0, Code.CONVERGED)],
        slow=[(900.0, Code.MAX_ITERATIONS), (890.0, Code.BEHIND)],
        close=[(300.0, Code.MAX_ITERATIONS), (120.0, Code.CONVERGED), (119.0, Code.CONVERGED)],
    )
    found = own.contest([task("fast"), task("slow"), task("close")])
    opening, onwards, exact = own.asked
    assert [(t.iterations, t.tolerance, t.target) for t in opening] == [(OPENING, ROUGH, np.inf)] * 3
    assert [t.effects for t in onwards] == [("slow",), ("close",)]
    for t in onwards:
        assert t.iterations == 60 - OPENING
        assert t.starts == ({(f"{t.effects[0]}.k", None): 1.0},)
        # BIC = 2 target + log N where the target is just reached.
        assert 2 * t.target + np.log(SAMPLES) == pytest.approx(100.0 + ROOM)
    assert [t.effects for t in exact] == [("fast",), ("close",)]
    assert [r.bic for r in found] == pytest.approx([100.0, 890.0, 119.0])
    assert [r.overtaken for r in found] == [False, True, False]


def test_what_ended_at_a_bound_gives_nobody_up() -> None:
    """It gets no name, and the next best may be slow."""
    own = nest(
        bounds=("edge",), edge=[(100.0, Code.CONVERGED)] * 2,
        slow=[(900.0, Code.MAX_ITERATIONS), (800.0, Code.CONVERGED), (800.0, Code.CONVERGED)],
    )  # fmt: skip
    own.contest([task("edge"), task("slow")], held=1000.0)
    assert 2 * own.asked[1][0].target + np.log(SAMPLES) == pytest.approx(1000.0 + ROOM)


def test_where_starts_are_paid_for_nobody_is_given_up() -> None:
    """The price of the start is known at the end."""
    own = nest(fast=[(100.0, Code.CONVERGED)] * 2, slow=[(900.0, Code.MAX_ITERATIONS), (800.0, Code.CONVERGED)])
    own.contest([task("fast"), replace(task("slow"), marginal=True)])
    assert own.asked[1][0].target == np.inf
