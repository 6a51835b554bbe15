"""What the IMU reports: lever arm, then mounting angle, then scale, then bias, whatever the order
of listing."""

from __future__ import annotations

import numpy as np
from craft import CROOKED, flat, function, model_of, rotation, state, vector

VALUES = {
    "accelerometer_lever_arm": {"r_x": 0.02, "r_y": -0.01, "r_z": 0.03},
    "imu_misalignment": {"theta_x": 0.1, "theta_y": -0.2, "theta_z": 0.3},
    "accelerometer_scale": {"s_x": 0.05, "s_y": -0.1, "s_z": 0.2},
    "gyro_scale": {"s_x": -0.2, "s_y": 0.1, "s_z": 0.05},
    "accelerometer_bias": {"b_x": 0.3, "b_y": -0.2, "b_z": 0.1},
    "gyro_bias": {"b_x": 0.03, "b_y": -0.02, "b_z": 0.01},
}
RATE = np.array([2.0, -1.0, 3.0])


def imu(names):
    """(gyro, accelerometer, angular acceleration) in a tilted, turning flight."""
    model = model_of(CROOKED, *names)
    p = vector(model, **{f"{n}__{k}": v for n in names for k, v in VALUES[n].items()})
    x = state(model, velocity=[3.0, -2.0, 1.0], attitude=[0.5, 0.5, -0.5, 0.5], rate=RATE)
    u = [0.5, 0.62, 0.45, 0.58]
    y, f = flat(function(model, "h")(x, u, p)), flat(function(model, "f")(x, u, p))
    at = {n: i for i, n in enumerate(model.outputs.names)}
    turning = np.array([f[model.states[f"rate.{a}"]] for a in "xyz"])
    return y[[at[n] for n in "pqr"]], y[[at[n] for n in ("ax", "ay", "az")]], turning


def numbers(name):
    return np.array(list(VALUES[name].values()))


def test_the_chain_is_that_of_the_stage():
    gyro, felt, turning = imu([])
    lever = numbers("accelerometer_lever_arm")
    felt = felt + np.cross(turning, lever) + np.cross(RATE, np.cross(RATE, lever))
    angle = numbers("imu_misalignment")
    size = np.linalg.norm(angle)
    turn = rotation([np.cos(size / 2), *(np.sin(size / 2) * angle / size)]).T
    expected_gyro = (1 + numbers("gyro_scale")) * (turn @ gyro) + numbers("gyro_bias")
    expected_felt = (1 + numbers("accelerometer_scale")) * (turn @ felt) + numbers(
        "accelerometer_bias"
    )
    for names in (list(VALUES), list(VALUES)[::-1]):
        seen_gyro, seen_felt, _ = imu(names)
        np.testing.assert_allclose(seen_gyro, expected_gyro, rtol=1e-12)
        np.testing.assert_allclose(seen_felt, expected_felt, rtol=1e-12)


def test_a_scale_acts_on_the_prediction():
    """The innovation is data minus scaled prediction: its size cannot shrink by scaling the
    data."""
    model = model_of(CROOKED, "accelerometer_scale")
    p = vector(
        model,
        accelerometer_scale__s_x=0.5,
        accelerometer_scale__s_y=0.5,
        accelerometer_scale__s_z=0.5,
    )
    x = state(model)
    y = np.arange(1.0, 1.0 + len(model.outputs))
    y_hat = flat(function(model, "h")(x, [0.5] * 4, p))
    e = flat(model.innovation(y, y_hat, x))
    rows = [i for i, n in enumerate(model.innovations.names) if n in ("ax", "ay", "az")]
    at = [model.outputs[n] for n in ("ax", "ay", "az")]
    np.testing.assert_array_equal(e[rows], y[at] - y_hat[at])
