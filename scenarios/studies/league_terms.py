"""What the peers of discover regress on: discrepancies along a flight, and a library of terms with
the names of greybox's catalogue.

    0:6    (specific force, domega/dt) less those of the nominal model (m/s^2, rad/s^2)
    6:12   what the pose says less what the IMU says: rates of the attitude less the gyro's (rad/s),
           dv/dt + g in body axes less the accelerometer's (m/s^2)
    12:    measured rotor speeds less the nominal model's, as shares of the largest

The last two where a log has them. The nominal model is the vehicle file's: its rotor lag, thrust
and torque maps, inertia. All that is compared goes through one Savitzky-Golay filter (1964), whose
window is WINDOW rows; rows are then thinned to one per window, so that the filter does not tie them
together. A term is what one parameter of an effect adds, to first order; without a pose, effects of
pose, attitude and gyro bias cannot be named.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter, savgol_filter

from greybox.model.vehicle import Vehicle

Array = NDArray[np.float64]
RATE = 100.0
WINDOW = 11
ORDER = 3
AXES = ("xx", "yy", "zz")
QUATERNION = ("qw", "qx", "qy", "qz")
LATER = 0.05
"""Time constant [s] of the lag that stands for all."""
AIR = 0.03
"""Share by which rotors are stronger or weaker than a file can know: the density of the air."""
SHORTEST = 0.002
"""Lag [s] below which none is believed."""
SWIRL = "swirl "
"""The moment of turning inertias that are not as stated; this and late clocks stay linear."""
CLOCK = 0.002
"""Standard deviation [s] of what clocks and integrators are off by, a part of a row."""
LATE = "command_delay|motor_lag"
"""Along accelerations these are one term, to first order."""
LATE_ALL = f"{LATE}|sensor_delay"
"""So is a late IMU where no pose tells its time."""
CLOCKS = {LATE: 1.0 / RATE, LATE_ALL: 1.0 / RATE, "sensor_delay": 1.0, "pose_delay": 1.0}
"""Effects whose first term is a delay of so many seconds."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Regression:
    """Thinned rows of one flight: y (n, channels), effect -> terms (n, channels, parameters), what
    the file is not sure of (n, channels, k), by name with its value there and standard deviation.
    """

    y: Array
    terms: Mapping[str, Array]
    core: Array
    known: Mapping[str, tuple[float, float]]


def read_columns(path: Path) -> dict[str, Array]:
    """Columns of a flight log, on a uniform grid; lost rows are interpolated."""
    with path.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    raw = {n: np.array([float(r[n]) if r[n] else np.nan for r in rows]) for n in rows[0]}
    if "qw" in raw:
        q = np.stack([raw[n] for n in QUATERNION])
        signs = np.cumprod(np.sign(np.sum(q[:, 1:] * q[:, :-1], axis=0)))
        raw |= dict(zip(QUATERNION, q * np.concatenate([[1.0], signs])))
    t = np.arange(raw["t"][0], raw["t"][-1], 1.0 / RATE)
    return {n: np.interp(t, raw["t"], v) for n, v in raw.items() if not np.isnan(v).any()}


def smooth(x: Array, derivative: int = 0) -> Array:
    """The filter, along the first axis."""
    return np.asarray(savgol_filter(x, WINDOW, ORDER, deriv=derivative, delta=1.0 / RATE, axis=0))


def lagged(x: Array, tau: float) -> Array:
    """First-order lag of values that are held over a row, at the begin of each."""
    keep = float(np.exp(-1.0 / RATE / tau))
    late = shifted(x)
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], late, axis=0, zi=keep * late[:1])[0])


def shifted(x: Array) -> Array:
    """One row later."""
    return np.concatenate([x[:1], x[:-1]])


def rotor_speeds(vehicle: Vehicle, u: Array, later: float = 0.0) -> Array:
    """nu (n, rotors) of the commands held over a row, at its begin, behind the file's lag and so
    many seconds more."""
    lag = vehicle.effects.get("motor_lag")
    return u if lag is None else lagged(u, max(lag["tau"].value + later, SHORTEST))


