"""A velocity that nobody measures: which effects bring one into a model, and does the filter hold it?

Without position or velocity in the log a model feels its velocity only through a drag or a lift. Without any of these there
is no velocity at all, and the score of a drag at its null says nothing. A law that is flat at rest (parasitic_drag,
translational_lift: quadratic) shows it to a simulation but not to the stationary filter, which is linear at rest: that
velocity is dead reckoning, its errors colour the innovations, and further names would only mend them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from greybox.estimation.filtering import Filter
from greybox.estimation.gain import Linearisation
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel

HELD = 1e-2
"""Standard deviations by which 1 m/s must move some innovation in one sample."""


def moving(bare: PhysicsModel, offered: Iterable[Effect]) -> tuple[str, ...]:
    """Effects with which alone the log of the `bare` model feels a velocity; none where it does without any."""
    return () if _has_velocity(bare) else tuple(e.name for e in offered if _has_velocity(bare.with_effect(e)))


def unmeasured(model: IdentifiedModel) -> bool:
    """Whether neither position nor velocity is measured."""
    sensors = {s.name for s in getattr(model.physics, "sensors", ())}
    return bool(sensors) and not {"position", "velocity"} & sensors


def drifts(model: IdentifiedModel) -> bool:
    """Whether the model has a velocity of which its filter sees nothing, in a reading or in the next rates."""
    dynamics = model.dynamics
    names = dynamics.error_states.names
    v = [i for i, n in enumerate(names) if n.startswith("d_velocity.")]
    if not v or not unmeasured(model):
        return False
    window = np.repeat(model.reference_inputs[:, None], sum(dynamics.window) + 1, axis=1)
    a, _, c, _ = Linearisation(dynamics, ()).values(
        model.reference_state, window, model.parameter_vector(), model.sample_time
    )  # fmt: skip
    spread = np.sqrt(np.diag(Filter(model).riccati.S))
    seen = [np.abs(c[:, v]) / spread[:, None]]
    channels = dynamics.innovations.names
    for axis, gyro in (("x", "p"), ("y", "q"), ("z", "r")):
        if gyro in channels and f"d_rate.{axis}" in names:
            seen.append(np.abs(a[names.index(f"d_rate.{axis}"), v])[None] / spread[channels.index(gyro)])
    return max(float(s.max()) for s in seen) < HELD


def _has_velocity(model: PhysicsModel) -> bool:
    return "velocity.x" in model.states.names
