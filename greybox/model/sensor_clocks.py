"""SensorClocks: what the sensors of a model show, each at the instant of its own clock.

States are those of the clock `STATE_CLOCK`. The state at another instant is computed once for each,
and all sensors that show this instant read from it:

    x(t - age) = x - age dx/dt(t - age/2), by the midpoint rule with the mean command on the way
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca

from greybox.errors import ModelError
from greybox.frames import quat_exp, quat_multiply
from greybox.model.clock import CLOCKS, ROTOR_CLOCK, STATE_CLOCK
from greybox.model.command_window import CommandWindow
from greybox.model.flow import Flow
from greybox.model.rigid_body import RigidBody
from greybox.model.rotors import Turning, path_means, positive
from greybox.symbolic import Expr


class Instant(NamedTuple):
    """What a sensor shows: `delay` [s] before the instant of its `clock`."""

    clock: str
    delay: float


OWN = Instant(STATE_CLOCK, 0.0)
"""The instant of the states."""
TELEMETRY = Instant(ROTOR_CLOCK, 0.0)
"""The instant of measured rotor speeds."""


@dataclass(frozen=True, kw_only=True)
class Passage:
    """The way from the instant of the states to another one, `age` [s] before it (negative: after
    it).

    `mean` is the mean command on the way, which moves velocities; `early` the mean weighted by the
    way that remains, which moves positions; `end` the command at the other instant.
    """

    age: Expr
    mean: Expr
    early: Expr
    end: Expr


@dataclass(frozen=True, kw_only=True)
class SensorClocks:
    """The sensors of a model on the clocks of its effects; `body` says how the states move."""

    body: RigidBody

    @cached_property
    def instants(self) -> dict[Instant, tuple[str, ...]]:
        """Instant -> names of the sensors that show it."""
        out: dict[Instant, tuple[str, ...]] = {OWN: ()}
        for s in self.body.staged.sensors:
            at = Instant(s.clock, s.delay)
            out[at] = (*out.get(at, ()), s.name)
        return out

    @cached_property
    def apart(self) -> tuple[Instant, ...]:
        """Instants that may differ from that of the states: something delays them, or the
        states."""
        staged = self.body.staged
        own = staged.has(CLOCKS[STATE_CLOCK].delay)
        return tuple(
            i
            for i in self.instants
            if i != OWN
            and (i.delay or (i.clock != STATE_CLOCK and (own or staged.has(CLOCKS[i.clock].delay))))
        )

    @cached_property
    def follow(self) -> bool:
        """Whether rotors as telemetry shows them are states of their own: those of the states,
        later by a delay, would run away on the way back."""
        late = self.body.staged.has(CLOCKS[ROTOR_CLOCK].delay)
        return late and self.body.rotors.have_lag

    # ---------------------------------------------------------------- commands

    def lateness(self, at: Instant, values: Mapping[str, Expr]) -> Expr:
        """How much an instant lies before what the log calls now [s]."""
        late = self.body.staged.early(CLOCKS[at.clock].delay, values)
        return late + at.delay if at.delay else late

    def command_age(self, at: Instant, values: Mapping[str, Expr]) -> Expr:
        """How old commands are [s] that act on the rotors at an instant."""
        return self.body.staged.early("delay", values) + self.lateness(at, values)

    @cached_property
    def late(self) -> bool:
        """Whether anything is late: commands, the states, or other instants."""
        staged = self.body.staged
        return staged.has("delay") or staged.has(CLOCKS[STATE_CLOCK].delay) or bool(self.apart)

    def reach(self, upper: Mapping[str, float], sample_time: float) -> float:
        """How far back [s] a model has to see commands, with its parameters at the bounds `upper`.
        Raises `ModelError`."""
        staged = self.body.staged
        late = [0.0]
        if staged.has(CLOCKS[STATE_CLOCK].delay):
            late.append(max(float(self.lateness(OWN, upper)), sample_time))
        late += [min(float(self.lateness(i, upper)), CLOCKS[i.clock].reach) for i in self.apart]
        longest = float(staged.early("delay", upper)) + max(late)
        if not math.isfinite(longest):
            raise ModelError(
                "a delay without an upper bound", fix="declare the parameter with a finite upper"
            )
        return longest

    def passages(
        self, commands: CommandWindow, window: Expr, values: Mapping[str, Expr], dt: Expr
    ) -> dict[Instant, Passage]:
        """The way to every instant of `apart`, at a sample with this window of commands."""
        start, own = self.command_age(OWN, values), self.lateness(OWN, values)
        out = {}
        for at in self.apart:
            end = self.command_age(at, values)
            mean, early = commands.mean(window, start, end, dt)
            out[at] = Passage(
                age=self.lateness(at, values) - own,
                mean=mean,
                early=early,
                end=commands.sampled(window, commands.sent(end, dt), dt),
            )
        return out

    def held(self, u: Expr, values: Mapping[str, Expr]) -> dict[Instant, Passage]:
        """The same where the command u has always been held."""
        own = self.lateness(OWN, values)
        return {
            at: Passage(age=self.lateness(at, values) - own, mean=u, early=u, end=u)
            for at in self.apart
        }

    # ---------------------------------------------------------------- readings

    def readings(
        self,
        x: Mapping[str, Expr],
        turning: tuple[Turning, Turning],
        u: Expr,
        passages: Mapping[Instant, Passage],
        values: Mapping[str, Expr],
        w: Expr,
        lasting: Expr,
    ) -> dict[str, Expr]:
        """Readings by sensor name, of states `x` and rotors `turning` (now, and as telemetry shows
        them) that the command u drives, under the noise `w` of the coming step and what
        pushes now and before."""
        now, followed = turning
        rotors = self.body.rotors
        goal = rotors.goal(u, values)
        aim = rotors.aim(now, goal, values)
        rate = rotors.rates(Turning(now.speed), aim, values).speed
        force, _, flow = self.body.accelerations(
            x, now.speed if rotors.have_lag else goal, rate, u, values, w + lasting
        )
        shown = self.shown(flow, force, x, values)
        for at in self.apart:
            end = followed.speed if self.follow and at == TELEMETRY else None
            seen = self.shown(*self.state_at(passages[at], x, now, values, w, lasting, end), values)
            shown |= {name: seen[name] for name in self.instants[at]}
        return shown

    def shown(
        self, flow: Flow, force: Expr, x: Mapping[str, Expr], values: Mapping[str, Expr]
    ) -> dict[str, Expr]:
        """Readings of all sensors at one instant, after the chain of the sensor stage."""
        staged = self.body.staged
        readings = {
            s.name: s.reading(staged.with_memory(s, flow, x), force) for s in staged.sensors
        }
        flow = replace(flow, acceleration_world=flow.rotation @ force + self.body.gravity)
        for e in staged.of("sensor"):
            slots = e.apply(replace(flow, measured=readings), staged.own(e, values))
            readings = {k: slots.get(k, v) for k, v in readings.items()}
        return readings

    def state_at(
        self,
        way: Passage,
        x: Mapping[str, Expr],
        now: Turning,
        values: Mapping[str, Expr],
        w: Expr,
        lasting: Expr,
        known: Expr = None,
    ) -> tuple[Flow, Expr, dict[str, Expr]]:
        """(flow, specific force [m/s^2], states) at the end of `way`, from states `x` and rotors
        `now` at its start; at its end they are as `known`, where they are.

        Bodies move by the midpoint rule, rotors exactly. The noise `w` of the coming step acts
        ahead of the states alone, what is `lasting` on both sides.
        """
        rotors, back = self.body.rotors, way.age
        w = lasting + ca.if_else(back < 0, w, ca.DM.zeros(w.shape[0]))
        u, goal, soon = way.mean, rotors.goal(way.mean, values), rotors.goal(way.early, values)
        if rotors.have_lag:
            # Backwards a settled rotor would run away: there the lag counts as no shorter than
            # the way.
            nu = now.speed
            tau = positive(rotors.lag_over(nu, goal, values))
            goal = rotors.aim(now, goal, values, ca.fabs(back))
            tau = ca.if_else(back > 0, ca.fmax(tau, back), tau)
            nu_rate = (goal - nu) / ca.fmax(tau, ca.fabs(back))
            mean, early = path_means(-back / tau)
            middle, early = goal + (nu - goal) * mean, goal + (nu - goal) * early
            end = goal + (nu - goal) * ca.exp(back / tau)
        else:
            middle, early, nu_rate = goal, soon, goal * 0
            end = rotors.goal(way.end, values)
        d = self.body.rates(x, early, nu_rate, u, values, w)
        half = {b: x[b] - 0.5 * back * d[b] for b in x}
        half["attitude"] = quat_multiply(x["attitude"], quat_exp(-0.5 * back * x["rate"]))
        d = self.body.rates(half, middle, nu_rate, u, values, w)
        there = {b: x[b] - back * d[b] for b in x}
        there["attitude"] = quat_multiply(x["attitude"], quat_exp(-back * half["rate"]))
        end = end if known is None else known
        force, _, flow = self.body.accelerations(there, end, nu_rate, way.end, values, w)
        return flow, force, there
