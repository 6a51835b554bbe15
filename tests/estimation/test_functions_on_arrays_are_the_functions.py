"""A function that keeps the arrays it reads and writes gives what a call of it gives, with sparse
results and arguments of no length among them."""

from __future__ import annotations

import casadi as ca
import numpy as np

from greybox.symbolic import OnArrays


def test_results_are_those_of_a_call_whatever_was_asked_before() -> None:
    x, u, none = ca.SX.sym("x", 3), ca.SX.sym("u", 2, 4), ca.SX.sym("p", 0)
    found = [x * u[1, 2], ca.sparsify(ca.jacobian(x[1] * u[0, 3] ** 2, ca.vertcat(x, ca.vec(u))))]
    function = ca.Function("f", [x, u, none], [*found, ca.SX(0, 2)])
    own, draw = OnArrays(function), np.random.default_rng(0)
    for _ in range(3):
        a, b = draw.normal(size=3), draw.normal(size=(2, 4))
        results = own(a, b.ravel(order="F"), np.zeros(0))
        for ours, theirs in zip(results, function(a, b, ca.DM(0, 1)), strict=True):
            assert ours.shape == theirs.shape
            np.testing.assert_array_equal(ours, theirs.full())
