"""CommandWindow: what commands were at, and between, instants that do not fall on samples."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from greybox.symbolic import Expr

APERTURE = 0.01
"""Part of a sample over which a sensor sees a command that jumps: an instant, but with a slope for
the fit."""


@dataclass(frozen=True, kw_only=True)
class CommandWindow:
    """How to read a window of inputs, n_u x (past + 1 + future), whose column `past` holds those of
    the sample t_k.

    The first `rotors` rows are commands, which may be late; the rest (a voltage) is taken as that
    of t_k.
    """

    rotors: int
    past: int
    future: int

    def bracket(self, window: Expr, r: Expr) -> tuple[Expr, Expr, Expr]:
        """(older, newer, share): the rotor commands on both sides of the instant r samples before
        t_k.

        share in [0, 1] is how far that instant lies from the newer towards the older one. Branches
        are closed to the left, so that the slope at r = 0 is the one-sided one.
        """
        past, future = self.past, self.future
        older: Expr = 0.0
        newer: Expr = 0.0
        whole: Expr = 0.0
        for m in range(-future, past):
            there = ca.if_else(r >= m, 1.0, 0.0) if m > -future else 1.0
            there = there * (ca.if_else(r < m + 1, 1.0, 0.0) if m < past - 1 else 1.0)
            newer = newer + there * window[: self.rotors, past - m]
            older = older + there * window[: self.rotors, past - m - 1]
            whole = whole + there * m
        return older, newer, r - whole

    def sent(self, age: Expr, dt: Expr) -> Expr:
        """An age [s] of commands, no younger than the newest of the window."""
        newest = -self.future * dt
        return ca.if_else(age < newest, newest, age)

    def held(self, window: Expr, delay: Expr, dt: Expr) -> tuple[Expr, Expr, Expr]:
        """(u_a, u_b, s): the delayed record holds u_a over [t_k, t_k + s) and u_b over [t_k + s,
        t_k+1).

        Exact for a held record. Of a record that runs linearly the value at the middle of the step
        is taken as both.
        """
        past, future = self.past, self.future
        if past == 0 and future == 0:
            return window, window, 0.0
        # Of a line the value at the middle of the step, half a sample later.
        older, newer, share = self.bracket(window, delay / dt - 0.5 * min(future, 1))
        rest = window[self.rotors :, past]
        if future:
            middle = ca.vertcat(share * older + (1 - share) * newer, rest)
            return middle, middle, 0.0
        return ca.vertcat(older, rest), ca.vertcat(newer, rest), share * dt

    def sampled(self, window: Expr, delay: Expr, dt: Expr, aperture: float = APERTURE) -> Expr:
        """The delayed command that a sample sees: the value now, of a held record its mean over the
        coming `aperture` dt."""
        past, future = self.past, self.future
        if past == 0 and future == 0:
            return window
        older, newer, share = self.bracket(window, delay / dt)
        if not future:
            share = ca.fmin(share / aperture, 1.0)
        return ca.vertcat(newer + share * (older - newer), window[self.rotors :, past])

    def mean(self, window: Expr, start: Expr, end: Expr, dt: Expr) -> tuple[Expr, Expr]:
        """Of the commands that were `start` to `end` seconds old at t_k, either first: the mean,
        which moves a velocity, and the mean weighted by the way that remains to `end`, which moves
        a position; the coming one where none has come."""
        past, future = self.past, self.future
        young, old = ca.fmin(start, end), ca.fmax(start, end)
        if future:
            middle = self.sampled(window, ca.fmax(0.5 * (young + old), (1 - future) * dt), dt)
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
            remains = (
                backwards * last - (1 - backwards) * first + (1 - 2 * backwards) * 0.5 * (a + b)
            )
            for i, weight in enumerate((length, length * remains)):
                totals[i] = totals[i] + weight
                sums[i] = sums[i] + weight * window[: self.rotors, past - m - 1]
        coming = self.sampled(window, ca.fmax(old, 0.0), dt, aperture=1.0)
        known = ca.logic_or(old > 0, young >= 0)
        tiny = (1e-9, 1e-15)
        rest = window[self.rotors :, past]
        mean, early = (
            ca.vertcat(c / ca.fmax(t, z), rest) for c, t, z in zip(sums, totals, tiny, strict=True)
        )
        return ca.if_else(known, mean, coming), ca.if_else(known, early, coming)
