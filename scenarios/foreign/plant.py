"""The plant contract around a foreign simulator: commands in, the columns of a flight log out.

Frames: world ENU, body FLU from the body origin, quaternion (w, x, y, z) body to world. What
differs in a simulator is converted in the file of that simulator and nowhere else. `measure()`
reports the state at t_k; `step(u, dt)` holds u from t_k to t_k + dt; the accelerometer at t_k feels
the gust of the step that begins at t_k.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scenarios.foreign.craft import Craft
from scenarios.foreign.gusts import Gusts
from scenarios.plants.airframe import Airframe
from scenarios.plants.noise import SensorNoise, axes
from scenarios.plants.quadrotor import STATES
from scenarios.plants.vectors import (
    ZERO,
    Quaternion,
    Vector,
    add,
    apply,
    apply_transposed,
    cross,
    multiply,
    norm,
    quaternion_of,
    rotation,
    subtract,
)

_SAME_INSTANT = 1e-9


class MissingSimulator(RuntimeError):
    """The package of a simulator is not installed."""

    def __init__(self, package: str) -> None:
        super().__init__(f"{package} is not installed; it comes with: pip install \"greybox-sysid[judge]\"")


@dataclass(frozen=True, kw_only=True)
class Motion:
    """A craft at one instant: centre of mass, world; attitude; rates and their rate of change,
    body; speeds as nu."""

    position: Vector
    velocity: Vector
    acceleration: Vector
    attitude: Quaternion
    rates: Vector
    turning: Vector
    nu: tuple[float, ...]


class ForeignPlant(ABC):
    """A craft in a foreign simulator: `reset(seed)`, `step(u, dt)`, `measure()`, `truth()`.

    sample_time [s]: the interval over which a gust is constant.
    """

    batch: int | None = None
    """A foreign plant is always one vehicle."""
    simulator: str = ""

    def __init__(
        self, craft: Craft, *, sensors: SensorNoise | None = None, sample_time: float = 0.01
    ) -> None:
        self.craft = craft
        self.sensors = sensors or SensorNoise()
        self.sample_time = sample_time
        self.reset(0)

    @property
    def airframe(self) -> Airframe:
        """The true airframe."""
        return self.craft.airframe

    def reset(
        self,
        seed: int | Sequence[int] = 0,
        *,
        position: Vector = (0.0, 0.0, 1.0),
        velocity: Vector = ZERO,
        attitude: Quaternion = (1.0, 0.0, 0.0, 0.0),
        rates: Vector = ZERO,
        charge_used: float = 0.0,
    ) -> None:
        """Start anew at t = 0 with rotors at hover speed; arguments as in
        `scenarios.plants.quadrotor.Quadrotor`.

        Raises ValueError for a sequence of seeds: a foreign plant flies alone.
        """
        if not isinstance(seed, int | np.integer):
            raise ValueError("a foreign plant flies one vehicle: give one seed")
        hover = float(self.airframe.hover_speed)
        self.time = 0.0
        self._charge = charge_used
        self._history: list[tuple[float, tuple[float, ...]]] = [(-math.inf, (hover,) * 4)]
        self._gusts = Gusts(self.craft.air, self.sample_time, int(seed))
        self._random = np.random.default_rng([int(seed), 0])
        self._row = self._draw()
        x, y, z = (float(v) for v in position)
        w, i, j, k = (float(v) for v in attitude)
        vx, vy, vz = (float(v) for v in velocity)
        start = ((x, y, z), (vx, vy, vz), (w, i, j, k), rates)
        self._motion: Motion | None = None
        self._start(*start, hover)
        self.voltage = self._voltage()
        # rotors turn as fast as the hover command makes them at this voltage
        self._start(*start, self._target((hover,))[0])
        self._motion = None

    @abstractmethod
    def _start(
        self, position: Vector, velocity: Vector, attitude: Quaternion, rates: Vector, nu: float
    ) -> None:
        """Put the simulator's craft there, all rotors at speed nu."""

    @abstractmethod
    def _hold(
        self, target: tuple[float, ...], wind: Vector, twist: Vector, duration: float
    ) -> None:
        """Let the rotors run towards `target` (nu) for `duration` [s] in this wind [m/s] and moment
        [N m]."""

    @abstractmethod
    def _look(self, wind: Vector, twist: Vector) -> Motion:
        """The present motion in this wind [m/s] and under this moment of the gusts [N m, body]."""

    @property
    def exact(self) -> dict[str, float]:
        """Parameters of effects that this simulator has in just the form of greybox's catalogue."""
        return {}

    @property
    def near(self) -> dict[str, float]:
        """Parameters of catalogue effects that come near to what this simulator does in a form of
        its own."""
        return {}

    def _draw(self) -> list[float]:
        return [float(v) for v in self._random.standard_normal(20 + len(self.airframe.rotors))]

    def _voltage(self) -> float:
        if self.craft.battery is None:
            return math.nan
        nu = list(self._now().nu)
        return float(self.craft.battery.voltage(self._charge, self.craft.battery.current(nu)))

    def _twist(self) -> Vector:
        """Moment of the gusts on the body [N m]."""
        x, y, z = (j * s for j, s in zip(self.airframe.inertia, self._gusts.swirl))
        return (x, y, z)

    def _now(self) -> Motion:
        if self._motion is None:
            self._motion = self._look(self._gusts.wind, self._twist())
        return self._motion

    def _target(self, command: tuple[float, ...]) -> tuple[float, ...]:
        """Rotor speeds (nu) that these commands end at under the present voltage."""
        factor = 1.0
        nominal = self.airframe.nominal_voltage
        if self.craft.battery is not None and nominal is not None:
            factor += self.craft.sag * (self.voltage - nominal) / nominal
        return tuple(
            factor * min(max(u, self.airframe.u_min), self.airframe.u_max) for u in command
        )

    def _pieces(self, length: float) -> list[tuple[float, tuple[float, ...]]]:
        """Durations [s] of the next `length` s and the commands that reach the rotors in them."""
        delay, begin, end = self.craft.delay, self.time, self.time + length
        pieces: list[tuple[float, tuple[float, ...]]] = []
        for k, (sent, command) in enumerate(self._history):
            until = self._history[k + 1][0] + delay if k + 1 < len(self._history) else math.inf
            duration = min(until, end) - max(sent + delay, begin)
            if duration > _SAME_INSTANT:
                pieces.append((duration, command))
        return pieces

    def step(self, u: Sequence[float], dt: float | None = None) -> None:
        """Hold command u (n,) for dt [s] (default: sample_time).

        Raises ValueError unless there is one command per rotor.
        """
        length = self.sample_time if dt is None else dt
        command = tuple(float(v) for v in u)
        if len(command) != len(self.airframe.rotors):
            raise ValueError(
                f"{len(self.airframe.rotors)} rotors need as many commands, got {len(command)}"
            )
        self._history.append((self.time, command))
        wind, twist = self._gusts.wind, self._twist()
        for duration, held in self._pieces(length):
            self._hold(self._target(held), wind, twist, duration)
        self.time += length
        reach = self.time - self.craft.delay - _SAME_INSTANT
        while len(self._history) > 1 and self._history[1][0] <= reach:
            del self._history[0]
        self._motion = None
        self._gusts.advance()
        self._row = self._draw()
        if self.craft.battery is not None:
            self._charge += length * float(self.craft.battery.current(list(self._now().nu)))
            self.voltage = self._voltage()

    def measure(self, u: Sequence[float] | None = None, *, noise: bool = True) -> dict[str, float]:
        """Measurements at the present time by flight-log column.

        u: the command that begins now, if already known; else the last one is reported. Repeating
        the call gives the same noise. Pose, velocity and IMU are those of the body origin and of
        the airframe's IMU position.
        """
        row = self._row if noise else [0.0] * len(self._row)
        motion, frame, sensors = self._now(), self.airframe, self.sensors
        turn = rotation(motion.attitude)
        origin = subtract(ZERO, frame.center_of_mass)
        imu = subtract(frame.imu_position, frame.center_of_mass)
        ax, ay, az = motion.acceleration
        felt = apply_transposed(turn, (ax, ay, az + frame.gravity))
        spun = cross(motion.rates, cross(motion.rates, imu))
        felt = add(felt, add(cross(motion.turning, imu), spun))
        position = add(motion.position, apply(turn, origin))
        velocity = add(motion.velocity, apply(turn, cross(motion.rates, origin)))
        attitude = multiply(
            motion.attitude, quaternion_of(_noisy(ZERO, sensors.attitude, row[6:9]))
        )
        command = self._history[-1][1] if u is None else [float(v) for v in u]
        out = {"t": self.time}
        out |= {f"u{i}": v for i, v in enumerate(command, 1)}
        if self.craft.battery is not None:
            out["vbat"] = self.voltage + float(sensors.voltage) * row[15]
        out |= dict(zip(("qw", "qx", "qy", "qz"), attitude))
        out |= dict(zip("pqr", _noisy(motion.rates, sensors.gyro, row[0:3])))
        out |= dict(zip(("ax", "ay", "az"), _noisy(felt, sensors.accelerometer, row[3:6])))
        out |= dict(zip("xyz", _noisy(position, sensors.position, row[9:12])))
        out |= dict(zip(("vx", "vy", "vz"), _noisy(velocity, sensors.velocity, row[12:15])))
        for i, n in enumerate(motion.nu, 1):
            out[f"omega{i}"] = self.craft.speed_max * n + float(sensors.rotor_speed) * row[15 + i]
        return out

    def states(self) -> dict[str, float]:
        """True state now: centre of mass, attitude, rates, nu1..n, voltage, wind."""
        motion = self._now()
        rigid = (*motion.position, *motion.velocity, *motion.attitude, *motion.rates)
        out = {name: float(value) for name, value in zip(STATES, rigid)}
        out |= {f"nu{i}": n for i, n in enumerate(motion.nu, 1)}
        out["voltage"] = self.voltage
        return out | dict(zip(("wind_x", "wind_y", "wind_z"), self._gusts.wind))

    def parameters(self) -> dict[str, float]:
        """True parameters by catalogue name, of what has the form of the catalogue."""
        found = self.craft.parameters() | self.exact
        return {name: value for name, value in found.items() if name not in self.near}

    def truth(self) -> dict[str, Any]:
        """Everything a log does not say: `parameters`, `near`, `states`, `sensor_noise`."""
        return {
            "simulator": self.simulator,
            "parameters": self.parameters(),
            "near": self.near,
            "states": self.states(),
            "sensor_noise": vars(self.sensors).copy(),
        }

    def energy(self) -> float:
        """Kinetic and potential energy of the body [J]."""
        motion, frame = self._now(), self.airframe
        spinning = apply(frame.inertia_matrix, motion.rates)
        turning = sum(a * b for a, b in zip(motion.rates, spinning))
        height = frame.gravity * motion.position[2]
        return float(frame.mass * (0.5 * norm(motion.velocity) ** 2 + height) + 0.5 * turning)


def _noisy(value: Vector, level: Any, row: Sequence[float]) -> Vector:
    """Value plus white noise from three standard normals."""
    sx, sy, sz = axes(level)
    x, y, z = (float(v) + s * n for v, s, n in zip(value, (sx, sy, sz), row))
    return (x, y, z)
