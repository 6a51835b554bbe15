"""What the peers of discover regress on: discrepancy accelerations along a flight, and a library of
terms with the names of greybox's catalogue.

    y = (specific force - nominal force / m, domega/dt - nominal domega/dt), (n, 6)

The nominal model is the vehicle file's: its rotor lag, thrust and torque maps, inertia. Gyro and
everything that is compared with its derivative go through one Savitzky-Golay filter (1964), whose
window is WINDOW rows; rows are then thinned to one per window, so that the filter does not tie them
together. A term is what one parameter of an effect adds to y, to first order; effects without one
(those of pose and attitude, and a bias of the gyro) cannot be named from accelerations.
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
CORE = "core"
"""Terms of what the file is not sure of: sizes of thrust, torque and inertia, a lag. Always in."""
LATE = "command_delay|motor_lag|sensor_delay"
"""To first order in the delay these are one term."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Regression:
    """Thinned rows of one flight: y (n, 6), and effect -> terms (n, 6, parameters)."""

    y: Array
    terms: Mapping[str, Array]


def read_columns(path: Path) -> dict[str, Array]:
    """Columns of a flight log, on a uniform grid; lost rows are interpolated."""
    with path.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    raw = {n: np.array([float(r[n]) if r[n] else np.nan for r in rows]) for n in rows[0]}
    t = np.arange(raw["t"][0], raw["t"][-1], 1.0 / RATE)
    return {n: np.interp(t, raw["t"], v) for n, v in raw.items() if not np.isnan(v).any()}


def smooth(x: Array, derivative: int = 0) -> Array:
    """The filter, along the first axis."""
    return np.asarray(savgol_filter(x, WINDOW, ORDER, deriv=derivative, delta=1.0 / RATE, axis=0))


def rotor_speeds(vehicle: Vehicle, u: Array) -> Array:
    """nu (n, rotors) of the commands held over a row, at its begin, behind the file's lag."""
    lag = vehicle.effects.get("motor_lag")
    if lag is None:
        return u
    keep = float(np.exp(-1.0 / RATE / lag["tau"].value))
    late = np.concatenate([u[:1], u[:-1]])
    start = keep * late[:1]
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], late, axis=0, zi=start)[0])


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
    def of(cls, vehicle: Vehicle, columns: Mapping[str, Array]) -> Flight:
        """The flight as the vehicle file sees it."""
        u = np.stack([columns[f"u{i + 1}"] for i in range(len(vehicle.rotors))], axis=-1)
        gyro = np.stack([columns[c] for c in "pqr"], axis=-1)
        return cls(
            vehicle=vehicle,
            columns=columns,
            number={name: q.value for name, q in vehicle.quantities.items()},
            u=u,
            nu=rotor_speeds(vehicle, u),
            felt=smooth(np.stack([columns[c] for c in ("ax", "ay", "az")], axis=-1)),
            omega=smooth(gyro),
            turning=smooth(gyro, 1),
        )

    def curve(self, name: str) -> Array:
        """thrust or torque of every rotor."""
        return np.asarray(sum(self.number[f"{name}.c{k}"] * self.nu**k for k in range(3)))

    @property
    def slope(self) -> Array:
        """dT/dnu of every rotor [N]."""
        return self.number["thrust.c1"] + 2.0 * self.number["thrust.c2"] * self.nu

    @property
    def mass(self) -> float:
        """Of the file [kg]."""
        return self.number["mass"]

    @property
    def inertia(self) -> Array:
        """Diagonal of the file's [kg m^2]."""
        return np.array([self.number[f"inertia.{a}"] for a in ("xx", "yy", "zz")])

    def wrench(self, per_rotor: Array) -> Array:
        """Accelerations (n, 6) of a thrust of every rotor, smoothed."""
        arms = np.array([r.position for r in self.vehicle.rotors])
        torque = np.stack([per_rotor @ arms[:, 1], -per_rotor @ arms[:, 0]], axis=-1)
        out = np.zeros((len(per_rotor), 6))
        out[:, 2], out[:, 3:5] = per_rotor.sum(-1) / self.mass, torque / self.inertia[:2]
        return smooth(out)

    @property
    def yaw(self) -> Array:
        """Accelerations (n, 6) of the rotors' drag torque."""
        out = np.zeros((len(self.nu), 6))
        spins = np.array([r.spin for r in self.vehicle.rotors])
        out[:, 5] = -(self.curve("torque") @ spins) / self.inertia[2]
        return smooth(out)

    @property
    def swirl(self) -> Array:
        """Angular accelerations (n, 3) of the turning body."""
        return np.asarray(-np.cross(self.omega, self.omega * self.inertia) / self.inertia)

    @property
    def speeds(self) -> Array:
        """Rotor speeds [rad/s], smoothed."""
        return smooth(self.nu) * float(self.vehicle.actuator.speed_max or 1.0)


