"""Measure in other kilograms, metres, seconds and volts, and every declared unit says how the
numbers change.

Finds a wrong unit, a formula of wrong dimension and a constant that is hidden in the code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from specimen import (
    DT,
    at_random,
    column,
    crooked,
    effects_under_test,
    function,
    model_with,
    parameter_vector,
    random_state,
    random_window,
)
from units import dimensions, factor, factors

from greybox.model.effects import CATALOGUE
from greybox.model.model import PhysicsModel
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle

VEHICLE_UNITS: Mapping[str, str] = {
    "gravity": "m/s^2",
    "mass": "kg",
    "inertia": "kg m^2",
    "inertia_sigma": "kg m^2",
    "center_of_mass": "m",
    "imu_position": "m",
    "position": "m",
    "rotor_radius": "m",
    "speed_max": "rad/s",
    "thrust": "N",
    "thrust_sigma": "N",
    "torque": "N m",
    "torque_sigma": "N m",
    "nominal_voltage": "V",
    "gyro": "rad/s",
    "accelerometer": "m/s^2",
    "attitude": "rad",
    "velocity": "m/s",
    "voltage": "V",
    "rotor_speed": "rad/s",
}


def rescaled(vehicle: Vehicle, scale: Mapping[str, float]) -> Vehicle:
    """The same craft written down in other units."""

    def walk(value, unit):
        if isinstance(value, Mapping):
            return {k: walk(v, VEHICLE_UNITS.get(k, unit)) for k, v in value.items()}
        if isinstance(value, list):
            return [walk(v, unit) for v in value]
        if unit is not None and isinstance(value, float):
            return value * factor(unit, scale)
        return value

    return Vehicle.from_dict(walk(vehicle.to_dict(), None))


def without_speed(vehicle: Vehicle) -> Vehicle:
    """The same craft whose full rotor speed nobody wrote down."""
    return replace(vehicle, actuator=replace(vehicle.actuator, speed_max=None))


def check(effects, seed, vehicle):
    rng = np.random.default_rng(seed)
    scale = dict(zip(("kg", "m", "s", "V"), np.exp(rng.uniform(-0.9, 0.9, size=4)), strict=True))
    model, other = (
        PhysicsModel(
            vehicle=v,
            effects=tuple(effects),
            sensors=SENSORS,
            sample_time=dt,
        )
        for v, dt in ((vehicle, DT), (rescaled(vehicle, scale), DT * scale["s"]))
    )
    values = {k: v for e in effects for k, v in at_random(e, vehicle, rng).items()}
    x, p = random_state(model, rng), parameter_vector(model, values)
    # The longest delay in samples is a number of seconds in code: each model takes what it wants of
    # one long record.
    record = random_window(max(model, other, key=lambda m: m.window), rng)
    window, longer = (record[:, record.shape[1] - 1 - m.window[0] :] for m in (model, other))
    w = 0.1 * rng.normal(size=6)
    units = [d.unit for d in model.parameters]
    there = (
        x * factors(model.states.units, scale),
        longer * factors(model.inputs.units, scale)[:, None],
        p * factors(units, scale),
    )
    core = parameter_vector(other, {})[: len(model_with().parameters)]
    np.testing.assert_allclose(
        core, there[2][: core.size], rtol=1e-12, err_msg="core parameters and their units"
    )
    rate = factors([f"{u}/s" for u in model.states.units], scale)
    f = (
        column(function(model, "f")(x, window[:, -1], p)),
        column(function(other, "f")(there[0], there[1][:, -1], there[2])),
    )
    h = (
        column(function(model, "h")(x, window[:, -1], p)),
        column(function(other, "h")(there[0], there[1][:, -1], there[2])),
    )
    noise = w * factors(model.noises.units, scale)
    step = (
        column(function(model, "step")(x, window, p, w, DT)),
        column(function(other, "step")(*there, noise, DT * scale["s"])),
    )
    for names, (here, got), by in (
        (model.states.names, f, rate),
        (model.outputs.names, h, factors(model.outputs.units, scale)),
        (model.states.names, step, factors(model.states.units, scale)),
    ):
        for name, a, b, k in zip(names, here, got, by, strict=True):
            assert b == pytest.approx(a * k, rel=1e-9, abs=1e-11 * k), name


@pytest.mark.parametrize("effect", effects_under_test())
@pytest.mark.parametrize("seed", [1, 2])
def test_everything_rescales_by_its_declared_unit(effect, seed):
    check([effect], seed, crooked())


@pytest.mark.parametrize(
    "effect",
    [pytest.param(e, id=e.name) for e in CATALOGUE if "actuator.speed_max" not in e.needs.vehicle],
)
def test_everything_rescales_where_full_speed_is_unknown(effect):
    check([effect], 1, without_speed(crooked()))


def test_all_effects_together_rescale_by_their_declared_units():
    check(list(CATALOGUE), 5, crooked())


def test_units_are_read_as_written():
    assert dimensions("N s^2/m^2") == {"kg": 1, "m": -1}
    assert dimensions("N m s/rad") == {"kg": 1, "m": 2, "s": -1}
    assert dimensions("kg m/rad") == {"kg": 1, "m": 1}
    assert dimensions("-") == dimensions("rad") == {}
    with pytest.raises(ValueError, match="furlong"):
        dimensions("furlong/s")