@dataclass(frozen=True, kw_only=True, eq=False)
class Flight:
    """Smoothed signals of a flight and the nominal model's accelerations along it.

    nu (n, rotors) and its thrust, drag, slope dT/dnu [N, N m, N]; u, felt (n, 3), omega, turning.
    """

    vehicle: Vehicle
    columns: Mapping[str, Array]
    number: Mapping[str, float]
    u: Array
    nu: Array
    felt: Array
    omega: Array
    turning: Array

    @classmethod
    def of(cls, vehicle: Vehicle, columns: Mapping[str, Array], off: Mapping[str, float]) -> Flight:
        """The flight as the vehicle file sees it, with its numbers off by so much."""
        u = np.stack([columns[f"u{i + 1}"] for i in range(len(vehicle.rotors))], axis=-1)
        gyro = np.stack([columns[c] for c in "pqr"], axis=-1)
        number = {name: q.value for name, q in vehicle.quantities.items()}
        for name in (n for n in number if n.startswith(("thrust", "torque"))):
            number[name] *= 1.0 + off.get(name.split(".")[0], 0.0)
        for name, key in (("mass", "mass"), *((f"inertia.{a}", a) for a in AXES)):
            number[name] /= 1.0 + off.get(key, 0.0)
        return cls(
            vehicle=vehicle,
            columns=columns,
            number=number,
            u=u,
            nu=rotor_speeds(vehicle, u, LATER * off.get("lag", 0.0)),
            felt=smooth(np.stack([columns[c] for c in ("ax", "ay", "az")], axis=-1)),
            omega=smooth(gyro),
            turning=smooth(gyro, 1),
        )

    def curve(self, name: str, nu: Array | None = None) -> Array:
        """thrust or torque of every rotor, at these speeds or the flight's."""
        nu = self.nu if nu is None else nu
        return np.asarray(sum(self.number[f"{name}.c{k}"] * nu**k for k in range(3)))

    def doubt(self, name: str) -> float:
        """Relative standard deviation of a number of the file."""
        q = self.vehicle.quantities[name]
        return float(q.sigma / abs(q.value)) if q.value else 0.0

    @property
    def mass(self) -> float:
        """Of the file [kg]."""
        return self.number["mass"]

    @property
    def hover(self) -> float:
        """Rotor speed at which the file's craft hovers."""
        c0, c1, c2 = (self.number[f"thrust.c{k}"] for k in range(3))
        lift = self.mass * self.vehicle.gravity / len(self.vehicle.rotors)
        return float(max(np.roots([c2, c1, c0 - lift]).real))

    @property
    def inertia(self) -> Array:
        """Diagonal of the file's [kg m^2]."""
        return np.array([self.number[f"inertia.{a}"] for a in AXES])

    def wrench(self, per_rotor: Array) -> Array:
        """Accelerations (n, 6) of a thrust of every rotor, smoothed."""
        arms = np.array([r.position for r in self.vehicle.rotors])
        torque = np.stack([per_rotor @ arms[:, 1], -per_rotor @ arms[:, 0]], axis=-1)
        out = np.zeros((len(per_rotor), 6))
        out[:, 2], out[:, 3:5] = per_rotor.sum(-1) / self.mass, torque / self.inertia[:2]
        return smooth(out)

    def yaw(self, per_rotor: Array) -> Array:
        """Accelerations (n, 6) of a drag torque of every rotor, smoothed."""
        out = np.zeros((len(per_rotor), 6))
        spins = np.array([r.spin for r in self.vehicle.rotors])
        out[:, 5] = -(per_rotor @ spins) / self.inertia[2]
        return smooth(out)

    def turned(self, nu: Array) -> Array:
        """Change (n, 12 + rotors) of accelerations and of rotor speeds at other speeds."""
        thrust = self.curve("thrust", nu) - self.curve("thrust")
        torque = self.curve("torque", nu) - self.curve("torque")
        pulled = self.wrench(thrust) + self.yaw(torque)
        return np.concatenate([pulled, np.zeros_like(pulled), smooth(nu - self.nu)], axis=-1)

    @property
    def swirl(self) -> Array:
        """Angular accelerations (n, 3) of the turning body."""
        return np.asarray(-np.cross(self.omega, self.omega * self.inertia) / self.inertia)

    @property
    def speeds(self) -> Array:
        """Rotor speeds [rad/s], smoothed."""
        return smooth(self.nu) * float(self.vehicle.actuator.speed_max or 1.0)


