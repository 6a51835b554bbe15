"""Rotors of second order look like a delay with a short lag, of which no slope tells: a fit says
that neither is a measurement, and nothing of the kind where the delay is one."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.automatic.wanted import with_rivals
from greybox.data import Dataset
from greybox.estimation.fit import fit
from greybox.estimation.result import Fit
from greybox.excitation.hover import Hover
from greybox.excitation.injection import rich_excitation
from greybox.model.model import build_model
from greybox.plants.effects import CommandDelay, MotorLag, MotorLagSecond
from greybox.plants.flight_log import fly, member
from greybox.plants.presets import controller_for, nano
from tests.automatic.craft import flight, vehicle

EFFECTS = ("motor_lag", "command_delay", "gyro_bias")


def told(*effects: object) -> Fit:
    """A fit with lag and delay to flights with these effects, with what its flights want."""
    true = nano(list(effects))
    log = fly(true, controller_for(true), Hover(), rich_excitation(), 8.0, seed=[1, 2], warm_up=0.5)
    parts = [flight(member(log, i), f"run{i}") for i in range(2)]
    data = Dataset(flights=tuple(p.flights[0] for p in parts))
    model = build_model(vehicle(), data.channels, EFFECTS, sample_time=data.flights[0].dt)
    return with_rivals(fit(model, data, disturbance=("torque",)), data)


@pytest.fixture(scope="module")
def of_second_order() -> Fit:
    return told(MotorLag(tau=0.022), MotorLagSecond(b=1.0))


def test_lag_and_delay_are_no_measurement_and_the_flights_want_the_second_order(of_second_order):
    said = of_second_order.covariance.form
    assert "command_delay.d" in said and "motor_lag.tau" in said
    assert "no measurement" in said and "motor_lag_second" in said


def test_the_errors_hold_both_though_both_are_wrong(of_second_order):
    for name, true in {"motor_lag.tau": 0.022, "command_delay.d": 0.0}.items():
        estimate = of_second_order[name]
        assert abs(estimate.value - true) < 2 * estimate.std


@pytest.mark.parametrize("delay", [pytest.param(0.0, marks=pytest.mark.slow), 0.018])
def test_a_delay_that_is_there_is_one(delay):
    found = told(MotorLag(tau=0.03), CommandDelay(d=delay))
    assert "motor_lag_second" not in found.covariance.form
    assert np.isfinite(found["command_delay.d"].std)
    assert found["command_delay.d"].std < 2e-3
