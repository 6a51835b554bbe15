"""Samples that cannot be become missing, counted and listed; nothing else is changed.

Three rules, one question: could the craft have done this? A value outside its channel's range; a
rotor faster than 1.3 times its top speed; a single sample that stands apart from both its
neighbours, which agree, by more than two things allow:

- the channel's own noise and bandwidth: the same distance at the samples around it and in the whole
  flight. What a sensor sees of a motion that it can follow stands as far apart next to it;
- what the rotors can add and take back in that time, from rest: full thrust is there after `RISE`,
  so that a rate reaches a quarter of its square where the gap is shorter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from greybox.data.airframe import Airframe, ThrustMap, TopSpeed, Weighed
from greybox.data.channel import Channel, channel
from greybox.data.raw import RawLog, Removed
from greybox.data.resampling import continuous_signs
from greybox.symbolic import BoolArray, FloatArray

IntArray = npt.NDArray[np.int64]
Possible = Callable[[FloatArray], FloatArray]
"""Gap to the neighbours (n,) [s] -> how far the craft can go and be back, (n,)."""
PLACE, SPEED, TURN = ("x", "y", "z"), ("vx", "vy", "vz"), ("p", "q", "r")
ATTITUDE = ("qw", "qx", "qy", "qz")
FORCE, BATTERY = ("ax", "ay", "az"), ("vbat",)

OUTSIDE = "outside its range"
AT_REST = 0.05
"""Share of the largest rotor speed of a log that a rotor at rest may read below zero: noise has
either sign, and so slow a rotor lifts nothing."""
OVERSPEED = 1.3
"""Times the top speed of the vehicle file: a rotor in a dive turns a little faster, never this
much."""
APART = 40.0
"""Times the usual distance from the neighbours, in the flight and around the sample, from which it
stands apart; sound samples of real flights come to 34, white noise to 7."""
ROUNDING = 0.25
"""Median distance of a rounded value from the line between its neighbours, in steps (0.29)."""
AROUND = (2, 3, 4, 5)
"""Samples before and after whose distances are those around: the fourth largest of eight, so that
another lone sample among them hides none. A sine of any frequency stays below three times that."""
PASSES = 10
"""Samples that are found next to each other are judged again, at most so often."""
RISE = 0.02
"""Time [s] from no thrust to all of it: no motor is quicker."""
MARGIN = 2.0
"""Times what the vehicle file says of thrust and inertia."""
SPIKES = 0.05
"""Share of a channel's samples up to which they are spikes; more is a fault of the channel (a unit,
a scale), which stays for the data-fault check to name."""
SAG = 0.2
"""Change of a battery's voltage under load, as a share of it."""


def lowest(declared: Channel, values: FloatArray) -> float:
    """The smallest of the `values` (n,) of a channel that can be, see `AT_REST`."""
    if declared.group != "rotor_speed":
        return declared.lower
    return -AT_REST * float(np.nanmax(np.abs(values), initial=0.0))


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
            outside = (values < lowest(declared, values)) | (values > declared.upper)
            drop((name,), outside, values, OUTSIDE)
            if declared.group == "rotor_speed" and top is not None:
                limit = OVERSPEED * top
                reason = f"beyond {OVERSPEED:g} times speed_max, {limit:.4g} rad/s"
                drop((name,), ~outside & (values > limit), values, reason)
    for names, limit_of in {
        **_of_motors(raw, top),
        **_possible(set(raw.channels), vehicle),
    }.items():
        block = np.column_stack([new.get(n, raw.channels[n]) for n in names])
        rows = _measured(raw.t, block)
        known = block[rows]
        if names == ATTITUDE:
            known, _ = continuous_signs(known)  # q and -q are the same attitude
        size = np.zeros(raw.n)
        size[rows] = _lone(raw.t[rows], known, limit_of)
        drop(names, size > 0.0, size, "one sample that no rotor can make (a touch can)")
    if not removed:
        return raw
    notes = (*raw.notes, *(r.line() for r in removed))
    every = (*raw.removed, *removed)
    return replace(raw, channels={**raw.channels, **new}, notes=notes, removed=every)


def top_speed(vehicle: Airframe) -> float | None:
    """Speed [rad/s] of a rotor at full command; None where the vehicle does not state it."""
    return vehicle.actuator.speed_max if isinstance(vehicle.actuator, TopSpeed) else None


def _measured(t: FloatArray, block: FloatArray) -> IntArray:
    """Rows with every value of a group, each later than those before: a slow channel has its
    own."""
    rows = np.flatnonzero(np.isfinite(block).all(axis=1) & np.isfinite(t))
    latest = np.maximum.accumulate(np.concatenate([[-np.inf], t[rows]]))[:-1]
    later: IntArray = rows[t[rows] > latest]
    return later


def _of_motors(raw: RawLog, top: float | None) -> Mapping[tuple[str, ...], Possible]:
    """How far each rotor, whose top speed is `top` [rad/s], and the battery can go and be back."""
    out: dict[tuple[str, ...], Possible] = {}
    for name in raw.channels:
        if channel(name).group == "rotor_speed" and top is not None:
            out[name,] = lambda gap: top * np.minimum(gap / RISE, 1.0)
    if "vbat" in raw.channels and np.isfinite(raw.channels["vbat"]).any():
        usual = float(np.nanmedian(raw.channels["vbat"]))
        out[BATTERY] = lambda gap: np.full_like(gap, SAG * usual)
    return out


