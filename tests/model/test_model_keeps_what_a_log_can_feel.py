"""States that no sensor feels are left out, and a disturbance is slow noise on the channel it is
named after."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from craft import CROOKED, X250, flat, function, model_of, sensors, state, vector, vehicle_of

from greybox.errors import ModelError, UnknownNameError
from greybox.model.model import PhysicsModel, sensors_for
from greybox.model.noise import with_disturbance

IMU = sensors("gyro", "accelerometer")


def kept(model):
    return {n.split(".")[0] for n in model.states.names}


@pytest.mark.parametrize(
    ("names", "effects", "expected"),
    [
        (("gyro",), (), {"rate"}),
        (("gyro", "accelerometer"), (), {"rate"}),
        (("gyro", "accelerometer"), ("motor_lag",), {"rate", "rotor"}),
        # A drag lets the accelerometer feel the velocity, and gravity turns it: attitude comes
        # along.
        (("gyro", "accelerometer"), ("rotor_drag",), {"rate", "velocity", "attitude"}),
        (("gyro",), ("blade_flapping",), {"rate", "velocity", "attitude"}),
        (("gyro", "accelerometer"), ("constant_force",), {"rate", "attitude"}),
        (("attitude",), (), {"rate", "attitude"}),
        (("velocity",), (), {"velocity", "attitude", "rate"}),
        (("position",), (), {"position", "velocity", "attitude", "rate"}),
    ],
)
def test_a_log_keeps_the_states_that_it_feels(names, effects, expected):
    model = model_of(X250, *effects, sensors=sensors(*names))
    assert kept(model) == expected
    assert len(model.error_states) == len(model.states) - ("attitude" in expected)


def test_the_reduced_model_is_the_full_one_seen_through_fewer_windows():
    full, small = model_of(CROOKED), model_of(CROOKED, sensors=IMU)
    x = state(full, velocity=[3, 2, 1], attitude=[0.6, 0.0, 0.8, 0.0], rate=[1, -2, 3])
    u = np.array([0.5, 0.55, 0.45, 0.6])
    rows = [full.states[n] for n in small.states.names]
    for which, layout in (("f", "states"), ("h", "outputs")):
        everything = flat(function(full, which)(x, u, vector(full)))
        some = [getattr(full, layout)[n] for n in getattr(small, layout).names]
        np.testing.assert_allclose(
            flat(function(small, which)(x[rows], u, vector(small))), everything[some], rtol=1e-12
        )


def test_a_log_without_force_channels_has_no_force_noise():
    assert model_of(X250, sensors=sensors("gyro")).noises.names == (
        "torque.x",
        "torque.y",
        "torque.z",
    )
    assert len(model_of(X250, sensors=IMU).noises) == 6


def test_sensors_take_part_when_all_their_columns_are_there():
    vehicle = vehicle_of(X250)
    names = ["p", "q", "r", "ax", "ay", "qw", "qx", "qy", "qz", "x"]
    assert [s.name for s in sensors_for(names, vehicle)] == ["attitude", "gyro"]
    assert [s.name for s in sensors_for(names, vehicle, exclude=["gyro"])] == ["attitude"]


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"sensors": ()}, "no sensor"),
        ({"sensors": sensors("gyro", "rotor_speed"), "input": "speed"}, "input and output at once"),
    ],
)
def test_models_that_cannot_be_are_refused(settings, match):
    with pytest.raises(ModelError, match=match):
        PhysicsModel(vehicle=vehicle_of(X250), **settings)


def test_effects_whose_needs_are_not_met_are_refused():
    bare = replace(vehicle_of(X250), nominal_voltage=None)
    with pytest.raises(ModelError, match="battery_sag needs nominal_voltage"):
        PhysicsModel(vehicle=bare).with_effect("battery_sag")
    with pytest.raises(ModelError, match="accelerometer_bias needs sensor accelerometer"):
        model_of(X250, sensors=sensors("gyro")).with_effect("accelerometer_bias")
    with pytest.raises(ModelError, match="motor_lag shapes the command"):
        PhysicsModel(vehicle=vehicle_of(X250), input="speed").with_effect("motor_lag")


def test_measured_speeds_drive_the_rotors_as_commands_would():
    by_speed = PhysicsModel(vehicle=vehicle_of(CROOKED), input="speed")
    by_command = PhysicsModel(vehicle=vehicle_of(CROOKED))
    assert by_speed.inputs.names == ("omega1", "omega2", "omega3", "omega4")
    x, u = state(by_command, rate=[1, 2, 3], velocity=[1, 0, 0]), np.array([0.5, 0.6, 0.55, 0.4])
    p = vector(by_command)
    np.testing.assert_allclose(
        flat(function(by_speed, "f")(x, CROOKED.speed_max * u, p)),
        flat(function(by_command, "f")(x, u, p)),
        rtol=1e-12,
    )


def test_values_in_the_vehicle_file_become_nominal_and_misspelt_ones_are_an_error():
    from greybox.model.vehicle_parts import Quantity

    vehicle = replace(
        vehicle_of(X250), effects={"motor_lag": {"tau": Quantity(value=0.031, sigma=0.004)}}
    )
    tau = next(
        p
        for p in PhysicsModel(vehicle=vehicle).with_effect("motor_lag").parameters
        if p.name == "motor_lag.tau"
    )
    assert (tau.nominal, tau.sigma) == (0.031, 0.004)
    wrong = replace(vehicle, effects={"motor_lag": {"tua": Quantity(value=0.031)}})
    with pytest.raises(UnknownNameError, match=r"tua.*did you mean tau"):
        _ = PhysicsModel(vehicle=wrong).with_effect("motor_lag").parameters


# ------------------------------------------------------------------ disturbances

INNER = model_of(CROOKED)
DISTURBED = with_disturbance(INNER, ("force", "torque"))
X = state(INNER, velocity=[1, 2, 3], attitude=[0.8, 0.6, 0, 0], rate=[1, -1, 2])
D = np.array([0.1, -0.2, 0.3, 1e-3, -2e-3, 3e-3])
U = np.array([0.5, 0.55, 0.45, 0.6])


def test_a_disturbance_enters_exactly_like_the_noise_of_its_channel():
    p = np.concatenate([vector(INNER), [1.0, 2.0]])
    for which in ("step", "output"):
        slow = flat(function(DISTURBED, which)(np.concatenate([X, D]), U, p, np.zeros(12), 0.01))
        white = flat(function(INNER, which)(X, U, vector(INNER), D, 0.01))
        np.testing.assert_allclose(slow[: white.size], white, rtol=1e-13)


def test_a_disturbance_decays_with_its_time_constant_and_is_a_random_walk_without_one():
    drive = np.concatenate([np.zeros(6), 0.01 * np.arange(1, 7)])
    for times, keep in (
        ((0.5, 2.0), np.exp(-0.01 / np.repeat([0.5, 2.0], 3))),
        ((1e12, 1e12), np.ones(6)),
    ):
        p = np.concatenate([vector(INNER), times])
        after = flat(function(DISTURBED, "step")(np.concatenate([X, D]), U, p, drive, 0.01))
        np.testing.assert_allclose(after[-6:], keep * D + drive[6:], rtol=1e-10)


def test_a_disturbance_names_a_channel_of_the_model():
    with pytest.raises(UnknownNameError, match=r"disturbance group 'forse'.*did you mean force"):
        with_disturbance(INNER, ("forse",))
    only = with_disturbance(INNER, ("torque",))
    assert only.states.names[-3:] == (
        "disturbance.torque.x",
        "disturbance.torque.y",
        "disturbance.torque.z",
    )
    assert only.parameters[-1].name == "disturbance.torque.T"
    x0, sigma = only.initial_state({})
    assert x0.size == len(only.states)
    assert sigma.size == len(only.error_states) == only.reference({}).size - 1
    assert (sigma > 0).all()
    assert only.noise_scale(0.01).size == len(only.noises)


def test_the_filter_is_linearised_at_the_flown_height_where_height_matters():
    means = {"x": 1.0, "y": 2.0, "z": 0.3, "u1": 0.6, "u2": 0.5, "u3": 0.5, "u4": 0.5}
    plain, near = model_of(X250, "motor_lag"), model_of(X250, "motor_lag", "ground_effect")
    position = slice(plain.states["position.x"], plain.states["position.z"] + 1)
    np.testing.assert_array_equal(plain.reference(means)[position], [0, 0, 0])
    np.testing.assert_array_equal(near.reference(means)[position], [1, 2, 0.3])
    np.testing.assert_array_equal(plain.reference(means)[-4:], near.reference(means)[-4:])
