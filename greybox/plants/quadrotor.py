"""A simulated multirotor, independent of every model that is fitted to it: state, time stepping,
sensors, truth.

Timing. `measure()` reports the state at t_k; `step(u, dt)` holds u from t_k to t_k + dt. The
accelerometer at t_k sees the rotor speeds at t_k and the disturbance force of the step that begins
at t_k. Rotors without lag jump at t_k: pass the command, `measure(u)`, to see the instant just
after the jump, which is what a log row (measurement at t_k, u_k) holds.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from greybox.plants.actuators import Actuators
from greybox.plants.airframe import Airframe
from greybox.plants.battery import Battery
from greybox.plants.effects.base import PlantEffect, hooks
from greybox.plants.memory import Memory
from greybox.plants.noise import (
    COLUMNS,
    ROTORS_MAX,
    Disturbance,
    Draws,
    ProcessNoise,
    SensorNoise,
    axes,
)
from greybox.plants.physics import CORE, Physics
from greybox.plants.vectors import (
    ZERO,
    Command,
    Number,
    Quaternion,
    Vector,
    add,
    apply,
    cross,
    multiply,
    normalised,
    quaternion_of,
)

DELAYED_SUBSTEP = 0.001
"""Longest integration step [s] of a plant with late sensors, whose readings are linear inside a
step."""

STATES = ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "p", "q", "r")


class Quadrotor:
    """A multirotor that can be flown: `reset(seed)`, `step(u, dt)`, `measure()`, `truth()`.

    airframe: the body; effects: what acts on it besides thrust and gravity; battery: None means
    constant voltage and no `vbat` channel; sensors, process: noise levels; sample_time [s]: the
    interval over which process noise is constant; substep [s]: the longest Runge-Kutta step inside
    a sample.

    `reset` with a sequence of seeds makes it a batch of B independent vehicles: commands then have
    shape (B, n) and every measured value shape (B,). Member b repeats bit for bit, up to rounding
    of elementary functions, the single plant with the same seed.
    """

    def __init__(
        self,
        airframe: Airframe,
        effects: Sequence[PlantEffect] = (),
        *,
        battery: Battery | None = None,
        sensors: SensorNoise | None = None,
        process: ProcessNoise | None = None,
        sample_time: float = 0.01,
        substep: float = 0.005,
    ) -> None:
        names = [e.name for e in effects]
        if len(set(names)) != len(names):
            raise ValueError(f"an effect is listed twice: {', '.join(names)}")
        if len(airframe.rotors) > ROTORS_MAX:
            raise ValueError(f"at most {ROTORS_MAX} rotors, got {len(airframe.rotors)}")
        self.airframe = airframe
        self.effects = tuple(effects)
        self.battery = battery
        self.sensors = sensors or SensorNoise()
        self.process = process or ProcessNoise()
        self.sample_time = sample_time
        self._pose_delay = float(sum(e.pose_delay() for e in self.effects))
        self._imu_delay = float(sum(e.imu_delay() for e in self.effects))
        self._speed_delay = float(sum(e.rotor_speed_delay() for e in self.effects))
        self._longest = max(self._pose_delay, self._imu_delay, self._speed_delay)
        self._late = self._longest > 0.0
        self.substep = min(substep, DELAYED_SUBSTEP) if self._late else substep
        self.physics = Physics(airframe, self.effects)
        self._needs_speed_rate = any(e.needs_speed_rate for e in self.effects)
        self._gyro = hooks(self.effects, "gyro")
        self._accelerometer = hooks(self.effects, "accelerometer")
        self._attitude = hooks(self.effects, "attitude")
        self._rotor_speed = hooks(self.effects, "rotor_speed")
        sizes = {np.size(v) for v in self.parameters().values()} - {1}
        if len(sizes) > 1:
            raise ValueError(
                f"parameter values of a batch must have one length, got {sorted(sizes)}"
            )
        self._members = sizes.pop() if sizes else None
        self.reset(0 if self._members is None else range(self._members))

    @property
    def rotors(self) -> int:
        """Number of rotors."""
        return len(self.airframe.rotors)

    @property
    def alike(self) -> bool:
        """Whether the vehicles of a batch differ in their seeds alone."""
        levels = [v for part in (self.process, self.sensors, self.battery) for v in _values(part)]
        return self._members is None and not any(isinstance(v, np.ndarray) for v in levels)

    @property
    def batch(self) -> int | None:
        """Number of vehicles in the batch, or None for a single vehicle."""
        return self._batch

    def reset(
        self,
        seed: int | Sequence[int] = 0,
        *,
        position: Vector = (0.0, 0.0, 1.0),
        velocity: Vector = ZERO,
        attitude: Quaternion = (1.0, 0.0, 0.0, 0.0),
        rates: Vector = ZERO,
        charge_used: Number = 0.0,
        nu: Sequence[Number] | None = None,
        sent: Sequence[tuple[float, Command]] = (),
    ) -> None:
        """Start anew at t = 0 with the rotors turning at hover speed, or at nu.

        seed: an integer, or a sequence of B integers for a batch. position [m] and velocity [m/s]
        are those of the centre of mass, world; attitude (w, x, y, z); rates [rad/s]; charge_used [A
        s] is what the battery has already given. nu: speed of each rotor, where it is not that of
        hover; sent: commands that were sent before, as pairs (time < 0 [s], command), oldest first.
        Raises `ValueError` for another number of seeds than the parameters have values.
        """
        self._batch = None if isinstance(seed, int | np.integer) else len(seed)
        if self._members is not None and self._batch != self._members:
            raise ValueError(
                f"this plant's parameters have {self._members} values each: give as many seeds"
            )
        self.time = 0.0
        state = [*position, *velocity, *attitude, *rates, *[0.0] * (self.physics.size - CORE)]
        self._state: list[Number] = [self._spread(v) for v in state]
        self._charge = self._spread(charge_used)
        self._actuators = Actuators(self.effects, self.rotors)
        self._actuators.reset(self._spread(self.airframe.hover_speed))
        self.voltage = self._voltage()
        self._actuators.settle(self.voltage)
        for when, command in sent:
            self._actuators.hold(when, self._columns(command))
        if nu is not None:
            self._actuators.nu = [self._spread(v) for v in nu]
            self.voltage = self._voltage()
        self._draws = Draws(seed)
        self._disturbance = Disturbance(self.process, self.sample_time)
        self._row = self._draws.row()
        self._disturbance.advance(self._row)
        self._memory: Memory | None = None
        self._read: tuple[tuple[object, ...], list[Number]] | None = None
        if self._late:
            first = self._reading(self.time, *self._speeds_now())
            self._memory = Memory(self._longest, first)

    def branch(self, seed: int | Sequence[int] | None) -> Quadrotor:
        """A copy that goes on from here with other noise: draws of `seed` (one per member), or none
        at all (lasting force and torque then fade)."""
        other = copy.deepcopy(self)
        if seed is None:
            other._disturbance.calm()
            other.sensors = SensorNoise()
        else:
            other._draws = Draws(seed)
        return other

    def _spread(self, value: Number) -> Number:
        if self._batch is None:
            return float(value)
        return np.broadcast_to(np.asarray(value, dtype=float), (self._batch,)).copy()

    def _voltage(self) -> Number:
        if self.battery is None:
            return (
                self.airframe.nominal_voltage
                if self.airframe.nominal_voltage is not None
                else math.nan
            )
        return self.battery.voltage(self._charge, self.battery.current(self._actuators.nu))

    def _columns(self, u: Command) -> list[Number]:
        if self._batch is None:
            command = [float(v) for v in u]
        else:
            array = np.asarray(u, dtype=float)
            if array.shape != (self._batch, self.rotors):
                raise ValueError(
                    f"commands of a batch have shape {(self._batch, self.rotors)}, got "
                    f"{array.shape}"
                )
            command = list(array.T)
        if len(command) != self.rotors:
            raise ValueError(
                f"{self.rotors} rotors need {self.rotors} commands, got {len(command)}"
            )
        return command

    def step(self, u: Command, dt: float | None = None) -> None:
        """Hold command u, shape (n,) or (B, n), for dt [s] (default: sample_time)."""
        length = self.sample_time if dt is None else dt
        actuators = self._actuators
        actuators.hold(self.time, self._columns(u))
        for start, duration, command in actuators.pieces(self.time, length):
            actuators.target = actuators.steady(command, self.voltage)
            actuators.nu = [actuators.start(n, s) for n, s in zip(actuators.nu, actuators.target)]
            for offset, length_here, limit in self._parts(duration):
                count = max(1, math.ceil(length_here / limit - 1e-6))
                h = length_here / count
                for k in range(count):
                    self._advance(start + offset + k * h, h)
        if self.battery is not None:
            self._charge = self._charge + length * self.battery.current(actuators.nu)
            self.voltage = self._voltage()
        self.time += length
        self._row = self._draws.row()
        self._disturbance.advance(self._row)

    def _parts(self, duration: float) -> list[tuple[float, float, float]]:
        """Parts (offset, length, longest step) of a piece: a lag much shorter than a step gets
        steps of its own."""
        tau = self._actuators.shortest_lag
        if tau == 0.0 or 0.25 * tau >= self.substep:
            return [(0.0, duration, self.substep)]
        first = min(duration, 15.0 * tau)
        rest = duration - first
        return [(0.0, first, 0.25 * tau), *([(first, rest, self.substep)] if rest > 0.0 else [])]

    def _advance(self, time: float, h: float) -> None:
        """One Runge-Kutta step of length h [s], rotor speeds exact at its three instants."""
        act = self._actuators
        now, half, end = (act.nu, act.pull), act.relax(0.5 * h), act.relax(h)
        at_begin, at_half, at_end = (
            (speeds, act.rates(speeds, pulls) if self._needs_speed_rate else [])
            for speeds, pulls in (now, half, end)
        )
        f = self.physics.derivative
        rest = (self.voltage, self._disturbance.force, self._disturbance.torque)
        state = self._state
        k1 = f(time, state, *at_begin, *rest)
        k2 = f(time + 0.5 * h, [x + 0.5 * h * k for x, k in zip(state, k1)], *at_half, *rest)
        k3 = f(time + 0.5 * h, [x + 0.5 * h * k for x, k in zip(state, k2)], *at_half, *rest)
        k4 = f(time + h, [x + h * k for x, k in zip(state, k3)], *at_end, *rest)
        sixth = h / 6.0
        new = [x + sixth * (a + 2.0 * (b + c) + d) for x, a, b, c, d in zip(state, k1, k2, k3, k4)]
        new[6:10] = normalised((new[6], new[7], new[8], new[9]))
        first = self._reading(time, *at_begin) if self._memory is not None else []
        self._state = new
        act.nu, act.pull = end
        if self._memory is not None:
            self._memory.keep(time, time + h, first, self._reading(time + h, *at_end))

    def _speeds_now(self, u: Command | None = None) -> tuple[list[Number], list[Number]]:
        """Rotor speeds and their rates of change just after the present instant, if the command u
        begins now."""
        act = self._actuators
        if u is not None:
            act.hold(self.time, self._columns(u))
        act.target = act.steady(act.at(self.time), self.voltage)
        nu = [act.start(n, s) for n, s in zip(act.nu, act.target)]
        return nu, act.rates(nu, act.pull) if self._needs_speed_rate else []

    def _reading(self, time: float, nu: list[Number], nu_rate: list[Number]) -> list[Number]:
        """Undelayed noise-free gyro, specific force, attitude, position, velocity (16 values) and
        rotor speeds (n, as nu) at the present state."""
        physics, disturbance = self.physics, self._disturbance
        body, specific, turning = physics.accelerations(
            time, self._state, nu, nu_rate, self.voltage, disturbance.force, disturbance.torque
        )
        felt = add(
            specific,
            add(cross(turning, physics.imu), cross(body.rates, cross(body.rates, physics.imu))),
        )
        position = add(body.position, apply(body.rotation, physics.tracked))
        velocity = add(body.velocity, apply(body.rotation, cross(body.rates, physics.tracked)))
        return [*body.rates, *felt, *body.attitude, *position, *velocity, *nu]

    def _reading_now(self, u: Command | None) -> list[Number]:
        """The reading if the command u begins now. A controller asks before it commands and a log
        after it: rotors that lag have not moved in between."""
        nu, nu_rate = self._speeds_now(u)
        if self._batch is not None:
            return self._reading(self.time, nu, nu_rate)
        of = (self._state, self._disturbance.force, self.time, self.voltage, nu, nu_rate)
        if self._read is None or any(
            a is not b and (k < 2 or a != b) for k, (a, b) in enumerate(zip(self._read[0], of))
        ):
            self._read = of, self._reading(self.time, nu, nu_rate)
        return self._read[1]

    def measure(self, u: Command | None = None, *, noise: bool = True) -> dict[str, Number]:
        """Measurements at the present time by flight-log column; floats, or arrays (B,) for a
        batch.

        u: the command that begins now, if already known (see the module's note on timing).
        Repeating the call gives the same noise: it is drawn once per step. noise=False leaves it
        out; sensors keep their bias, scale and delay.
        """
        row = self._row if noise else [0.0] * COLUMNS
        sensors, act = self.sensors, self._actuators
        now = self._reading_now(u)
        imu, pose, shown = (
            now if self._memory is None or delay == 0.0 else self._memory.at(self.time - delay)
            for delay in (self._imu_delay, self._pose_delay, self._speed_delay)
        )
        gyro: Vector = (imu[0], imu[1], imu[2])
        felt: Vector = (imu[3], imu[4], imu[5])
        attitude: Quaternion = (pose[6], pose[7], pose[8], pose[9])
        if pose is not now:
            attitude = normalised(attitude)
        for hook in self._gyro:
            gyro = hook(gyro)
        for hook in self._accelerometer:
            felt = hook(felt)
        for hook in self._attitude:
            attitude = hook(attitude)
        speeds = [self.physics.scale * n for n in shown[16:]]
        for hook in self._rotor_speed:
            speeds = hook(speeds)
        gyro = _noisy(gyro, sensors.gyro, row, 12)
        felt = _noisy(felt, sensors.accelerometer, row, 15)
        attitude = multiply(attitude, quaternion_of(_noisy(ZERO, sensors.attitude, row, 18)))
        position = _noisy((pose[10], pose[11], pose[12]), sensors.position, row, 21)
        velocity = _noisy((pose[13], pose[14], pose[15]), sensors.velocity, row, 24)
        out: dict[str, Number] = {"t": self.time}
        out |= {f"u{i}": v for i, v in enumerate(act._history[-1][1], 1)}
        if self.battery is not None:
            out["vbat"] = self.voltage + sensors.voltage * row[27]
        out |= dict(zip(("qw", "qx", "qy", "qz"), attitude))
        out |= dict(zip(("p", "q", "r", "ax", "ay", "az"), (*gyro, *felt)))
        out |= dict(zip(("x", "y", "z", "vx", "vy", "vz"), (*position, *velocity)))
        out |= {
            f"omega{i}": speed + sensors.rotor_speed * row[27 + i]
            for i, speed in enumerate(speeds, 1)
        }
        return out

    def states(self) -> dict[str, Number]:
        """True state now: centre of mass, attitude, rates, nu1..n, voltage, disturbances, hidden
        states."""
        out: dict[str, Number] = dict(zip(STATES, self._state))
        out |= {f"nu{i}": n for i, n in enumerate(self._actuators.nu, 1)}
        out["voltage"] = self.voltage
        out |= dict(zip(("force_x", "force_y", "force_z"), self._disturbance.force))
        out |= dict(zip(("torque_x", "torque_y", "torque_z"), self._disturbance.torque))
        out |= {f"hidden{i}": v for i, v in enumerate(self._state[CORE:], 1)}
        return out

    def parameters(self) -> dict[str, Number]:
        """True parameters by canonical name: airframe and every effect."""
        out = self.airframe.parameters()
        for effect in self.effects:
            out |= effect.parameters()
        return out

    def truth(self) -> dict[str, Any]:
        """Everything a log does not say: `parameters`, `effects` (names), `states`,
        `process_noise`, `sensor_noise`."""
        return {
            "parameters": self.parameters(),
            "effects": [e.name for e in self.effects],
            "states": self.states(),
            "process_noise": vars(self.process).copy(),
            "sensor_noise": vars(self.sensors).copy(),
        }


def _values(part: object) -> list[object]:
    """The numbers of a part, those of vectors one by one."""
    every = [] if part is None else list(vars(part).values())
    return [v for level in every for v in (level if isinstance(level, tuple) else (level,))]


def _noisy(value: Vector, level: Number | Vector, row: list[Number], column: int) -> Vector:
    """Value plus white noise from three columns of the row of standard normals."""
    sx, sy, sz = axes(level)
    return (
        value[0] + sx * row[column],
        value[1] + sy * row[column + 1],
        value[2] + sz * row[column + 2],
    )
