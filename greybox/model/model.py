"""PhysicsModel: rigid body with n rotors plus named effects plus sensors, as CasADi expressions
(one `Dynamics`).

    command -> rotor (`rotors`) -> thrust -> body -> wrench (`rigid_body`) -> sensors on their
    clocks (`sensor_clocks`)

This file composes them: the layout of the vectors, the chart of the state, one step, and where a
flight starts.

Error state: position and velocity errors in body axes (p = p_hat + R_hat dp), attitude error q =
q_hat * exp(dtheta/2). In these coordinates the linearisation depends on neither position nor
heading, so that one stationary gain serves a whole flight (Bonnabel, Martin and Salaun 2009,
Invariant extended Kalman filter: theory and application, CDC).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import casadi as ca
import numpy as np

from greybox.data.channel import command_names
from greybox.data.drive import LATE_SPEEDS, drive_names
from greybox.errors import ModelError
from greybox.frames import (
    quat_difference,
    quat_exp,
    quat_multiply,
    quat_normalize,
    rotation_matrix,
)
from greybox.model.command_window import CommandWindow
from greybox.model.composition import SHAPING, check_effects, check_sensors
from greybox.model.core_parameters import core_parameters
from greybox.model.dynamics_text import dynamics_text, parameter_rows
from greybox.model.effect import SLOTS, Effect
from greybox.model.effects import demand_parameters, effect_by_name
from greybox.model.felt import Felt
from greybox.model.flow import Remembered
from greybox.model.parameter import Parameter
from greybox.model.rigid_body import PUSHES, RigidBody
from greybox.model.rotors import Rotors, Turning, rotor_path
from greybox.model.sensor import Sensor, first_complete
from greybox.model.sensor_clocks import OWN, TELEMETRY, Instant, Passage, SensorClocks
from greybox.model.sensors import SENSORS, USUAL
from greybox.model.staged_effects import StagedEffects
from greybox.model.state_blocks import BLOCKS, first_columns, first_times, start_of, usual_of
from greybox.model.vehicle import Vehicle
from greybox.shown import Cell, Shown
from greybox.symbolic import Expr, FloatArray, Layout, Signal, written_once
from greybox.takes import EFFECTS, FLAG, INPUT, NAMES, OWN_SENSORS, POSITIVE, VEHICLE, takes


@dataclass(frozen=True, kw_only=True, repr=False)
class PhysicsModel(Shown):
    """Newton-Euler multirotor of `vehicle` with `effects` and the sensors named in `sensors`.

    `input`: "command" (u1..un) or "speed" (measured rotor speeds omega1..omegan drive the rotors;
    needs speed_max). `kinematic_noise` adds white noise on the attitude kinematics, for logs whose
    attitude and gyro drift against each other in time, so that the one is not the integral of the
    other. `sample_time` [s] fixes how many earlier commands a step sees (for a delay). `parts`:
    Runge-Kutta steps of a sample. States that no sensor can feel, directly or through other states,
    are left out (an IMU-only log has no position). Raises `ModelError`, `UnknownNameError`.
    """

    vehicle: Vehicle
    effects: tuple[Effect, ...] = ()
    sensors: tuple[Sensor, ...] = USUAL
    input: Literal["command", "speed"] = "command"
    sample_time: float = 0.01
    kinematic_noise: bool = False
    parts: int = 1

    def __post_init__(self) -> None:
        if not self.sensors:
            raise ModelError(
                "no sensor: the log has no complete group of measured columns",
                fix="log the gyro: p, q, r",
            )
        speed = self.input == "speed"
        check_effects(self.effects, self.vehicle, self.sensor_names, measured_speed=speed)
        ordered = tuple(
            sorted(self.effects, key=lambda e: (list(SLOTS).index(e.stage), e.order, e.name))
        )
        object.__setattr__(self, "effects", ordered)
        check_sensors(self.sensors, self.effects, self.vehicle, self.inputs.names)

    # ---------------------------------------------------------------- shown

    def _shown_text(self) -> str:
        """Name, what goes in, what comes out and what is unknown."""
        return dynamics_text(self)

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per parameter."""
        return parameter_rows(self)

    # ---------------------------------------------------------------- composition

    @property
    def name(self) -> str:
        """Vehicle name and effects."""
        return f"{self.vehicle.name} + {', '.join(e.name for e in self.effects) or 'no effects'}"

    def with_effect(self, *names: str | Effect) -> PhysicsModel:
        """The model with further effects, by catalogue name or as objects."""
        added = tuple(effect_by_name(n) if isinstance(n, str) else n for n in names)
        return replace(self, effects=(*self.effects, *added))

    def without_effect(self, *names: str) -> PhysicsModel:
        """The model without the named effects. Raises `ModelError` for one that is not there."""
        have = {e.name for e in self.effects}
        for n in names:
            if n not in have:
                raise ModelError(
                    f"the model has no effect '{n}'", expected=f"one of {', '.join(sorted(have))}"
                )
        return replace(self, effects=tuple(e for e in self.effects if e.name not in names))

    @property
    def sensor_names(self) -> frozenset[str]:
        """Names of the sensors that the log fills."""
        return frozenset(s.name for s in self.sensors)

    @property
    def omega_known(self) -> bool:
        """Whether rotor speeds are in rad/s (speed_max known) or per unit nu."""
        return self.vehicle.actuator.speed_max is not None

    # ---------------------------------------------------------------- layouts

    @cached_property
    def _n(self) -> int:
        return len(self.vehicle.rotors)

    @property
    def _has_lag(self) -> bool:
        return self._rotors.have_lag

    @property
    def _has_pull(self) -> bool:
        return self._rotors.have_pull

    @property
    def memory_sizes(self) -> dict[str, float]:
        """State of an effect's or a sensor's own -> what is typical of it."""
        return {f"memory.{owner}.{r.name}": r.size for owner, r in self._staged.remembered}

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Core parameters of the vehicle, then those of the effects as effect.parameter."""
        known = self.vehicle.effects
        out = list(core_parameters(self.vehicle))
        for e in self.effects:
            stated = known.get(e.name, {})
            declared = e.parameters(self.vehicle)
            demand_parameters(e, stated, self.vehicle)
            for d in declared:
                given = stated.get(d.name)
                if self.input == "speed" and "delay" in e.early:
                    # A command may not act before it was sent; a speed acts at once, and is
                    # logged late or early by what the vehicle file does not know.
                    d, given = replace(d, lower=-LATE_SPEEDS, upper=LATE_SPEEDS), None
                out.append(
                    replace(d, name=f"{e.name}.{d.name}")
                    if given is None
                    else replace(
                        d, name=f"{e.name}.{d.name}", nominal=given.value, sigma=given.sigma
                    )
                )
        return tuple(out)

    @cached_property
    def inputs(self) -> Layout:
        """u1..un (or omega1..omegan), then vbat where an effect needs it."""
        if self.input == "command":
            rows = [Signal(name=f"u{i + 1}", unit="-", meaning="command") for i in range(self._n)]
        else:
            rows = [
                Signal(name=f"omega{i + 1}", unit="rad/s", meaning="rotor speed")
                for i in range(self._n)
            ]
        if self._staged.needs_vbat:
            rows.append(Signal(name="vbat", unit="V", meaning="battery voltage"))
        return Layout(rows)

    @cached_property
    def outputs(self) -> Layout:
        """Columns of all sensors in order."""
        return Layout([s for sensor in self.sensors for s in sensor.signals(self.vehicle)])

    @cached_property
    def innovations(self) -> Layout:
        """Innovation components of all sensors in order."""
        return Layout(
            [s for sensor in self.sensors for s in sensor.innovation_signals(self.vehicle)]
        )

    @cached_property
    def innovation_columns(self) -> tuple[tuple[str, ...], ...]:
        """Columns that every innovation component needs.

        All of its sensor's where they are turned into body axes, else just its own.
        """
        rows: list[tuple[str, ...]] = []
        for sensor in self.sensors:
            columns = tuple(s.name for s in sensor.signals(self.vehicle))
            own = tuple(s.name for s in sensor.innovation_signals(self.vehicle))
            rows += [(c,) for c in columns] if columns == own else [columns] * len(own)
        return tuple(rows)

    @cached_property
    def channel_groups(self) -> tuple[str, ...]:
        """Channel group of every innovation component."""
        return tuple(s.group for s in self.sensors for _ in s.innovation_signals(self.vehicle))

    @cached_property
    def noises(self) -> Layout:
        """Noise of force [N], torque [N m], attitude kinematics [rad/s] and drifting memories.

        Body axes; force only where the log feels any, kinematics only where asked for.
        """
        felt = {
            "force": "velocity" in self._felt.blocks or self._felt.force,
            "torque": True,
            "turn": self.kinematic_noise and "attitude" in self._felt.blocks,
        }
        said = {
            "force": ("N", "force noise, body"),
            "torque": ("N m", "torque noise, body"),
            "turn": ("rad/s", "noise of the attitude kinematics"),
        }
        rows = [
            Signal(name=f"{push}.{a}", unit=said[push][0], meaning=said[push][1])
            for push in PUSHES
            if felt[push]
            for a in "xyz"
        ]
        rows += [
            Signal(
                name=f"drift.{owner}.{r.name}",
                unit=f"{r.unit}/s",
                meaning=f"drift of {owner}.{r.name}",
            )
            for owner, r in self._drifting
        ]
        return Layout(rows)

    @cached_property
    def _drifting(self) -> tuple[tuple[str, Remembered], ...]:
        return tuple(self._staged.remembered[i] for i in self._staged.drifting)

    @cached_property
    def states(self) -> Layout:
        """Kept blocks of the rigid body, what is remembered, rotor speeds where there is a lag.

        position.x, ..., memory.<effect or sensor>.<name>, rotor.1 .. rotor.n, what pulls them in a
        lag of second order: rotor_pull.1 .. rotor_pull.n, and all that once more as telemetry shows
        it, late: rotor_shown.1 .. rotor_shown.n and rotor_shown_pull.1 .. rotor_shown_pull.n.
        """
        rows = [
            Signal(name=f"{b}.{a}", unit=BLOCKS[b].unit, meaning=b)
            for b in self._felt.blocks
            for a in BLOCKS[b].letters
        ]
        rows += self._memory_signals("")
        return Layout(rows + self._rotor_signals("", "normalised rotor speed"))

    @cached_property
    def error_states(self) -> Layout:
        """As `states`, the attitude with three components [rad].

        Position and velocity errors are in body axes.
        """
        rows = []
        for b in self._felt.blocks:
            unit = "rad" if b == "attitude" else BLOCKS[b].unit
            rows += [
                Signal(name=f"d_{b}.{a}", unit=unit, meaning=f"{b} error, body axes") for a in "xyz"
            ]
        rows += self._memory_signals("d_")
        return Layout(rows + self._rotor_signals("d_", "rotor error"))

    def _rotor_signals(self, prefix: str, meaning: str) -> list[Signal]:
        late = "as telemetry shows it"
        pulls = [("", meaning), ("_pull", f"{meaning}, what pulls it")][: 1 + self._has_pull]
        kinds = [(f"rotor{kind}", said) for kind, said in pulls]
        kinds += [(f"rotor_shown{kind}", f"{said}, {late}") for kind, said in pulls]
        return [
            Signal(name=f"{prefix}{kind}.{i + 1}", unit="-", meaning=said)
            for kind, said in kinds[: self._copies]
            for i in range(self._n)
        ]

    @property
    def _copies(self) -> int:
        """How often the rotors are among the states: once where they lag, twice where they are
        shown late, and each with what pulls them in a lag of second order."""
        return (int(self._has_lag) + int(self._clocks.follow)) * (1 + self._has_pull)

    def _memory_signals(self, prefix: str) -> list[Signal]:
        return [
            Signal(
                name=f"{prefix}memory.{owner}.{r.name}",
                unit=r.unit,
                meaning=r.meaning or f"memory of {owner}",
            )
            for owner, r in self._staged.remembered
        ]

    @cached_property
    def window(self) -> tuple[int, int]:
        """Earlier commands for the longest delay, one later command for a linear hold, and later
        rotor speeds where they may have been logged late."""
        past = 0
        if self._clocks.late:
            upper = {d.name: d.upper for d in self.parameters}
            past = math.ceil(self._clocks.reach(upper, self.sample_time) / self.sample_time + 1e-9)
        if self.input == "command":
            return past, int(self.vehicle.actuator.hold == "linear")
        # Measured rotor speeds run smoothly between samples, whatever the command does.
        late = LATE_SPEEDS if self._staged.has("delay") else 0.0
        return past, 1 + math.ceil(late / self.sample_time - 1e-9)

    # ---------------------------------------------------------------- parts

    @cached_property
    def _staged(self) -> StagedEffects:
        return StagedEffects(vehicle=self.vehicle, effects=self.effects, sensors=self.sensors)

    @cached_property
    def _rotors(self) -> Rotors:
        return Rotors(staged=self._staged, measured=self.input == "speed")

    @cached_property
    def body(self) -> RigidBody:
        """The rigid body with its rotors and effects."""
        return RigidBody(staged=self._staged, rotors=self._rotors)

    @cached_property
    def _clocks(self) -> SensorClocks:
        return SensorClocks(body=self.body)

    @cached_property
    def _felt(self) -> Felt:
        return Felt(
            clocks=self._clocks,
            parameters=tuple(d.name for d in self.parameters),
            inputs=len(self.inputs),
        )

    @cached_property
    def _commands(self) -> CommandWindow:
        past, future = self.window
        return CommandWindow(rotors=self._n, past=past, future=future)

    def _values(self, p: Expr) -> dict[str, Expr]:
        return {d.name: p[i] for i, d in enumerate(self.parameters)}

    # ---------------------------------------------------------------- vectors

    def _split(self, x: Expr) -> tuple[dict[str, Expr], Expr]:
        blocks: dict[str, Expr] = {}
        at = 0
        for b, block in BLOCKS.items():
            if b in self._felt.blocks:
                blocks[b] = x[at : at + block.size]
                at += block.size
            else:
                blocks[b] = ca.DM(block.rest)
        if size := len(self._staged.remembered):
            blocks["memory"] = x[at : at + size]
            at += size
        return blocks, x[at:]

    def _join(self, blocks: Mapping[str, Expr], nu: Expr) -> Expr:
        kept = [*self._felt.blocks, *(["memory"] if self._staged.remembered else [])]
        return ca.vertcat(*(blocks[b] for b in kept), *([nu] if self._has_lag else []))

    def _turning(self, rotors: Expr) -> tuple[Turning, Turning]:
        """(rotors now, rotors as telemetry shows them) of the rotor states."""
        turning = self._rotors.turning
        if not self._has_lag:
            return Turning(rotors), Turning(rotors)
        if not self._clocks.follow:
            return turning(rotors), turning(rotors)
        half = self._n * (1 + self._has_pull)
        return turning(rotors[:half]), turning(rotors[half:])

    def _noise(self, w: Expr) -> Expr:
        """Noise of `PUSHES` and of drifting memories, zeros for what the model does not have.

        None stands for no noise at all.
        """
        drifting = len(self._drifting)
        if w is None:
            return ca.DM.zeros(3 * len(PUSHES) + drifting)
        count = len(self.noises) - drifting
        groups = [n.split(".")[0] for n in self.noises.names[:count:3]]
        parts = {g: w[3 * i : 3 * i + 3] for i, g in enumerate(groups)}
        return ca.vertcat(
            *(parts.get(g, ca.DM.zeros(3)) for g in PUSHES), w[count : count + drifting]
        )

    def f(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """dx/dt at the command u (n_u); w (n_w), where given, pushes as process noise does."""
        blocks, rotors = self._split(x)
        values = self._values(p)
        goal = self._rotors.goal(u, values)
        now, shown = self._turning(rotors)
        change = self._rotors.rates(now, goal, values)
        d = self.body.rates(
            blocks, now.speed if self._has_lag else goal, change.speed, u, values, self._noise(w)
        )
        follow = [self._rotors.rates(shown, goal, values).stacked] if self._clocks.follow else []
        return self._join(d, ca.vertcat(change.stacked, *follow))

    def h(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Noise-free outputs at the command u (n_u); w (n_w), where given, pushes as noise does."""
        values = self._values(p)
        return self._outputs(x, u, self._clocks.held(u, values), values, None, w)

    def _outputs(
        self,
        x: Expr,
        u: Expr,
        passages: Mapping[Instant, Passage],
        values: Mapping[str, Expr],
        w: Expr,
        lasting: Expr,
    ) -> Expr:
        blocks, rotors = self._split(x)
        noise, push = self._noise(w), self._noise(lasting)
        turning = self._turning(rotors)
        readings = self._clocks.readings(blocks, turning, u, passages, values, noise, push)
        return ca.vertcat(*(readings[s.name] for s in self.sensors))

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """One sample: rotors exactly, rigid body by Runge-Kutta 4, unit quaternion."""
        blocks, rotors = self._split(x)
        values = self._values(p)
        now, shown = self._turning(rotors)
        u_a, u, switch = self._commands.held(window, self._clocks.command_age(OWN, values), dt)
        goals = (self._rotors.goal(u_a, values), self._rotors.goal(u, values))
        held, length = (u, values, self._noise(w)), dt / self.parts
        for k in range(self.parts):
            at = switch if self.parts == 1 else ca.fmin(ca.fmax(switch - k * length, 0.0), length)
            blocks, now = self._runge_kutta(blocks, now, goals, at, held, length)
        follow = [self._followed(shown, window, values, dt)] if self._clocks.follow else []
        return self._join(blocks, ca.vertcat(now.stacked, *follow))

    def _followed(self, shown: Turning, window: Expr, values: Mapping[str, Expr], dt: Expr) -> Expr:
        """The rotors that telemetry shows after dt: they follow the commands of their own
        instant."""
        age = self._commands.sent(self._clocks.command_age(TELEMETRY, values), dt)
        u_a, u_b, switch = self._commands.held(window, age, dt)
        goals = (self._rotors.goal(u_a, values), self._rotors.goal(u_b, values))
        leg = partial(self._rotors.leg, values=values)
        return rotor_path(shown, *goals, switch, dt, leg)[1].stacked

    def _runge_kutta(
        self,
        blocks: dict[str, Expr],
        now: Turning,
        goals: tuple[Expr, Expr],
        switch: Expr,
        held: tuple[Expr, dict[str, Expr], Expr],
        dt: Expr,
    ) -> tuple[dict[str, Expr], Turning]:
        """Blocks and rotors after dt, where rotors go to the first, from `switch` on to the second
        of the `goals`; command, parameters and noise are `held`."""
        u, values, noise = held
        start = now if self._has_lag else Turning(goals[0])
        path, end = rotor_path(start, *goals, switch, dt, partial(self._rotors.leg, values=values))
        slope = (end.speed - now.speed) / dt if self._has_lag else end.speed * 0

        def written(states: Mapping[str, Expr], speed: Expr) -> dict[str, Expr]:
            return self.body.rates(states, speed, slope, u, values, noise)

        rates = written_once(written, blocks, path[0])

        def moved(k: Mapping[str, Expr], step: Expr) -> dict[str, Expr]:
            return {b: blocks[b] + step * k[b] for b in blocks}

        k1 = rates(blocks, path[0])
        k2 = rates(moved(k1, dt / 2), path[1])
        k3 = rates(moved(k2, dt / 2), path[1])
        k4 = rates(moved(k3, dt), path[2])
        after = {b: blocks[b] + dt / 6 * (k1[b] + 2 * k2[b] + 2 * k3[b] + k4[b]) for b in blocks}
        after["attitude"] = quat_normalize(after["attitude"])
        return after, end

    def output(
        self,
        t: Expr,
        x: Expr,
        window: Expr,
        p: Expr,
        w: Expr,
        dt: Expr,
        lasting: Expr = None,
    ) -> Expr:
        """Outputs at the sample; the force noise of the coming step reaches the accelerometer.

        Rotors with a lag show their speed at t_k; rotors without one that of the step that begins.
        """
        values = self._values(p)
        u = self._commands.sampled(window, self._clocks.command_age(OWN, values), dt)
        passages = self._clocks.passages(self._commands, window, values, dt)
        return self._outputs(x, u, passages, values, w, lasting)

    def innovation(self, y: Expr, y_hat: Expr, x: Expr) -> Expr:
        """Per sensor; world vectors are turned into body axes, attitudes give delta_theta."""
        blocks, _ = self._split(x)
        rotation = rotation_matrix(blocks["attitude"])
        out, at = [], 0
        for s in self.sensors:
            size = len(s.signals(self.vehicle))
            out.append(s.innovation(y[at : at + size], y_hat[at : at + size], rotation))
            at += size
        return ca.vertcat(*out)

    def boxplus(self, x: Expr, d: Expr) -> Expr:
        """p + R dp, v + R dv, q * exp(dtheta/2), the rest by addition."""
        blocks, nu = self._split(x)
        rotation = rotation_matrix(blocks["attitude"])
        moved, at = {}, 0
        for b in self._felt.blocks:
            e = d[at : at + 3]
            at += 3
            if b == "attitude":
                moved[b] = quat_multiply(blocks[b], quat_exp(e))
            else:
                moved[b] = blocks[b] + (e if b == "rate" else rotation @ e)
        if size := len(self._staged.remembered):
            moved["memory"] = blocks["memory"] + d[at : at + size]
            at += size
        return self._join(moved, nu + d[at:])

    def boxminus(self, x2: Expr, x1: Expr) -> Expr:
        """The error state that carries x1 into x2."""
        a, nu1 = self._split(x1)
        b, nu2 = self._split(x2)
        rotation = rotation_matrix(a["attitude"])
        out = []
        for k in self._felt.blocks:
            if k == "attitude":
                out.append(quat_difference(a[k], b[k]))
            else:
                out.append(b[k] - a[k] if k == "rate" else rotation.T @ (b[k] - a[k]))
        if self._staged.remembered:
            out.append(b["memory"] - a["memory"])
        return ca.vertcat(*out, *([nu2 - nu1] if self._has_lag else []))

    def derived(self, p: Expr) -> dict[str, Expr]:
        """Named numbers that follow from the parameters p: effect.name -> expression."""
        values = self._values(p)
        out: dict[str, Expr] = {}
        for e in self.effects:
            for k, v in e.derived(self._staged.own(e, values), self.vehicle).items():
                out[f"{e.name}.{k}"] = v
        return out

    # ---------------------------------------------------------------- start of a flight

    def initial_state(self, start: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """What first samples say; else level, at rest, memories zero, rotors at their command: to a
        tenth, and to how far that is from the usual one, for a log may begin when a command jumps.

        Sensors say so whether the model takes measurements from them or not.
        """
        t = first_times(start)
        said = [x for s in self._all_sensors for x in s.starts(self._first(start, s), t)]
        values, sigma = [], []
        for b in self._felt.blocks:
            value, spread = start_of(b, said)
            values.append(value)
            sigma.append(spread)
        sizes = np.array([r.size for _, r in self._staged.remembered])
        values.append(np.zeros(len(sizes)))
        sigma.append(sizes)
        if self._has_lag:
            names = self.inputs.names[: self._n]
            u = first_complete(first_columns(start, names))
            u = np.full(self._n, 0.5) if u is None else u
            usual = np.array(
                [float(start.get(usual_of(n), u[i : i + 1])[0]) for i, n in enumerate(names)]
            )
            values += [u] * self._copies
            sigma += [np.hypot(0.1, usual - u)] * self._copies
        return np.concatenate(values), np.concatenate(sigma)

    @property
    def _all_sensors(self) -> tuple[Sensor, ...]:
        """The model's sensors and those of the catalogue that it takes no measurements from."""
        return (*self.sensors, *(s for s in SENSORS if s.name not in self.sensor_names))

    def _first(self, start: Mapping[str, FloatArray], sensor: Sensor) -> FloatArray:
        return first_columns(start, [s.name for s in sensor.signals(self.vehicle)])

    def reference(self, means: Mapping[str, float]) -> FloatArray:
        """Level and at rest, rotors at the mean command, memories 0.

        At the mean position where forces depend on it.
        """
        blocks = {b: list(BLOCKS[b].rest) for b in self._felt.blocks}
        if self._felt.place:
            blocks["position"] = [means.get(a, 0.0) for a in "xyz"]
        out = [v for block in blocks.values() for v in block] + [0.0] * len(self._staged.remembered)
        out += [means.get(n, 0.5) for n in self.inputs.names[: self._n]] * self._copies
        return np.asarray(out)

    def noise_scale(self, dt: float) -> FloatArray:
        """0.1 m/s^2 and 1 rad/s^2 per sample, 0.1 rad/s of kinematics, and the declared drifts."""
        force = 0.1 * self.vehicle.mass.value
        torque = [1.0 * float(self.vehicle.inertia[i][i]) for i in range(3)]
        parts = {"force": [force] * 3, "torque": torque, "turn": [0.1] * 3}
        pushes = [
            n.split(".")[0] for n in self.noises.names[: len(self.noises) - len(self._drifting) : 3]
        ]
        drifts = [r.drift / math.sqrt(dt) for _, r in self._drifting]
        return np.array([v for push in pushes for v in parts[push]] + drifts)

    def sensor_scale(self) -> FloatArray:
        """The vehicle file's [noise] by sensor name, else what is typical of the sensor."""
        levels = []
        for s in self.sensors:
            count = len(s.innovation_signals(self.vehicle))
            level = self.vehicle.noise.get(s.name, s.typical_noise(self.vehicle))
            levels.append(np.broadcast_to(np.asarray(level, dtype=float), (count,)))
        return np.concatenate(levels)


def sensors_for(
    columns: Iterable[str], vehicle: Vehicle, *, exclude: Iterable[str] = ()
) -> tuple[Sensor, ...]:
    """The sensors whose columns are all in `columns`, without those named in `exclude`."""
    have, left_out = set(columns), set(exclude)
    return tuple(
        s
        for s in SENSORS
        if s.name not in left_out and have.issuperset(x.name for x in s.signals(vehicle))
    )


def input_of(columns: Iterable[str], vehicle: Vehicle) -> Literal["command", "speed"]:
    """What drives a model of a log with these `columns`: its commands, or its rotor speeds where it
    has no commands but these."""
    names = drive_names(columns, len(vehicle.rotors))
    return "speed" if names and not command_names(names) else "command"


@takes(vehicle=VEHICLE, columns=NAMES, effects=EFFECTS, sample_time=POSITIVE, noncausal=NAMES)
@takes(input=INPUT, kinematic_noise=FLAG, sensors=OWN_SENSORS)
def build_model(
    vehicle: Vehicle,
    columns: Iterable[str],
    effects: Iterable[str | Effect] = (),
    *,
    input: Literal["command", "speed"] | None = None,
    sample_time: float = 0.01,
    noncausal: Iterable[str] = (),
    kinematic_noise: bool = False,
    sensors: Iterable[Sensor] = (),
) -> PhysicsModel:
    """The model for a vehicle and a log: known effects, those asked for, and the log's sensors.

    `columns` are the channels of the data (`Dataset.channels`), `noncausal` those that were
    smoothed with later samples and must not serve as measurements; `kinematic_noise` is that of
    `PhysicsModel`. An effect object (`load_effects`) also stands for its name in the vehicle file.
    `sensors` are further ones, of the user's own, which always take part: the log must have their
    columns. `input` None: what the log has, commands before rotor speeds. Raises `ModelError`,
    `UnknownNameError`.
    """
    columns = set(columns)
    usable = columns - set(noncausal)
    input = input or input_of(columns, vehicle)
    asked = tuple(effects)
    given = {e.name: e for e in asked if isinstance(e, Effect)}
    for e in asked:
        if isinstance(e, Effect) and given[e.name] is not e:
            raise ModelError(f"two effects are named {e.name}", fix="give each its own name")
    chosen: list[Effect] = [given.get(n) or effect_by_name(n) for n in vehicle.effects]
    if input == "speed":  # measured rotor speeds already contain what shapes the command
        chosen = [e for e in chosen if e.stage not in SHAPING]
    names = [e.name for e in chosen]
    for e in asked:
        effect = e if isinstance(e, Effect) else given.get(e) or effect_by_name(e)
        if effect.name not in names:
            names.append(effect.name)
            chosen.append(effect)
    driving = (
        {x.name for s in SENSORS if not s.usual for x in s.signals(vehicle)}
        if input == "speed"
        else set()
    )
    return PhysicsModel(
        vehicle=vehicle,
        effects=tuple(chosen),
        sensors=(*sensors_for(usable - driving, vehicle), *sensors),
        input=input,
        sample_time=sample_time,
        kinematic_noise=kinematic_noise,
    )
