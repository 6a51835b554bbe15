"""The plant contract around a foreign simulator: commands in, the columns of a flight log out.

Frames: world ENU, body FLU from the body origin, quaternion (w, x, y, z) body to world. What
differs in a simulator is converted in the file of that simulator and nowhere else. `measure()`
reports the state at t_k; `step(u, dt)` holds u from t_k to t_k + dt; the accelerometer at t_k feels
the gust of the step that begins at t_k. Effects that the simulator does not have act from outside
(`loads`): their force and moment follow the motion every `LOAD_STEP`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from greybox.plants.airframe import Airframe
from greybox.plants.effects.base import PlantEffect
from greybox.plants.noise import SensorNoise, axes
from greybox.plants.quadrotor import STATES
from greybox.plants.vectors import (
    ZERO,
    Command,
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
from scenarios.foreign.craft import Craft
from scenarios.foreign.gusts import Gusts
from scenarios.foreign.loads import Instant, Load, Loads

_SAME_INSTANT = 1e-9
LOAD_STEP = 0.005
"""Longest time [s] over which the force of an outside effect is held, at the motion foretold for
its middle."""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Sensors without noise: rates and specific force; attitude, position and velocity of the
    origin."""

    gyro: Vector
    felt: Vector
    attitude: Quaternion
    position: Vector
    velocity: Vector


