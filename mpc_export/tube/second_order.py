"""What the linear recursion of the tube leaves out: turns about two axes also turn about the third,
lift falls with the cosine of the tilt and grows with the square of the command.

The estimate moves about a plan that hovers as

    x_hat+ = f_d(x_hat, clip(u + K h)) boxplus w,    h = x_hat boxminus x,    w ~ N(0, W),

and the linear loop as l+ = (A + B K) l + w. From one ensemble of both, with the same w, comes the
correction of stage k,

    D_k = E[h h'] - E[l l'],     its positive part in units of the linear spread,

second moments about the plan, so that what moves the mean counts as well. It is a property of
model, gain and limits, found once at hover and added to the covariance at every plan: a control law
of 7 degrees rms about the level axes turns the vehicle by one degree about the third, which is more
than the linear loop says of the heading. (Monte Carlo in place of the second-order filter's
Gaussian closure, Jazwinski 1970, chapter 9: these terms stay alike over many stages.)
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from greybox.symbolic import FloatArray
from mpc_export.functions import ModelFunctions
from mpc_export.tube.problem import TubeProblem

DRAWS = 1000
"""Size of the ensemble: the correction's standard deviations are known to 3 or 4 %."""


def second_order(
    model: ModelFunctions,
    problem: TubeProblem,
    gain: FloatArray,
    fresh: FloatArray,
    steady: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """D (N + 1, n_d, n_d), zero at the first stage; gain K (n_u, n_d), fresh W (n_d, n_d), steady =
    (x, u) at hover.

    Draws are seeded; those that leave the model (not finite) do not count. Zero in the worst case,
    whose ellipsoids hold bounded disturbances of the linear loop.
    """
    n = len(fresh)
    found = np.zeros((problem.horizon + 1, n, n))
    if problem.kind == "worst case":
        return found
    x, u = steady
    _, a, b, _ = (v.full() for v in model["f_d_jac"](x, u, model.parameter_values))
    closed = a + b @ gain
    step = _step(model, problem, gain, steady).map(DRAWS)
    values, vectors = np.linalg.eigh(fresh)
    # The symmetric root does not depend on how a library chooses the eigenvectors of equal values.
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    rng = np.random.default_rng(0)
    state, linear = ca.repmat(ca.DM(x), 1, DRAWS), np.zeros((n, DRAWS))
    for k in range(1, problem.horizon + 1):
        w = root @ rng.standard_normal((n, DRAWS))
        state, away = step(state, w)
        h, linear = away.full(), closed @ linear + w
        whole = np.isfinite(h).all(axis=0)
        if whole.any():
            found[k] = _surplus(h[:, whole], linear[:, whole])
    return found


def _step(
    model: ModelFunctions,
    problem: TubeProblem,
    gain: FloatArray,
    steady: tuple[FloatArray, FloatArray],
) -> ca.Function:
    """(x_hat, w) -> (x_hat+, h+) of the closed loop about hover."""
    x, u = ca.DM(steady[0]), ca.DM(steady[1])
    state, w = ca.MX.sym("x", x.numel()), ca.MX.sym("w", gain.shape[1])
    command = u + ca.DM(gain) @ model["boxminus"](state, x)
    command = ca.fmin(ca.fmax(command, problem.command_min), problem.command_max)
    after = model["boxplus"](model["f_d"](state, command, model.parameter_values), w)
    return ca.Function("second_order_step", [state, w], [after, model["boxminus"](after, x)])


def _surplus(h: FloatArray, linear: FloatArray) -> FloatArray:
    """Positive part of E[h h'] - E[l l'], every row in units of the larger of its two spreads; zero
    where nothing moves."""
    size = np.sqrt(np.maximum((h**2).mean(axis=1), (linear**2).mean(axis=1)))
    unit = np.where(size > 0, size, 1.0)[:, None]
    h, linear = h / unit, linear / unit
    values, vectors = np.linalg.eigh((h @ h.T - linear @ linear.T) / h.shape[1])
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T * unit * unit.T)
