"""The identified model as a plant that also draws the error of its learned part: what back-offs are rehearsed on.

`ModelPlant` draws the parameters of the fit once a flight, and noise and disturbances at every sample. Here the learned
function g(z) is mean(z) + sd(z) e as well, e ~ N(0, I) drawn once a flight: the consider states of the tube, simulated.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

from scenarios.studies.mpc_plant import ModelPlant


class RehearsedPlant(ModelPlant):
    """`ModelPlant` of a hybrid with an error of the learned part that stays the same over a flight."""

    def reset(self, seed: int = 0, *, position: Sequence[float] = (0.0, 0.0, 1.0)) -> None:
        """Hover at `position` [m], with parameters, learned error and disturbances of this seed."""
        super().reset(seed, position=position)
        self._error = self._rng.standard_normal(len(self._channels))

    def copied(self) -> RehearsedPlant:
        """A copy that flies on by itself, with the draws that this one would have had; compiled functions are shared."""
        other = copy.copy(self)
        other._rng = copy.deepcopy(self._rng)
        return other
