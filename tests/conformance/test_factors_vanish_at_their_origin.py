"""A parameter that stands for a factor says where that vanishes: searches move it in its logarithm,
along the straight valley of what flights show as a product."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import numpy as np

from greybox.model.effects import effect_by_name
from tests import simulated


def test_thrust_and_torque_vanish_where_their_level_does() -> None:
    vehicle, effect = simulated.vehicle(), effect_by_name("thrust_level")
    (level,) = effect.parameters(vehicle)
    assert level.origin is not None
    flow = SimpleNamespace(vehicle=vehicle)
    for factor in effect.apply(flow, {"s": ca.DM(level.origin)}).values():  # type: ignore[arg-type]
        np.testing.assert_array_equal(np.asarray(ca.DM(factor)), 0.0)
