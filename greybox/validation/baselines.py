"""The rows beside every multi-step table: persistence as ceiling, dead reckoning with the measured IMU as floor.

A model that does not beat persistence knows nothing; one that comes near dead reckoning has nothing left to gain, since
dead reckoning is told the specific force and the rate that the model has to predict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.errors import DataError
from greybox.frames import GRAVITY, numeric
from greybox.symbolic import FloatArray
from greybox.validation.groups import error_vectors, group
from greybox.validation.samples import columns, complete_rows

IntArray = npt.NDArray[np.int64]


def persistence(references: Mapping[str, FloatArray], origins: npt.ArrayLike, *, steps: int) -> dict[str, FloatArray]:
    """Predictions (n, steps, dimension) per group: the last measured value at or before each origin, held.

    It holds the reference channel itself, smoothed velocities included, as the naive row of the IDSIA benchmark does.
    `references[group]` (N, dimension) of one stretch without gap; NaN where nothing was measured yet.
    """
    starts = np.asarray(origins, dtype=np.int64).ravel()
    held = {}
    for name, reference in references.items():
        group(name)
        seen = np.isfinite(reference).all(axis=1)
        last = np.maximum.accumulate(np.where(seen, np.arange(len(reference)), -1))[starts]
        value = np.where(last[:, None] >= 0, reference[last], np.nan)
        held[name] = np.broadcast_to(value[:, None, :], (len(starts), steps, reference.shape[1]))
    return held


@dataclass(frozen=True, kw_only=True)
class ImuBias:
    """Constant offsets of the IMU, measured = true + bias: gyro (3,) [rad/s] and accelerometer (3,) [m/s^2]."""

    gyro: FloatArray
    accelerometer: FloatArray

    @classmethod
    def zero(cls) -> ImuBias:
        """No bias."""
        return cls(gyro=np.zeros(3), accelerometer=np.zeros(3))


@dataclass(frozen=True, kw_only=True)
class ImuRecord:
    """Measured rate [rad/s] and specific force [m/s^2], (N, 3) each, uniform in time; `filled` samples were missing.

    Missing samples are interpolated linearly in time, since an integrator needs them all; `filled` counts them.
    """

    rate: FloatArray
    specific_force: FloatArray
    sample_time: float
    filled: int = 0

    @classmethod
    def of(cls, rate: npt.ArrayLike, specific_force: npt.ArrayLike, *, sample_time: float) -> ImuRecord:
        """From measured arrays (N, 3), NaN = missing. Raises `DataError` where a whole column is missing."""
        parts, filled = [], 0
        for name, values in (("rate", rate), ("specific force", specific_force)):
            array = columns(values, what=name).copy()
            if array.shape[1] != 3:
                raise DataError(f"{name}: wrong shape", expected="(N, 3)", got=str(array.shape))
            index = np.arange(len(array))
            for column in array.T:
                seen = np.isfinite(column)
                if not seen.any():
                    raise DataError(f"dead reckoning needs all three axes of the {name}", fix="leave this row out")
                filled += int(len(column) - seen.sum())
                column[~seen] = np.interp(index[~seen], index[seen], column[seen])
            parts.append(array)
        if len(parts[0]) != len(parts[1]):
            raise DataError("rate and specific force differ in length", got=f"{len(parts[0])} and {len(parts[1])}")
        return cls(rate=parts[0], specific_force=parts[1], sample_time=sample_time, filled=filled)


def dead_reckoning(
    imu: ImuRecord,
    origins: npt.ArrayLike,
    *,
    attitude: FloatArray,
    velocity: FloatArray | None = None,
    position: FloatArray | None = None,
    steps: int,
    bias: ImuBias | None = None,
    gravity: float = GRAVITY,
) -> dict[str, FloatArray]:
    """Predictions (n, steps, dimension) of rotation, velocity and position from start states at n origins.

    `attitude` (n, 4), `velocity` (n, 3) and `position` (n, 3) are the states at the origins, known causally: measured
    there, or a filter's. Without velocity only the rotation is predicted. Rates and world accelerations are taken as
    linear between samples: the rotation vector of a step is dt (w0 + w1)/2 + dt^2/12 w0 x w1 (P. G. Savage, "Strapdown
    inertial navigation integration algorithm design", J. Guidance 21(1), 1998, coning term), velocity and position
    integrate exactly. `specific_force` is that at the point whose position is predicted; lever arms are ignored.
    Predictions past the end of the record are NaN. Raises `DataError` where shapes do not match.
    """
    starts = np.asarray(origins, dtype=np.int64).ravel()
    for what, value, width in (("attitude", attitude, 4), ("velocity", velocity, 3), ("position", position, 3)):
        if value is not None and np.shape(value) != (len(starts), width):
            raise DataError(f"dead reckoning: {what}", expected=f"({len(starts)}, {width})", got=str(np.shape(value)))
    offset = ImuBias.zero() if bias is None else bias
    rate, force = imu.rate - offset.gyro, imu.specific_force - offset.accelerometer
    down, dt, last = np.array([0.0, 0.0, -gravity]), imu.sample_time, len(rate) - 1
    out = {"rotation": np.full((len(starts), steps, 4), np.nan)}
    if velocity is not None:
        out["velocity"] = np.full((len(starts), steps, 3), np.nan)
        if position is not None:
            out["position"] = np.full((len(starts), steps, 3), np.nan)
    if not len(starts):
        return out
    q = attitude / np.linalg.norm(attitude, axis=1, keepdims=True)
    v = np.zeros((len(starts), 3)) if velocity is None else np.array(velocity, dtype=np.float64)
    p = np.zeros_like(v) if position is None else np.array(position, dtype=np.float64)
    acceleration = numeric("rotate", q, force[starts]) + down
    for h in range(steps):
        now, later = np.minimum(starts + h, last), np.minimum(starts + h + 1, last)
        turn = 0.5 * dt * (rate[now] + rate[later]) + dt * dt / 12.0 * np.cross(rate[now], rate[later])
        q = numeric("multiply", q, numeric("exp", turn))
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        next_acceleration = numeric("rotate", q, force[later]) + down
        p = p + dt * v + dt * dt / 6.0 * (2.0 * acceleration + next_acceleration)
        v = v + 0.5 * dt * (acceleration + next_acceleration)
        acceleration = next_acceleration
        inside = starts + h + 1 <= last
        for name, value in (("rotation", q), ("velocity", v), ("position", p)):
            if name in out:
                out[name][inside, h] = value[inside]
    return out


def estimate_imu_bias(
    imu: ImuRecord,
    *,
    attitude: FloatArray,
    velocity: FloatArray | None = None,
    horizon: int = 25,
    gravity: float = GRAVITY,
    iterations: int = 3,
) -> ImuBias:
    """Biases that make dead reckoning over `horizon` steps agree with the measured pose of an adaptation window.

    `attitude` (N, 4), `velocity` (N, 3) measured in the window, NaN = missing; the window lies before every origin that
    the biases are used for, so that smoothed velocities are fair here. Without velocity the accelerometer bias stays 0.
    Gauss-Newton on the errors in units of their typical size. Raises `DataError` for a window that is too short.
    """
    starts = np.arange(len(imu.rate) - horizon)
    usable = complete_rows(attitude)
    if velocity is not None:
        usable &= complete_rows(velocity)
    starts = starts[usable[starts] & usable[starts + horizon]] if len(starts) else starts
    if len(starts) < 2 * horizon:
        raise DataError(
            f"IMU bias: {len(starts)} origins in the adaptation window",
            expected=f"at least {2 * horizon}",
            fix="adapt on more seconds",
        )

    def errors(value: FloatArray) -> FloatArray:
        predicted = dead_reckoning(
            imu,
            starts,
            attitude=attitude[starts],
            velocity=None if velocity is None else velocity[starts],
            steps=horizon,
            bias=ImuBias(gyro=value[:3], accelerometer=value[3:]),
            gravity=gravity,
        )
        turned = error_vectors("rotation", predicted["rotation"][:, -1], attitude[starts + horizon])
        if velocity is None:
            return turned.ravel() / 0.01
        moved = error_vectors("velocity", predicted["velocity"][:, -1], velocity[starts + horizon])
        # 0.01 rad and 0.05 m/s are typical of a quarter of a second; only their ratio matters.
        return np.concatenate([turned.ravel() / 0.01, moved.ravel() / 0.05])

    value, free = np.zeros(6), 3 if velocity is None else 6
    for _ in range(iterations):
        at = errors(value)
        jacobian = np.stack([(errors(value + 1e-4 * e) - at) / 1e-4 for e in np.eye(6)[:free]], axis=1)
        value[:free] -= np.linalg.lstsq(jacobian, at, rcond=None)[0]
    return ImuBias(gyro=value[:3], accelerometer=value[3:])
