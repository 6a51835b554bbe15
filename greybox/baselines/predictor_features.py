"""Features: what a learned part beside a predictor may look at, by name.

| name | meaning |
|---|---|
| `NAME[t-1]`, `NAME[t-2]`, ... | a log column, or phi, theta, psi, so many samples before |
| `NAME[t]` | a command at t |
| `error.NAME[t-1]` | the model's own last one-step error |
| any other | a predicted output or a signal of the predicted state |
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from greybox.baselines.kinematics import QUATERNION
from greybox.baselines.predictor_run import Run
from greybox.data import Segment
from greybox.data.channel import channel, is_canonical
from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.record import hold_missing
from greybox.frames import numeric
from greybox.residual.features import available
from greybox.symbolic import FloatArray, Layout, Signal, evaluate

if TYPE_CHECKING:
    from greybox.baselines.base_predictor import BasePredictor

ANGLES = ("phi", "theta", "psi")
_LATE = re.compile(r"(?P<name>.+)\[t(-(?P<lag>[1-9]\d*))?\]")
_LAST_ERROR = re.compile(r"error\.(?P<name>.+)\[t-1\]")


def column_of(name: str) -> tuple[str, int] | None:
    """Log column and lag, ("q", 1) of "q[t-1]" and ("u1", 0) of "u1[t]"; None of another feature."""
    found = None if _LAST_ERROR.fullmatch(name) else _LATE.fullmatch(name)
    return None if found is None else (found["name"], int(found["lag"] or 0))


def error_of(name: str) -> str | None:
    """The output of a last error, p of "error.p[t-1]"; None of another feature."""
    found = _LAST_ERROR.fullmatch(name)
    return None if found is None else found["name"]


def uses_errors(names: Sequence[str]) -> bool:
    """Whether any of the features is an error."""
    return any(error_of(n) is not None for n in names)


def layout_of(base: BasePredictor, names: Sequence[str]) -> Layout:
    """Features with units. Raises `UnknownNameError`, and `ModelError` for a measurement of time
    t."""
    return Layout([Signal(name=n, unit=_unit(base, n)) for n in names])


def _unit(base: BasePredictor, name: str) -> str:
    outputs = {s.name: s.unit for s in base.dynamics.outputs if s.name in base.outputs}
    last, late = error_of(name), column_of(name)
    if last is not None:
        if last not in base.outputs:
            raise UnknownNameError("feature", name, [f"error.{n}[t-1]" for n in base.outputs])
        return outputs[last]
    if late is not None:
        column, lag = late
        if not lag and column not in base.commands:
            raise ModelError(
                f"feature {name} is a measurement of the predicted instant",
                expected="a command, or [t-1]",
            )
        return "rad" if column in ANGLES else channel(column).unit if is_canonical(column) else "1"
    inputs = base.dynamics.inputs.names
    own = outputs | {n: u for n, u in available(base.dynamics).items() if n not in inputs}
    if name not in own:
        raise UnknownNameError("feature", name, [*own, *(f"{c}[t-1]" for c in base.commands)])
    return own[name]


def given(segment: Segment, names: Sequence[str]) -> FloatArray:
    """The features (n, n_given) that are columns of the log in their order, the last value where
    one is missing."""
    out = []
    for name in names:
        late = column_of(name)
        if late is None:
            continue
        column, lag = late
        if column in ANGLES and column not in segment.channels:
            value = numeric("euler", hold_missing(segment.matrix(QUATERNION))[0])[
                :, ANGLES.index(column)
            ]
        else:
            value = hold_missing(segment.column(column)[:, None])[0][:, 0]
        lag = min(lag, segment.n)
        out.append(np.concatenate([np.full(lag, np.nan), value[: segment.n - lag]]))
    return np.column_stack(out) if out else np.zeros((segment.n, 0))


def last_errors(base: BasePredictor, segment: Segment, run: Run) -> FloatArray:
    """One-step errors (n, n_o) of the sample before each, the last known one where it was not
    measured; NaN before the first."""
    e = np.where(run.known[:, None], segment.matrix(base.outputs) - run.mean, np.nan)
    held, _ = hold_missing(e)
    held[~np.logical_or.accumulate(np.isfinite(e), axis=0)] = np.nan
    return np.vstack([np.full((1, e.shape[1]), np.nan), held[:-1]])


def features_of(
    base: BasePredictor, segment: Segment, run: Run, names: Sequence[str]
) -> FloatArray:
    """Features (n, n_z) of every sample of a run; NaN where one is not known."""
    steps = base.steps
    states = np.where(run.known[:, None], run.states, 0.0)
    z = evaluate(
        steps.features(tuple(names)),
        states,
        steps.windows(run.inputs, np.arange(segment.n)),
        given(segment, names),
        last_errors(base, segment, run),
        run.p,
        run.shift,
    )
    return np.where(run.known[:, None], z, np.nan)
