"""A function that a controller calls at every sample, compiled and on arrays of its own, gives what
CasADi gives, whatever the form of its arguments, and no later call changes what it gave."""

from __future__ import annotations

import casadi as ca
import numpy as np

from mpc_export.tube.native import native


def test_it_gives_what_casadi_gives_and_gives_it_away() -> None:
    x, u, s = ca.SX.sym("x", 3), ca.SX.sym("u", 2, 4), ca.SX.sym("s")
    corner = ca.SX.sym("c", ca.Sparsity.lower(2))
    found = [s * x * u[1, 2], ca.jacobian(x[1] * u[0, 3] ** 2, x), corner + u[:, :2] @ corner]
    function = ca.Function("f", [x, u, s, corner], found)
    own, draw = native(function), np.random.default_rng(0)
    kept = []
    for _ in range(3):
        given = (draw.normal(size=3), draw.normal(size=(4, 2)).T, 2.0, draw.normal(size=(2, 2)))
        kept.append(
            (own(*given), [np.array(v) for v in function(*given[:3], ca.tril(ca.DM(given[3])))])
        )
    for ours, theirs in kept:
        for one, other in zip(ours, theirs, strict=True):
            assert one.shape == other.shape
            np.testing.assert_array_equal(one, other)