def regression(
    vehicle: Vehicle, columns: Mapping[str, Array], off: Mapping[str, float] | None = None
) -> Regression:
    """Discrepancy and terms of one flight; off: what the file's numbers are off by, for a second
    look from nearer by."""
    off = {n: v for n, v in (off or {}).items() if n not in CLOCKS and not n.startswith(SWIRL)}
    f = Flight.of(vehicle, columns, off)
    pulled, yaw = f.wrench(f.curve("thrust")), f.yaw(f.curve("torque"))
    nominal = pulled + yaw + _padded(f.swirl)
    turn = attitude(columns)
    rotors = f.nu.shape[1]
    parts = [np.concatenate([f.felt, f.turning], axis=-1) - nominal]
    kept = [*range(6)]
    terms = {**_rotor_terms(f), **_body_terms(f), **_imu_terms(f, nominal)}
    terms["payload_mass"] = [-_force(pulled)]
    if turn is None:
        terms[LATE_ALL] = [*terms.pop(LATE), *_late(nominal)]
    else:
        parts.append(pose_less_imu(f, turn))
        kept += range(6, 12)
        terms = _with_pose(f, terms, nominal) | _moving(f, turn)
    if "omega1" in columns:
        measured = np.stack([columns[f"omega{i + 1}"] for i in range(rotors)], axis=-1)
        kept += range(12, 12 + rotors)
        parts.append(smooth(measured / float(vehicle.actuator.speed_max or 1.0) - f.nu))
    y = np.concatenate(parts, axis=-1)
    core = _core(f, pulled, yaw)
    core |= {n: (CLOCK / unit, terms[n][0]) for n, unit in CLOCKS.items() if n in terms}
    declared = _declared(f, terms)
    terms = {n: t for n, t in terms.items() if n not in vehicle.effects}
    core |= {n: (doubt, term) for n, (_, doubt, term) in declared.items()}
    core = {n: known for n, known in core.items() if known[0] > 0.0}
    for name, (value, _, term) in declared.items():
        y[:, :6] -= (value + off.get(name, 0.0)) * term[:, :6]
    few = slice(WINDOW, -WINDOW, WINDOW)
    wide = {n: _channels(t, kept)[few] for n, t in terms.items()}
    held = _channels([term for _, term in core.values()], kept)[few]
    known = {n: (off.get(n, 0.0), float(doubt)) for n, (doubt, _) in core.items()}
    return Regression(y=y[few], terms=wide, core=held, known=known)


def _channels(terms: list[Array], kept: list[int]) -> Array:
    """Terms in the channels that a log has (n, channels, parameters); a narrow one adds nothing to
    the later channels."""
    out = np.zeros((len(terms[0]), kept[-1] + 1, len(terms)))
    for k, term in enumerate(terms):
        width = min(term.shape[1], out.shape[1])
        out[:, :width, k] = term[:, :width]
    return out[:, kept]


def _core(f: Flight, pulled: Array, yaw: Array) -> dict[str, tuple[float, Array]]:
    """What the file is not sure of: how sure it is, and what it adds. For a mass or an inertia this
    is the share that its inverse is off by."""
    turns = {a: f.doubt(f"inertia.{a}") for a in AXES}
    core = {
        "thrust": (float(np.hypot(AIR, f.doubt("thrust.c2"))), pulled),
        "torque": (float(np.hypot(AIR, f.doubt("torque.c2"))), yaw),
        "mass": (f.doubt("mass"), _force(pulled)),
    }
    for i, (axis, doubt) in enumerate(turns.items()):
        core[axis] = (doubt, _axis(pulled + yaw, 3 + i))
        core[SWIRL + axis] = (max(turns.values()), _axis(_padded(f.swirl), 3 + i))
    lag = f.vehicle.effects.get("motor_lag")
    if lag is not None:
        doubt = float(np.hypot(CLOCK, lag["tau"].sigma))
        core["lag"] = (doubt / LATER, f.turned(lagged(f.nu, LATER)))
    return core


def _declared(f: Flight, terms: Mapping[str, list[Array]]) -> dict[str, tuple[float, float, Array]]:
    """Value, standard deviation and term of every parameter of the file's effects."""
    return {
        f"{name}.{parameter}": (q.value, q.sigma, term)
        for name, numbers in f.vehicle.effects.items()
        for (parameter, q), term in zip(numbers.items(), terms.get(name, ()))
    }


