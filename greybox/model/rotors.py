"""Rotors: from commands to normalised speeds nu, with a lag where an effect brings one.

u -> command stage -> rotor stage -> goal nu_ss;   d nu / dt = (nu_ss - nu) / tau,  nu = nu_ss
without a lag. A lag of second order follows a pull m, which is a state beside the speed:

    d nu / dt = (m - nu) / tau,   b tau dm / dt = nu_ss - m + b (m - nu);   m = nu_ss at b = 0
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import casadi as ca

from greybox.model.flow import Flow
from greybox.model.staged_effects import StagedEffects
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


class Turning(NamedTuple):
    """Rotors at one instant: speeds nu (n), and what pulls them (n), None in a lag of first
    order."""

    speed: Expr
    pull: Expr = None

    @property
    def stacked(self) -> Expr:
        """Both as a part of the state vector."""
        return self.speed if self.pull is None else ca.vertcat(self.speed, self.pull)


class Leg(NamedTuple):
    """Rotors under one goal for a while: where they are at the `end`, and of their way to the goal
    the `area` and the `arm`, integrals of nu - goal and of t (nu - goal), t in steps."""

    end: Turning
    area: Expr
    arm: Expr


@dataclass(frozen=True, kw_only=True)
class Rotors:
    """The rotors of a model. `measured`: the inputs are rotor speeds [rad/s] instead of
    commands."""

    staged: StagedEffects
    measured: bool

    @property
    def count(self) -> int:
        """Number of rotors."""
        return len(self.staged.vehicle.rotors)

    @cached_property
    def have_lag(self) -> bool:
        """Whether rotors follow their goal with a lag: their speeds are then states."""
        return self.staged.has("lag")

    @cached_property
    def have_pull(self) -> bool:
        """Whether that lag is of second order: what pulls the rotors is then a state as well."""
        return self.have_lag and self.staged.has("lag_second")

    def turning(self, rotors: Expr) -> Turning:
        """Speeds and pulls of a part of the state vector."""
        return Turning(*ca.vertsplit(rotors, self.count)) if self.have_pull else Turning(rotors)

    def goal(self, u: Expr, values: Mapping[str, Expr]) -> Expr:
        """nu_ss that the inputs u ask for: command chain, then the product of the rotor stage's
        factors."""
        staged, vbat, command = self.staged, self.staged.voltage(u), u[: self.count]
        if self.measured:
            return command / staged.vehicle.actuator.speed_max
        for e in staged.of("command"):
            flow = Flow(vehicle=staged.vehicle, command=command, vbat=vbat)
            command = e.apply(flow, staged.own(e, values)).get("command", command)
        nu = command
        for e in staged.of("rotor"):
            flow = Flow(vehicle=staged.vehicle, command=command, vbat=vbat)
            nu = nu * e.apply(flow, staged.own(e, values)).get("steady_factor", 1.0)
        return nu

    def lag(self, values: Mapping[str, Expr]) -> Expr:
        """Time constant; it may be zero (divide by `positive` of it)."""
        return self.staged.early("lag", values)

    def lag_over(self, nu: Expr, goal: Expr, values: Mapping[str, Expr]) -> Expr:
        """Time constant [s] of rotors that go from `nu` towards `goal` (n): of each its own where
        slowing down takes another time than speeding up, or where it depends on the speed."""
        tau = self._lag_each_way(nu, goal, values)
        if not self._lag_by_speed:
            return tau
        return tau / self._quicker(0.5 * (nu + goal), values)

    def leg(
        self, start: Turning, goal: Expr, length: Expr, dt: Expr, values: Mapping[str, Expr]
    ) -> Leg:
        """Rotors from `start` under one `goal` (n) for `length` of a step of `dt` [s].

        Of second order with one time constant it is exact, one that depends on the speed is that
        at the beginning. In the areas tau stands before every exponential, so that tau = 0 is the
        rotor without lag to the last digit, with the true slope there.
        """
        if not self.have_pull:
            return _first_order(start, goal, length, dt, self._decay(start, goal, length, values))
        tau, b = self.lag_over(start.speed, goal, values), self.staged.early("lag_second", values)
        second = _second_order(start, goal, length, dt, (tau, b))
        if not self._lag_by_speed:
            return second
        # What the second order changes in a lag of that time constant, beside the exact first one.
        exact = _first_order(start, goal, length, dt, self._decay(start, goal, length, values))
        plain = _first_order(start, goal, length, dt, (tau, ca.exp(-length / positive(tau))))
        return Leg(
            Turning(exact.end.speed + (second.end.speed - plain.end.speed), second.end.pull),
            exact.area + (second.area - plain.area),
            exact.arm + (second.arm - plain.arm),
        )

    def _decay(
        self, start: Turning, goal: Expr, length: Expr, values: Mapping[str, Expr]
    ) -> tuple[Expr, Expr]:
        """(time constant [s], share (n) that is left after `length` [s]) of the way of rotors to
        `goal` in a lag of first order; the area under what is left is their difference times the
        time constant."""
        nu = start.speed
        tau = self._lag_each_way(nu, goal, values)
        if not self._lag_by_speed:
            return tau, ca.exp(-length / positive(tau))
        # With e = nu - goal: de/dt = -e (last + (now - last) e / e_0) / tau, whose solution is
        # e_0 E / (1 + (now / last - 1) (1 - E)) with E = exp(-last t / tau).
        now, last = (self._quicker(s, values) for s in (0.5 * (nu + goal), goal))
        kept = ca.exp(-last * length / positive(tau))
        y = (now / last - 1) * (1 - kept)
        small = ca.fabs(y) < 1e-4
        some = ca.if_else(small, 1.0, y)
        mean = ca.if_else(small, 1 - y / 2 * (1 - 2 / 3 * y), ca.log1p(some) / some)
        return tau / now * mean * (1 + y), kept / (1 + y)

    @property
    def _lag_by_speed(self) -> bool:
        return self.have_lag and self.staged.has("lag_speed")

    def _lag_each_way(self, nu: Expr, goal: Expr, values: Mapping[str, Expr]) -> Expr:
        tau = self.lag(values) if self.have_lag else 0.0
        if not self.staged.has("lag_asymmetry"):
            return tau
        return tau * (1 + self.staged.early("lag_asymmetry", values) * ca.sign(nu - goal))

    def _quicker(self, speed: Expr, values: Mapping[str, Expr]) -> Expr:
        """Rate of rotors about a speed (n), in units of that about the speed that hovers."""
        share = self.staged.early("lag_speed", values)
        hover = hover_speed(self.staged.vehicle, values)
        return ca.fmax(1 + share * (speed / hover - 1), SLOWEST)

    def rates(self, now: Turning, goal: Expr, values: Mapping[str, Expr]) -> Turning:
        """d/dt [1/s] of speeds and pulls on the way to `goal`; 0 without a lag."""
        if not self.have_lag:
            return Turning(goal * 0)
        tau = self.lag_over(now.speed, goal, values)
        if now.pull is None:
            return Turning((goal - now.speed) / positive(tau))
        b, gap = self.staged.early("lag_second", values), now.pull - now.speed
        change = (goal - now.pull + b * gap) / positive(b * tau)
        return Turning(gap / positive(tau), change)

    def aim(self, now: Turning, goal: Expr, values: Mapping[str, Expr], way: Expr = 0.0) -> Expr:
        """Where rotors go on a short `way` [s] under one `goal`: there in a lag of first order,
        else to the mean of what pulls them, which comes near the goal within b tau."""
        if now.pull is None:
            return goal
        tau = self.lag_over(now.speed, goal, values)
        short, way = self.staged.early("lag_second", values) * tau, ca.fmax(way, AT_ONCE * tau)
        left = short / positive(way) * (1 - ca.exp(-way / positive(short)))
        return goal + (now.pull - goal) * left


AT_ONCE = 0.01
"""What a sensor shows of a pull that just changed: its mean over this part of a time constant."""

SLOWEST = 0.1
"""Rate of a rotor that nearly stands, in units of that in hover: a lag stays a lag."""


def hover_speed(vehicle: Vehicle, values: Mapping[str, Expr]) -> Expr:
    """Speed nu at which equal rotors carry the weight of a vehicle with these `values`, by mass and
    thrust map alone."""
    weight = values["mass"] * vehicle.gravity / len(vehicle.rotors)
    c0, c1, c2 = (values[f"thrust.c{k}"] for k in range(3))
    need = ca.fmax(weight - c0, 0.0)
    return positive(2 * need / positive(c1 + ca.sqrt(c1 * c1 + 4 * c2 * need)))


def positive(tau: Expr) -> Expr:
    """A time constant to divide by: at least one microsecond, so that tau = 0 is the instantaneous
    rotor."""
    return ca.fmax(tau, 1e-6)


def path_means(z: Expr) -> tuple[Expr, Expr]:
    """What is left of a difference that decays as exp(-t / tau), over 0 .. z tau: in the mean,
    which moves a velocity, and in the mean weighted by the time that remains, which moves a
    position: (1 - e^-z) / z and 2 (z - 1 + e^-z) / z^2."""
    small = ca.fabs(z) < 0.05
    y = ca.if_else(small, 1.0, z)
    mean, early = (1 - ca.exp(-y)) / y, 2 * (y - 1 + ca.exp(-y)) / y**2
    mean = ca.if_else(small, 1 - z / 2 * (1 - z / 3 * (1 - z / 4 * (1 - z / 5))), mean)
    return mean, ca.if_else(small, 1 - z / 3 * (1 - z / 4 * (1 - z / 5 * (1 - z / 6))), early)


def _first_order(
    start: Turning, goal: Expr, length: Expr, dt: Expr, decay: tuple[Expr, Expr]
) -> Leg:
    """The leg of a lag with its (time constant [s], share that is left at the end)."""
    (tau, left), off = decay, start.speed - goal
    short = tau / dt
    area = short * (1 - left)
    arm = short * (area - length / dt * left)
    return Leg(Turning(goal + off * left), off * area, off * arm)


def _second_order(
    start: Turning, goal: Expr, length: Expr, dt: Expr, lag: tuple[Expr, Expr]
) -> Leg:
    """The leg of b tau^2 nu'' + tau nu' + nu = goal with `lag` (tau [s], b), solved.

    Area and arm follow from both ends, since the equation is the derivative of b tau^2 nu' + tau nu
    but for its last term.
    """
    (tau, b), off, far = lag, start.speed - goal, start.pull - goal
    mean, odd = _modes(length, tau, b)
    left = mean * off + odd * (0.5 * off + b * (far - off))
    pulled = mean * far + odd * ((b - 0.5) * far - b * off)
    short = tau / dt
    area = short * (b * (far - off - pulled + left) + off - left)
    arm = short * (area - length / dt * (b * (pulled - left) + left) + b * short * (left - off))
    return Leg(Turning(goal + left, goal + pulled), area, arm)


def _modes(length: Expr, tau: Expr, b: Expr) -> tuple[Expr, Expr]:
    """(exp(-s) cosh(r s), 2 exp(-s) sinh(r s) / r) with s = length / (2 b tau), r^2 = 1 - 4 b:
    half the sum of both modes of a lag of second order, and their difference by r.

    Two lags where b < 1/4 (at b = 0 one), a damped wave beyond; a series about equal lags.
    """
    q, s = 1 - 4 * b, 0.5 * length / positive(b * tau)
    near = ca.logic_and(ca.fabs(q) < 0.5, ca.fabs(q) * s * s < 1e-2)
    z = ca.if_else(near, q * s * s, 0.0)
    fades = ca.exp(-s)
    even = fades * (1 + z / 2 * (1 + z / 12 * (1 + z / 30)))
    odd = 2 * s * fades * (1 + z / 6 * (1 + z / 20 * (1 + z / 42)))
    r = ca.sqrt(ca.if_else(near, 1.0, ca.fabs(q)))
    slow, fast = ca.exp(-2 / (1 + r) * length / positive(tau)), ca.exp(-(1 + r) * s)
    lags = q > 0
    mean = ca.if_else(lags, 0.5 * (slow + fast), fades * ca.cos(r * s))
    apart = ca.if_else(lags, slow - fast, 2 * fades * ca.sin(r * s)) / r
    return ca.if_else(near, even, mean), ca.if_else(near, odd, apart)


def rotor_path(
    start: Turning,
    first: Expr,
    second: Expr,
    switch: Expr,
    dt: Expr,
    leg: Callable[[Turning, Expr, Expr, Expr], Leg],
) -> tuple[tuple[Expr, Expr, Expr], Turning]:
    """((nu at 0, dt/2 and dt for Runge-Kutta), rotors at the end) of a lag whose goal changes at
    `switch`; `leg` is that of `Rotors`, of (rotors, their goal, the time under it, dt).

    The end is exact. The integrator gets the straight line that has the mean and the first moment
    of the exact path over the step, so that impulse and displacement are right however short tau is
    against dt and wherever the goal changes (of motor_lag_speed the moment is that of an
    exponential, half a percent off at most); a sampled exponential would give a rotor that has long
    settled a sixth of its old speed.
    """
    before, after = switch / dt, 1 - switch / dt
    a = leg(start, first, switch, dt)
    b = leg(a.end, second, dt - switch, dt)
    mean = before * first + after * second + a.area + b.area
    moment = 0.5 * before * after * (second - first)  # about the middle of the step
    moment = moment + (a.arm - 0.5 * a.area) + (b.arm + (before - 0.5) * b.area)
    return (mean - 6 * moment, mean, mean + 6 * moment), b.end
