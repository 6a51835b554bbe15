"""Mean and variance in open loop of a predictor in innovation form.

With a learned part g(z) for the mean of e(t) the recursion is that of the output residual
(`greybox.baselines.output_residual`). Ahead of an origin the covariance of the state is that of the
innovations still to come, and g's own error, which is the same function all along, is carried as a
consider state (Schmidt 1966), both linearised along the predicted path. What a model says of its
states and parameters instead is `greybox.estimation.propagation`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from greybox.baselines.predictor_features import column_of, given, last_errors, uses_errors
from greybox.baselines.predictor_run import Run
from greybox.baselines.regressors import inside
from greybox.data import Segment
from greybox.residual.weight_space import Candidate
from greybox.symbolic import BoolArray, FloatArray, IntArray, evaluate

if TYPE_CHECKING:
    from greybox.baselines.base_predictor import BasePredictor

CHUNK = 2000
"""Origins that are rolled out at once (bounds the memory)."""


def run_with_spread(
    base: BasePredictor,
    segment: Segment,
    origins: npt.ArrayLike,
    horizon: int,
    posterior: Candidate | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Mean and variance (m, horizon, n_o) of the samples k+1 .. k+horizon from origins k (m,), with
    `posterior` as mean of the innovations or None.

    Measured features keep their value at k; of the errors to come the mean is expected. NaN where
    nothing is known at k+1, and past the end. Raises `DataError` for an origin outside.
    """
    k, run = inside(segment, origins), base.run(segment)
    names = () if posterior is None else posterior.inputs.names
    columns = [c for n in names if (c := column_of(n)) is not None]
    beside = _Beside(
        given=given(segment, names),
        held=np.array([c not in base.commands for c, _ in columns], dtype=bool),
        errors=last_errors(base, segment, run) if uses_errors(names) else np.zeros(run.mean.shape),
    )
    mean, variance = np.full((2, len(k), horizon, len(base.outputs)), np.nan)
    for at in range(0, len(k), CHUNK):
        part = slice(at, at + CHUNK)
        mean[part], variance[part] = _roll(base, run, beside, k[part], horizon, posterior)
    return mean, variance


@dataclass(frozen=True, kw_only=True, eq=False)
class _Beside:
    """What is known beside a run: features `given` (n, n_given) by the log, which of them are `held`
    from the origin on, and the last errors (n, n_o)."""

    given: FloatArray
    held: BoolArray
    errors: FloatArray


def _roll(
    base: BasePredictor,
    run: Run,
    beside: _Beside,
    k: IntArray,
    horizon: int,
    posterior: Candidate | None,
) -> tuple[FloatArray, FloatArray]:
    told = base.steps.step(posterior)
    gain, cov = _driven_by(base, posterior)
    rows, n, n_o, n_d = base.rows, len(run.mean), len(base.outputs), len(gain)
    given, errors = beside.given, beside.errors
    fresh = gain @ cov @ gain.T
    own = np.diag(cov)[rows]
    mean, variance = np.full((2, len(k), horizon, n_o), np.nan)
    start = np.minimum(k + 1, n - 1)
    known = np.isfinite(np.hstack([given, errors])[start]).all(axis=1)
    live = np.flatnonzero((k + 1 < n) & run.known[start] & known)
    x, last = run.states[start[live]], errors[start[live]]
    white, learned = np.zeros((len(live), n_d, n_d)), np.zeros((len(live), n_d, n_o))
    for h in range(1, horizon + 1):
        row = k[live] + h
        keep = row < n
        live, row, x, last = live[keep], row[keep], x[keep], last[keep]
        white, learned = white[keep], learned[keep]
        if not live.size:
            break
        z = np.where(beside.held, given[k[live] + 1], given[row])
        windows = base.steps.windows(run.inputs, row)
        step = _Step.of(evaluate(told, x, windows, z, last, run.p, run.shift), n_o, x.shape[1], n_d)
        mean[live, h - 1], x, last = step.mean, step.x, step.last
        now = step.c @ learned
        now[:, range(n_o), range(n_o)] += step.sd
        variance[live, h - 1] = (
            np.einsum("mij,mjk,mik->mi", step.c, white, step.c) + own + np.sum(now**2, axis=2)
        )
        white = step.a @ white @ step.a.swapaxes(1, 2) + fresh
        learned = step.a @ learned + gain[:, rows] * step.sd[:, None, :]
    return mean, variance


def _driven_by(base: BasePredictor, posterior: Candidate | None) -> tuple[FloatArray, FloatArray]:
    """(gain, covariance) of the innovations that drive the state, which has the last errors in it
    where `posterior` looks at them."""
    gain, cov = base.gain
    if posterior is None:
        return gain, cov
    cov = foretold_covariance(base, posterior)
    if uses_errors(posterior.inputs.names):
        gain = np.vstack([gain, np.eye(len(cov))[base.rows]])
    return gain, cov


def foretold_covariance(base: BasePredictor, posterior: Candidate) -> FloatArray:
    """Covariance (n_e, n_e) of what is left of the innovations that `posterior` foretells: its
    noise."""
    cov = base.gain[1]
    scale = np.ones(len(cov))
    scale[base.rows] = np.sqrt(posterior.noise / np.diag(cov)[base.rows])
    return cov * scale * scale[:, None]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Step:
    """One step of m paths: `mean` (m, n_o), standard deviation `sd` (m, n_o) of the GP, the errors
    `last` (m, n_o) that it expects, next state x (m, n_x), slopes c (m, n_o, n_d) of the mean and a
    (m, n_d, n_d) of the next state."""

    mean: FloatArray
    sd: FloatArray
    last: FloatArray
    x: FloatArray
    c: FloatArray
    a: FloatArray

    @classmethod
    def of(cls, out: FloatArray, n_o: int, n_x: int, n_d: int) -> _Step:
        """Of the rows `out` of the function "step"."""
        mean, spread, last, x, c, a = np.split(
            out, np.cumsum([n_o, n_o, n_o, n_x, n_o * n_d]), axis=1
        )
        return cls(
            mean=mean,
            sd=np.sqrt(np.maximum(spread, 0.0)),
            last=last.copy(),
            x=x.copy(),
            c=c.reshape(-1, n_d, n_o).swapaxes(1, 2),
            a=a.reshape(-1, n_d, n_d).swapaxes(1, 2),
        )