def _rotor_terms(f: Flight) -> dict[str, list[Array]]:
    """Terms of commands and rotors."""
    thrust, torque, u = f.curve("thrust"), f.curve("torque"), f.u

    def commanded(change: Array, size: float = 0.1) -> Array:
        """Of a change of the commands, per unit."""
        return f.turned(f.nu + size * rotor_speeds(f.vehicle, change)) / size

    # shares of sum zero: what one rotor gains the last one loses
    apart = np.eye(u.shape[1])[:-1] - np.eye(u.shape[1])[-1]
    limits = [f.hover + share * (f.vehicle.actuator.u_max - f.hover) for share in (0.3, 0.5)]
    terms = {
        LATE: [f.turned(shifted(f.nu)), f.turned(lagged(f.nu, LATER))],
        "thrust_curve": [commanded(u * u - u)],
        "command_saturation": [commanded(-np.maximum(u - limit, 0.0), 1.0) for limit in limits],
        "rotor_asymmetry": [f.wrench(thrust * gain) + f.yaw(torque * gain) for gain in apart],
    }
    if "vbat" in f.columns:
        full = f.vehicle.nominal_voltage or float(np.mean(f.columns["vbat"]))
        fall = smooth(f.columns["vbat"] / full - 1.0)[:, None]
        terms["battery_sag"] = [f.turned(f.nu * (1.0 + 0.1 * fall)) / 0.1]
    return terms


def _body_terms(f: Flight) -> dict[str, list[Array]]:
    """Terms of the body and of moments on it."""
    omega, zero = f.omega, np.zeros(len(f.omega))
    lift = smooth(f.curve("thrust").sum(-1))
    spinning = f.speeds @ np.array([r.spin for r in f.vehicle.rotors])
    gyroscopic = np.stack(
        [-omega[:, 1] * spinning, omega[:, 0] * spinning, -np.gradient(spinning) * RATE], -1
    )
    pairs = ((0, 1), (0, 2), (1, 2))
    return {
        "center_of_mass_offset": [
            _padded(np.stack(moment, -1) / f.inertia) - _levered(f, axis)
            for axis, moment in enumerate(((zero, lift, zero), (-lift, zero, zero)))
        ],
        "rotational_damping": [_axis(_padded(-omega / f.inertia), 3 + i) for i in range(3)],
        "rotor_gyroscopic": [_padded(gyroscopic / f.inertia)],
        "products_of_inertia": [_product(omega, f.turning, f.inertia, i, j) for i, j in pairs],
    }


def _imu_terms(f: Flight, nominal: Array) -> dict[str, list[Array]]:
    """Terms of gyro and accelerometer: of the nominal motion, for the measured one would explain
    itself."""
    felt, turning = nominal[:, :3], nominal[:, 3:]
    return {
        "accelerometer_lever_arm": [_levered(f, i) for i in range(3)],
        "accelerometer_scale": [_axis(nominal, i) for i in range(3)],
        "accelerometer_bias": [_axis(np.ones_like(nominal), i) for i in range(3)],
        "gyro_scale": [_axis(nominal, 3 + i) for i in range(3)],
        "imu_misalignment": [
            np.concatenate([np.cross(felt, e), np.cross(turning, e)], -1) for e in np.eye(3)
        ],
    }


def attitude(columns: Mapping[str, Array]) -> Array | None:
    """Rotation matrices (3, 3, n), body to world; None where the log has no pose."""
    if "vx" not in columns or "qw" not in columns:
        return None
    w, x, y, z = (columns[n] for n in QUATERNION)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose_less_imu(f: Flight, turn: Array) -> Array:
    """(n, 6): rates and specific force as the pose has them, less gyro and accelerometer."""
    spin = np.einsum("ijn,njk->nik", turn.transpose(1, 0, 2), smooth(np.moveaxis(turn, -1, 0), 1))
    rates = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=-1)
    world = np.stack([f.columns[c] for c in ("vx", "vy", "vz")], axis=-1)
    lifted = smooth(world, 1) + np.array([0.0, 0.0, f.vehicle.gravity])
    felt = np.einsum("ijn,ni->nj", turn, lifted)
    return np.concatenate([rates - f.omega, felt - f.felt], axis=-1)


