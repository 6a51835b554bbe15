"""An hour of sensitivities does not fit into memory: the predictor hands out pieces, and no number
changes."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pytest

from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.criteria.robust import Robust
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import Block, Problem, make_problem
from greybox.model.model import build_model
from tests.simulated import flights, vehicle


def gappy() -> Dataset:
    """Two flights with missing cells, so that there are several patterns and gains."""
    rng = np.random.default_rng(0)
    whole = flights(2)
    out = None
    for flight in whole:
        segment = flight.segments[0]
        columns = {n: v.copy() for n, v in segment.channels.items()}
        for name in ("ax", "p", "x"):
            columns[name][rng.random(segment.n) < 0.05] = np.nan
        one = dataset_from_arrays(segment.t, columns, name=flight.name)
        out = one if out is None else out + one
    assert out is not None
    return out


def problem(data: Dataset, predictor: Innovation, criterion: Gaussian | None = None) -> Problem:
    model = build_model(vehicle(), data.channels, ("rotor_drag",))
    return make_problem(model, data, predictor=predictor, criterion=criterion or Gaussian())


@pytest.mark.parametrize("criterion", [Gaussian(), Robust()], ids=["gaussian", "robust"])
def test_pieces_add_up_to_the_whole(criterion: Gaussian):
    data = gappy()
    whole = problem(data, Innovation(), criterion)
    theta = np.array([u.start for u in whole.unknowns])
    # A piece ends with a stretch of the scores, and in the middle of nothing else.
    one = whole.evaluate(theta, scores=50)
    many = problem(data, Innovation(piece=150), criterion).evaluate(theta, scores=50)
    for name in ("cost", "gradient", "hessian", "scores"):
        expected, got = np.asarray(getattr(one, name)), np.asarray(getattr(many, name))
        assert got == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max()), name


@dataclass(frozen=True, kw_only=True)
class Watched(Innovation):
    """Notes how much memory is in use whenever a block is handed out."""

    def blocks(self, problem: Problem, theta: np.ndarray, jacobian: bool) -> Iterable[Block]:
        for block in super().blocks(problem, theta, jacobian):
            SEEN.append(tracemalloc.get_traced_memory()[0])
            yield block


SEEN: list[int] = []


def repeated(times: int) -> Dataset:
    """One long record."""
    segment = flights(1)[flights(1).names[0]].segments[0]
    n = segment.n * times
    return dataset_from_arrays(
        segment.t[0] + np.arange(n) * 0.01,
        {c: np.tile(v, times) for c, v in segment.channels.items()},
        name="long",
    )


@pytest.mark.slow
def test_memory_does_not_grow_with_the_length():
    peak = {}
    for times in (4, 16):
        long = problem(repeated(times), Watched(piece=400))
        theta = np.array([u.start for u in long.unknowns])
        SEEN.clear()
        tracemalloc.start()
        value = long.evaluate(theta)
        tracemalloc.stop()
        assert value.valid
        assert len(SEEN) == 2 * times
        peak[times] = max(SEEN)
    assert peak[16] < 1.3 * peak[4]