def regression(vehicle: Vehicle, columns: Mapping[str, Array]) -> Regression:
    """Discrepancy and terms of one flight."""
    f = Flight.of(vehicle, columns)
    pulled, yaw = f.wrench(f.curve("thrust")), f.yaw
    nominal = pulled + yaw + _padded(f.swirl)
    y = np.concatenate([f.felt, f.turning], axis=-1) - nominal
    turns = [_axis(some, 3 + i) for some in (pulled + yaw, _padded(f.swirl)) for i in range(3)]
    terms = {CORE: [pulled, yaw, *turns], **_rotor_terms(f), **_body_terms(f)}
    terms |= _imu_terms(f, nominal)
    lag = vehicle.effects.get("motor_lag")
    if lag is not None and lag["tau"].sigma > 0.0:
        terms[CORE] += terms[LATE]
    if "vx" in columns and "qw" in columns:
        terms |= _moving(columns, f.speeds.sum(-1), f.mass, f.inertia)
    few = slice(WINDOW, -WINDOW, WINDOW)
    return Regression(y=y[few], terms={n: np.stack(t, -1)[few] for n, t in terms.items()})


def _rotor_terms(f: Flight) -> dict[str, list[Array]]:
    """Terms of commands and rotors."""
    nu, slope = f.nu, f.slope
    # shares of sum zero: what one rotor gains the last one loses
    apart = np.eye(nu.shape[1])[:-1] - np.eye(nu.shape[1])[-1]
    terms = {
        LATE: [f.wrench(-slope * np.gradient(nu, 1.0 / RATE, axis=0))],
        "thrust_curve": [f.wrench(slope * (nu * nu - nu))],
        "command_saturation": [
            f.wrench(-slope * np.maximum(f.u - limit, 0.0)) for limit in (0.7, 0.8)
        ],
        "rotor_asymmetry": [f.wrench(f.curve("thrust") * gained) for gained in apart],
    }
    if "vbat" in f.columns:
        volts = f.columns["vbat"]
        fall = smooth(volts - np.mean(volts))[:, None]
        terms["battery_sag"] = [f.wrench(slope * nu) * fall]
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
            _padded(np.stack(moment, -1) / f.inertia) + _levered(f, axis)
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


def _moving(
    columns: Mapping[str, Array], total: Array, mass: float, inertia: Array
) -> dict[str, list[Array]]:
    """Terms that need velocity and attitude; total: sum of the rotor speeds [rad/s]."""
    w, x, y, z = (columns[n] for n in ("qw", "qx", "qy", "qz"))
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    world = smooth(np.stack([columns[c] for c in ("vx", "vy", "vz")], -1))
    v = np.einsum("ijn,ni->nj", turn, world)
    speed, zero = np.linalg.norm(v, axis=-1)[:, None], np.zeros(len(v))

    def push(force: Array) -> Array:
        return np.concatenate([force / mass, np.zeros_like(force)], axis=-1)

    drag = [push(-np.eye(3)[i] * v * total[:, None]) for i in range(3)]
    lift = np.stack([zero, zero, v[:, 0] ** 2 + v[:, 1] ** 2], -1)
    flap = np.stack([v[:, 1], -v[:, 0], zero], -1) * total[:, None]
    level = np.array([1.0, 1.0, 0.0]) * total[:, None]
    return {
        "rotor_drag": drag[:2],
        "axial_inflow": drag[2:],
        "translational_lift": [push(lift)],
        "parasitic_drag": [push(-np.eye(3)[i] * v * speed) for i in range(3)],
        "constant_force": [push(turn[i].T) for i in range(3)],
        "steady_wind": [push(turn[i].T * level) for i in range(2)],
        "blade_flapping": [_padded(flap / inertia)],
    }