def _possible(have: set[str], vehicle: Airframe) -> Mapping[tuple[str, ...], Possible]:
    """Channel group -> how far the rotors can take a sample from its neighbours and be back."""
    actuator = vehicle.actuator
    if not isinstance(actuator, ThrustMap) or not isinstance(vehicle, Weighed):
        return {}
    c0, c1, c2 = (c.value for c in actuator.thrust)
    thrust = (c0 + actuator.u_max * (c1 + actuator.u_max * c2)) * len(vehicle.rotors)
    push = MARGIN * thrust / vehicle.mass.value
    arm = max(float(np.hypot(r.position[0], r.position[1])) for r in vehicle.rotors)
    twist = MARGIN * arm * thrust / min(float(vehicle.inertia[i][i]) for i in range(3))

    def gained(gap: FloatArray) -> FloatArray:
        """Time [s] of all there is that a rate gains in a gap: there and back is a triangle."""
        return gap * np.minimum(gap / (4.0 * RISE), 1.0)

    every: dict[tuple[str, ...], Possible] = {
        FORCE: lambda gap: push * np.minimum(gap / RISE, 1.0),
        SPEED: lambda gap: push * gained(gap),
        PLACE: lambda gap: 0.5 * push * gained(gap) * gap,
        TURN: lambda gap: twist * gained(gap),
        ATTITUDE: lambda gap: 0.25 * twist * gained(gap) * gap,  # a quaternion has half the angle
    }
    return {names: limit for names, limit in every.items() if have.issuperset(names)}


def _off_line(t: FloatArray, block: FloatArray, k: int) -> FloatArray:
    """Distance of the samples (n, d) from the line between those k before and k after; 0 at the
    ends."""
    out = np.zeros(block.shape)
    share = ((t[k:-k] - t[: -2 * k]) / (t[2 * k :] - t[: -2 * k]))[:, None]
    out[k:-k] = np.abs(block[k:-k] - (1.0 - share) * block[: -2 * k] - share * block[2 * k :])
    return out


def _lone(t: FloatArray, block: FloatArray, possible: Possible) -> FloatArray:
    """How far (n,) each lone sample of (n, d) at increasing times (n,) is off, 0 for all others.

    The largest of close ones first: what is left is judged without it."""
    size, left = np.zeros(len(block)), np.arange(len(block))
    for _ in range(PASSES):
        found = _apart(t[left], block[left], possible)
        wide = np.pad(found, 2)
        lone = (found > 0.0) & (
            found >= np.max([wide[k : k + found.size] for k in (0, 1, 3, 4)], axis=0)
        )
        if not lone.any():
            break
        size[left[lone]] = found[lone]
        left = left[~lone]
    return size


def _rounding(block: FloatArray) -> FloatArray:
    """Usual distance (d,) from the line between their neighbours of values (n, d) that are right
    but for rounding: a sensor in coarse steps stands still between two, and then one step is no
    motion. The step is the smallest between values that come more than once, as a lone one may
    not, where most samples have such a value: faults repeat theirs on a sensor without steps."""
    steps = np.full(block.shape[1], np.inf)
    for j, values in enumerate(block.T):
        levels, count = np.unique(values, return_counts=True)
        again = count > 1
        if 2 * count[again].sum() > values.size:
            steps[j] = np.min(np.diff(levels[again]), initial=np.inf)
    return np.where(np.isfinite(steps), ROUNDING * steps, 0.0)


def _apart(t: FloatArray, block: FloatArray, possible: Possible) -> FloatArray:
    """How far a component of a sample stands apart from the line between both neighbours, which go
    on as those beyond them, (n,); 0 where that is possible."""
    n, out = len(block), np.zeros(len(block))
    if n < 2 * max(AROUND):
        return out
    apart = _off_line(t, block, 1)
    # Stamps jitter: two that lie closer than usual leave the craft no less time to move.
    gap = np.diff(t)
    limit = np.zeros(n)
    limit[1:-1] = possible(np.maximum(np.maximum(gap[:-1], gap[1:]), float(np.median(gap))))
    # What is costly is asked of the few samples that the craft and the usual noise do not explain.
    above = apart > limit[:, None]
    rounding = _rounding(block) if above.any() else np.zeros(block.shape[1])
    above &= apart > APART * np.maximum(
        np.median(apart[1:-1], axis=0) if above.any() else 0.0, rounding
    )
    rows = np.flatnonzero(above.any(axis=1))
    if not rows.size:
        return out
    wide = np.pad(apart, ((max(AROUND),) * 2, (0, 0)))
    places = [max(AROUND) + sign * k for k in AROUND for sign in (-1, 1)]
    around = np.partition([wide[rows + k] for k in places], -len(AROUND), axis=0)[-len(AROUND)]
    # From one neighbour to the other, less than what is usual on the calmer side: a step is no lone
    # sample.
    two = np.pad(np.abs(block[2:] - block[:-2]), ((3, 3), (0, 0)))
    step = two[rows + 2] - np.minimum(two[rows], two[rows + 4])
    far = apart[rows]
    # A sound sample between two spikes lies where those beyond them do.
    lone = (
        above[rows]
        & (far > APART * np.maximum(around, rounding))
        & (step < 0.5 * far)
        & (_off_line(t, block, 2)[rows] > 0.25 * far)
    )
    out[rows] = np.where(lone, far, 0.0).max(axis=1)
    return out
