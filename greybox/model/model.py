"""PhysicsModel: rigid body with n rotors plus named effects plus sensors, as CasADi expressions (one `Dynamics`).

The whole of the staged physics stands in this one file, because it is one derivation: command -> rotor -> thrust ->
body -> wrench -> rigid body -> sensors. Newton-Euler equations of the centre of mass, quaternion attitude:

    dp/dt = v,   m dv/dt = R(q) F - m g e_z,   dq/dt = q * (0, omega)/2,   J domega/dt = M - omega x J omega
    F = sum_i T_i e_z + effects,   M = sum_i (r_i x T_i e_z - s_i Q_i e_z) + effects,   T_i, Q_i = c0 + c1 nu + c2 nu^2

(Mahony, Kumar and Corke 2012, IEEE RAM 19(3), eq. 1-4; Stevens, Lewis and Johnson 2015, ch. 1.)

Error state: position and velocity errors in body axes (p = p_hat + R_hat dp), attitude error q = q_hat * exp(dtheta/2).
In these coordinates the linearisation depends on neither position nor heading, so that one stationary gain serves a
whole flight (Bonnabel, Martin and Salaun 2009, Invariant extended Kalman filter: theory and application, CDC).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np

from greybox.errors import ModelError, UnknownNameError
from greybox.frames import quat_derivative, quat_difference, quat_exp, quat_multiply, quat_normalize, rotation_matrix
from greybox.model.bounds import core_bounds
from greybox.model.effect import SLOTS, Effect, Flow, Remembered
from greybox.model.effects import effect_by_name
from greybox.model.parameter import Parameter
from greybox.model.sensor import Sensor
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr, FloatArray, Layout, Signal

BLOCKS: Mapping[str, tuple[str, str, int, int]] = {
    "position": ("xyz", "m", 3, 3),
    "velocity": ("xyz", "m/s", 3, 3),
    "attitude": ("wxyz", "-", 4, 3),
    "rate": ("xyz", "rad/s", 3, 3),
}
"""State blocks of the rigid body: letters, unit, raw size, error size. What effects remember follows, and rotor states where
there is a lag."""
REMEMBERING = ("thrust", "wrench")
"""Stages whose effects may have states of their own."""
POSE_REACH = 0.05
"""How far back commands are looked up for a late pose [s]; before that the oldest of them stands."""
APERTURE = 0.01
"""Part of a sample over which a sensor sees a command that jumps: an instant, but with a slope for the fit."""


@dataclass(frozen=True, kw_only=True)
class PhysicsModel:
    """Newton-Euler multirotor of `vehicle` with `effects` and the sensors named in `sensors`.

    `input`: "command" (u1..un) or "speed" (measured rotor speeds omega1..omegan drive the rotors; needs speed_max).
    `kinematic_noise` adds white noise on the attitude kinematics, for logs whose attitude and gyro drift against each
    other in time, so that the one is not the integral of the other.
    `sample_time` [s] fixes how many earlier commands a step sees (for a delay). States that no sensor can feel,
    directly or through other states, are left out (an IMU-only log has no position). Raises `ModelError`,
    `UnknownNameError`.
    """

    vehicle: Vehicle
    effects: tuple[Effect, ...] = ()
    sensors: tuple[Sensor, ...] = SENSORS[:5]
    input: Literal["command", "speed"] = "command"
    sample_time: float = 0.01
    kinematic_noise: bool = False

    def __post_init__(self) -> None:
        names = [e.name for e in self.effects]
        double = sorted({n for n in names if names.count(n) > 1})
        if double:
            raise ModelError(f"effect given twice: {', '.join(double)}")
        if not self.sensors:
            raise ModelError(
                "no sensor: the log has no complete group of measured columns", fix="log the gyro: p, q, r"
            )
        if self.input == "speed":
            if self.vehicle.actuator.speed_max is None:
                raise ModelError("--input speed needs actuator.speed_max in the vehicle file", fix="add speed_max")
            if any(s.name == "rotor_speed" for s in self.sensors):
                raise ModelError(
                    "rotor speed cannot be input and output at once", fix="leave rotor_speed out of sensors"
                )
            for e in self.effects:
                if e.stage in ("command", "rotor"):
                    raise ModelError(f"effect {e.name} shapes the command, which --input speed does not use")
        for e in self.effects:
            if missing := e.missing(self.vehicle, self.sensor_names):
                raise ModelError(f"effect {e.name} needs {', '.join(missing)}", fix="add it, or leave the effect out")
            own = e.memory(self.vehicle)
            if own and e.stage not in REMEMBERING:
                raise ModelError(
                    f"effect {e.name} of stage {e.stage} has a memory", expected=f"one of stage {' or '.join(REMEMBERING)}"
                )
            if own and e.early:
                raise ModelError(
                    f"effect {e.name} has a memory and returns {', '.join(sorted(e.early))}, needed before that is known",
                    fix="return a force instead",
                )
            if len({m.name for m in own}) < len(own) or not all(re.fullmatch(r"[a-z][a-z0-9_]*", m.name) for m in own):
                raise ModelError(
                    f"effect {e.name}: bad names in its memory", got=", ".join(m.name for m in own),
                    expected="each its own, of lower-case letters, digits and underscores",
                )  # fmt: skip
            if not all(0 < m.size < math.inf for m in own):
                raise ModelError(f"effect {e.name}: a size in its memory is not positive", expected="what is typical of it")
        lags = [e.name for e in self.effects if "lag" in e.early]
        if len(lags) > 1:
            raise ModelError(f"two lags of the rotors: {', '.join(lags)}", fix="keep one of them")
        ordered = tuple(sorted(self.effects, key=lambda e: (list(SLOTS).index(e.stage), e.order, e.name)))
        object.__setattr__(self, "effects", ordered)

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
                raise ModelError(f"the model has no effect '{n}'", expected=f"one of {', '.join(sorted(have))}")
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

    @cached_property
    def _has_lag(self) -> bool:
        return self._has("lag")

    def _has(self, slot: str) -> bool:
        return any(slot in e.early for e in self.effects)

    @cached_property
    def _memory(self) -> dict[str, tuple[Remembered, ...]]:
        """Effect -> its own states, in the order of the state vector."""
        return {e.name: own for e in self.effects if (own := e.memory(self.vehicle))}

    @cached_property
    def _remembered(self) -> tuple[Remembered, ...]:
        return tuple(r for own in self._memory.values() for r in own)

    @property
    def memory_sizes(self) -> dict[str, float]:
        """State of an effect's own -> what is typical of it."""
        return {f"memory.{e}.{r.name}": r.size for e, own in self._memory.items() for r in own}

    @cached_property
    def _needs_vbat(self) -> bool:
        return any("vbat" in e.needs.columns for e in self.effects)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Core parameters of the vehicle, then those of the effects as effect.parameter."""
        known = self.vehicle.effects
        out = list(core_parameters(self.vehicle))
        for e in self.effects:
            stated = known.get(e.name, {})
            declared = e.parameters(self.vehicle)
            for short in stated:
                if short in e.derived({d.name: 0.0 for d in declared}, self.vehicle):
                    continue  # follows from the others
                if short not in {d.name for d in declared}:
                    raise UnknownNameError(f"parameter of effect {e.name}", short, (d.name for d in declared))
            for d in declared:
                given = stated.get(d.name)
                out.append(
                    replace(d, name=f"{e.name}.{d.name}")
                    if given is None
                    else replace(d, name=f"{e.name}.{d.name}", nominal=given.value, sigma=given.sigma)
                )
        return tuple(out)

    @cached_property
    def inputs(self) -> Layout:
        """u1..un (or omega1..omegan), then vbat where an effect needs it."""
        if self.input == "command":
            rows = [Signal(name=f"u{i + 1}", unit="-", meaning="command") for i in range(self._n)]
        else:
            rows = [Signal(name=f"omega{i + 1}", unit="rad/s", meaning="rotor speed") for i in range(self._n)]
        if self._needs_vbat:
            rows.append(Signal(name="vbat", unit="V", meaning="battery voltage"))
        return Layout(rows)

    @cached_property
    def outputs(self) -> Layout:
        """Columns of all sensors in order."""
        return Layout([s for sensor in self.sensors for s in sensor.signals(self.vehicle)])

    @cached_property
    def innovations(self) -> Layout:
        """Innovation components of all sensors in order."""
        return Layout([s for sensor in self.sensors for s in sensor.innovation_signals(self.vehicle)])

    @cached_property
    def innovation_columns(self) -> tuple[tuple[str, ...], ...]:
        """A sensor's components need all of its columns where they are turned into body axes, else just their own."""
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
        """Force noise [N] and torque noise [N m] in body axes (torque alone where the log feels no force)."""
        rows = []
        if "velocity" in self._kept or any(s.name == "accelerometer" for s in self.sensors):
            rows += [Signal(name=f"force.{a}", unit="N", meaning="force noise, body") for a in "xyz"]
        rows += [Signal(name=f"torque.{a}", unit="N m", meaning="torque noise, body") for a in "xyz"]
        if self.kinematic_noise and "attitude" in self._kept:
            rows += [Signal(name=f"turn.{a}", unit="rad/s", meaning="noise of the attitude kinematics") for a in "xyz"]
        return Layout(rows)

    def _symbols(self) -> dict[str, Expr]:
        """Symbols of all state blocks but the rotors'."""
        own = {"memory": ca.SX.sym("memory", len(self._remembered))} if self._remembered else {}
        return {b: ca.SX.sym(b, BLOCKS[b][2]) for b in BLOCKS} | own

    @cached_property
    def _kept(self) -> tuple[str, ...]:
        """State blocks that some sensor feels, directly or through other states (structural observability)."""
        x = self._symbols()
        nu, u = ca.SX.sym("nu", self._n), ca.SX.sym("u", len(self.inputs))
        p, w = ca.SX.sym("p", len(self.parameters)), ca.SX.sym("w", 6)
        sf, alpha, flow = self._rigid_body(x, nu, nu * 0, u, p, w)
        rates = self._changes(flow, x, p) | {
            "position": x["velocity"],
            "velocity": flow.rotation @ sf,
            "attitude": quat_derivative(x["attitude"], x["rate"]),
            "rate": alpha,
        }
        # Gravity enters the velocity equation in body axes through the attitude.
        rates["velocity"] = flow.rotation.T @ (rates["velocity"] + ca.vertcat(0, 0, -1)) + flow.velocity * 0
        felt = ca.vertcat(*self._measure(flow, sf, p).values())
        kept: set[str] = set()
        frontier = [felt]
        while frontier:
            expression = frontier.pop()
            for b, symbol in x.items():
                if b not in kept and ca.which_depends(expression, symbol, 1, True).count(True):
                    kept.add(b)
                    frontier.append(rates[b])
        return tuple(b for b in BLOCKS if b in kept)

    @cached_property
    def _feels_place(self) -> bool:
        """Whether forces or moments depend on the position (as near the ground)."""
        if not self.effects or "position" not in self._kept:
            return False
        x = self._symbols()
        nu, u = ca.SX.sym("nu", self._n), ca.SX.sym("u", len(self.inputs))
        p = ca.SX.sym("p", len(self.parameters))
        sf, alpha, flow = self._rigid_body(x, nu, nu * 0, u, p, ca.DM.zeros(6))
        felt = ca.vertcat(sf, alpha, *self._changes(flow, x, p).values())
        return any(ca.which_depends(felt, x["position"], 1, False))

    @cached_property
    def states(self) -> Layout:
        """Kept rigid-body blocks, memory.<effect>.<name> of effects that remember, rotor.1..rotor.n where there is a lag."""
        rows = [Signal(name=f"{b}.{a}", unit=BLOCKS[b][1], meaning=b) for b in self._kept for a in BLOCKS[b][0]]
        rows += self._memory_signals("")
        if self._has_lag:
            rows += [Signal(name=f"rotor.{i + 1}", unit="-", meaning="normalised rotor speed") for i in range(self._n)]
        return Layout(rows)

    @cached_property
    def error_states(self) -> Layout:
        """As `states`, the attitude with three components [rad]; position and velocity errors in body axes."""
        rows = []
        for b in self._kept:
            unit = "rad" if b == "attitude" else BLOCKS[b][1]
            rows += [Signal(name=f"d_{b}.{a}", unit=unit, meaning=f"{b} error, body axes") for a in "xyz"]
        rows += self._memory_signals("d_")
        if self._has_lag:
            rows += [Signal(name=f"d_rotor.{i + 1}", unit="-", meaning="rotor error") for i in range(self._n)]
        return Layout(rows)

    def _memory_signals(self, prefix: str) -> list[Signal]:
        return [
            Signal(name=f"{prefix}memory.{effect}.{r.name}", unit=r.unit, meaning=r.meaning or f"memory of {effect}")
            for effect, own in self._memory.items() for r in own
        ]  # fmt: skip

    @cached_property
    def window(self) -> tuple[int, int]:
        """Earlier commands for the longest delay, one later command for a linear hold."""
        past = 0
        if self._has("delay") or self._has("imu_delay") or self._has("pose_delay"):
            upper = {f"{e.name}.{d.name}": d.upper for e in self.effects for d in e.parameters(self.vehicle)}
            longest = float(self._early("delay", upper))
            late_imu = max(float(self._early("imu_delay", upper)), self.sample_time) if self._has("imu_delay") else 0.0
            late_pose = min(float(self._early("pose_delay", upper)), POSE_REACH) if self._has("pose_delay") else 0.0
            longest += max(late_imu, late_pose)
            if not math.isfinite(longest):
                raise ModelError("a delay without an upper bound", fix="declare the parameter with a finite upper")
            past = math.ceil(longest / self.sample_time + 1e-9)
        # Measured rotor speeds run smoothly between samples, whatever the command does.
        return past, int(self.vehicle.actuator.hold == "linear" or self.input == "speed")

    # ---------------------------------------------------------------- stages

    def _values(self, p: Expr) -> dict[str, Expr]:
        return {d.name: p[i] for i, d in enumerate(self.parameters)}

    def _own(self, effect: Effect, values: Mapping[str, Expr]) -> dict[str, Expr]:
        return {d.name: values[f"{effect.name}.{d.name}"] for d in effect.parameters(self.vehicle)}

    def _stage(self, stage: str) -> Iterable[Effect]:
        return (e for e in self.effects if e.stage == stage)

    def _early(self, slot: str, values: Mapping[str, Expr]) -> Expr:
        """Sum over the effects of a slot that depends on parameters alone (`EARLY`)."""
        total: Expr = 0.0
        idle = Flow(vehicle=self.vehicle, vbat=1.0, command=ca.DM.zeros(self._n))
        for e in self.effects:
            if slot in e.early:
                total = total + e.apply(idle, self._own(e, values))[slot]
        return total

    def _bracket(self, window: Expr, r: Expr) -> tuple[Expr, Expr, Expr]:
        """(older, newer, share): the rotor commands on both sides of the instant r samples before t_k.

        share in [0, 1] is how far that instant lies from the newer towards the older one. Branches are closed to the
        left, so that the slope at r = 0 is the one-sided one.
        """
        past, future = self.window
        older: Expr = 0.0
        newer: Expr = 0.0
        whole: Expr = 0.0
        for m in range(-future, past):
            there = ca.if_else(r >= m, 1.0, 0.0) if m > -future else 1.0
            there = there * (ca.if_else(r < m + 1, 1.0, 0.0) if m < past - 1 else 1.0)
            newer = newer + there * window[: self._n, past - m]
            older = older + there * window[: self._n, past - m - 1]
            whole = whole + there * m
        return older, newer, r - whole

    def _held_command(self, window: Expr, delay: Expr, dt: Expr) -> tuple[Expr, Expr, Expr]:
        """(u_a, u_b, s): the delayed record holds u_a over [t_k, t_k + s) and u_b over [t_k + s, t_k+1).

        Exact for a held record. Of a record that runs linearly the value at the middle of the step is taken as both.
        """
        past, future = self.window
        if past == 0 and future == 0:
            return window, window, 0.0
        older, newer, share = self._bracket(window, delay / dt - 0.5 * future)
        rest = window[self._n :, past]
        if future:
            middle = ca.vertcat(share * older + (1 - share) * newer, rest)
            return middle, middle, 0.0
        return ca.vertcat(older, rest), ca.vertcat(newer, rest), share * dt

    def _sampled_command(self, window: Expr, delay: Expr, dt: Expr, aperture: float = APERTURE) -> Expr:
        """The delayed command that a sample sees: the value now, of a held record its mean over the coming `aperture` dt."""
        past, future = self.window
        if past == 0 and future == 0:
            return window
        older, newer, share = self._bracket(window, delay / dt)
        if not future:
            share = ca.fmin(share / aperture, 1.0)
        return ca.vertcat(newer + share * (older - newer), window[self._n :, past])

    def _mean_commands(self, window: Expr, start: Expr, end: Expr, dt: Expr) -> tuple[Expr, Expr]:
        """Of the commands that were `start` to `end` seconds old at t_k, either first: the mean, which moves a velocity, and
        the mean weighted by the way that remains to `end`, which moves a position; the coming one where none has come."""
        past, future = self.window
        young, old = ca.fmin(start, end), ca.fmax(start, end)
        if future:
            middle = self._sampled_command(window, ca.fmax(0.5 * (young + old), 0.0), dt)
            return middle, middle
        if past == 0:
            return window, window
        # Ages in samples; of an instant the command of the step that just ended.
        first = young / dt
        last = ca.fmax(old / dt, first + 1e-6)
        backwards = ca.if_else(end > start, 1.0, 0.0)
        totals: list[Expr] = [0.0, 0.0]
        sums: list[Expr] = [0.0, 0.0]
        for m in range(past):
            a, b = ca.fmax(first, m), ca.fmin(last, m + 1) if m < past - 1 else last
            length = ca.fmax(b - a, 0.0)
            remains = backwards * last - (1 - backwards) * first + (1 - 2 * backwards) * 0.5 * (a + b)
            for i, weight in enumerate((length, length * remains)):
                totals[i] = totals[i] + weight
                sums[i] = sums[i] + weight * window[: self._n, past - m - 1]
        coming = self._sampled_command(window, ca.fmax(old, 0.0), dt, aperture=1.0)
        known = ca.logic_or(old > 0, young >= 0)
        tiny = (1e-9, 1e-15)
        rest = window[self._n :, past]
        mean, early = (ca.vertcat(c / ca.fmax(t, z), rest) for c, t, z in zip(sums, totals, tiny, strict=True))
        return ca.if_else(known, mean, coming), ca.if_else(known, early, coming)

    def _steady_speed(self, u: Expr, values: Mapping[str, Expr]) -> Expr:
        """nu_ss: command chain, then the product of the rotor stage's factors."""
        vbat = u[self._n] if self._needs_vbat else None
        command = u[: self._n]
        if self.input == "speed":
            return command / self.vehicle.actuator.speed_max
        for e in self._stage("command"):
            slots = e.apply(Flow(vehicle=self.vehicle, command=command, vbat=vbat), self._own(e, values))
            command = slots.get("command", command)
        nu = command
        for e in self._stage("rotor"):
            slots = e.apply(Flow(vehicle=self.vehicle, command=command, vbat=vbat), self._own(e, values))
            nu = nu * slots.get("steady_factor", 1.0)
        return nu

    def _lag(self, values: Mapping[str, Expr]) -> Expr:
        """Time constant; it may be zero (divide by `_positive` of it)."""
        return self._early("lag", values)

    def _lag_over(self, gap: Expr, values: Mapping[str, Expr]) -> Expr:
        """Time constant of rotors that are faster than their goal by `gap` (n): of each its own where slowing down takes
        another time than speeding up."""
        tau = self._lag(values) if self._has_lag else 0.0
        return tau * (1 + self._early("lag_asymmetry", values) * ca.sign(gap)) if self._has("lag_asymmetry") else tau

    def _rigid_body(
        self, x: Mapping[str, Expr], nu: Expr, nu_rate: Expr, u: Expr, p: Expr, w: Expr
    ) -> tuple[Expr, Expr, Flow]:
        """(specific force [m/s^2], angular acceleration [rad/s^2], flow) in body axes. w = (force, torque) noise."""
        vehicle, values, n = self.vehicle, self._values(p), self._n
        rotation = rotation_matrix(x["attitude"])
        mass = values["mass"]
        kind = type(mass) if isinstance(mass, ca.SX | ca.MX) else ca.DM
        inertia = kind(ca.DM(np.asarray(vehicle.inertia)))
        for i, a in enumerate(("xx", "yy", "zz")):
            inertia[i, i] = values[f"inertia.{a}"]
        com = ca.vertcat(*(values[f"center_of_mass.{a}"] for a in "xyz"))
        flow = Flow(vehicle=vehicle, vbat=u[n] if self._needs_vbat else None)
        diagonal = _is_diagonal(vehicle)
        for e in self._stage("body"):
            slots = e.apply(flow, self._own(e, values))
            diagonal = diagonal and "inertia_increment" not in slots
            mass = mass * slots.get("mass_factor", 1.0)
            inertia = inertia + slots.get("inertia_increment", 0.0)
            com = com + slots.get("center_of_mass", 0.0)
        arms = ca.horzcat(*(ca.DM(list(r.position)) - com for r in vehicle.rotors))
        spin = [r.spin for r in vehicle.rotors]
        thrust = _polynomial(nu, [values.get(f"thrust.c{k}", 0.0) for k in range(3)])
        torque = _polynomial(nu, [values.get(f"torque.c{k}", 0.0) for k in range(3)])
        if self._has_lag:
            # At tau = 0 the jumps of the command are no rates: effects see what they see without a lag.
            nu_rate = ca.if_else(self._lag(values) > 0, nu_rate, 0)
        flow = replace(
            flow, nu=nu, nu_rate=nu_rate, rotor_speed=vehicle.omega_scale * nu, thrust=thrust,
            velocity=rotation.T @ x["velocity"], velocity_world=x["velocity"], omega=x["rate"],
            wind=rotation.T @ self._early("wind", values) if self._has("wind") else ca.DM.zeros(3),
            rotation=rotation, quaternion=x["attitude"], position=x["position"], arms=arms, mass=mass,
            center_of_mass=com,
        )  # fmt: skip
        increment: Expr = 0.0
        for e in self._stage("thrust"):
            slots = e.apply(self._with_memory(e, flow, x), self._own(e, values))
            thrust = thrust * slots.get("thrust_factor", 1.0)
            torque = torque * slots.get("torque_factor", 1.0)
            increment = increment + slots.get("thrust_increment", 0.0)
        thrust = thrust + increment
        force = ca.vertcat(0, 0, ca.sum1(thrust)) + w[0:3]
        moment = w[3:6] + ca.vertcat(
            sum(arms[1, i] * thrust[i] for i in range(n)),
            -sum(arms[0, i] * thrust[i] for i in range(n)),
            -sum(spin[i] * torque[i] for i in range(n)),
        )
        for e in self._stage("wrench"):
            slots = e.apply(self._with_memory(e, flow, x), self._own(e, values))
            force = force + slots.get("force", 0.0)
            moment = moment + slots.get("moment", 0.0)
            if "hub_force" in slots:
                hub = slots["hub_force"]
                force = force + ca.sum2(hub)
                moment = moment + sum(ca.cross(arms[:, i], hub[:, i]) for i in range(n))
        gyroscopic = ca.cross(x["rate"], inertia @ x["rate"])
        if diagonal:
            alpha = (moment - gyroscopic) / ca.diag(inertia)
        else:
            alpha = ca.inv(inertia) @ (moment - gyroscopic)
        return force / mass, alpha, replace(flow, angular_acceleration=alpha)

    def _with_memory(self, effect: Effect, flow: Flow, x: Mapping[str, Expr]) -> Flow:
        """The flow as an effect that remembers sees it: with its own part of the states."""
        at = 0
        for name, own in self._memory.items():
            if name == effect.name:
                return replace(flow, memory=x["memory"][at : at + len(own)])
            at += len(own)
        return flow

    def _changes(self, flow: Flow, x: Mapping[str, Expr], p: Expr) -> dict[str, Expr]:
        """d memory / dt of all effects that remember, as a block; none where no effect does."""
        values = self._values(p)
        parts = []
        for e in self.effects:
            if e.name not in self._memory:
                continue
            change = e.remember(self._with_memory(e, flow, x), self._own(e, values))
            part = ca.vertcat(*change) if isinstance(change, list | tuple) else ca.vertcat(change)
            expected = len(self._memory[e.name])
            if part.shape != (expected, 1):
                got = "x".join(str(n) for n in part.shape)
                raise ModelError(f"effect {e.name}: remember() gives {got} values", expected=f"a column of {expected}")
            parts.append(part)
        return {"memory": ca.vertcat(*parts)} if parts else {}

    def _measure(self, flow: Flow, specific_force: Expr, p: Expr) -> dict[str, Expr]:
        """Readings by sensor name, after the chain of the sensor stage."""
        values = self._values(p)
        readings = {s.name: s.reading(flow, specific_force) for s in self.sensors}
        flow = replace(flow, acceleration_world=flow.rotation @ specific_force + self._gravity())
        for e in self._stage("sensor"):
            slots = e.apply(replace(flow, measured=readings), self._own(e, values))
            readings = {k: slots.get(k, v) for k, v in readings.items()}
        return readings

    # ---------------------------------------------------------------- vectors

    def _split(self, x: Expr) -> tuple[dict[str, Expr], Expr]:
        blocks: dict[str, Expr] = {}
        at = 0
        for b, (_, _, size, _) in BLOCKS.items():
            if b in self._kept:
                blocks[b] = x[at : at + size]
                at += size
            else:
                blocks[b] = ca.DM([1, 0, 0, 0]) if b == "attitude" else ca.DM.zeros(3)
        if size := len(self._remembered):
            blocks["memory"] = x[at : at + size]
            at += size
        return blocks, x[at:]

    def _join(self, blocks: Mapping[str, Expr], nu: Expr) -> Expr:
        kept = [*self._kept, *(["memory"] if self._remembered else [])]
        return ca.vertcat(*(blocks[b] for b in kept), *([nu] if self._has_lag else []))

    def _noise(self, w: Expr) -> Expr:
        """(force, torque, turn) noise (9,), zeros for those that the model does not have."""
        groups = [n.split(".")[0] for n in self.noises.names[::3]]
        parts = {g: w[3 * i : 3 * i + 3] for i, g in enumerate(groups)}
        return ca.vertcat(*(parts.get(g, ca.DM.zeros(3)) for g in ("force", "torque", "turn")))

    def _gravity(self) -> Expr:
        return ca.DM([0, 0, -self.vehicle.gravity])

    def _derivative(
        self, blocks: Mapping[str, Expr], nu: Expr, nu_rate: Expr, u: Expr, p: Expr, w: Expr
    ) -> dict[str, Expr]:
        sf, alpha, flow = self._rigid_body(blocks, nu, nu_rate, u, p, w)
        return {
            "position": blocks["velocity"],
            "velocity": flow.rotation @ sf + self._gravity(),
            "attitude": quat_derivative(blocks["attitude"], blocks["rate"] + w[6:9]),
            "rate": alpha,
            **self._changes(flow, blocks, p),
        }

    def f(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """dx/dt at the command u (n_u); w (n_w), where given, pushes as process noise does."""
        blocks, nu = self._split(x)
        values = self._values(p)
        steady = self._steady_speed(u, values)
        if self._has_lag:
            nu_rate = (steady - nu) / _positive(self._lag_over(nu - steady, values))
        else:
            nu, nu_rate = steady, steady * 0
        d = self._derivative(blocks, nu, nu_rate, u, p, self._noise(w) if w is not None else ca.DM.zeros(9))
        return self._join(d, nu_rate)

    def h(self, t: Expr, x: Expr, u: Expr, p: Expr, w: Expr = None) -> Expr:
        """Noise-free outputs at the command u (n_u); w (n_w), where given, pushes as process noise does."""
        return self._outputs(x, u, (u, u, u), p, self._noise(w) if w is not None else ca.DM.zeros(9))

    def _outputs(self, x: Expr, u: Expr, others: tuple[Expr, Expr, Expr], p: Expr, w: Expr) -> Expr:
        """Outputs at the command u that gyro and accelerometer see; `others` are the mean commands between that instant and
        the one of the pose (`_mean_commands`), and the one between that instant and now, or that of now where rotors have
        no lag."""
        blocks, nu = self._split(x)
        values = self._values(p)
        steady = self._steady_speed(u, values)
        lag = _positive(self._lag_over(nu - steady, values)) if self._has_lag else 1.0
        nu_rate = (steady - nu) / lag if self._has_lag else steady * 0
        sf, _, flow = self._rigid_body(blocks, nu if self._has_lag else steady, nu_rate, u, p, w)
        readings = self._measure(flow, sf, p)
        if self._has("imu_delay") or self._has("pose_delay"):
            pose = self._measure(*self._pose_seen(blocks, nu, others[:2], p, w), p)
            readings |= {k: pose[k] for k in ("attitude", "position", "velocity") if k in readings}
        if self._has("imu_delay") and "rotor_speed" in readings:
            turning = self._steady_speed(others[2], values)  # measured rotor speeds are those of now
            if self._has_lag:
                lag = _positive(self._lag_over(nu - turning, values))
                left = ca.exp(-self._early("imu_delay", values) / lag)
                turning = turning + (nu - turning) * left
            seen = replace(flow, nu=turning, rotor_speed=self.vehicle.omega_scale * turning)
            readings["rotor_speed"] = self._measure(seen, sf, p)["rotor_speed"]
        return ca.vertcat(*(readings[s.name] for s in self.sensors))

    def _pose_seen(
        self, blocks: Mapping[str, Expr], nu: Expr, between: tuple[Expr, Expr], p: Expr, w: Expr
    ) -> tuple[Flow, Expr]:
        """(flow, specific force) as the pose shows them, which is later than gyro and accelerometer (`pose_delay`) or
        earlier (`imu_delay`): from the present by the midpoint rule, with the mean commands `between` (`_mean_commands`).
        The noise of the coming step acts ahead of the present alone."""
        values = self._values(p)
        back = self._early("pose_delay", values) - self._early("imu_delay", values)
        w = ca.if_else(back < 0, w, ca.DM.zeros(9))
        u, steady, soon = between[0], self._steady_speed(between[0], values), self._steady_speed(between[1], values)
        if self._has_lag:
            # Backwards a settled rotor would run away: there the lag counts as no shorter than the way.
            tau = _positive(self._lag_over(nu - steady, values))
            tau = ca.if_else(back > 0, ca.fmax(tau, back), tau)
            nu_rate = (steady - nu) / ca.fmax(tau, ca.fabs(back))
            mean, early = _path_means(-back / tau)
            middle, early = steady + (nu - steady) * mean, steady + (nu - steady) * early
        else:
            middle, early, nu_rate = steady, soon, steady * 0
        d = self._derivative(blocks, early, nu_rate, u, p, w)
        half = {b: blocks[b] - 0.5 * back * d[b] for b in blocks}
        half["attitude"] = quat_multiply(blocks["attitude"], quat_exp(-0.5 * back * blocks["rate"]))
        d = self._derivative(half, middle, nu_rate, u, p, w)
        before = {b: blocks[b] - back * d[b] for b in blocks}
        before["attitude"] = quat_multiply(blocks["attitude"], quat_exp(-back * half["rate"]))
        sf, _, flow = self._rigid_body(before, middle, nu_rate, u, p, w)
        return flow, sf

    def _ages(self, p: Expr) -> tuple[Expr, Expr, Expr]:
        """How old commands are [s] that act on the rotors when the log says now, at the instant that gyro and
        accelerometer show, and at that of the pose."""
        values = self._values(p)
        now = self._early("delay", values)
        return now, now + self._early("imu_delay", values), now + self._early("pose_delay", values)

    def step(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """One sample: rotors exactly, rigid body by Runge-Kutta 4, the quaternion brought back to unit length."""
        blocks, nu = self._split(x)
        values = self._values(p)
        _, delay, _ = self._ages(p)
        u_a, u_b, switch = self._held_command(window, delay, dt)
        w = self._noise(w)
        first, second = self._steady_speed(u_a, values), self._steady_speed(u_b, values)
        u = u_b
        start = nu if self._has_lag else first
        path, end = _rotor_path(start, first, second, switch, dt, lambda gap: self._lag_over(gap, values))
        slope = (end - nu) / dt if self._has_lag else end * 0

        def moved(k: Mapping[str, Expr], step: Expr) -> dict[str, Expr]:
            return {b: blocks[b] + step * k[b] for b in blocks}

        k1 = self._derivative(blocks, path[0], slope, u, p, w)
        k2 = self._derivative(moved(k1, dt / 2), path[1], slope, u, p, w)
        k3 = self._derivative(moved(k2, dt / 2), path[1], slope, u, p, w)
        k4 = self._derivative(moved(k3, dt), path[2], slope, u, p, w)
        after = {b: blocks[b] + dt / 6 * (k1[b] + 2 * k2[b] + 2 * k3[b] + k4[b]) for b in blocks}
        after["attitude"] = quat_normalize(after["attitude"])
        return self._join(after, end)

    def output(self, t: Expr, x: Expr, window: Expr, p: Expr, w: Expr, dt: Expr) -> Expr:
        """Outputs at the sample; the force noise of the coming step reaches the accelerometer.

        Rotors with a lag show their speed at t_k; rotors without one that of the step that begins.
        """
        now, imu, pose = self._ages(p)
        u = self._sampled_command(window, imu, dt)
        if not (self._has("imu_delay") or self._has("pose_delay")):
            return self._outputs(x, u, (u, u, u), p, self._noise(w))
        between = self._mean_commands(window, imu, pose, dt)
        since = self._mean_commands(window, imu, now, dt)[0] if self._has_lag else self._sampled_command(window, now, dt)
        return self._outputs(x, u, (*between, since), p, self._noise(w))

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
        for b in self._kept:
            e = d[at : at + 3]
            at += 3
            if b == "attitude":
                moved[b] = quat_multiply(blocks[b], quat_exp(e))
            else:
                moved[b] = blocks[b] + (e if b == "rate" else rotation @ e)
        if size := len(self._remembered):
            moved["memory"] = blocks["memory"] + d[at : at + size]
            at += size
        return self._join(moved, nu + d[at:])

    def boxminus(self, x2: Expr, x1: Expr) -> Expr:
        """The error state that carries x1 into x2."""
        a, nu1 = self._split(x1)
        b, nu2 = self._split(x2)
        rotation = rotation_matrix(a["attitude"])
        out = []
        for k in self._kept:
            if k == "attitude":
                out.append(quat_difference(a[k], b[k]))
            else:
                out.append(b[k] - a[k] if k == "rate" else rotation.T @ (b[k] - a[k]))
        if self._remembered:
            out.append(b["memory"] - a["memory"])
        return ca.vertcat(*out, *([nu2 - nu1] if self._has_lag else []))

    def derived(self, p: Expr) -> dict[str, Expr]:
        """Named numbers that follow from the parameters: effect.name -> expression in the vector p."""
        values = self._values(p)
        out: dict[str, Expr] = {}
        for e in self.effects:
            for k, v in e.derived(self._own(e, values), self.vehicle).items():
                out[f"{e.name}.{k}"] = v
        return out

    # ---------------------------------------------------------------- start of a flight

    def initial_state(self, start: Mapping[str, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """First measured values; level and at rest where nothing is measured; rotors at their command, memories at zero."""

        def first(names: Sequence[str], default: Sequence[float]) -> tuple[FloatArray, bool]:
            columns = [np.asarray(start.get(n, np.array([np.nan]))) for n in names]
            rows = np.column_stack(columns) if len({c.size for c in columns}) == 1 else np.full((1, len(names)), np.nan)
            good = rows[np.isfinite(rows).all(axis=1)]
            return (good[0], True) if len(good) else (np.asarray(default, dtype=float), False)

        values, sigma = [], []
        t = np.asarray(start.get("t", np.array([0.0])))
        defaults = {
            "position": (("x", "y", "z"), (0, 0, 0), 0.01, 10.0),
            "rate": (("p", "q", "r"), (0, 0, 0), 0.2, 1.0),
        }
        for b in self._kept:
            if b == "attitude":
                q, seen = first(("qw", "qx", "qy", "qz"), (1, 0, 0, 0))
                values.append(q / np.linalg.norm(q))
                sigma += [0.02 if seen else 0.3] * 3
            elif b == "velocity":
                v, seen = first(("vx", "vy", "vz"), (0, 0, 0))
                spread = 0.1 if seen else 1.0
                if not seen and t.size > 2:
                    track = np.column_stack([np.asarray(start.get(a, np.full(t.size, np.nan))) for a in "xyz"])
                    good = np.isfinite(track).all(axis=1)
                    if good.sum() > 2:
                        v = np.polyfit(t[good] - t[good][0], track[good], 1)[0]
                        spread = 0.3
                values.append(v)
                sigma += [spread] * 3
            else:
                names, default, tight, wide = defaults[b]
                v, seen = first(names, default)
                values.append(v)
                sigma += [tight if seen else wide] * 3
        values.append(np.zeros(len(self._remembered)))
        sigma += [r.size for r in self._remembered]
        if self._has_lag:
            u, _ = first(self.inputs.names[: self._n], [0.5] * self._n)
            values.append(u)
            sigma += [0.1] * self._n
        return np.concatenate(values) if values else np.zeros(0), np.asarray(sigma)

    def reference(self, means: Mapping[str, float]) -> FloatArray:
        """Level and at rest, rotors at the mean command, memories 0; at the mean position where forces depend on it."""
        blocks = {"position": [0.0] * 3, "velocity": [0.0] * 3, "attitude": [1.0, 0.0, 0.0, 0.0], "rate": [0.0] * 3}
        if self._feels_place:
            blocks["position"] = [means.get(a, 0.0) for a in "xyz"]
        out = [v for b in self._kept for v in blocks[b]] + [0.0] * len(self._remembered)
        if self._has_lag:
            out += [means.get(n, 0.5) for n in self.inputs.names[: self._n]]
        return np.asarray(out)

    def noise_scale(self, dt: float) -> FloatArray:
        """0.1 m/s^2 and 1 rad/s^2 of white acceleration per sample, 0.1 rad/s on the attitude kinematics."""
        force = 0.1 * self.vehicle.mass.value
        torque = [1.0 * float(self.vehicle.inertia[i][i]) for i in range(3)]
        parts = {"force": [force] * 3, "torque": torque, "turn": [0.1] * 3}
        return np.array([v for n in self.noises.names[::3] for v in parts[n.split(".")[0]]])

    def sensor_scale(self) -> FloatArray:
        """The vehicle file's [noise], else values typical of small quadrotors."""
        typical = {
            "gyro": 0.02, "accelerometer": 0.1, "attitude": 0.003, "position": 0.001, "velocity": 0.02,
            "rotor_speed": 0.01 * self.vehicle.omega_scale,
        }  # fmt: skip
        known = self.vehicle.noise
        return np.array(
            [known.get(s.name, typical[s.name]) for s in self.sensors for _ in s.innovation_signals(self.vehicle)]
        )


def core_parameters(vehicle: Vehicle) -> tuple[Parameter, ...]:
    """Declarations of mass, inertia, centre of mass, thrust and torque maps from the vehicle file.

    Bounds follow the physics, or four sigma in older vehicle files (see `core_bounds`); priors are soft.
    """

    def declare(name: str, unit: str, value: float, sigma: float, meaning: str, *, size: float) -> Parameter:
        lower, upper = core_bounds(vehicle, name)
        scale = sigma if 0 < sigma < math.inf else (abs(value) or size)
        return Parameter(
            name=name, unit=unit, nominal=value, lower=lower, upper=upper, sigma=sigma, scale=scale, meaning=meaning
        )

    m = vehicle.mass
    out = [declare("mass", "kg", m.value, m.sigma, "mass", size=m.value)]
    for i, a in enumerate(("xx", "yy", "zz")):
        j = float(vehicle.inertia[i][i])
        out.append(
            declare(
                f"inertia.{a}", "kg m^2", j, float(vehicle.inertia_sigma[i]), f"moment of inertia {a}",
                size=j,
            )
        )  # fmt: skip
    for i, a in enumerate("xyz"):
        c = vehicle.center_of_mass[i]
        out.append(
            declare(
                f"center_of_mass.{a}", "m", c.value, c.sigma, f"centre of mass {a}",
                size=vehicle.arm_length,
            )
        )  # fmt: skip
    for kind, unit, triple in (("thrust", "N", vehicle.actuator.thrust), ("torque", "N m", vehicle.actuator.torque)):
        size = max(abs(q.value) for q in triple) or 1.0
        for k, q in enumerate(triple):
            out.append(
                declare(
                    f"{kind}.c{k}", unit, q.value, q.sigma, f"{kind} per rotor, power {k} of nu",
                    size=size,
                )
            )  # fmt: skip
    return tuple(out)


def sensors_for(columns: Iterable[str], vehicle: Vehicle, *, exclude: Iterable[str] = ()) -> tuple[Sensor, ...]:
    """The sensors whose columns are all in `columns`, without those named in `exclude`."""
    have, left_out = set(columns), set(exclude)
    return tuple(s for s in SENSORS if s.name not in left_out and have.issuperset(x.name for x in s.signals(vehicle)))


def _positive(tau: Expr) -> Expr:
    """A time constant to divide by: at least one microsecond, so that tau = 0 is the instantaneous rotor."""
    return ca.fmax(tau, 1e-6)


def _path_means(z: Expr) -> tuple[Expr, Expr]:
    """What is left of a difference that decays as exp(-t / tau), over 0 .. z tau: in the mean, which moves a velocity, and
    in the mean weighted by the time that remains, which moves a position: (1 - e^-z) / z and 2 (z - 1 + e^-z) / z^2."""
    small = ca.fabs(z) < 0.05
    y = ca.if_else(small, 1.0, z)
    mean, early = (1 - ca.exp(-y)) / y, 2 * (y - 1 + ca.exp(-y)) / y**2
    mean = ca.if_else(small, 1 - z / 2 * (1 - z / 3 * (1 - z / 4 * (1 - z / 5))), mean)
    return mean, ca.if_else(small, 1 - z / 3 * (1 - z / 4 * (1 - z / 5 * (1 - z / 6))), early)


def _rotor_path(
    nu: Expr, first: Expr, second: Expr, switch: Expr, dt: Expr, lag: Callable[[Expr], Expr]
) -> tuple[tuple[Expr, Expr, Expr], Expr]:
    """((nu at 0, dt/2 and dt for Runge-Kutta), nu at the end) of a first-order lag whose goal changes at `switch`; `lag`
    gives the time constant of rotors that are faster than their goal by so much, which stays until they reach it.

    The end is exact. The integrator gets the straight line that has the mean and the first moment of the exact path
    over the step, so that impulse and displacement are right however short tau is against dt and wherever the goal
    changes; a sampled exponential would give a rotor that has long settled a sixth of its old speed. In the moments tau
    stands before every exponential, so that tau = 0 is the rotor without lag to the last digit and the slope there is
    the true one, -(goal - nu)/dt in the mean.
    """
    before, after = switch / dt, 1 - switch / dt
    start_a, tau_a = nu - first, lag(nu - first)
    left_a = ca.exp(-switch / _positive(tau_a))
    start_b = first - second + start_a * left_a
    tau_b = lag(start_b)
    left_b = ca.exp(-(dt - switch) / _positive(tau_b))
    # Moments over [0, length] of exp(-xi / short), xi the time in units of dt.
    short_a, short_b = tau_a / dt, tau_b / dt
    area_a, area_b = short_a * (1 - left_a), short_b * (1 - left_b)
    arm_a, arm_b = short_a * (area_a - before * left_a), short_b * (area_b - after * left_b)
    mean = before * first + after * second + start_a * area_a + start_b * area_b
    moment = 0.5 * before * after * (second - first)  # about the middle of the step
    moment = moment + start_a * (arm_a - 0.5 * area_a) + start_b * (arm_b + (before - 0.5) * area_b)
    return (mean - 6 * moment, mean, mean + 6 * moment), second + start_b * left_b


def _polynomial(nu: Expr, c: Sequence[Expr]) -> Expr:
    return c[0] + nu * (c[1] + nu * c[2])


def _is_diagonal(vehicle: Any) -> bool:
    j = np.asarray(vehicle.inertia)
    return bool(np.allclose(j, np.diag(np.diag(j))))


def build_model(
    vehicle: Vehicle,
    columns: Iterable[str],
    effects: Iterable[str | Effect] = (),
    *,
    input: Literal["command", "speed"] = "command",
    sample_time: float = 0.01,
    noncausal: Iterable[str] = (),
    kinematic_noise: bool = False,
) -> PhysicsModel:
    """The model for a vehicle and a log: its known effects, the ones asked for, and the sensors that the log fills.

    `columns` are the channels of the data (`Dataset.channels`), `noncausal` those that were smoothed with later samples
    and must not serve as measurements; `kinematic_noise` is that of `PhysicsModel`. An effect object (`load_effects`) also
    stands for its name in the vehicle file. Raises `ModelError`, `UnknownNameError`.
    """
    usable = set(columns) - set(noncausal)
    asked = tuple(effects)
    given = {e.name: e for e in asked if isinstance(e, Effect)}
    for e in asked:
        if isinstance(e, Effect) and given[e.name] is not e:
            raise ModelError(f"two effects are named {e.name}", fix="give each its own name")
    chosen: list[Effect] = [given.get(n) or effect_by_name(n) for n in vehicle.effects]
    if input == "speed":  # measured rotor speeds already contain what shapes the command
        chosen = [e for e in chosen if e.stage not in ("command", "rotor")]
    names = [e.name for e in chosen]
    for e in asked:
        effect = e if isinstance(e, Effect) else given.get(e) or effect_by_name(e)
        if effect.name not in names:
            names.append(effect.name)
            chosen.append(effect)
    exclude = {"rotor_speed"} if input == "speed" else set()
    return PhysicsModel(
        vehicle=vehicle,
        effects=tuple(chosen),
        sensors=sensors_for(usable, vehicle, exclude=exclude),
        input=input,
        sample_time=sample_time,
        kinematic_noise=kinematic_noise,
    )