class MissingSimulator(RuntimeError):
    """The package of a simulator is not installed."""

    def __init__(self, package: str) -> None:
        super().__init__(
            f'{package} is not installed; it comes with: pip install "greybox-sysid[judge]"'
        )


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

    sample_time [s]: the interval over which a gust is constant. effects: what acts from outside.
    """

    batch: int | None = None
    """A foreign plant is always one vehicle."""
    simulator: str = ""

    def __init__(
        self,
        craft: Craft,
        *,
        sensors: SensorNoise | None = None,
        sample_time: float = 0.01,
        effects: Sequence[PlantEffect] = (),
    ) -> None:
        self.craft = craft
        self.sensors = sensors or SensorNoise()
        self.sample_time = sample_time
        self._loads = Loads(effects, craft)
        self._loaded = bool(self._loads.push or craft.air.push or craft.air.turn)
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
        `greybox.plants.quadrotor.Quadrotor`.

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
        self._loads.reset()
        self._aim: tuple[float, ...] | None = None
        self._kept: list[tuple[float, Reading]] = []
        x, y, z = (float(v) for v in position)
        w, i, j, k = (float(v) for v in attitude)
        vx, vy, vz = (float(v) for v in velocity)
        start = ((x, y, z), (vx, vy, vz), (w, i, j, k), rates)
        self._motion: Motion | None = None
        self.voltage = math.nan
        self._start(*start, hover)
        self.voltage = self._voltage()
        # rotors turn as fast as the hover command makes them at this voltage
        self._start(*start, self._target((hover,))[0])
        self._motion = None
        if self._late:
            self._kept = [(-math.inf, self._read(self._now()))]

    @abstractmethod
    def _start(
        self, position: Vector, velocity: Vector, attitude: Quaternion, rates: Vector, nu: float
    ) -> None:
        """Put the simulator's craft there, all rotors at speed nu."""

    @abstractmethod
    def _hold(
        self, target: tuple[float, ...], wind: Vector, twist: Vector, load: Load, duration: float
    ) -> None:
        """Let the rotors run towards `target` (nu) for `duration` [s] in this wind [m/s], swirl
        [N m] and load."""

    @abstractmethod
    def _look(self, wind: Vector, twist: Vector, load: Load) -> Motion:
        """The present motion in this wind [m/s], swirl of the gusts [N m, body] and load."""

    def goes_on_as(self, craft: Craft) -> ForeignPlant:
        """This flight with another craft from now on: its motion, commands, sensors' noise and
        gusts go on, in the air of the new one. Hidden states of outside effects begin anew.

        Raises ValueError where the simulator has no way to do so.
        """
        other = type(self)(
            craft, sensors=self.sensors, sample_time=self.sample_time, effects=self._loads.effects
        )
        other.time, other.voltage, other._charge = self.time, self.voltage, self._charge
        # what was sent before all that is remembered counts, should commands come later from now on
        other._history = [(-math.inf, self._history[0][1]), *self._history[1:]]
        other._gusts, other._gusts.air = self._gusts, craft.air
        other._random, other._row, other._aim = self._random, self._row, self._aim
        other._kept = list(self._kept)
        other._carry_over(self)
        other._motion = None
        return other

    def _carry_over(self, before: ForeignPlant) -> None:
        """Take the simulator's state from a plant of the same kind."""
        raise ValueError(f"a craft in {self.simulator} cannot change in flight")

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
            wind, twist = self._gusts.wind, self._twist()
            self._motion = self._look(wind, twist, Load())
            if self._loaded:
                self._motion = self._look(wind, twist, self._load(self._motion))
        return self._motion

    def _instant(self, motion: Motion, ahead: float = 0.0) -> Instant:
        """What outside effects see, `ahead` [s] of this motion if nothing changes."""
        aim = motion.nu if self._aim is None else self._aim
        left = math.exp(-ahead / self.craft.lag)
        nu = tuple(a + left * (n - a) for a, n in zip(aim, motion.nu))
        turned = quaternion_of(_on(ZERO, motion.rates, ahead))
        return Instant(
            time=self.time + ahead,
            position=_on(motion.position, motion.velocity, ahead),
            velocity=_on(motion.velocity, motion.acceleration, ahead),
            attitude=multiply(motion.attitude, turned) if ahead else motion.attitude,
            rates=_on(motion.rates, motion.turning, ahead),
            nu=nu,
            nu_rate=tuple((a - n) / self.craft.lag for a, n in zip(aim, nu)),
            wind=self._gusts.wind,
            voltage=self.voltage,
        )

    def _load(self, motion: Motion, ahead: float = 0.0) -> Load:
        """Force and moment of gusts and outside effects, `ahead` [s] of this motion."""
        seen = self._instant(motion, ahead)
        moment = apply(self.airframe.inertia_matrix, self._gusts.turn)
        push = apply_transposed(rotation(seen.attitude), self._gusts.push)
        return Load(push, moment).plus(self._loads.at(seen))

    def _run(self, target: tuple[float, ...], duration: float) -> None:
        """Hold the target for `duration` [s], under the loads that act."""
        self._aim = target
        wind, twist = self._gusts.wind, self._twist()
        if not self._loaded:
            self._hold(target, wind, twist, Load(), duration)
            return
        count = math.ceil(duration / LOAD_STEP - _SAME_INSTANT)
        length = duration / count
        for _ in range(count):
            motion = self._look(wind, twist, Load())
            middle = self._load(motion, 0.5 * length)
            self._loads.advance(self._instant(motion, 0.5 * length), length)
            self._hold(target, wind, twist, middle, length)

    @property
    def _late(self) -> bool:
        return bool(self._loads.imu_delay or self._loads.pose_delay)

    def _target(self, command: tuple[float, ...]) -> tuple[float, ...]:
        """Rotor speeds (nu) that these commands end at under the present voltage."""
        factor = 1.0
        nominal = self.airframe.nominal_voltage
        if self.craft.battery is not None and nominal is not None:
            factor += self.craft.sag * (self.voltage - nominal) / nominal
        low, high = self.airframe.u_min, self.airframe.u_max
        return tuple(factor * self._loads.command(min(max(u, low), high)) for u in command)

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

    def step(self, u: Command, dt: float | None = None) -> None:
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
        begin, done = self.time, 0.0
        marks = self._marks(length)
        for duration, held in self._pieces(length):
            inside = [m for m in marks if done < m - _SAME_INSTANT <= done + duration]
            for until in (*inside, done + duration):
                if until - done > _SAME_INSTANT:
                    self._run(self._target(held), until - done)
                    duration -= until - done
                    done = until
                if until in marks:
                    self._motion = None
                    self._kept.append((begin + done, self._read(self._now())))
        self.time = begin + length
        del self._kept[: -2 - round(self._longest / length)]
        reach = self.time - self.craft.delay - _SAME_INSTANT
        while len(self._history) > 1 and self._history[1][0] <= reach:
            del self._history[0]
        self._motion = None
        self._gusts.advance()
        self._row = self._draw()
        if self.craft.battery is not None:
            self._charge += length * float(self.craft.battery.current(list(self._now().nu)))
            self.voltage = self._voltage()

    @property
    def _longest(self) -> float:
        return max(self._loads.imu_delay, self._loads.pose_delay)

    def _marks(self, length: float) -> list[float]:
        """Instants in the next `length` [s] whose readings late sensors will show at its end or
        later."""
        late = {self._loads.imu_delay, self._loads.pose_delay} - {0.0}
        return sorted(length * (1 + math.floor(d / length + _SAME_INSTANT)) - d for d in late)

    def _read(self, motion: Motion) -> Reading:
        """Sensors without noise at this motion."""
        frame = self.airframe
        turn = rotation(motion.attitude)
        tracked = subtract(self._loads.pose_shift, frame.center_of_mass)
        imu = subtract(frame.imu_position, frame.center_of_mass)
        ax, ay, az = motion.acceleration
        felt = apply_transposed(turn, (ax, ay, az + frame.gravity))
        spun = cross(motion.rates, cross(motion.rates, imu))
        felt = add(felt, add(cross(motion.turning, imu), spun))
        gyro, felt, attitude = self._loads.readings(motion.rates, felt, motion.attitude)
        return Reading(
            gyro=gyro,
            felt=felt,
            attitude=attitude,
            position=add(motion.position, apply(turn, tracked)),
            velocity=add(motion.velocity, apply(turn, cross(motion.rates, tracked))),
        )

    def _seen(self, delay: float) -> Reading:
        """What a sensor shows now that is `delay` [s] late."""
        if not delay:
            return self._read(self._now())
        return min(self._kept, key=lambda kept: abs(kept[0] - (self.time - delay)))[1]

    def measure(self, u: Command | None = None, *, noise: bool = True) -> dict[str, float]:
        """Measurements at the present time by flight-log column.

        u: the command that begins now, if already known; else the last one is reported. Repeating
        the call gives the same noise. Pose, velocity and IMU are those of the body origin and of
        the airframe's IMU position.
        """
        row = self._row if noise else [0.0] * len(self._row)
        motion, sensors = self._now(), self.sensors
        imu, pose = self._seen(self._loads.imu_delay), self._seen(self._loads.pose_delay)
        attitude = multiply(pose.attitude, quaternion_of(_noisy(ZERO, sensors.attitude, row[6:9])))
        command = self._history[-1][1] if u is None else [float(v) for v in u]
        out = {"t": self.time}
        out |= {f"u{i}": v for i, v in enumerate(command, 1)}
        if self.craft.battery is not None:
            out["vbat"] = self.voltage + float(sensors.voltage) * row[15]
        out |= dict(zip(("qw", "qx", "qy", "qz"), attitude))
        out |= dict(zip("pqr", _noisy(imu.gyro, sensors.gyro, row[0:3])))
        out |= dict(zip(("ax", "ay", "az"), _noisy(imu.felt, sensors.accelerometer, row[3:6])))
        out |= dict(zip("xyz", _noisy(pose.position, sensors.position, row[9:12])))
        out |= dict(zip(("vx", "vy", "vz"), _noisy(pose.velocity, sensors.velocity, row[12:15])))
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
        for effect in self._loads.effects:
            found |= {name: float(value) for name, value in effect.parameters().items()}
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


def _on(value: Vector, rate: Vector, time: float) -> Vector:
    """Value after `time` [s] at this rate."""
    x, y, z = (v + r * time for v, r in zip(value, rate))
    return (x, y, z)
