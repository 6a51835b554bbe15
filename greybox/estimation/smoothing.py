"""Fixed-interval smoothing with the identified stationary filter: states given the whole flight.

Backward recursion of the adjoint (Bryson and Frazier 1963; in the form for correlated process and
measurement noise de Jong 1989, JASA 84(408), eq. 2.8), with the linearisation at every predicted
state:

    r[k-1] = C' S^-1 e[k] + (A - K C)' r[k],          d_s[k] = P r[k-1]
    N[k-1] = C' S^-1 C + (A - K C)' N[k] (A - K C),   V[k] = P - P N[k-1] P

d_s is the correction of the predicted state in its error coordinates, V its covariance. P is the
stationary covariance of the filter, so that V is that of the stationary problem: near the ends of a
flight and in gaps it is too small.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import FitError
from greybox.estimation.engine import Engine, Windows
from greybox.estimation.filtering import Filter, Filtered
from greybox.symbolic import FloatArray, evaluate


@dataclass(frozen=True, kw_only=True, eq=False)
class Smoothed:
    """States (n, n_x) given all samples of the segment, variance (n, n_d) of their error state, and
    what was filtered."""

    filtered: Filtered
    states: FloatArray
    variance: FloatArray


def transitions(
    engine: Engine,
    states: FloatArray,
    rows: npt.NDArray[np.int_],
    inputs: FloatArray,
    p: FloatArray,
    dt: float,
    start: FloatArray | None = None,
) -> Windows:
    """One step from each of `states` (m, n_x) at the record's distinct `rows` (m,), linearised at
    the predicted output.

    `start` (m, n_d, n_s) are the sensitivities to carry along, by default those of the state
    itself: then `end_sensitivity` is A (m, n_d, n_d) and `sensitivity` is -C, the derivative of the
    innovation (m, n_e, n_d). Raises `FitError` for a step that is not finite.
    """
    m = len(states)
    one = np.ones(m, dtype=np.int32)
    n = len(inputs) - engine.past - engine.future
    # What turns with the attitude is linearised where the innovation is zero.
    outputs = np.zeros((n, engine.ny))
    told = engine.rollout(starts=states, rows=rows, horizon=1, inputs=inputs, p=p, dt=dt)[0][:, 0]
    outputs[rows] = engine.expected(states, told)
    found = engine.windows(
        starts=states,
        rows=rows,
        lengths=one,
        tails=one,
        inputs=inputs,
        outputs=outputs,
        mask=np.ones((n, engine.ne)),
        p=p,
        dt=dt,
        s0=np.repeat(np.eye(engine.nd)[None], m, axis=0) if start is None else start,
    )
    if found.failed_in is not None:
        raise FitError("an open-loop prediction is not finite")
    return found


def smooth(runner: Filter, filtered: Filtered) -> Smoothed:
    """Smooth one segment that `runner` has filtered. Raises `FitError` where the linearisation or
    what is smoothed is not finite."""
    record, engine = filtered.record, runner.engine
    n, nd = record.n, engine.nd
    linear = transitions(
        engine, filtered.states, np.arange(n), record.inputs, filtered.p, record.dt
    )
    assert linear.end_sensitivity is not None
    assert linear.sensitivity is not None
    a, c = linear.end_sensitivity, -linear.sensitivity
    table, covariance, _ = filtered.gains.tables()
    weights, there, before = (
        np.linalg.inv(covariance),
        filtered.gains.there,
        filtered.gains.covariances,
    )
    r, info = np.zeros(nd), np.zeros((nd, nd))
    moved, variance = np.zeros((n, nd)), np.zeros((n, nd))
    with np.errstate(over="ignore", invalid="ignore"):  # said at the end
        for k in range(n - 1, -1, -1):
            g = filtered.gains.pattern[k]
            p = before[g]
            seen = c[k] * there[g][:, None]
            closed = a[k] - table.gain[g] @ seen
            weighted = seen.T @ weights[g]
            r = weighted @ filtered.innovations[k] + closed.T @ r
            info = weighted @ seen + closed.T @ info @ closed
            moved[k] = p @ r
            variance[k] = np.diag(p) - ((p @ info) * p).sum(axis=1)  # p is symmetric
    x, d = ca.SX.sym("x", engine.nx), ca.SX.sym("d", nd)
    chart = ca.Function("moved", [x, d], [ca.densify(engine.dynamics.boxplus(x, d))])
    floor = 1e-6 * np.diag(filtered.state_covariance)
    states = evaluate(chart, filtered.states, moved)
    if not np.isfinite(states).all():
        raise FitError("a smoothed flight is not finite: the filter is not stable along it")
    return Smoothed(
        filtered=filtered,
        states=states,
        variance=np.maximum(variance, floor),
    )
