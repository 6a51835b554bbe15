"""How far from hover the linear tube may be trusted.

Craft are put away from hover, one by one in tilt, speed or rate, then in all of them, in DRAWS
directions. Under hover's command the model flies them through a plan's stages, and so does its
transition at hover. Where place or tilt of the two come apart by TRUSTED standard deviations of the
tube (Mahalanobis) the prediction counts as lost: the tube no longer says where the craft will be.
"""

from __future__ import annotations

import numpy as np

from greybox.symbolic import FloatArray
from mpc_export.tube.controller import TubeController
from mpc_export.tube.stages import block

TRUSTED = 1.0
"""Standard deviations of the tube by which the prediction of a craft near hover may miss."""
DRAWS = 32
"""Directions in which a craft is put away from hover."""
FARTHEST = 10.0
"""No deviation beyond this is looked at [rad, m/s, rad/s]."""


def trusted(pilot: TubeController, a: FloatArray, total: FloatArray) -> FloatArray:
    """Tilt [rad], speed [m/s] and rate [rad/s] (3,) away from hover, each alone, up to which the
    prediction misses by no more than TRUSTED; together where the sum of squares of tilt, speed and
    rate over these is at most 1. a: transition (n_d, n_d); total: the tube (N + 1, n_d, n_d)."""
    f, rng = pilot.functions, np.random.default_rng(0)
    at = [block(f, v, error=True) for v in ("attitude", "velocity", "rate")]
    at[0] = at[0][:2]
    alone = []
    for rows in at:
        d = np.zeros((len(f.error_states), DRAWS))
        d[rows] = rng.standard_normal((len(rows), DRAWS))
        alone.append(_reach(pilot, a, total, d / np.linalg.norm(d, axis=0)))
    d = np.zeros((len(f.error_states), DRAWS))
    own = np.concatenate(at)
    d[own] = rng.standard_normal((len(own), DRAWS))
    d /= np.linalg.norm(d, axis=0)
    for rows, reach in zip(at, alone, strict=True):
        d[rows] *= reach
    return np.array(alone) * min(1.0, _reach(pilot, a, total, d))


def _reach(pilot: TubeController, a: FloatArray, total: FloatArray, d: FloatArray) -> float:
    """Largest multiple, at most FARTHEST, of the deviations d (n_d, draws) at which no prediction
    misses by more than TRUSTED."""
    f, (x, u) = pilot.functions, pilot.solver.stages.steady
    n = d.shape[1]
    step, moved, away = (f[v].map(n) for v in ("f_d", "boxplus", "boxminus"))
    hover, held, p = (np.tile(np.asarray(v)[:, None], (1, n)) for v in (x, u, f.parameter_values))
    place, tilt = block(f, "position", error=True), block(f, "attitude", error=True)[:2]

    def missed(by: float) -> float:
        y, linear, most = moved(hover, by * d), by * d, 0.0
        for k in range(1, pilot.problem.horizon + 1):
            y, linear = step(y, held, p), a @ linear
            off = away(y, hover).full() - linear
            for rows in (place, tilt):
                e = off[rows]
                size = (e * np.linalg.solve(total[k][np.ix_(rows, rows)], e)).sum(axis=0)
                most = max(most, float(np.sqrt(size.max())))
        return most if np.isfinite(most) else np.inf

    low, high = 0.0, FARTHEST
    if missed(high) <= TRUSTED:
        return high
    for _ in range(12):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if missed(middle) <= TRUSTED else (low, middle)
    return low
