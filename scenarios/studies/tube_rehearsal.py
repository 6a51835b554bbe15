"""The identified model as a plant that also draws the error of its learned part: what back-offs are rehearsed on.

`ModelPlant` draws the parameters of the fit once a flight, and noise and disturbances at every sample. Here the learned
function g(z) is mean(z) + sd(z) e as well, e ~ N(0, I) drawn once a flight: the consider states of the tube, simulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from greybox.model.identified import IdentifiedModel
from mpc_export.tube.native import native
from scenarios.studies.mpc_plant import ModelPlant


class RehearsedPlant(ModelPlant):
    """`ModelPlant` of a hybrid with an error of the learned part that stays the same over a flight."""

    def __init__(self, model: IdentifiedModel) -> None:
        self._pushed: Any = None
        super().__init__(model)
        f = self.functions
        if not f.sizes["n_g"]:
            return
        sizes = f.sizes
        x, u, p = ca.MX.sym("x", sizes["n_x"]), ca.MX.sym("u", sizes["n_u"]), ca.MX.sym("p", sizes["n_p"])
        after, e = ca.MX.sym("after", sizes["n_x"]), ca.MX.sym("e", sizes["n_g"])
        deviation = ca.sqrt(ca.fmax(f["gp_variance"](f["gp_features_raw"](x, u, p)[0], p), 0.0))
        moved = f["boxplus"](after, f["B_d"](x, u, p) @ (deviation * e))
        self._pushed = native(ca.Function("pushed", [x, u, p, after, e], [ca.densify(moved)]))

    def reset(self, seed: int = 0, *, position: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
        """Hover at `position` [m], with parameters, learned error and disturbances of this seed."""
        super().reset(seed, position=position)
        self._error = self._rng.standard_normal(self.functions.sizes["n_g"])

    def step(self, u: Any, dt: float | None = None) -> None:
        """Hold the command u (n,) for one sample."""
        before = self._x
        super().step(u, dt)
        if self._pushed is not None:
            slow = self._x[self._slow]
            self._x = self._pushed(before, self._u, self._p, self._x, self._error).full().ravel()
            self._x[self._slow] = slow
