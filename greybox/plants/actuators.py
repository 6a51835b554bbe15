"""From logged commands to rotor speeds: delay, shaping, supply voltage, a lag solved
exactly."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from greybox.plants.effects.base import PlantEffect, hooks
from greybox.plants.vectors import Number, exponential, where

_SAME_INSTANT = 1e-9


class Actuators:
    """The rotors of one plant (or of a batch): held commands in, normalised speeds out."""

    def __init__(self, effects: tuple[PlantEffect, ...], rotors: int) -> None:
        self._shapes = hooks(effects, "command")
        self._factors = hooks(effects, "rotor_factor")
        self.delay = float(sum(e.delay() for e in effects))
        lags = hooks(effects, "lag")
        if len(lags) > 1:
            raise ValueError("more than one effect gives the rotors a lag; keep one")
        self._up: Number = lags[0]() if lags else 0.0
        self._down = self._up
        for asymmetry in hooks(effects, "lag_asymmetry"):
            self._up, self._down = self._up * (1.0 - asymmetry()), self._down * (1.0 + asymmetry())
        self._drag = next((d() for d in hooks(effects, "lag_drag")), None)
        self._second: Number = sum(b() for b in hooks(effects, "lag_second"))
        self._instant_up, self._instant_down = self._zero(self._up), self._zero(self._down)
        positive = [float(v) for tau in (self._up, self._down) for v in np.ravel(tau) if v > 0.0]
        self.shortest_lag = min(positive, default=0.0)
        """Shortest time constant above zero [s], or zero."""
        self._rotors = rotors
        self._history: list[tuple[float, list[Number]]] = []
        self.nu: list[Number] = []
        self.target: list[Number] = []
        self.pull: list[Number] = []
        """What the speeds follow: the targets, or a state of its own in a lag of second order."""

    @staticmethod
    def _zero(tau: Number) -> Number:
        """Whether the time constant is zero, as a bool or an array of bools."""
        return tau == 0.0

    def reset(self, command: Number) -> None:
        """All rotors have held `command` for ever."""
        self._history = [(float("-inf"), [command] * self._rotors)]
        self.nu = self.target = self.pull = [command] * self._rotors

    def settle(self, voltage: Number) -> None:
        """Put the speeds at the steady state of the present command at this voltage [V]."""
        self.nu = self.target = self.pull = self.steady(self._history[-1][1], voltage)

    def hold(self, time: float, command: list[Number]) -> None:
        """From `time` on the flight controller sends `command`."""
        if self._history[-1][0] > time - _SAME_INSTANT:
            self._history.pop()
        self._history.append((time, command))
        cut = time - self.delay - _SAME_INSTANT
        while len(self._history) > 1 and self._history[1][0] <= cut:
            del self._history[0]

    def steady(self, command: list[Number], voltage: Number) -> list[Number]:
        """Speeds that the rotors settle at under `command` and `voltage` [V]."""
        factor: Number = 1.0
        for factor_hook in self._factors:
            factor = factor * factor_hook(voltage)
        speeds = []
        for u in command:
            for shape in self._shapes:
                u = shape(u)
            speeds.append(u * factor)
        return speeds

    def pieces(self, start: float, length: float) -> Iterator[tuple[float, float, list[Number]]]:
        """Tiles (start, length, command at the motor) of [start, start + length], split where
        commands switch."""
        end = start + length
        marks = [t + self.delay for t, _ in self._history]
        inner = [m for m in marks if start + _SAME_INSTANT < m < end - _SAME_INSTANT]
        edges = [start, *inner, end]
        for a, b in pairwise(edges):
            yield a, b - a, self.at(a)

    def at(self, time: float) -> list[Number]:
        """The command that reaches the motors just after `time`."""
        present = self._history[0][1]
        for t, command in self._history:
            if t + self.delay <= time + _SAME_INSTANT:
                present = command
        return present

    def start(self, nu: Number, target: Number) -> Number:
        """Speed just after the target changed: the target itself where there is no lag."""
        return where(where(target > nu, self._instant_up, self._instant_down), target, nu)

    def relax(self, duration: float) -> tuple[list[Number], list[Number]]:
        """Speeds and pulls `duration` [s] later, on their way to the present targets."""
        first = self._relax_first(duration)
        if np.all(np.equal(self._second, 0.0)):
            return first, self.target
        there = [self._swung(*now, duration) for now in zip(self.nu, self.pull, self.target)]
        plain = np.equal(self._second, 0.0)
        return (
            [where(plain, f, n) for f, (n, _) in zip(first, there)],
            [where(plain, s, m) for s, (_, m) in zip(self.target, there)],
        )

    def _relax_first(self, duration: float) -> list[Number]:
        """Speeds `duration` [s] later, of a lag of first order."""
        nu = self.nu
        if self._drag is not None:
            return [self._dragged(n, s, duration) for n, s in zip(nu, self.target)]
        if self._up is self._down:
            left = self._decay(self._up, duration)
            return [s + (n - s) * left for n, s in zip(nu, self.target)]
        return [
            s + (n - s) * self._decay(where(s > n, self._up, self._down), duration)
            for n, s in zip(nu, self.target)
        ]

    def _swung(
        self, nu: Number, pull: Number, target: Number, duration: float
    ) -> tuple[Number, Number]:
        """(speed, pull) of a lag of second order, by its two modes, waves or not."""
        tau = self._lag(nu, target)
        still = tau == 0.0
        tau, b = where(still, 1.0, tau), where(self._second == 0.0, 1.0, self._second)
        root = np.sqrt(1.0 - 4.0 * b + 0j)
        root = np.where(np.abs(root) < 1e-6, 1e-6, root)
        one, two = (-1.0 + root) / (2.0 * b * tau), (-1.0 - root) / (2.0 * b * tau)
        off = nu - target
        part = ((pull - nu) / tau - two * off) / (one - two)
        modes = part * np.exp(one * duration), (off - part) * np.exp(two * duration)
        gap, slope = np.real(modes[0] + modes[1]), np.real(one * modes[0] + two * modes[1])
        speed = where(still, target, target + gap)
        return speed, where(still, target, speed + tau * slope)

    def _dragged(self, nu: Number, target: Number, duration: float) -> Number:
        """Bernoulli's equation of a rotor with the drag of its propeller, solved."""
        assert self._drag is not None
        own, drag = self._drag
        tau = where(target > nu, self._up, self._down)
        rate = own + 2.0 * drag * target
        left = self._decay(tau, rate * duration)
        gap, still = nu - target, rate == 0.0
        # (1 - left) / rate, which is duration / tau where the rotor shall stand still
        slow = duration / where(tau == 0.0, 1.0, tau)
        passed = where(still, slow, (1.0 - left) / where(still, 1.0, rate))
        return target + gap * left / (1.0 + drag * gap * passed)

    @staticmethod
    def _decay(tau: Number, duration: float) -> Number:
        """Factor by which the distance to the target shrinks in `duration` [s]."""
        if isinstance(tau, float):
            return 0.0 if tau == 0.0 else exponential(-duration / tau)
        instant = tau == 0.0
        return where(instant, 0.0, exponential(-duration / where(instant, 1.0, tau)))

    def _lag(self, nu: Number, target: Number) -> Number:
        """Time constant [s] of a rotor on its way."""
        tau = self._up if self._up is self._down else where(target > nu, self._up, self._down)
        if self._drag is None:
            return tau
        own, drag = self._drag
        return tau / (own + drag * (nu + target))

    def rates(self, nu: list[Number], pull: list[Number]) -> list[Number]:
        """dnu/dt [1/s] of rotors on their way to the present targets; zero for one without lag."""
        return [self._rate(*now) for now in zip(nu, pull, self.target)]

    def _rate(self, nu: Number, pull: Number, target: Number) -> Number:
        tau = self._lag(nu, target)
        aim = where(np.equal(self._second, 0.0), target, pull)
        if isinstance(tau, float):
            return 0.0 if tau == 0.0 else (aim - nu) / tau
        return where(tau == 0.0, 0.0, (aim - nu) / where(tau == 0.0, 1.0, tau))
