"""Dead reckoning reproduces a rigid-body motion whose gyro and accelerometer readings are known in
closed form."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from greybox.errors import DataError
from greybox.frames import GRAVITY
from greybox.validation.baselines import (
    ImuBias,
    ImuRecord,
    dead_reckoning,
    estimate_imu_bias,
    persistence,
)
from greybox.validation.groups import error_norms

DT, N, H = 0.01, 600, 50


def _motion(turn: float = 2.0):
    """A circle flown at constant speed while the body turns at `turn` about a fixed, tilted axis of
    its own."""
    t = np.arange(N) * DT
    w = 1.5
    position = np.stack([np.cos(w * t), np.sin(w * t), 0.5 * t], axis=1)
    velocity = np.stack([-w * np.sin(w * t), w * np.cos(w * t), 0.5 + 0 * t], axis=1)
    acceleration = -w * w * np.stack([np.cos(w * t), np.sin(w * t), 0 * t], axis=1)
    axis = np.array([0.2, -0.3, 0.933])
    axis /= np.linalg.norm(axis)
    attitude = Rotation.from_rotvec(t[:, None] * turn * axis)
    rate = np.broadcast_to(turn * axis, (N, 3))
    force = attitude.inv().apply(acceleration + np.array([0, 0, GRAVITY]))
    return position, velocity, np.roll(attitude.as_quat(), 1, axis=1), rate, force


def _errors(bias: ImuBias | None = None, offset_gyro=0.0, offset_acc=0.0) -> dict[str, np.ndarray]:
    position, velocity, attitude, rate, force = _motion()
    imu = ImuRecord.of(rate + offset_gyro, force + offset_acc, sample_time=DT)
    k = np.arange(N - H)
    predicted = dead_reckoning(
        imu, k, attitude=attitude[k], velocity=velocity[k], position=position[k], steps=H, bias=bias
    )
    index = k[:, None] + np.arange(1, H + 1)
    truth = {"position": position, "velocity": velocity, "rotation": attitude}
    return {g: error_norms(g, predicted[g], truth[g][index]).max(axis=0) for g in truth}


def test_exact_to_the_order_of_the_integration() -> None:
    worst = _errors()
    assert worst["rotation"][-1] < 1e-12
    # Linear interpolation of an acceleration of 2.25 m/s^2 at up to 3.5 rad/s: h^2/12 a'' t is
    # about 1e-4 m/s.
    assert worst["velocity"][-1] < 2e-4
    assert worst["position"][-1] < 1e-4


def test_free_fall_and_hover_are_exact() -> None:
    k = np.array([0])
    for force, drop in ((0.0, -0.5 * GRAVITY * 0.25), (GRAVITY, 0.0)):
        imu = ImuRecord.of(np.zeros((H + 1, 3)), np.tile([0, 0, force], (H + 1, 1)), sample_time=DT)
        out = dead_reckoning(
            imu,
            k,
            attitude=np.eye(4)[:1],
            velocity=np.zeros((1, 3)),
            position=np.zeros((1, 3)),
            steps=H,
        )
        assert out["position"][0, -1, 2] == pytest.approx(drop, abs=1e-12)


def test_biases_are_recovered_from_an_adaptation_window_and_removed() -> None:
    _, velocity, attitude, rate, force = _motion()
    gyro, acc = np.array([0.02, -0.03, 0.01]), np.array([0.1, 0.2, -0.15])
    imu = ImuRecord.of(rate[:300] + gyro, force[:300] + acc, sample_time=DT)
    bias = estimate_imu_bias(imu, attitude=attitude[:300], velocity=velocity[:300])
    np.testing.assert_allclose(bias.gyro, gyro, atol=1e-4)
    np.testing.assert_allclose(bias.accelerometer, acc, atol=5e-3)
    with_bias, without = _errors(bias, gyro, acc), _errors(None, gyro, acc)
    assert with_bias["velocity"][-1] < 0.05 * without["velocity"][-1]
    assert with_bias["rotation"][-1] < 0.05 * without["rotation"][-1]


@pytest.mark.parametrize("moved", ["velocity", "position"])
@pytest.mark.parametrize(("every", "later"), [(1, 0), (10, 0), (10, 3), (40, 7)])
def test_biases_are_recovered_whatever_the_rates_of_the_sensors(
    moved: str, every: int, later: int
) -> None:
    """A pose of 10 Hz and less, which meets the attitude at no sample where it is `later`."""
    position, velocity, attitude, rate, force = _motion()
    gyro, acc = np.array([0.02, -0.03, 0.01]), np.array([0.1, 0.2, -0.15])
    imu = ImuRecord.of(rate[:500] + gyro, force[:500] + acc, sample_time=DT)
    slow = {"velocity": velocity, "position": position}[moved][:500].copy()
    slow[np.arange(500) % every != later] = np.nan
    posed = attitude[:500].copy()
    posed[np.arange(500) % min(every, 5) != 0] = np.nan
    bias = estimate_imu_bias(imu, attitude=posed, **{moved: slow})
    np.testing.assert_allclose(bias.gyro, gyro, atol=2e-4)
    np.testing.assert_allclose(bias.accelerometer, acc, atol=1e-2)


def test_the_past_of_an_origin_does_not_matter_and_the_end_of_the_record_is_not_invented() -> None:
    position, velocity, attitude, rate, force = _motion()
    imu = ImuRecord.of(rate, force, sample_time=DT)
    k = np.array([N - 10])
    out = dead_reckoning(
        imu, k, attitude=attitude[k], velocity=velocity[k], position=position[k], steps=H
    )
    assert np.isfinite(out["position"][0, :9]).all()
    assert np.isnan(out["position"][0, 9:]).all()
    assert "velocity" not in dead_reckoning(imu, k, attitude=attitude[k], steps=H)


def test_missing_imu_samples_are_interpolated_and_a_missing_sensor_is_refused() -> None:
    rate = np.outer(np.arange(20.0), np.ones(3))
    rate[3, 1] = np.nan
    assert ImuRecord.of(rate, np.zeros((20, 3)), sample_time=DT).rate[3, 1] == pytest.approx(3.0)
    assert np.isnan(rate[3, 1])
    rate[:, 0] = np.nan
    with pytest.raises(DataError, match="all three axes"):
        ImuRecord.of(rate, np.zeros((20, 3)), sample_time=DT)
    with pytest.raises(DataError, match="adaptation window"):
        estimate_imu_bias(
            ImuRecord.of(np.zeros((30, 3)), np.zeros((30, 3)), sample_time=DT),
            attitude=np.tile(np.eye(4)[0], (30, 1)),
        )


def test_the_measured_attitude_takes_gyro_errors_out_of_the_translation() -> None:
    position, velocity, attitude, rate, force = _motion()
    imu = ImuRecord.of(rate + np.array([0.05, 0.0, 0.0]), force, sample_time=DT)
    k = np.arange(N - H)
    start = {"attitude": attitude[k], "velocity": velocity[k], "position": position[k]}
    record = attitude.copy()
    record[200] = np.nan
    plain = dead_reckoning(imu, k, steps=H, **start)
    helped = dead_reckoning(imu, k, steps=H, attitude_record=record, **start)
    truth = velocity[k + H]
    assert error_norms("velocity", plain["velocity"][:, -1], truth).max() > 0.05
    assert error_norms("velocity", helped["velocity"][:, -1], truth).max() < 1e-3
    np.testing.assert_array_equal(plain["rotation"], helped["rotation"])
    bias = estimate_imu_bias(imu, attitude=record, velocity=velocity, with_attitude_record=True)
    np.testing.assert_allclose(bias.accelerometer, 0.0, atol=2e-3)


def test_persistence_holds_the_last_measured_value() -> None:
    reference = {"position": np.arange(12.0).reshape(4, 3)}
    reference["position"][2] = np.nan
    held = persistence(reference, [1, 2], steps=5)["position"]
    assert held.shape == (2, 5, 3)
    np.testing.assert_array_equal(held[0], np.tile([3.0, 4.0, 5.0], (5, 1)))
    np.testing.assert_array_equal(held[1], held[0])
