"""Body rates of a flight for every check that needs them: those of the gyro, else of the attitude.

Without a gyro the attitude still turns: its difference over a window is the mean rate in it. Over a
short window that is mostly noise of the attitude, over a long one little of the motion is left. A
user of these rates tries `windows` and takes the one that shows most of what it looks for.
"""

from __future__ import annotations

import math

import numpy as np

from greybox.data.checks.signals import (
    attitude_joined_up,
    attitude_rate,
    derivative,
    joined_up,
    pace,
    smoothed,
    turned,
)
from greybox.data.checks.view import FloatArray, View

HALF_WINDOW = 0.015
"""A gyro, and an attitude at the least, is differentiated over twice this time [s]."""
WIDEST = 0.12
"""An attitude is at most differentiated over twice this time [s]."""
WIDER = 1.5
"""Each window that is tried is so many times as wide as the one before."""


def shown_by(view: View) -> str:
    """The group that shows the body rates: "rate" (a gyro), else "attitude", "" where neither is
    there."""
    return next((group for group in ("rate", "attitude") if view.has(group)), "")


def windows(view: View) -> tuple[int, ...]:
    """Half windows [samples] over which rates may be taken and differentiated: one for a gyro; for
    an attitude from the pace of its samples on, each half as wide again as the one before."""
    half = max(1, round(HALF_WINDOW / view.dt))
    if shown_by(view) == "rate":
        return (half,)
    first = max(half, pace(view.group("attitude")))
    steps = range(math.floor(math.log(max(WIDEST / view.dt / first, 1.0), WIDER)) + 1)
    return tuple(dict.fromkeys(round(first * WIDER**k) for k in steps))


def body_rates(view: View, half: int) -> tuple[FloatArray, int]:
    """(body rates (N, 3) [rad/s], half window [samples] of which they are the mean).

    A gyro's are those of its samples (half window 0), an attitude's its turn over twice `half`
    samples. One of both must be there.
    """
    if shown_by(view) == "rate":
        return joined_up(view.group("rate"), half), 0
    quaternions = attitude_joined_up(view.group("attitude"), half)
    return attitude_rate(quaternions, view.dt, half), half


def lateral_force(view: View, half: int) -> FloatArray | None:
    """Specific force along the body's x and y (N, 2) [m/s^2], about as late and as smooth as the
    angular acceleration over this half window [samples]; None where nothing shows it.

    Beside a gyro it is that of the accelerometer. Beside an attitude it is that of the velocity, or
    of the position, turned into the body: where the attitude errs gravity is in it, too, which
    shows the error.
    """
    moving = next((g for g in ("velocity", "position") if view.has(g)), "")
    if shown_by(view) == "attitude" and moving:
        velocity = joined_up(view.group(moving), half)
        if moving == "position":
            velocity = derivative(velocity, view.dt, half)
        force = derivative(velocity, view.dt, half) + np.array([0.0, 0.0, view.vehicle.gravity])
        quaternions = attitude_joined_up(view.group("attitude"), half)
        return smoothed(turned("rotate_inverse", quaternions, force)[:, :2], half)
    if not view.has("specific_force"):
        return None
    return smoothed(joined_up(view.joined(["ax", "ay"]), half), 2 * half)
