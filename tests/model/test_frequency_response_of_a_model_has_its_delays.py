"""Claim: a model's frequency response is that of its own steps: it agrees with a simulation, and
with python-control; its step response is the same answer in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.errors import ModelError
from greybox.model.frequency_response import response_of, step_response
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices
from greybox.symbolic import Layout, Signal
from tests.simulators.identified import identified

FREQUENCY = np.array([0.5, 2.0, 6.0])


def linear(delays: tuple[int, ...]) -> LinearModel:
    a = np.array([[0.9, 0.1], [-0.05, 0.8]])
    return LinearModel(
        name="two",
        matrices=Matrices(a, np.eye(2), np.eye(2), np.zeros((2, 2)), np.zeros((2, 2))),
        noise=np.eye(2),
        dt=0.02,
        inputs=Layout([Signal(name=n, unit="1") for n in "ab"]),
        outputs=Layout([Signal(name=n, unit="1") for n in "cd"]),
        delays=delays,
    )


def test_a_linear_model_with_delays_agrees_with_python_control():
    model = linear((3, 0))
    theirs = model.to_control(include_delays=True)(np.exp(2j * np.pi * FREQUENCY * model.dt))
    np.testing.assert_allclose(response_of(model, FREQUENCY), np.moveaxis(theirs, 2, 0), rtol=1e-9)
    with pytest.raises(ModelError, match="below half its rate"):
        response_of(model, np.array([30.0]))


def test_a_craft_answers_with_its_lag_and_its_delay():
    tau, delay = 0.05, 0.0137
    model = identified({"motor_lag.tau": tau, "command_delay.d": delay})
    hover = model.dynamics.reference({f"u{i}": 0.7 for i in range(1, 5)})
    h = response_of(replace(model, reference_state=hover), FREQUENCY)
    p, nu = model.dynamics.innovations["p"], hover[model.dynamics.states["rotor.1"]]
    roll = h[:, p, :4] @ np.sign([r.position[1] for r in model.physics.vehicle.rotors])
    gain = 4 * 0.1 * 10 * nu / 0.01  # four rotors at 0.1 m, thrust 5 nu^2, 0.01 kg m^2
    s = 2j * np.pi * FREQUENCY
    held = (1 - np.exp(-s * model.sample_time)) / (s * model.sample_time)
    np.testing.assert_allclose(
        roll, gain * held * np.exp(-s * delay) / (s * (1 + tau * s)), rtol=0.02
    )


def test_the_step_response_is_the_frequency_response_in_time():
    model = linear((3, 0))
    impulse = np.diff(step_response(model, 400), axis=0, prepend=0)
    assert not impulse[:4, :, 0].any()
    assert impulse[1, :, 1].any()
    z = np.exp(-2j * np.pi * np.outer(FREQUENCY, model.dt * np.arange(400)))
    np.testing.assert_allclose(
        np.tensordot(z, impulse, 1), response_of(model, FREQUENCY), rtol=1e-9
    )


def test_a_craft_turns_after_its_delay_and_its_lag():
    tau, delay = 0.05, 0.0137
    model = identified({"motor_lag.tau": tau, "command_delay.d": delay})
    hover = model.dynamics.reference({f"u{i}": 0.7 for i in range(1, 5)})
    steps = step_response(replace(model, reference_state=hover), 30)
    roll = steps[:, model.dynamics.innovations["p"], :4] @ np.sign(
        [r.position[1] for r in model.physics.vehicle.rotors]
    )
    gain = 4 * 0.1 * 10 * hover[model.dynamics.states["rotor.1"]] / 0.01
    t = np.maximum(model.sample_time * np.arange(30) - delay, 0.0)
    np.testing.assert_allclose(
        roll, gain * (t - tau * (1 - np.exp(-t / tau))), rtol=0.02, atol=2e-3 * gain * tau
    )
