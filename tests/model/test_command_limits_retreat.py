"""command_saturation is a clip whose limits move inwards; at its null it is exactly nothing, with a
one-sided slope."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from craft import CROOKED, vehicle_of

from greybox.model.effect import Flow
from greybox.model.effects.command_saturation import CommandSaturation

EFFECT = CommandSaturation()
VEHICLE = vehicle_of(CROOKED)
NARROW = replace(VEHICLE, actuator=replace(VEHICLE.actuator, u_min=0.1, u_max=0.8))


def clipped(vehicle=VEHICLE):
    """u_eff and its slopes in (a_lo, a_hi) for one command."""
    u, p = ca.SX.sym("u"), ca.SX.sym("p", 2)
    after = EFFECT.apply(Flow(vehicle=vehicle, command=u), {"a_lo": p[0], "a_hi": p[1]})["command"]
    f = ca.Function("f", [u, p], [after, ca.jacobian(after, p)])
    return lambda value, lo, hi: [np.ravel(r.full()) for r in f(value, [lo, hi])]


@pytest.mark.parametrize("vehicle", [VEHICLE, NARROW])
def test_within_the_stated_range_it_is_the_clip(vehicle):
    f, low, high = clipped(vehicle), vehicle.actuator.u_min, vehicle.actuator.u_max
    for u in np.linspace(low, high, 41):
        for lo, hi in ((0.0, 0.0), (0.05, 0.0), (0.0, 0.2), (0.1, 0.3), (0.35, 0.35)):
            assert f(u, lo, hi)[0] == pytest.approx(np.clip(u, low + lo, high - hi), abs=1e-15)


@pytest.mark.parametrize("u", [-0.3, 0.0, 0.1, 0.2, 0.79999, 0.8, 0.97, 1.0, 1.4])
def test_at_the_null_it_is_exactly_nothing_even_outside_the_range(u):
    assert clipped(NARROW)(u, 0.0, 0.0)[0] == u


def test_at_the_null_only_commands_at_a_limit_have_a_slope_and_it_points_inwards():
    f = clipped()
    np.testing.assert_array_equal(f(1.0, 0.0, 0.0)[1], [0, -1])
    np.testing.assert_array_equal(f(0.0, 0.0, 0.0)[1], [1, 0])
    for u in (1e-9, 0.5, 1 - 1e-9):
        np.testing.assert_array_equal(f(u, 0.0, 0.0)[1], [0, 0])
    # One-sided: the same as the difference towards a limit inside the range.
    assert (f(1.0, 0.0, 1e-6)[0] - f(1.0, 0.0, 0.0)[0]) / 1e-6 == pytest.approx(-1)


def test_bounds_never_let_the_limits_cross():
    for vehicle in (VEHICLE, NARROW):
        assert (
            sum(p.upper for p in EFFECT.parameters(vehicle))
            <= vehicle.actuator.u_max - vehicle.actuator.u_min
        )