def _with_pose(
    f: Flight, terms: Mapping[str, list[Array]], nominal: Array
) -> dict[str, list[Array]]:
    """The terms of sensors where a pose stands beside the IMU (n, 12), forces as nominal."""
    zero, none = np.zeros_like(f.felt), np.zeros_like(nominal)
    eye = np.eye(3)
    force = nominal[:, :3]
    late = np.concatenate([f.turning, np.gradient(force, 1.0 / RATE, axis=0)], axis=-1)
    turned = [np.concatenate([np.cross(f.omega, e), np.cross(force, e)], -1) for e in eye]
    felt = {
        "accelerometer_bias": [_axis(np.ones_like(nominal), 3 + i) for i in range(3)],
        "accelerometer_scale": [_axis(_padded(force), 3 + i) for i in range(3)],
        "accelerometer_lever_arm": [np.roll(_levered(f, i), 3, axis=1) for i in range(3)],
        "gyro_scale": [_axis(np.concatenate([f.omega, zero], -1), i) for i in range(3)],
        "imu_misalignment": turned,
    }
    pairs = {n: [(t, -s) for t, s in zip(terms[n], seen)] for n, seen in felt.items()}
    pairs["gyro_bias"] = [(none, -_axis(np.ones_like(nominal), i)) for i in range(3)]
    both = (_late(nominal), [late, -np.gradient(late, 1.0 / RATE, axis=0)])
    pairs["sensor_delay"] = list(zip(*both))
    pairs["pose_delay"] = [(none, -late)]
    pairs["mocap_misalignment"] = [(none, t) for t in turned]
    pairs["pose_lever_arm"] = [(none, np.roll(_levered(f, i), 3, axis=1)) for i in range(3)]
    wide = {n: [np.concatenate(two, axis=-1) for two in some] for n, some in pairs.items()}
    return {**terms, **wide}


def _late(nominal: Array) -> list[Array]:
    """Accelerations that are late, and those that a low-pass took the corners off: first and second
    order."""
    first = np.gradient(nominal, 1.0 / RATE, axis=0)
    return [-first, np.gradient(first, 1.0 / RATE, axis=0)]


def _force(values: Array) -> Array:
    """Only the force."""
    out = values.copy()
    out[:, 3:] = 0.0
    return out


def _axis(values: Array, axis: int) -> Array:
    """Only this column."""
    out = np.zeros_like(values)
    out[:, axis] = values[:, axis]
    return out


def _padded(turning: Array) -> Array:
    return np.concatenate([np.zeros_like(turning), turning], axis=-1)


def _levered(f: Flight, axis: int) -> Array:
    """Specific force (n, 6) at a unit lever arm."""
    arm = np.eye(3)[axis]
    felt = np.cross(f.turning, arm) + np.cross(f.omega, np.cross(f.omega, arm))
    return np.concatenate([felt, np.zeros_like(felt)], axis=-1)


def _product(omega: Array, turning: Array, inertia: Array, i: int, j: int) -> Array:
    matrix = np.zeros((3, 3))
    matrix[i, j] = matrix[j, i] = 1.0
    moment = -turning @ matrix - np.cross(omega, omega @ matrix)
    return _padded(moment / inertia)


def _moving(f: Flight, turn: Array) -> dict[str, list[Array]]:
    """Terms that need velocity and attitude: what acts at a rotor's hub also turns the craft."""
    world = smooth(np.stack([f.columns[c] for c in ("vx", "vy", "vz")], -1))
    v = np.einsum("ijn,ni->nj", turn, world)
    speed, eye = np.linalg.norm(v, axis=-1)[:, None], np.eye(3)
    arms = np.array([r.position for r in f.vehicle.rotors])
    hubs = v[:, None] + np.cross(f.omega[:, None], arms)
    spinning = f.speeds[..., None]

    def push(force: Array) -> Array:
        return np.concatenate([force / f.mass, np.zeros_like(force)], axis=-1)

    def at_hubs(force: Array) -> Array:
        turning = np.cross(arms, force).sum(axis=1) / f.inertia
        return np.concatenate([force.sum(axis=1) / f.mass, turning], axis=-1)

    drag = [at_hubs(-spinning * hubs * eye[i]) for i in range(3)]
    lift = (hubs[..., :2] ** 2).sum(axis=-1)[..., None] * eye[2]
    flap = (spinning * np.cross(hubs, eye[2])).sum(axis=1)
    level, up = np.array([1.0, 1.0, 0.0]), eye[2]
    return {
        "rotor_drag": drag[:2],
        "axial_inflow": drag[2:],
        "translational_lift": [at_hubs(lift)],
        "parasitic_drag": [push(-eye[i] * v * speed) for i in range(3)],
        "constant_force": [push(turn[i].T) for i in range(3)],
        "steady_wind": [
            at_hubs(spinning * (turn[i].T * some)[:, None])
            for some in (level, up)
            for i in range(2)
        ],
        "blade_flapping": [_padded(flap / f.inertia)],
    }
