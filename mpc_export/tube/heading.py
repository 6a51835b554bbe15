"""The heading gives way to the place: what a command that asks for too much gives up first.

Of what rotors do, turning about the thrust axis costs the most command and matters least: small
craft that hover near the end of their command range can lift more and tilt more, but hardly turn.
So a steady command beyond its limits is moved within them along the one change that leaves lift,
roll and pitch as they are (control allocation by priority: Faessler et al. 2017, IEEE Robotics and
Automation Letters 2(2)). Thrust and torque are taken to grow with the square of the command.
"""

from __future__ import annotations

import numpy as np

from greybox.symbolic import FloatArray

TURN = 1.0
"""A craft that would turn by more than this while it waits to come down, at its rate of now and with
the torque that it lacks, holds no place by tilting [rad]."""


def turning(places: FloatArray, spins: FloatArray) -> FloatArray:
    """(n,) Change of the squared commands that turns the most, of length 1, and neither lifts nor
    tilts: rotors at `places` (n, 3) in the body frame, turned back by `spins` (n,). Zeros where no
    change does."""
    kept = np.column_stack([np.ones(len(places)), np.asarray(places, dtype=float)[:, :2]])
    left = spins - kept @ np.linalg.lstsq(kept, spins, rcond=None)[0]
    length = float(np.linalg.norm(left))
    return np.asarray(left / length if length > 1e-6 else 0.0 * left)


def room(u: FloatArray, way: FloatArray, low: float, high: float) -> tuple[float, float]:
    """The least and the most by which u (n,) can be moved along `way` of squared commands within low
    and high; the least is larger than the most where it cannot."""
    size, sense = np.abs(way), np.sign(way)
    on = size > 0
    if ((u[~on] < low) | (u[~on] > high)).any():
        return np.inf, -np.inf
    if not on.any():
        return 0.0, 0.0
    ends = np.array([low * abs(low), high * abs(high)])
    far = np.sort((ends[:, None] - (u * np.abs(u))[on]) * sense[on], axis=0) / size[on]
    return float(far[0].max()), float(far[1].min())


def within(
    u: FloatArray, way: FloatArray, low: float, high: float
) -> tuple[FloatArray, float] | None:
    """The nearest command (n,) to u within low and high along `way` of squared commands, and by how
    much it is moved along it; None where there is none."""
    least, most = room(u, way, low, high)
    if least > most:
        return None
    moved = min(max(0.0, least), most)
    if moved == 0.0:
        return u, 0.0
    squares = u * np.abs(u) + moved * way
    return np.clip(np.sign(squares) * np.sqrt(np.abs(squares)), low, high), moved
