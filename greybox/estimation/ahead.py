"""Open loop: where a model goes from given states while recorded commands drive it.

All predictions ahead start here: those of `greybox validate`, `compare`, `discover`, of the pages,
and of networks that add to every step. What needs slopes along the way (fits, covariances) takes
`Engine.windows`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from greybox.errors import FitError
from greybox.estimation.engine import Engine
from greybox.symbolic import FloatArray, IntArray

Between = Callable[[int, FloatArray, FloatArray], FloatArray]
"""(h, states (m, n_x) at sample h, states that follow by the model) -> states at sample h + 1."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenLoop:
    """m runs: outputs (m, steps, n_y), states (m, steps, n_x) where they were asked for, at
    parameters p (n_p); `first` (m,) is the row of `inputs` that begins at the first sample."""

    outputs: FloatArray
    states: FloatArray | None
    p: FloatArray
    inputs: FloatArray
    first: IntArray

    @property
    def commands(self) -> FloatArray:
        """Commands (m, steps, n_u) that begin at the samples."""
        return self.inputs[self.first[:, None] + np.arange(self.outputs.shape[1])]

    def without_first(self) -> OpenLoop:
        """The same runs from their second sample on."""
        return replace(
            self,
            outputs=self.outputs[:, 1:],
            states=None if self.states is None else self.states[:, 1:],
            first=self.first + 1,
        )


def run_ahead(
    engine: Engine,
    *,
    starts: FloatArray,
    rows: IntArray,
    steps: int,
    inputs: FloatArray,
    p: FloatArray,
    dt: float,
    want_states: bool = False,
    between: Between | None = None,
) -> OpenLoop:
    """`steps` samples from the states `starts` (m, n_x) at the samples `rows` (m,) of a record, the
    first of them included; inputs (n + past + future, n_u) as in `Record`.

    Past the end of the record the last command is held. `between` changes the states from sample to
    sample, and then they are in the answer. Raises `FitError` for a row beyond the end.
    """
    inputs = np.concatenate([inputs, np.repeat(inputs[-1:], steps + 1, axis=0)])
    if len(rows) and rows.max() + steps + engine.past > len(inputs):
        raise FitError("an origin lies outside its record")

    def run(x: FloatArray, at: IntArray, horizon: int) -> tuple[FloatArray, FloatArray | None]:
        return engine.rollout(
            starts=x,
            rows=at,
            horizon=horizon,
            inputs=inputs,
            p=p,
            dt=dt,
            want_states=want_states or between is not None,
        )

    if between is None:
        outputs, states = run(starts, rows, steps)
    else:
        x, y, seen = starts, [], []
        for h in range(steps):
            now, after = run(x, rows + h, 2)
            assert after is not None
            y.append(now[:, 0])
            seen.append(x)
            if h + 1 < steps:
                x = between(h, x, after[:, 1].copy())
        outputs, states = np.stack(y, axis=1), np.stack(seen, axis=1)
    return OpenLoop(outputs=outputs, states=states, p=p, inputs=inputs, first=rows + engine.past)
