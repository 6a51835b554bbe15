"""The rows beside every multi-step table: persistence as ceiling, dead reckoning with the measured
IMU as floor.

A model that does not beat persistence knows nothing; one that comes near dead reckoning has nothing
left to gain, since dead reckoning is told the specific force and the rate that the model has to
predict.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.data import Flight, Segment
from greybox.errors import DataError
from greybox.frames import GRAVITY, numeric
from greybox.symbolic import FloatArray, IntArray
from greybox.validation.groups import GROUPS, error_vectors
from greybox.validation.samples import columns, complete_rows


def persistence(
    references: Mapping[str, FloatArray], origins: npt.ArrayLike, *, steps: int
) -> dict[str, FloatArray]:
    """Predictions (n, steps, dimension) per group: the last measured value at or before each
    origin, held.

    It holds the reference channel itself, smoothed velocities included, as the naive row of the
    IDSIA benchmark does. `references[group]` (N, dimension) of one stretch without gap; NaN where
    nothing was measured yet.
    """
    starts = np.asarray(origins, dtype=np.int64).ravel()
    held = {}
    for name, reference in references.items():
        seen = np.isfinite(reference).all(axis=1)
        last = np.maximum.accumulate(np.where(seen, np.arange(len(reference)), -1))[starts]
        value = np.where(last[:, None] >= 0, reference[last], np.nan)
        held[name] = np.broadcast_to(value[:, None, :], (len(starts), steps, reference.shape[1]))
    return held


@dataclass(frozen=True, kw_only=True)
class ImuBias:
    """Constant offsets of the IMU, measured = true + bias: gyro (3,) [rad/s] and accelerometer (3,)
    [m/s^2]."""

    gyro: FloatArray
    accelerometer: FloatArray

    @classmethod
    def zero(cls) -> ImuBias:
        """No bias."""
        return cls(gyro=np.zeros(3), accelerometer=np.zeros(3))


@dataclass(frozen=True, kw_only=True)
class ImuRecord:
    """Measured rate [rad/s] and specific force [m/s^2], (N, 3) each, uniform in time. Missing
    samples are interpolated linearly, since an integrator needs them all."""

    rate: FloatArray
    specific_force: FloatArray
    sample_time: float

    @classmethod
    def of(
        cls, rate: npt.ArrayLike, specific_force: npt.ArrayLike, *, sample_time: float
    ) -> ImuRecord:
        """From measured arrays (N, 3), NaN = missing. Raises `DataError` where a whole column is
        missing."""
        parts = []
        for name, values in (("rate", rate), ("specific force", specific_force)):
            array = columns(values, what=name).copy()
            if array.shape[1] != 3:
                raise DataError(f"{name}: wrong shape", expected="(N, 3)", got=str(array.shape))
            index = np.arange(len(array))
            for column in array.T:
                seen = np.isfinite(column)
                if not seen.any():
                    raise DataError(
                        f"dead reckoning needs all three axes of the {name}",
                        fix="leave this row out",
                    )
                column[~seen] = np.interp(index[~seen], index[seen], column[seen])
            parts.append(array)
        if len(parts[0]) != len(parts[1]):
            raise DataError(
                "rate and specific force differ in length",
                got=f"{len(parts[0])} and {len(parts[1])}",
            )
        return cls(rate=parts[0], specific_force=parts[1], sample_time=sample_time)


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """Hamilton products (4, n) of quaternions a, b (4, n)."""
    w, x, y, z = a
    return np.stack(
        [
            w * b[0] - x * b[1] - y * b[2] - z * b[3],
            w * b[1] + x * b[0] + y * b[3] - z * b[2],
            w * b[2] - x * b[3] + y * b[0] + z * b[1],
            w * b[3] + x * b[2] - y * b[1] + z * b[0],
        ]
    )


def _turned(q: FloatArray, v: FloatArray) -> FloatArray:
    """Vectors v (3, n) in body axes, in the world, for unit quaternions q (4, n)."""
    twice = 2.0 * _cross(q[1:], v)
    return v + q[0] * twice + _cross(q[1:], twice)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """a x b, (3, n)."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


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
    attitude_record: FloatArray | None = None,
) -> dict[str, FloatArray]:
    """Predictions (n, steps, dimension) of rotation, velocity and position from start states at n
    origins.

    `attitude` (n, 4), `velocity` (n, 3) and `position` (n, 3) are the states at the origins, known
    causally: measured there, or a filter's. Without velocity only the rotation is predicted. Rates
    and world accelerations are taken as linear between samples: the rotation vector of a step is dt
    (w0 + w1)/2 + dt^2/12 w0 x w1 (P. G. Savage, "Strapdown inertial navigation integration
    algorithm design", J. Guidance 21(1), 1998, coning term), velocity and position integrate
    exactly. `specific_force` is that at the point whose position is predicted; lever arms are
    ignored. With `attitude_record` (N, 4), the measured attitude of all samples, the specific force
    is turned into the world by that instead of by the integrated gyro: the tightest floor of
    velocity and position, which a causal predictor cannot have; the rotation is integrated as
    before. Predictions past the end of the record are NaN. Raises `DataError` where shapes do not
    match.
    """
    starts = np.asarray(origins, dtype=np.int64).ravel()
    _demand_shapes(len(starts), attitude, velocity, position)
    offset = ImuBias.zero() if bias is None else bias
    rate, force = imu.rate - offset.gyro, imu.specific_force - offset.accelerometer
    last, dt = len(rate) - 1, imu.sample_time
    out = {"rotation": np.full((len(starts), steps, 4), np.nan)}
    if velocity is not None:
        out["velocity"] = np.full((len(starts), steps, 3), np.nan)
        if position is not None:
            out["position"] = np.full((len(starts), steps, 3), np.nan)
    if not len(starts) or last < 1:
        return out
    steps_of, acceleration = _turns(rate, dt), _accelerations(force, attitude_record, gravity)
    q = (attitude / np.linalg.norm(attitude, axis=1, keepdims=True)).T
    v = np.zeros((3, len(starts))) if velocity is None else velocity.T
    p = np.zeros((3, len(starts))) if position is None else position.T
    before = acceleration(q, np.minimum(starts, last))
    for h in range(steps):
        q = _product(q, steps_of[:, np.minimum(starts + h, last - 1)])
        q = q / np.sqrt((q * q).sum(axis=0))
        after = acceleration(q, np.minimum(starts + h + 1, last))
        p = p + dt * v + dt * dt / 6.0 * (2.0 * before + after)
        v, before = v + 0.5 * dt * (before + after), after
        inside = starts + h + 1 <= last
        for name, state in (("rotation", q), ("velocity", v), ("position", p)):
            if name in out:
                out[name][inside, h] = state.T[inside]
    return out


