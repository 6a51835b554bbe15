"""Every sensor: canonical columns and units, an innovation that is zero where it should be,
readings worked by hand."""

from __future__ import annotations

import importlib

import casadi as ca
import numpy as np
import pytest
from specimen import crooked, model_with, random_state
from units import dimensions

from greybox.data.channel import channel
from greybox.frames import quat_exp, quat_multiply, rotation_matrix
from greybox.model.clock import CLOCKS
from greybox.model.effect import Flow
from greybox.model.sensors import SENSORS
from greybox.model.state_blocks import BLOCKS
from greybox.model.vehicle_tables import NOISES

every_sensor = pytest.mark.parametrize("sensor", [pytest.param(s, id=s.name) for s in SENSORS])


def number(value):
    return np.asarray(ca.DM(value).full()).ravel()


def random_quaternion(rng):
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


@every_sensor
def test_columns_are_those_of_the_log_contract_with_their_units(sensor):
    module = importlib.import_module(f"greybox.model.sensors.{sensor.name}")
    assert type(sensor).__module__ == module.__name__
    for s in sensor.signals(crooked()):
        declared = channel(s.name)
        assert dimensions(s.unit) == dimensions(declared.unit)
        if sensor.name != "gyro":
            assert declared.group in (sensor.group, sensor.name)
    assert len(sensor.summary) > 5


@every_sensor
def test_what_a_sensor_declares_of_itself_is_complete(sensor):
    assert sensor.clock in CLOCKS
    assert sensor.delay == 0.0
    noise = np.broadcast_to(
        sensor.typical_noise(crooked()), len(sensor.innovation_signals(crooked()))
    )
    assert (noise > 0).all()
    assert (noise < sensor.noisiest).all()
    assert (sensor.noisiest < np.inf) == bool(sensor.noisiest_hint)
    assert sensor.name in NOISES
    assert sensor.witnesses <= {s.name for s in SENSORS}
    assert sensor.shows in {*BLOCKS, None}


@every_sensor
def test_a_flight_starts_where_its_sensor_says(sensor):
    """A sensor that shows a state block starts it at its first complete row; of no reading it says
    nothing."""
    columns = len(sensor.signals(crooked()))
    t = 0.01 * np.arange(5)
    rows = np.tile(random_quaternion(np.random.default_rng(3))[:columns], (5, 1))
    rows[0, 0] = np.nan
    assert sensor.starts(np.full((5, columns), np.nan), t) == ()
    said = {s.block: s for s in sensor.starts(rows, t)}
    assert (sensor.shows in said) == (sensor.shows is not None)
    if sensor.shows is not None:
        np.testing.assert_allclose(said[sensor.shows].value, rows[1], rtol=1e-12)
    for start in said.values():
        assert len(start.value) == BLOCKS[start.block].size
        assert len(start.spread) == 3
        assert (np.asarray(start.spread) < BLOCKS[start.block].spread).all()


@every_sensor
def test_innovation_has_a_name_and_a_unit_per_component_and_is_zero_at_the_prediction(sensor):
    rng = np.random.default_rng(1)
    y = rng.normal(size=len(sensor.signals(crooked())))
    if sensor.name == "attitude":
        y /= np.linalg.norm(y)
    rotation = rotation_matrix(ca.DM(random_quaternion(rng)))
    e = number(sensor.innovation(ca.DM(y), ca.DM(y), rotation))
    rows = sensor.innovation_signals(crooked())
    assert e.size == len(rows) == len({r.name for r in rows})
    assert np.abs(e).max() < 1e-15
    for row in rows:
        dimensions(row.unit)


