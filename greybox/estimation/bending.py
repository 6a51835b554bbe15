"""Bending: which errors of a start are too wide for a filter that is linear.

A filter carries the error of a start by its covariance. That is right as far as readings are linear
in it. Where a log begins as a command jumps, rotors may be a quarter of their range from it, and the
square of their speed shows in the thrust: what is left of it after the first samples, of which the
covariance does not know, would be taken for a lag. Where a start is known half as well as usual, the
second difference of the first readings across one standard deviation each way tells: if it is more
than the noise of a reading, the start is an unknown of the fit, which follows the curve.
"""

from __future__ import annotations

import numpy as np

from greybox.estimation.engine import Engine
from greybox.estimation.record import Record
from greybox.symbolic import BoolArray, FloatArray

UNUSUAL = 2.0
"""Times the spread that a model expects, from which on a start is asked: one unknown more for every
such error costs time."""


def bent(
    engine: Engine, record: Record, p: FloatArray, noise: FloatArray, samples: int
) -> BoolArray:
    """Mask (n_d,) of the errors of a record's start that bend its first `samples` readings by more
    than their `noise` (n_e,), where the parameters are `p` (n_p,)."""
    count, length = engine.nd, min(samples, record.n)
    unusual = record.x0_sigma > UNUSUAL * engine.dynamics.initial_state({})[1]
    if not unusual.any():
        return unusual
    moves = np.vstack([np.zeros(count), np.diag(record.x0_sigma), -np.diag(record.x0_sigma)])
    each = np.full(len(moves), length)
    runs = engine.windows(
        starts=np.array([engine.moved(record.x0, d)[0] for d in moves]),
        rows=np.zeros(len(moves), dtype=np.int32),
        lengths=each,
        tails=each,
        p=p,
        **record.samples,
    )
    read = runs.innovations.reshape(len(moves), length, -1) / noise
    middle, up, down = read[0], read[1 : count + 1], read[count + 1 :]
    curve = np.abs(0.5 * (up + down) - middle).max(axis=(1, 2))
    return np.asarray(unusual & (curve > 1.0))
