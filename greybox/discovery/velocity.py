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
from greybox.model.dynamics import Dynamics
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel
from greybox.model.sensors import SENSORS

SHOWN = {b: frozenset(s.name for s in SENSORS if s.shows == b) for b in ("position", "velocity", "rate")}
"""Sensors that measure a state block as it is."""
HELD = 1e-2
"""Standard deviations by which 1 m/s must move some innovation, of this sample or the next."""


def moving(bare: PhysicsModel, offered: Iterable[Effect]) -> tuple[str, ...]:
    """Effects with which alone the log of the `bare` model feels a velocity; none where it does without any."""
    return () if has_velocity(bare) else tuple(e.name for e in offered if has_velocity(bare.with_effect(e)))


def unmeasured(model: IdentifiedModel) -> bool:
    """Whether neither position nor velocity is measured."""
    return bool(model.sensors) and not (SHOWN["position"] | SHOWN["velocity"]) & model.sensors


def unknown_start(model: IdentifiedModel) -> bool:
    """Whether readings do not tell with which velocity or rates a flight begins: no position and no velocity, or no gyro."""
    return unmeasured(model) or (bool(model.sensors) and not SHOWN["rate"] & model.sensors)


def drifts(model: IdentifiedModel) -> bool:
    """Whether the model has a velocity of which its filter sees nothing, in a reading or in the next one."""
    if not has_velocity(model.dynamics) or not unmeasured(model):
        return False
    runner = Filter(model)
    a, _, c, _ = runner.linear
    v = [i for i, n in enumerate(model.dynamics.error_states.names) if n.startswith("d_velocity.")]
    seen = np.concatenate([c, c @ a], axis=1)[:, [*v, *(len(a) + i for i in v)]]
    return float((np.abs(seen) / np.sqrt(np.diag(runner.riccati.S))[:, None]).max()) < HELD


def has_velocity(dynamics: Dynamics) -> bool:
    """Whether a velocity is among the states."""
    return "velocity.x" in dynamics.states.names
