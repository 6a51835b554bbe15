"""Rotors: from commands to normalised speeds nu, with a lag where an effect brings one.

u -> command stage -> rotor stage -> goal nu_ss;   d nu / dt = (nu_ss - nu) / tau,  nu = nu_ss
without a lag
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca

from greybox.model.flow import Flow
from greybox.model.staged_effects import StagedEffects
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


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

    def decay(
        self, nu: Expr, goal: Expr, length: Expr, values: Mapping[str, Expr]
    ) -> tuple[Expr, Expr]:
        """(time constant [s], share (n) that is left after `length` [s]) of the way of rotors from
        `nu` to `goal`; the area under what is left is their difference times the time constant."""
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

    def rate(self, nu: Expr, goal: Expr, values: Mapping[str, Expr]) -> Expr:
        """d nu / dt [1/s] on the way to `goal`; 0 without a lag."""
        return (
            (goal - nu) / positive(self.lag_over(nu, goal, values)) if self.have_lag else goal * 0
        )


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


def rotor_path(
    nu: Expr,
    first: Expr,
    second: Expr,
    switch: Expr,
    dt: Expr,
    decay: Callable[[Expr, Expr, Expr], tuple[Expr, Expr]],
) -> tuple[tuple[Expr, Expr, Expr], Expr]:
    """((nu at 0, dt/2 and dt for Runge-Kutta), nu at the end) of a first-order lag whose goal
    changes at `switch`; `decay` is that of `Rotors`, of (a speed, its goal, the time on the way).

    The end is exact. The integrator gets the straight line that has the mean and the first moment
    of the exact path over the step, so that impulse and displacement are right however short tau is
    against dt and wherever the goal changes (of motor_lag_speed the moment is that of an
    exponential, half a percent off at most); a sampled exponential would give a rotor that has long
    settled a sixth of its old speed. In the moments tau stands before every exponential, so that
    tau = 0 is the rotor without lag to the last digit and the slope there is the true one, -(goal -
    nu)/dt in the mean.
    """
    before, after = switch / dt, 1 - switch / dt
    start_a = nu - first
    tau_a, left_a = decay(nu, first, switch)
    start_b = first - second + start_a * left_a
    tau_b, left_b = decay(second + start_b, second, dt - switch)
    # Moments over [0, length] of exp(-xi / short), xi the time in units of dt.
    short_a, short_b = tau_a / dt, tau_b / dt
    area_a, area_b = short_a * (1 - left_a), short_b * (1 - left_b)
    arm_a, arm_b = short_a * (area_a - before * left_a), short_b * (area_b - after * left_b)
    mean = before * first + after * second + start_a * area_a + start_b * area_b
    moment = 0.5 * before * after * (second - first)  # about the middle of the step
    moment = moment + start_a * (arm_a - 0.5 * area_a) + start_b * (arm_b + (before - 0.5) * area_b)
    return (mean - 6 * moment, mean, mean + 6 * moment), second + start_b * left_b