def _accelerations(
    force: FloatArray, attitude_record: FloatArray | None, gravity: float
) -> Callable[[FloatArray, IntArray], FloatArray]:
    """(q (4, n), samples (n,)) -> acceleration (3, n) in the world, of specific force (N, 3) turned
    by q, or else by the record."""
    force = np.ascontiguousarray(force.T)
    if attitude_record is None:
        down = np.array([[0.0], [0.0], [gravity]])
        return lambda q, at: _turned(q, force[:, at]) - down
    world = np.ascontiguousarray(_world_acceleration(force.T, attitude_record, gravity).T)
    return lambda q, at: world[:, at]


def _turns(rate: FloatArray, dt: float) -> FloatArray:
    """Quaternions (4, N - 1) of the steps between samples of rate (N, 3): the turn of a step is
    that of its two samples, whatever the attitude."""
    turns = 0.5 * dt * (rate[:-1] + rate[1:]) + dt * dt / 12.0 * np.cross(rate[:-1], rate[1:])
    return np.ascontiguousarray(numeric("exp", turns).T)


def _demand_shapes(
    n: int, attitude: FloatArray, velocity: FloatArray | None, position: FloatArray | None
) -> None:
    for what, value, width in (
        ("attitude", attitude, 4),
        ("velocity", velocity, 3),
        ("position", position, 3),
    ):
        if value is not None and np.shape(value) != (n, width):
            raise DataError(
                f"dead reckoning: {what}", expected=f"({n}, {width})", got=str(np.shape(value))
            )


