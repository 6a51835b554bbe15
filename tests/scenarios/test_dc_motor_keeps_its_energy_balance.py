"""The DC motor reaches the steady state that its parameters imply, and never gives more power than
it takes."""

from __future__ import annotations

import numpy as np
import pytest

from scenarios.plants.dc_motor import DcMotor


def test_steady_state_solves_the_balance_of_voltage_and_torque():
    motor = DcMotor(current_noise=0.0, speed_noise=0.0)
    p = motor.values
    log = motor.run(np.full(400, 6.0), 0.01)
    i, w = log["current"][-1], log["speed"][-1]
    assert p.resistance * i + p.constant * w == pytest.approx(6.0, rel=1e-6)
    assert p.constant * i == pytest.approx(p.viscous * w + p.coulomb, rel=1e-5)


def test_electrical_power_covers_friction_and_heat():
    motor = DcMotor(current_noise=0.0, speed_noise=0.0, substep=1e-4)
    p = motor.values
    u = 8.0 * np.sign(np.sin(np.arange(4000) * 0.005))
    log = motor.run(u, 0.001)
    i, w = log["current"], log["speed"]
    loss = p.resistance * i**2 + p.viscous * w**2 + p.coulomb * w * np.tanh(w / p.slip)
    stored = 0.5 * p.inductance * i[-1] ** 2 + 0.5 * p.inertia * w[-1] ** 2
    put_in = np.sum(u[:-1] * 0.5 * (i[1:] + i[:-1])) * 0.001
    lost = np.sum(0.5 * (loss[1:] + loss[:-1])) * 0.001
    assert put_in == pytest.approx(lost + stored, rel=1e-3)


def test_it_repeats_with_its_seed():
    motor = DcMotor(torque_noise=1e-4)
    u = np.ones(50)
    first, again, other = motor.run(u, 0.01, 1), motor.run(u, 0.01, 1), motor.run(u, 0.01, 2)
    assert np.array_equal(first["speed"], again["speed"])
    assert not np.array_equal(first["speed"], other["speed"])
