"""Samples that cannot be become missing, counted and listed; nothing else is changed.

Three rules, one question: could the craft have done this? A value outside its channel's range; a
rotor faster than 1.3 times its top speed; a single sample that stands apart from both its neighbours
by more than the craft can move in that time (pose: by what velocity or gyro say; gyro: by what the
rotors' torque can turn).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from greybox.data.channel import channel
from greybox.data.raw import RawLog
from greybox.model.vehicle import Vehicle
from greybox.symbolic import BoolArray, FloatArray

OVERSPEED = 1.3
"""Times the top speed of the vehicle file: a rotor in a dive turns a little faster, never this much."""
APART = 20.0
"""Times the usual size of such steps (median absolute) from which a single sample stands apart."""
MARGIN = 5.0
"""Times the change that motion explains from which a single sample stands apart."""


@dataclass(frozen=True, kw_only=True)
class Removed:
    """Samples of one channel group in one flight that were taken as missing."""

    flight: str
    channels: tuple[str, ...]
    count: int
    worst: float
    first_time: float
    reason: str

    def line(self) -> str:
        """For a terminal."""
        names = ", ".join(self.channels)
        return (
            f"{self.flight}: {self.count} sample(s) of {names} taken as missing ({self.reason}; "
            f"the worst {self.worst:.4g}, the first at t = {self.first_time:.2f} s)"
        )


def without_impossible(raw: RawLog, vehicle: Vehicle) -> tuple[RawLog, tuple[Removed, ...]]:
    """`raw` with samples that cannot be as missing cells, and what was removed."""
    removed: list[Removed] = []
    new: dict[str, FloatArray] = {}
    top = vehicle.actuator.speed_max

    def drop(names: tuple[str, ...], bad: BoolArray, values: FloatArray, reason: str) -> None:
        if not bad.any():
            return
        at = np.flatnonzero(bad)
        for n in names:
            column = np.array(new.get(n, raw.channels[n]), dtype=np.float64)
            column[at] = np.nan
            new[n] = column
        worst = float(values[at][np.argmax(np.abs(values[at]))])
        removed.append(
            Removed(
                flight=raw.flight,
                channels=names,
                count=int(at.size),
                worst=worst,
                first_time=float(raw.t[at[0]]),
                reason=reason,
            )
        )

    for name, values in raw.channels.items():
        declared = channel(name)
        if declared.group in ("command", "setpoint"):
            continue
        with np.errstate(invalid="ignore"):
            outside = (values < declared.lower) | (values > declared.upper)
            drop((name,), outside, values, "outside its range")
            if declared.group == "rotor_speed" and top is not None:
                limit = OVERSPEED * top
                reason = f"beyond {OVERSPEED:g} times speed_max, {limit:.4g} rad/s"
                drop((name,), ~outside & (values > limit), values, reason)
    for names, explained in _explained(raw, vehicle).items():
        bad, size = _alone(np.column_stack([new.get(n, raw.channels[n]) for n in names]), explained)
        drop(names, bad, size, "one sample that no motion of the craft explains")
    if not removed:
        return raw, ()
    notes = (*raw.notes, *(r.line() for r in removed))
    return replace(raw, channels={**raw.channels, **new}, notes=notes), tuple(removed)


def _explained(raw: RawLog, vehicle: Vehicle) -> Mapping[tuple[str, ...], FloatArray]:
    """Channel group -> how far a sample can lie from the middle of its neighbours, (n,)."""
    out: dict[tuple[str, ...], FloatArray] = {}
    n = raw.n
    if n < 5:
        return out
    dt = float(np.median(np.diff(raw.t)))
    have = set(raw.channels)
    place, speed, turn = ("x", "y", "z"), ("vx", "vy", "vz"), ("p", "q", "r")
    attitude = ("qw", "qx", "qy", "qz")
    thrust = sum(max(c.value, 0.0) for c in vehicle.actuator.thrust) * len(vehicle.rotors)
    push = 2.0 * thrust / vehicle.mass.value + vehicle.gravity
    if have.issuperset(place):
        out[place] = np.full(n, 0.5 * push * dt**2)
    if have.issuperset(speed):
        out[speed] = np.full(n, push * dt)
    arm = max(float(np.hypot(r.position[0], r.position[1])) for r in vehicle.rotors)
    twist = arm * thrust / min(float(vehicle.inertia[i][i]) for i in range(3))
    if have.issuperset(turn):
        out[turn] = np.full(n, twist * dt)
        if have.issuperset(attitude):
            rate = np.linalg.norm(np.column_stack([raw.channels[c] for c in turn]), axis=1)
            out[attitude] = 0.5 * (0.5 * np.nan_to_num(rate) * dt) ** 2 + 0.25 * twist * dt**2
    return out


def _alone(block: FloatArray, explained: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Samples that stand apart from the middle of both neighbours, which agree with each other."""
    bad = np.zeros(len(block), dtype=bool)
    size = np.zeros(len(block))
    if len(block) < 5:
        return bad, size
    middle = 0.5 * (block[:-2] + block[2:])
    apart = np.linalg.norm(block[1:-1] - middle, axis=1)
    between = np.linalg.norm(block[2:] - block[:-2], axis=1)
    seen = np.isfinite(apart)
    if not seen.any():
        return bad, size
    usual = float(np.median(apart[seen]))
    limit = np.maximum(APART * usual, MARGIN * explained[1:-1])
    with np.errstate(invalid="ignore"):
        bad[1:-1] = (apart > limit) & (between < 0.5 * apart)
    size[1:-1] = np.nan_to_num(apart)
    return bad, size
