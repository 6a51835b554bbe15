"""Samples that cannot be become missing, counted and listed; nothing else is changed.

Three rules, one question: could the craft have done this? A value outside its channel's range; a
rotor faster than 1.3 times its top speed; a single sample that stands apart from both its neighbours
by more than the craft can move in that time (pose: by what velocity or gyro say; gyro: by what the
rotors' torque can turn; specific force: by twice what they can push; rotor speed: by a motor that
reaches its top speed in 20 ms; battery: by a fifth of its voltage).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from greybox.data.airframe import Airframe, ThrustMap, TopSpeed, Weighed
from greybox.data.channel import channel
from greybox.data.raw import RawLog, Removed
from greybox.data.resampling import continuous_signs
from greybox.symbolic import BoolArray, FloatArray

IntArray = npt.NDArray[np.int64]
Explained = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
"""(times, gaps to the sample before, to the one after), (n,) [s] each -> how far motion goes, (n,)."""
PLACE, SPEED, TURN = ("x", "y", "z"), ("vx", "vy", "vz"), ("p", "q", "r")
ATTITUDE = ("qw", "qx", "qy", "qz")
FORCE, BATTERY = ("ax", "ay", "az"), ("vbat",)

OUTSIDE = "outside its range"
OVERSPEED = 1.3
"""Times the top speed of the vehicle file: a rotor in a dive turns a little faster, never this much."""
APART = 20.0
"""Times the usual size of such steps (median absolute) from which a single sample stands apart."""
MARGIN = 5.0
"""Times the change that motion explains from which a single sample stands apart."""
SPIN_UP = 0.1
"""Time [s] in which a motor reaches its top speed: a fifth of it with the margin."""
SPIKES = 0.05
"""Share of a channel's samples up to which they are spikes; more is a fault of the channel (a unit, a
scale), which stays for the data-fault check to name."""
SAG = 0.04
"""Change of a battery's voltage, as a share of it: a fifth with the margin."""


def without_impossible(raw: RawLog, vehicle: Airframe) -> RawLog:
    """`raw` with samples that cannot be as missing cells; its `removed` says which, and why.

    What the vehicle does not state (top speed, thrust, mass and inertia) rules nothing out.
    """
    removed: list[Removed] = []
    new: dict[str, FloatArray] = {}
    top = top_speed(vehicle)

    def drop(names: tuple[str, ...], bad: BoolArray, values: FloatArray, reason: str) -> None:
        if not bad.any() or bad.sum() > max(1.0, SPIKES * bad.size):
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
            drop((name,), outside, values, OUTSIDE)
            if declared.group == "rotor_speed" and top is not None:
                limit = OVERSPEED * top
                reason = f"beyond {OVERSPEED:g} times speed_max, {limit:.4g} rad/s"
                drop((name,), ~outside & (values > limit), values, reason)
    for names, limit_of in {**_of_motors(raw, top), **_explained(raw, vehicle)}.items():
        block = np.column_stack([new.get(n, raw.channels[n]) for n in names])
        rows = _measured(raw.t, block)
        known = block[rows]
        if names == ATTITUDE:
            known, _ = continuous_signs(known)  # q and -q are the same attitude
        bad, size = np.zeros(raw.n, dtype=bool), np.zeros(raw.n)
        bad[rows], size[rows] = _alone(raw.t[rows], known, limit_of)
        drop(names, bad, size, "one sample that no motion of the craft explains")
    if not removed:
        return raw
    notes = (*raw.notes, *(r.line() for r in removed))
    every = (*raw.removed, *removed)
    return replace(raw, channels={**raw.channels, **new}, notes=notes, removed=every)


def top_speed(vehicle: Airframe) -> float | None:
    """Speed [rad/s] of a rotor at full command; None where the vehicle does not state it."""
    return vehicle.actuator.speed_max if isinstance(vehicle.actuator, TopSpeed) else None


def _measured(t: FloatArray, block: FloatArray) -> IntArray:
    """Rows with every value of a group, each later than those before: a slow channel has its own."""
    rows = np.flatnonzero(np.isfinite(block).all(axis=1) & np.isfinite(t))
    latest = np.maximum.accumulate(np.concatenate([[-np.inf], t[rows]]))[:-1]
    later: IntArray = rows[t[rows] > latest]
    return later


