"""What a learned push says of its own error holds for the push itself, on flights that nobody
fitted: errors of states ahead do not scale it, and a strong prior does not hide what it takes
away."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from greybox.residual.hybrid import HybridModel
from greybox.residual.learn import Learned, learn
from greybox.residual.open_loop_fit import _spread
from greybox.residual.open_loop_paths import Basis
from greybox.symbolic import Layout, Signal
from tests.residual.hybrid_cases import pendulum_model, swings

HIDDEN = 0.35


def learned(seed: int) -> Learned:
    train = swings(3, seed, hidden=HIDDEN, period=4.0)
    base = replace(pendulum_model(), trained_on=train.names, data_hash=train.hash)
    return learn(base, train, features=("angle", "rate"), points=12, seed=0)


def test_intervals_hold_the_hidden_torque() -> None:
    """-0.35 rate |rate| is hidden; on a faster drive the stated 95 % hold it. Scaled to the errors
    of the flights that the weights were fitted to they held 82 %."""
    inside = []
    for seed in (2, 3, 7):
        found = learned(seed)
        assert isinstance(found.model.dynamics, HybridModel)
        new = swings(2, seed + 500, hidden=HIDDEN, period=3.3, name="new")
        z = np.concatenate(
            [np.column_stack([f.segments[0].channels[n] for n in ("y", "w")]) for f in new]
        )
        mean, variance = found.model.dynamics.posterior.evaluate(z)
        error = mean[:, 0] + HIDDEN * z[:, 1] * np.abs(z[:, 1])
        inside.append(np.mean(np.abs(error) < 1.96 * np.sqrt(variance[:, 0])))
        # What is calibrated ahead is the noise.
        assert np.array_equal(variance, found.fit.posterior.evaluate(z)[1])
    assert np.mean(inside) > 0.9, inside


@pytest.mark.parametrize("strength", [0.125, 1.0, 30.0])
def test_a_prior_that_is_too_strong_is_in_the_spread(strength: float) -> None:
    """Weights of variance 4 in noise of factor 0.5, which a prior of strength 0.125 would suit:
    whatever strength is taken, mean square errors are as large as stated."""
    rng = np.random.default_rng(3)
    m, factor, tau = 40, 0.5, 2.0
    slopes = rng.standard_normal((m, m)) * np.geomspace(3.0, 0.03, m)
    hessian = slopes.T @ slopes
    basis = cast(
        Basis,
        SimpleNamespace(
            m=m,
            members=1,
            posterior=SimpleNamespace(outputs=Layout([Signal(name="force.x", unit="N")])),
        ),
    )
    told, true = [], []
    for _ in range(200):
        theta = tau * rng.standard_normal(m)
        seen = hessian @ theta + np.sqrt(factor) * slopes.T @ rng.standard_normal(m)
        found = np.linalg.solve(hessian + strength * np.eye(m), seen)
        covariance, before = _spread(
            hessian, found, basis, np.array([strength]), np.array([factor])
        )
        assert before[0] >= factor / strength
        told.append(np.trace(covariance))
        true.append(np.sum((found - theta) ** 2))
    assert np.mean(told) == pytest.approx(np.mean(true), rel=0.15)


def test_an_output_that_is_off_does_not_widen_the_other() -> None:
    """Two outputs that the flights hardly tell apart, the second off: nothing is free in it."""
    rng = np.random.default_rng(4)
    m, factor = 20, 0.5
    slopes = rng.standard_normal((2 * m, 2 * m)) * np.geomspace(3.0, 0.03, 2 * m)
    slopes[:, m:] += slopes[:, :m]
    hessian, found = slopes.T @ slopes, np.r_[rng.standard_normal(m), np.zeros(m)]
    names = ("force.x", "force.y")
    both, alone = (
        cast(
            Basis,
            SimpleNamespace(
                m=m,
                members=1,
                posterior=SimpleNamespace(
                    outputs=Layout([Signal(name=n, unit="N") for n in names[:k]])
                ),
            ),
        )
        for k in (2, 1)
    )
    covariance, before = _spread(
        hessian, found, both, np.array([1.0, np.inf]), np.array([factor, factor])
    )
    own, prior = _spread(hessian[:m, :m], found[:m], alone, np.array([1.0]), np.array([factor]))
    assert covariance[:m, :m] == pytest.approx(own)
    assert not covariance[m:].any() and not covariance[:, m:].any()
    assert before == pytest.approx([prior[0], 0.0])