@every_sensor
def test_innovation_is_the_measured_value_minus_the_prediction(sensor):
    """To first order in a small change of y, in body axes for world vectors and for attitude."""
    rng = np.random.default_rng(2)
    rotation = rotation_matrix(ca.DM(random_quaternion(rng)))
    small = 1e-6 * rng.normal(size=len(sensor.innovation_signals(crooked())))
    if sensor.name == "attitude":
        y_hat = random_quaternion(rng)
        y, expected = number(quat_multiply(ca.DM(y_hat), quat_exp(ca.DM(small)))), small
    else:
        y_hat = rng.normal(size=small.size)
        y = y_hat + small
        expected = rotation.full().T @ small if sensor.name in ("position", "velocity") else small
    np.testing.assert_allclose(
        number(sensor.innovation(ca.DM(y), ca.DM(y_hat), rotation)), expected, atol=1e-15
    )


@every_sensor
def test_noise_of_columns_and_of_the_innovation_are_the_same_noise(sensor):
    components = len(sensor.innovation_signals(crooked()))
    level = np.full(components, sensor.typical_noise(crooked()))
    columns = sensor.noise_of_columns(level)
    assert columns.shape == (len(sensor.signals(crooked())),)
    np.testing.assert_allclose(sensor.noise_of_innovation(columns), level, rtol=1e-12)


def test_noise_on_a_quaternion_is_that_of_the_attitude_innovation():
    rng = np.random.default_rng(5)
    attitude = next(s for s in SENSORS if s.name == "attitude")
    e, q = ca.SX.sym("e", 4), ca.SX.sym("q", 4)
    innovation = ca.Function("e", [q, e], [attitude.innovation(q + e, q, ca.SX.eye(3))])
    columns = attitude.noise_of_columns(np.full(3, 1e-3))
    rows = [random_quaternion(rng) for _ in range(4000)]
    seen = np.array([number(innovation(r, columns * rng.normal(size=4))) for r in rows])
    np.testing.assert_allclose(seen.std(axis=0), 1e-3, rtol=0.05)


def test_the_attitude_innovation_is_the_rotation_vector_to_third_order():
    rng = np.random.default_rng(3)
    attitude = next(s for s in SENSORS if s.name == "attitude")
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    q_hat = random_quaternion(rng)
    errors = []
    for angle in (0.4, 0.2, 0.1):
        y = number(quat_multiply(ca.DM(q_hat), quat_exp(ca.DM(angle * axis))))
        e = number(attitude.innovation(ca.DM(y), ca.DM(q_hat), ca.DM.eye(3)))
        flipped = number(attitude.innovation(ca.DM(-y), ca.DM(q_hat), ca.DM.eye(3)))
        np.testing.assert_allclose(flipped, e, atol=1e-15)
        np.testing.assert_allclose(np.cross(e, axis), 0, atol=1e-15)
        errors.append(angle - e @ axis)
    # 2 sin(a/2) = a - a^3/24 + ...
    assert errors[2] == pytest.approx(0.1**3 / 24, rel=1e-3)
    assert errors[0] / errors[1] == pytest.approx(8, rel=0.01)
    assert errors[1] / errors[2] == pytest.approx(8, rel=0.01)


def test_an_innovation_turns_with_the_craft():
    """Turn the world about any axis: position, velocity and attitude innovations in body axes do
    not notice."""
    rng = np.random.default_rng(4)
    model = model_with()
    turn = ca.DM(random_quaternion(rng))
    x, y = random_state(model, rng), random_state(model, rng)
    outputs = number(
        model.h(0, ca.DM(y), ca.DM([0.5] * 4), ca.DM([d.nominal for d in model.parameters]))
    )
    predicted = number(
        model.h(0, ca.DM(x), ca.DM([0.5] * 4), ca.DM([d.nominal for d in model.parameters]))
    )

    def turned(values, layout):
        out = np.array(values)
        for names in (("x", "y", "z"), ("vx", "vy", "vz")):
            rows = [layout[n] for n in names]
            out[rows] = rotation_matrix(turn).full() @ out[rows]
        rows = [layout[n] for n in ("qw", "qx", "qy", "qz")]
        out[rows] = number(quat_multiply(turn, ca.DM(out[rows])))
        return ca.DM(out)

    x_turned = np.array(x)
    at = model.states["attitude.w"]
    x_turned[at : at + 4] = number(quat_multiply(turn, ca.DM(x[at : at + 4])))
    before = number(model.innovation(ca.DM(outputs), ca.DM(predicted), ca.DM(x)))
    after = number(
        model.innovation(
            turned(outputs, model.outputs), turned(predicted, model.outputs), ca.DM(x_turned)
        )
    )
    np.testing.assert_allclose(after, before, atol=1e-12)