def _of_motors(raw: RawLog, top: float | None) -> Mapping[tuple[str, ...], Explained]:
    """The same for each rotor, whose top speed is `top` [rad/s], and for the battery."""
    out: dict[tuple[str, ...], Explained] = {}
    for name in raw.channels:
        if channel(name).group == "rotor_speed" and top is not None:
            out[name,] = lambda t, a, b: top / SPIN_UP * 2.0 * a * b / (a + b)
    if "vbat" in raw.channels and np.isfinite(raw.channels["vbat"]).any():
        usual = float(np.nanmedian(raw.channels["vbat"]))
        out[BATTERY] = lambda t, a, b: np.full_like(a, SAG * usual)
    return out


def _explained(raw: RawLog, vehicle: Airframe) -> Mapping[tuple[str, ...], Explained]:
    """Channel group -> how far the craft can take a sample from the line between its neighbours."""
    out: dict[tuple[str, ...], Explained] = {}
    have = set(raw.channels)
    actuator = vehicle.actuator
    if not isinstance(actuator, ThrustMap) or not isinstance(vehicle, Weighed):
        return out
    c0, c1, c2 = (c.value for c in actuator.thrust)
    thrust = (c0 + actuator.u_max * (c1 + actuator.u_max * c2)) * len(vehicle.rotors)
    push = 2.0 * thrust / vehicle.mass.value + vehicle.gravity
    arm = max(float(np.hypot(r.position[0], r.position[1])) for r in vehicle.rotors)
    twist = arm * thrust / min(float(vehicle.inertia[i][i]) for i in range(3))
    if have.issuperset(FORCE):
        out[FORCE] = lambda t, a, b: np.full_like(a, 2.0 * thrust / vehicle.mass.value / MARGIN)
    # With the gaps a and b to the neighbours: a b / 2 times the second derivative, or
    # 2 a b / (a + b) times the first where that may jump.
    if have.issuperset(PLACE):
        out[PLACE] = lambda t, a, b: 0.5 * push * a * b
    if have.issuperset(SPEED):
        out[SPEED] = lambda t, a, b: push * 2.0 * a * b / (a + b)
    if have.issuperset(TURN):
        out[TURN] = lambda t, a, b: twist * 2.0 * a * b / (a + b)
        turning = np.column_stack([raw.channels[c] for c in TURN])
        rows = _measured(raw.t, turning)
        if have.issuperset(ATTITUDE) and rows.size:
            clock, rate = raw.t[rows], np.linalg.norm(turning[rows], axis=1)

            def of_attitude(t: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
                # The gyro has rows of its own: its value at the time of the attitude.
                return 0.125 * np.interp(t, clock, rate) ** 2 * a * b + 0.25 * twist * a * b

            out[ATTITUDE] = of_attitude
    return out


def _alone(t: FloatArray, block: FloatArray, explained: Explained) -> tuple[BoolArray, FloatArray]:
    """Samples (n, d) at increasing times (n,) that stand apart from the line between both
    neighbours, which agree with each other."""
    bad = np.zeros(len(block), dtype=bool)
    size = np.zeros(len(block))
    if len(block) < 5:
        return bad, size
    gap = np.diff(t)
    before, after = gap[:-1], gap[1:]
    share = (before / (before + after))[:, None]
    apart = np.linalg.norm(block[1:-1] - (1.0 - share) * block[:-2] - share * block[2:], axis=1)
    between = np.linalg.norm(block[2:] - block[:-2], axis=1)
    # Stamps jitter: two that lie closer than usual leave the craft no less time to move.
    usual = float(np.median(gap))
    possible = explained(t[1:-1], np.maximum(before, usual), np.maximum(after, usual))
    limit = np.maximum(APART * float(np.median(apart)), MARGIN * possible)
    bad[1:-1] = (apart > limit) & (between < 0.5 * apart)
    size[1:-1] = apart
    return bad, size
