"""What no craft has more of is three sigma of what is believed: an offset of the accelerometer that
may be anything takes the thrust that keeps the craft in the air."""

from __future__ import annotations

import math

import numpy as np
import pytest

import greybox as gb
from greybox.data import Dataset
from greybox.examples import flight_path, vehicle_path
from greybox.model.parameter import Parameter

EFFECTS = ("motor_lag", "command_delay", "accelerometer_bias", "gyro_bias")


def parameter(**said: float) -> Parameter:
    return Parameter(name="b", unit="m/s^2", nominal=0.1, null=0.0, **said)


@pytest.mark.parametrize(
    ("said", "believed"),
    [
        ({"possible": 2.4}, (0.0, 0.8)),
        ({"possible": 2.4, "sigma": 0.2}, (0.1, 0.2)),
        ({"possible": 2.4, "sigma": 0.0}, (0.1, 0.0)),
        ({}, (0.1, math.inf)),
    ],
)
def test_what_is_stated_comes_before_what_is_possible(said, believed):
    assert parameter(**said).believed == pytest.approx(believed)


def test_rotors_carry_the_craft_where_commands_and_imu_alone_are_logged():
    """A real flight in the air all the time: its mean specific force is what the rotors lift. They
    were said to lift 56 % of it, beside an offset of 4.6 m/s^2."""
    vehicle = gb.read_vehicle(vehicle_path("arpl_crazyflie"))
    flight = gb.read_logs([flight_path("arpl_crazyflie", "log15")], vehicle, rate=100).flights[0]
    begin = float(flight.segments[0].t[0])
    piece = flight.between(begin + 5.0, begin + 15.0)
    assert piece is not None
    data = Dataset(flights=(piece,))
    model = gb.build_model(vehicle, data.channels, EFFECTS, sample_time=0.01)
    values = gb.fit(model, data, fixed=["mass", "inertia.zz"]).model.values
    (segment,) = piece.segments
    u = segment.matrix(("u1", "u2", "u3", "u4"))
    thrust = values["thrust.c0"] + values["thrust.c1"] * u + values["thrust.c2"] * u**2
    lift = thrust.sum(axis=1).mean() / values["mass"]
    assert lift == pytest.approx(float(np.nanmean(segment.column("az"))), rel=0.1)
