"""Measured rotor speeds act at once, but may be logged late: a delay below zero looks them up
later in the record."""

from __future__ import annotations

import numpy as np
import pytest
from craft import X250, flat, function, state, vector, vehicle_of

from greybox.errors import ModelError
from greybox.model.model import PhysicsModel, build_model

DT = 0.01
CRAFT = vehicle_of(X250)
QUIET = np.zeros(6)
SEEN = ["p", "q", "r", "ax", "ay", "az", "x", "y", "z", "qw", "qx", "qy", "qz"]
SPEEDS = [f"omega{i}" for i in range(1, 5)]


def driven(*effects: str) -> PhysicsModel:
    return build_model(CRAFT, [*SPEEDS, *SEEN], effects, sample_time=DT)


def flown(model, d, record):
    """State after a step from every sample of the record (n, 4), which is looked up `d` seconds
    before it."""
    past, future = model.window
    padded = np.vstack([np.repeat(record[:1], past, 0), record, np.repeat(record[-1:], future, 0)])
    step, p = function(model, "step"), vector(model, command_delay__d=d)
    return np.array(
        [
            flat(step(state(model), padded[k : k + past + 1 + future].T, p, QUIET, DT))
            for k in range(len(record))
        ]
    )


def test_a_log_of_speeds_makes_a_model_of_speeds():
    assert driven().input == "speed"
    assert driven().inputs.names == tuple(SPEEDS)
    both = build_model(CRAFT, [*SPEEDS, "u1", "u2", "u3", "u4", "p", "q", "r"], sample_time=DT)
    assert both.input == "command"


def test_speeds_three_samples_late_are_those_three_samples_later():
    model = driven("command_delay")
    assert model.parameters[-1].lower == -0.05
    speeds = np.random.default_rng(0).uniform(0.5, 0.8, (12, 4)) * CRAFT.actuator.speed_max
    late = flown(model, -0.03, np.vstack([np.repeat(speeds[:1], 3, 0), speeds]))[:12]
    np.testing.assert_allclose(late, flown(model, 0.0, speeds), rtol=0, atol=1e-12)


def test_between_samples_speeds_run_straight():
    model = driven("command_delay")
    ramp = np.linspace(0.5, 0.8, 30)[:, None] * CRAFT.actuator.speed_max * np.ones(4)
    half = 0.5 * (ramp[1] - ramp[0])
    between = flown(model, -0.015, ramp)[10:20]
    np.testing.assert_allclose(between, flown(model, -0.02, ramp - half)[10:20], atol=1e-12)


def test_commands_never_act_before_they_are_sent():
    model = build_model(CRAFT, ["u1", "u2", "u3", "u4", "p", "q", "r"], ["command_delay"])
    assert next(d for d in model.parameters if d.name == "command_delay.d").lower == 0.0


@pytest.mark.parametrize("effect", ["motor_lag", "thrust_curve", "battery_sag"])
def test_what_shapes_a_command_is_in_the_speeds_already(effect):
    with pytest.raises(ModelError, match="shapes the command"):
        driven(effect)
