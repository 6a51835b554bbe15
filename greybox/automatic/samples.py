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

from greybox.data import Dataset, Flight, Segment
from greybox.data.channel import channel, is_canonical
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


def without_impossible(data: Dataset, vehicle: Vehicle) -> tuple[Dataset, tuple[Removed, ...]]:
    """`data` with samples that cannot be as missing cells, and what was removed."""
    removed: list[Removed] = []
    flights = []
    for flight in data:
        segments = tuple(_cleaned(s, flight, vehicle, removed) for s in flight.segments)
        changed = any(a is not b for a, b in zip(segments, flight.segments, strict=True))
        notes = tuple(r.line() for r in removed if r.flight == flight.name)
        flights.append(replace(flight, segments=segments, notes=flight.notes + notes) if changed else flight)
    return Dataset(flights=tuple(flights)), tuple(removed)


def _cleaned(segment: Segment, flight: Flight, vehicle: Vehicle, removed: list[Removed]) -> Segment:
    new: dict[str, FloatArray] = {}
    top = vehicle.actuator.speed_max

    def drop(names: tuple[str, ...], bad: BoolArray, values: FloatArray, reason: str) -> None:
        if not bad.any():
            return
        at = np.flatnonzero(bad)
        for n in names:
            column = new.get(n, np.array(segment.channels[n]))
            column[at] = np.nan
            new[n] = column
        removed.append(
            Removed(
                flight=flight.name, channels=names, count=int(at.size),
                worst=float(values[at][np.argmax(np.abs(values[at]))]), first_time=float(segment.t[at[0]]),
                reason=reason,
            )
        )

    for name, values in segment.channels.items():
        if not is_canonical(name):
            continue
        declared = channel(name)
        if declared.group in ("command", "setpoint"):
            continue
        with np.errstate(invalid="ignore"):
            drop((name,), (values < declared.lower) | (values > declared.upper), values, "outside its range")
            if declared.group == "rotor_speed" and top is not None:
                limit = OVERSPEED * top
                drop((name,), values > limit, values, f"beyond {OVERSPEED:g} times speed_max, {limit:.4g} rad/s")
    for names, explained in _explained(segment, vehicle).items():
        block = np.column_stack([new.get(n, segment.channels[n]) for n in names])
        bad, size = _alone(block, explained)
        drop(names, bad, size, "one sample that no motion of the craft explains")
    return segment.replace({**segment.channels, **new}) if new else segment


def _explained(segment: Segment, vehicle: Vehicle) -> Mapping[tuple[str, ...], FloatArray]:
    """Channel group -> how far a sample can lie from the middle of its neighbours, (n,)."""
    out: dict[tuple[str, ...], FloatArray] = {}
    dt, n = segment.dt, segment.n
    have = set(segment.names)
    place, speed, turn = ("x", "y", "z"), ("vx", "vy", "vz"), ("p", "q", "r")
    attitude = ("qw", "qx", "qy", "qz")
    thrust = sum(max(c.value, 0.0) for c in vehicle.actuator.thrust) * len(vehicle.rotors)
    push = 2.0 * thrust / vehicle.mass.value + vehicle.gravity
    if have.issuperset(place):
        out[place] = np.full(n, 0.5 * push * dt**2)
    if have.issuperset(speed):
        out[speed] = np.full(n, push * dt)
    arm = max(float(np.hypot(r.position[0], r.position[1])) for r in vehicle.rotors)
    smallest = min(float(vehicle.inertia[i][i]) for i in range(3))
    twist = arm * thrust / smallest
    if have.issuperset(turn):
        out[turn] = np.full(n, twist * dt)
        if have.issuperset(attitude):
            rate = np.nan_to_num(np.linalg.norm(np.column_stack([segment.channels[c] for c in turn]), axis=1))
            out[attitude] = 0.5 * (0.5 * rate * dt) ** 2 + 0.25 * twist * dt**2
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