def flow(**signals):
    rest = {
        "omega": ca.DM.zeros(3),
        "angular_acceleration": ca.DM.zeros(3),
        "center_of_mass": ca.DM.zeros(3),
    }
    return Flow(vehicle=crooked(), **(rest | {k: ca.DM(v) for k, v in signals.items()}))


def sensor(name):
    return next(s for s in SENSORS if s.name == name)


def test_the_accelerometers_lever_arm_by_hand():
    # IMU at (0.02, -0.01, 0.015) m from the origin, centre of mass at (0.01, -0.01, 0.005): r =
    # (0.01, 0, 0.01). Spinning about z at 10 rad/s: centripetal omega x (omega x r) = -100 * (0.01,
    # 0, 0) = (-1, 0, 0). Spinning up about y at 50 rad/s^2: (0, 50, 0) x r = (50 * 0.01, 0, -50 *
    # 0.01) = (0.5, 0, -0.5).
    read = sensor("accelerometer").reading(
        flow(
            omega=[0, 0, 10], angular_acceleration=[0, 50, 0], center_of_mass=[0.01, -0.01, 0.005]
        ),
        ca.DM([1, 2, 3]),
    )
    np.testing.assert_allclose(number(read), [1 - 1 + 0.5, 2, 3 - 0.5], atol=1e-12)


def test_pose_and_velocity_are_those_of_the_body_origin_by_hand():
    # Yawed left by 90 deg, body x is world y: a centre of mass 0.1 m in front of the origin lies
    # 0.1 m along world y. Yaw rate 2 rad/s: the origin moves against omega x c = (0, 0.2, 0) body =
    # (-0.2, 0, 0) world.
    left = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    at = flow(
        rotation=left,
        center_of_mass=[0.1, 0, 0],
        omega=[0, 0, 2],
        position=[1, 1, 1],
        velocity_world=[3, 0, 0],
    )
    np.testing.assert_allclose(
        number(sensor("position").reading(at, ca.DM.zeros(3))), [1, 0.9, 1], atol=1e-15
    )
    np.testing.assert_allclose(
        number(sensor("velocity").reading(at, ca.DM.zeros(3))), [3.2, 0, 0], atol=1e-15
    )


def test_a_hovering_accelerometer_reads_plus_g_and_a_falling_one_nothing():
    model = model_with()
    values = {d.name: d.nominal for d in model.parameters}
    values |= {"thrust.c0": 0.0, "thrust.c1": 0.0, "torque.c0": 0.0, "torque.c1": 0.0}
    p = ca.DM(list(values.values()))
    x = ca.DM(model.reference({}))
    rows = [model.outputs[n] for n in ("ax", "ay", "az")]
    nu = np.sqrt(values["mass"] * crooked().gravity / (4 * values["thrust.c2"]))
    centred = {f"center_of_mass.{a}": 0.0 for a in "xyz"}
    # No lever arm between IMU and centre of mass matters as long as nothing turns: ask for the
    # specific force alone.
    values |= centred
    p = ca.DM(list(values.values()))
    specific, _, _ = model.body.accelerations(
        model._split(x)[0], ca.DM([nu] * 4), ca.DM.zeros(4), ca.DM.zeros(4), values, ca.DM.zeros(6)
    )
    np.testing.assert_allclose(number(specific), [0, 0, crooked().gravity], atol=1e-12)
    np.testing.assert_allclose(
        number(model.h(0, x, ca.DM.zeros(4), p))[rows], [0, 0, 0], atol=1e-12
    )
