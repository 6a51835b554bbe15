"""A choice of strengths is taken where it saves more than a trace of some group's squared error on
left-out folds, and more than chance would have it."""

from __future__ import annotations

import numpy as np

from greybox.residual.judgement import CHANCE
from greybox.residual.strengths import Judged, choose, worth

COST = np.array([100.0, 100.0])


def folds(gain: float, noise: float, count: int = 8) -> list[Judged]:
    """One weight whose gradient on every fold is that of the others, and noise."""
    rng = np.random.default_rng(3)
    slopes = -gain + noise * rng.standard_normal(count)
    return [
        Judged(
            left_hessian=np.array([[count - 1.0]]),
            left_gradient=np.array([slopes.sum() - s]),
            hessian=np.array([[[0.5]], [[0.5]]]),
            gradient=np.array([[s / 2], [s / 2]]),
            cost=COST / count,
        )
        for s in slopes
    ]


def chosen(found: list[Judged]) -> bool:
    strength, share = choose(found, COST, ("force.x",), (np.inf, 0.01, 1.0))
    assert np.isfinite(strength).all() == (share > 0)
    return bool(np.isfinite(strength).all())


def test_what_every_fold_gains_is_learned() -> None:
    assert chosen(folds(1.0, 0.1))


def test_a_trace_that_every_fold_gains_is_not() -> None:
    assert not chosen(folds(0.3, 0.0))


def test_one_group_that_gains_is_enough() -> None:
    saved = np.column_stack([np.full(8, 0.5), np.zeros(8)])
    assert worth(saved, np.tile(COST / 8, (8, 1)))
    assert not worth(0.4 * saved, np.tile(COST / 8, (8, 1)))


def test_folds_may_be_of_any_length() -> None:
    for lengths in ((10, 10, 10, 100), (10, 20, 40), (60, 20)):
        cost = np.outer(lengths, [1.0, 1.0])
        assert worth(0.3 * cost, cost), lengths


def test_of_two_folds_each_has_to_gain() -> None:
    cost = np.tile([50.0, 50.0], (2, 1))
    assert worth(np.array([[30.0, 30.0], [10.0, 10.0]]), cost)
    assert not worth(np.array([[30.0, 30.0], [-1.0, -1.0]]), cost)


def test_what_one_fold_of_many_gains_may_be_chance() -> None:
    saved = np.zeros((8, 2))
    saved[0] = 20.0
    assert not worth(saved, np.tile(COST / 8, (8, 1)))


def test_gains_without_a_preference_seldom_pass() -> None:
    rng = np.random.default_rng(1)
    passed = [
        worth(20 * rng.standard_normal((6, 2)), np.tile(COST / 6, (6, 1))) for _ in range(1000)
    ]
    assert np.mean(passed) < 1.3 * CHANCE