def _world_acceleration(force: FloatArray, attitude: FloatArray, gravity: float) -> FloatArray:
    """Acceleration (N, 3) in the world from specific force and measured attitude; missing ones are
    interpolated."""
    seen = complete_rows(attitude)
    if attitude.shape != (len(force), 4) or not seen.any():
        raise DataError(
            "dead reckoning: attitude record", expected=f"({len(force)}, 4), not all missing"
        )
    index = np.arange(len(force))
    out = np.empty((len(force), 3))
    turned = numeric("rotate", attitude[seen], force[seen]) - np.array([0.0, 0.0, gravity])
    for axis in range(3):
        out[:, axis] = np.interp(index, index[seen], turned[:, axis])
    return out


def has_groups(channels: Iterable[str], *groups: str) -> bool:
    """Whether all columns of the groups are among `channels`."""
    return set(channels).issuperset(c for g in groups for c in GROUPS[g].columns)


def group_matrix(segment: Segment, group: str) -> FloatArray:
    """Values (N, dimension) of a group; NaN where not measured, and everywhere where a column is
    absent."""
    return segment.matrix(GROUPS[group].columns, missing_ok=True)


def imu_record(segment: Segment) -> ImuRecord:
    """The measured IMU of a segment."""
    return ImuRecord.of(
        group_matrix(segment, "rate"),
        group_matrix(segment, "specific_force"),
        sample_time=segment.dt,
    )


def bias_at_start(flight: Flight, seconds: float, gravity: float) -> ImuBias:
    """Biases that the first `seconds` of a flight show; none without an IMU and an attitude, or 0 s.

    Raises `DataError` for a window that is too short.
    """
    if not seconds or not has_groups(flight.channels, "rate", "specific_force", "rotation"):
        return ImuBias.zero()
    begin = float(flight.segments[0].t[0])
    window = flight.segments[0].between(begin, begin + seconds - 1e-9)
    moved = {
        g: group_matrix(window, g)
        for g in ("velocity", "position")
        if has_groups(flight.channels, g)
    }
    return estimate_imu_bias(
        imu_record(window),
        attitude=group_matrix(window, "rotation"),
        velocity=moved.get("velocity"),
        position=moved.get("position"),
        gravity=gravity,
    )


def estimate_imu_bias(
    imu: ImuRecord,
    *,
    attitude: FloatArray,
    velocity: FloatArray | None = None,
    position: FloatArray | None = None,
    horizon: int = 25,
    gravity: float = GRAVITY,
    iterations: int = 3,
    with_attitude_record: bool = False,
) -> ImuBias:
    """Biases that make dead reckoning over `horizon` steps agree with the measured pose of an
    adaptation window.

    `attitude` (N, 4), `velocity` (N, 3), `position` (N, 3) measured in the window, NaN = missing;
    the window lies before every origin that the biases are used for, so that smoothed velocities
    are fair here. Every measured attitude is an origin. A sensor that is slower than the IMU is
    compared where it was measured next. Positions stand in for a velocity that is not measured;
    without either the accelerometer bias stays 0. `with_attitude_record` as in `dead_reckoning`.
    Gauss-Newton on the errors in units of their typical size. Raises `DataError` for a window that
    is too short.
    """
    starts, turned, moves, record = _origins(imu, attitude, velocity, position, horizon)

    def errors(value: FloatArray) -> FloatArray:
        predicted = dead_reckoning(
            imu,
            starts,
            attitude=attitude[starts],
            velocity=np.zeros((len(starts), 3)),
            position=np.zeros((len(starts), 3)),
            steps=int(np.max([turned, *moves] - starts)),
            bias=ImuBias(gyro=value[:3], accelerometer=value[3:]),
            gravity=gravity,
            attitude_record=attitude if with_attitude_record else None,
        )
        end = predicted["rotation"][np.arange(len(starts)), turned - starts - 1]
        # 0.01 rad and 0.05 m/s are typical of a quarter of a second; only their ratio matters.
        out = [error_vectors("rotation", end, attitude[turned]).ravel() / 0.01]
        if record is not None:
            path = predicted["position" if velocity is None else "velocity"]
            typical = 0.05 * (horizon * imu.sample_time if velocity is None else 1.0)
            out.append(_moved(path, record, starts, moves).ravel() / typical)
        return np.concatenate(out)

    value, free = np.zeros(6), 3 if record is None else 6
    for _ in range(iterations):
        at = errors(value)
        jacobian = np.stack(
            [(errors(value + 1e-4 * e) - at) / 1e-4 for e in np.eye(6)[:free]], axis=1
        )
        value[:free] -= np.linalg.lstsq(jacobian, at, rcond=None)[0]
    return ImuBias(gyro=value[:3], accelerometer=value[3:])


