"""Features that are made again from half of the flights may be more or fewer, and are judged all
the same."""

from __future__ import annotations

import numpy as np

from greybox.residual.strengths import Judged, choose


def half(features: int, outputs: int, seed: int) -> Judged:
    """Quadratic cost of weights whose gain is in the first feature of every output."""
    size = features * outputs
    gradient = np.zeros(size)
    gradient[::features] = -3.0
    rng = np.random.default_rng(seed)
    root = 0.1 * rng.normal(size=(size, size))
    hessian = np.eye(size) + root @ root.T
    return Judged(
        left_hessian=hessian,
        left_gradient=gradient,
        hessian=hessian[None],
        gradient=gradient[None],
        cost=np.array([20.0]),
    )


def test_a_law_of_three_terms_beside_one_of_two_gains_what_both_gain():
    outputs = ("force.x", "force.y")
    cost = np.array([40.0])
    alike, share = choose([half(2, 2, 0), half(2, 2, 1)], cost, outputs, (np.inf, 0.01, 1.0))
    other, mixed = choose([half(3, 2, 0), half(2, 2, 1)], cost, outputs, (np.inf, 0.01, 1.0))
    assert np.isfinite(alike).all() and (other == alike).all()
    assert 0.5 * share < mixed <= 1.0
