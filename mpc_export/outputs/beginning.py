"""The beginning of a run: the filter of an export is settled, and knows a start far better than
anybody does.

The covariance of the prediction runs from the declared spread of the start, on the linearisation at
the model's typical point; the gain follows it and ends at the settled one (the covariance form of
`greybox.estimation.settling`, for states that are plain numbers).
"""

from __future__ import annotations

import numpy as np

from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from mpc_export.functions import ModelFunctions

SETTLED = 1e-4
"""Relative difference to the settled covariance from which on it is that one."""


class Beginning:
    """`covariance` (n_d, n_d) of the prediction now; `settled` once it is that of the filter."""

    def __init__(self, f: ModelFunctions) -> None:
        self._a = f["f_d_jac"](*f.reference, f.parameter_values)[1].full()
        self._c = f["h_jac"](*f.reference, f.parameter_values)[1].full()
        self._noise = f.noise
        own = f.model.dynamics.error_states if isinstance(f.model, IdentifiedModel) else ()
        self._spread = np.zeros(f.sizes["n_d"])
        if len(own):
            self._spread[: len(own)] = f.model.dynamics.initial_state({})[1]  # type: ignore[union-attr]
        names = f.outputs.names
        self._seen = [(i, names.index(n)) for i, n in enumerate(f.states.names) if n in names]
        self.covariance, self.settled = f.noise.covariance, True

    def start(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """x (n_x,) with the states that are measured under their own names at the first measured y
        (n_y,)."""
        self.settled = not self._spread.any()
        if not self.settled:
            self.covariance = np.maximum(np.diag(self._spread**2), 0.0)
        out = np.array(x)
        for i, j in self._seen:
            out[i] = y[j] if np.isfinite(y[j]) and not self.settled else out[i]
        return out

    def gain(self, there: FloatArray) -> FloatArray:
        """Gain (n_d, n_e) for the channels that are `there` (n_e,); goes one sample on."""
        a, noise, p = self._a, self._noise, self.covariance
        on = there != 0
        c = self._c[on]
        size = c @ p @ c.T + np.diag(noise.sensor[on] ** 2)
        gain = np.zeros((len(a), len(on)))
        gain[:, on] = np.linalg.solve(size, c @ p @ a.T).T
        self.covariance = a @ p @ a.T + noise.filtered - gain[:, on] @ size @ gain[:, on].T
        goal = noise.covariance
        self.settled = bool(
            np.abs(self.covariance - goal).max() <= SETTLED * max(np.abs(goal).max(), 1e-300)
        )
        if self.settled:
            self.covariance = goal
        return gain
