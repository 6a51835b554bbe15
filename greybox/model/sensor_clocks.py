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
from itertools import pairwise
from typing import NamedTuple

import casadi as ca

from greybox.errors import ModelError
from greybox.frames import quat_exp, quat_multiply
from greybox.model.clock import CLOCKS, STATE_CLOCK
from greybox.model.command_window import CommandWindow
from greybox.model.flow import Flow
from greybox.model.rigid_body import RigidBody
from greybox.model.rotors import path_means, positive
from greybox.symbolic import Expr


class Instant(NamedTuple):
    """What a sensor shows: `delay` [s] before the instant of its `clock`."""

    clock: str
    delay: float


PARTS = 3
"""Equal parts of the way to another instant, over each of which the command is its mean: of 20 ms
at 100 Hz the step of the command falls into one of them."""
BACKWARDS = 3.0
"""Time constants that rotors are followed back: an error of their speed grows by exp of it."""
OWN = Instant(STATE_CLOCK, 0.0)
"""The instant of the states."""


@dataclass(frozen=True, kw_only=True)
class Passage:
    """The way from the instant of the states to another one, `age` [s] before it (negative: after
    it).

    `mean` is the mean command on the way, which moves velocities; `early` the mean weighted by the
    way that remains, which moves positions; `parts` the means over `PARTS` equal parts of the way,
    from the states on; `end` the command at the other instant.
    """

    age: Expr
    parts: tuple[Expr, ...]
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
            edges = [start + (end - start) * i / PARTS for i in range(PARTS + 1)]
            out[at] = Passage(
                age=self.lateness(at, values) - own,
                parts=tuple(commands.mean(window, *e, dt)[0] for e in pairwise(edges)),
                mean=mean,
                early=early,
                end=commands.sampled(window, end, dt),
            )
        return out

    def held(self, u: Expr, values: Mapping[str, Expr]) -> dict[Instant, Passage]:
        """The same where the command u has always been held."""
        own = self.lateness(OWN, values)
        return {
            at: Passage(
                age=self.lateness(at, values) - own, parts=(u,) * PARTS, mean=u, early=u, end=u
            )
            for at in self.apart
        }

    # ---------------------------------------------------------------- readings

    def readings(
        self,
        x: Mapping[str, Expr],
        nu: Expr,
        u: Expr,
        passages: Mapping[Instant, Passage],
        values: Mapping[str, Expr],
        w: Expr,
        lasting: Expr,
    ) -> dict[str, Expr]:
        """Readings by sensor name, of states `x` and rotors `nu` that the command u drives, under the
        noise `w` of the coming step and what pushes now and before."""
        rotors = self.body.rotors
        goal = rotors.goal(u, values)
        rate = rotors.rate(nu, goal, values)
        force, _, flow = self.body.accelerations(
            x, nu if rotors.have_lag else goal, rate, u, values, w + lasting
        )
        shown = self.shown(flow, force, x, values)
        for at in self.apart:
            seen = self.shown(*self.state_at(passages[at], x, nu, values, w, lasting), values)
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
        nu: Expr,
        values: Mapping[str, Expr],
        w: Expr,
        lasting: Expr,
    ) -> tuple[Flow, Expr, dict[str, Expr]]:
        """(flow, specific force [m/s^2], states) at the end of `way`, from states `x` and rotors
        `nu` at its start.

        Bodies move by the midpoint rule, rotors exactly. The noise `w` of the coming step acts ahead
        of the states alone, what is `lasting` on both sides.
        """
        rotors, back = self.body.rotors, way.age
        w = lasting + ca.if_else(back < 0, w, ca.DM.zeros(w.shape[0]))
        if rotors.have_lag:
            middle, early, nu_rate, end = self.rotors_on(way, nu, values)
        else:
            middle, early, end = (rotors.goal(u, values) for u in (way.mean, way.early, way.end))
            nu_rate = end * 0
        u = way.mean
        d = self.body.rates(x, early, nu_rate, u, values, w)
        half = {b: x[b] - 0.5 * back * d[b] for b in x}
        half["attitude"] = quat_multiply(x["attitude"], quat_exp(-0.5 * back * x["rate"]))
        d = self.body.rates(half, middle, nu_rate, u, values, w)
        there = {b: x[b] - back * d[b] for b in x}
        there["attitude"] = quat_multiply(x["attitude"], quat_exp(-back * half["rate"]))
        force, _, flow = self.body.accelerations(there, end, nu_rate, way.end, values, w)
        return flow, force, there

    def rotors_on(
        self, way: Passage, nu: Expr, values: Mapping[str, Expr]
    ) -> tuple[Expr, Expr, Expr, Expr]:
        """Speeds of rotors with a lag on `way` from `nu`: in the mean, in the mean weighted by the
        way that remains, their mean rate [1/s], and at the end. Exact for commands that are
        constant over each part of the way."""
        rotors, time = self.body.rotors, -way.age / PARTS
        shortest = ca.fmax(way.age, 0.0) / BACKWARDS
        middle = early = rate = nu * 0
        for left, command in zip(reversed(range(PARTS)), way.parts, strict=True):
            goal = rotors.goal(command, values)
            gap = nu - goal
            tau = ca.fmax(positive(rotors.lag_over(gap, values)), shortest)
            mean, first = path_means(time / tau)
            middle = middle + (goal + gap * mean) / PARTS
            early = early + (goal + gap * first + 2 * left * (goal + gap * mean)) / PARTS**2
            rate = rate - gap * mean / tau / PARTS
            nu = goal + gap * ca.exp(-time / tau)
        return middle, early, rate, nu