def _origins(
    imu: ImuRecord,
    attitude: FloatArray,
    velocity: FloatArray | None,
    position: FloatArray | None,
    horizon: int,
) -> tuple[IntArray, IntArray, list[IntArray], FloatArray | None]:
    """(origins (n,), samples alike at which the rotation and between which the motion is compared,
    the record of the motion). Raises `DataError` where these span too little of the window."""
    starts = np.flatnonzero(complete_rows(attitude))
    turned = _next_measured(attitude, starts + horizon)
    moves, record = _moves(velocity, position, starts, horizon)
    inside = np.all([row < len(attitude) for row in (turned, *moves)], axis=0)
    reach = np.ptp(starts[inside]) + 1 if inside.any() else 0
    if reach < 2 * horizon:
        raise DataError(
            f"IMU bias: origins over {reach * imu.sample_time:.3g} s of the adaptation window",
            expected=f"at least {2 * horizon * imu.sample_time:.3g} s",
            fix="adapt on more seconds",
        )
    # Neighbouring origins share most of their samples.
    cell = (starts - starts[inside][0]) // max(1, horizon // 5)
    kept = np.flatnonzero(inside)[np.unique(cell[inside], return_index=True)[1]]
    return starts[kept], turned[kept], [row[kept] for row in moves], record


def _next_measured(record: FloatArray, rows: IntArray) -> IntArray:
    """The first complete samples of `record` (N, d) at or after `rows`; N where there is none."""
    seen = np.append(np.flatnonzero(complete_rows(record)), len(record))
    return seen[np.minimum(np.searchsorted(seen, rows), len(seen) - 1)]


def _moves(
    velocity: FloatArray | None, position: FloatArray | None, starts: IntArray, horizon: int
) -> tuple[list[IntArray], FloatArray | None]:
    """(samples after every start between which the motion is compared, the record of it): two
    velocities, or else three positions, whose start needs no velocity."""
    record = position if velocity is None else velocity
    if record is None:
        return [], None
    rows = [_next_measured(record, starts)]
    for _ in range(1 if velocity is not None else 2):
        rows.append(_next_measured(record, rows[-1] + horizon))
    return rows, record


def _moved(
    path: FloatArray, record: FloatArray, starts: IntArray, rows: list[IntArray]
) -> FloatArray:
    """Errors (n, 3) of what a `path` (n, steps, 3) that starts from zero changes by between `rows`,
    against the `record`; of three rows less what an unknown constant rate adds."""
    begin = np.zeros((len(starts), 1, 3))
    whole, each = np.concatenate([begin, path], axis=1), np.arange(len(starts))
    first, *more = [whole[each, row - starts] - record[row] for row in rows]
    if len(more) == 1:
        return more[0] - first
    share = ((rows[2] - rows[0]) / (rows[1] - rows[0]))[:, None]
    return more[1] - first - share * (more[0] - first)
