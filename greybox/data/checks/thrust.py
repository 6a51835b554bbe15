"""Check of the commands' scale: the thrust that the file's map makes of them against the specific
force, which without an accelerometer is that of the motion.

The level, mean specific force over mean promised thrust, is that of mass, thrust number or range.
How steeply thrust grows with the commands, each over its mean, is the same for every mass and
thrust number, and tells where the commands begin: the map is tried with zeros of the commands from
u = 0 on, and with every `thrust_curve`, none with a number that is free. Lag, feedback and gusts
make the slope smaller, never larger: that commands are shares of thrust, not of rotor speed, is
said where the level agrees.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from greybox.data.airframe import Airframe, ThrustMap, Weighed, WithEffects
from greybox.data.checks.acceleration import HALF_WINDOW as DIFFERENCED
from greybox.data.checks.block_sums import BLOCKS, BlockSums
from greybox.data.checks.finding import Check, Finding, Severity, Unjudged
from greybox.data.checks.relations import CLEAR, LEAST, LEFT, SEEN, jackknife
from greybox.data.checks.signals import (
    attitude_joined_up,
    best_lag,
    derivative,
    joined_up,
    pace,
    peak,
    shifted,
    smoothed,
    turned,
)
from greybox.data.checks.together import alone_and_together
from greybox.data.checks.view import FloatArray, View
from greybox.data.column_guess import CUSTOMARY

HALF_WINDOW = 0.15
"""Thrust and specific force are compared as means over twice this time [s]: the lag of the motors
takes little of a slope then. ..."""
SLOW = 1.0
"""... What means over twice this time show is left out: a battery that empties is no slope."""
LARGEST_LAG = 0.15
"""Largest lag from command to thrust that is looked for [s]."""
ZEROS = np.arange(0.0, 0.96, 0.05)
"""Commands at which the rotors may stand, as shares of the mean command."""
CURVES = np.arange(0.2, 1.01, 0.2)
"""Curvatures f of a `thrust_curve` that may be there; 1 is the strongest that rises from zero."""
STRONG = 0.6
"""From this curve on a warning is worth it."""
UNIT = 10.0
"""By such a factor no thrust and no mass is wrong."""
LEVEL = 0.15
"""Standard deviation of the log of thrust over what any file says: air, battery, ground, a rotor
that is weaker than the others."""
SHARES = np.linspace(0.0, 1.0, 1001)
"""Commands at which the file's map is looked up."""
FEWEST = 200
"""Fewer samples judge nothing."""
NEVER = 50.0
"""Log of what a map leaves that makes no thrust of the commands."""
NEAR = 0.1
"""Ends of a range within this share of it from customary or round ones are said as those."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Sums(BlockSums):
    """Sums over blocks of time (B,) of mass times specific force `y` [N], and for the map as given
    and all others, (K, B), of promised thrust `x`; products and squares are of what is quick. `u`
    (B,) are commands, `count` (B,) samples."""

    count: FloatArray
    u: FloatArray
    y: FloatArray
    yy: FloatArray
    x: FloatArray
    xx: FloatArray
    xy: FloatArray
    block_axis: ClassVar[int] = -1

    @property
    def level(self) -> FloatArray:
        """Mean specific force over promised thrust, (K, B)."""
        return self.y / self.x

    @property
    def steepness(self) -> FloatArray:
        """Slope of specific force over promised thrust, each over its mean, (K, B)."""
        return self.xy / np.maximum(self.xx, 1e-300) / self.level

    @property
    def zeros(self) -> FloatArray:
        """Commands (K,) at which the rotors may stand."""
        return ZEROS * float(self.u.sum() / self.count.sum())

    @property
    def left(self) -> FloatArray:
        """Log of the share of the quick specific force that each map leaves, at its level,
        (K, B)."""
        some = self.x > 1e-6 * self.y
        level = np.where(some, self.y / np.where(some, self.x, 1.0), 0.0)
        rest = self.yy - 2.0 * level * self.xy + level**2 * self.xx
        share = np.maximum(rest, 0.0) / np.maximum(self.yy, 1e-300)
        return np.where(some, np.log(share + LEAST), NEVER)


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What level and slope say; `claim` is the same where they say the same."""

    claim: str
    severity: Severity
    message: str
    evidence: Mapping[str, float]
    fix: str


def run(views: Sequence[View]) -> Iterator[Finding | Unjudged]:
    """Findings on the scale of the commands, in each flight and over those of the craft."""
    found: dict[str, Sums] = {}
    for view in views:
        sums = _sums(view) if view.commanded else None
        if isinstance(sums, Sums):
            found[view.name] = sums
        elif sums is not None:
            open_ = view.flight is not None and view.drives
            yield Unjudged(check=CHECK.name, flight=view.name, reason=sums, open=open_)
    if not found:
        return
    vehicle, views_of = views[0].vehicle, {v.name: v for v in views}
    told = alone_and_together(
        found,
        lambda some: _verdict(vehicle, Sums.joined(some)),
        claim=lambda said: said.claim,
        sure=lambda said: said.severity == "blocking",
    )
    for one in told:
        for flight in one.flights:
            felt = _felt_by(views_of[flight])
            unit = "" if felt == "specific_force" else f"; check the unit in [columns.{felt}], too"
            yield Finding(
                check=CHECK.name,
                severity=one.said.severity,
                flight=flight,
                where=f"u1.. against {_WHERE[felt]}",
                message=one.said.message + one.against,
                evidence={**one.said.evidence, "flights": len(one.flights)},
                fix=one.said.fix + unit,
            )


@dataclass(frozen=True, kw_only=True)
class _Map:
    """Thrust c0 + c1 nu + c2 nu^2 [N] of a rotor with its standard deviations, the mass [kg] and
    the curve of the commands, as the vehicle file states them."""

    thrust: tuple[float, float, float]
    sigmas: tuple[float, float, float]
    mass: float
    mass_sigma: float
    curve: float

    def promised(self, u: FloatArray) -> FloatArray:
        """Thrust [N] at commands, each."""
        c0, c1, c2 = self.thrust
        nu = (1.0 - self.curve) * u + self.curve * u**2
        return c0 + nu * (c1 + c2 * nu)

    @property
    def full(self) -> float:
        """Thrust [N] at u = 1: where commands are shares of thrust, that of which they are."""
        return float(self.promised(np.array(1.0)))

    def spread(self, u: float) -> float:
        """Standard deviation of the log of thrust over weight at a mean command."""
        of = [s * u**i for i, s in enumerate(self.sigmas)]
        thrust = max(float(self.promised(np.array(u))), 1e-300)
        return math.hypot(LEVEL, self.mass_sigma / self.mass, *(s / thrust for s in of))


def _map(vehicle: Airframe) -> _Map | None:
    """None where the file is silent."""
    actuator = vehicle.actuator
    if not isinstance(vehicle, Weighed) or not isinstance(actuator, ThrustMap):
        return None
    effects = vehicle.effects if isinstance(vehicle, WithEffects) else {}
    stated = effects.get("thrust_curve", {})
    c0, c1, c2 = actuator.thrust
    return _Map(
        thrust=(float(c0.value), float(c1.value), float(c2.value)),
        sigmas=(float(c0.sigma), float(c1.sigma), float(c2.sigma)),
        mass=float(vehicle.mass.value),
        mass_sigma=float(vehicle.mass.sigma),
        curve=float(stated["f"].value) if "f" in stated else 0.0,
    )


def _begun(u: FloatArray, at: float) -> FloatArray:
    """Commands that begin at another one and end at 1."""
    return np.maximum(u - at, 0.0) / (1.0 - at)


def _curved(u: FloatArray, f: float) -> FloatArray:
    return (1.0 - f) * u + f * u**2


_WHERE = {
    "specific_force": "az",
    "velocity": "vx, vy, vz with qw..qz",
    "position": "x, y, z with qw..qz",
}


def _felt_by(view: View) -> str:
    """The group that tells the specific force; empty where none does."""
    if view.has("specific_force"):
        return "specific_force"
    moved = (g for g in ("velocity", "position") if view.has("attitude", g))
    return next(moved, "")


def _felt(view: View, most: int) -> tuple[FloatArray, list[int]]:
    """Specific force along the body's z (N, 1) [m/s^2], over gaps of at most `most` samples:
    measured, or how the craft's motion changes, less gravity; and the half windows [rows] over
    which differences have smoothed it."""
    group = _felt_by(view)
    track = joined_up(view.group(group), most)
    if group == "specific_force":
        return track[:, 2:], []
    steps, times = pace(view.group(group)), 1
    if group == "position":
        steps, times = max(steps, round(DIFFERENCED / view.dt)), 2
    for _ in range(times):
        track = derivative(track, view.dt, steps)
    force = track + np.array([0.0, 0.0, view.vehicle.gravity])
    attitude = attitude_joined_up(view.group("attitude"), most)
    return turned("rotate_inverse", attitude, force)[:, 2:], [steps] * times


def _sums(view: View) -> Sums | str:
    """The sums of a flight, or why there are none."""
    known = _map(view.vehicle)
    if view.flight is None or not view.drives:
        return "no airborne stretch" if view.flight is None else "not all commands"
    if not _felt_by(view):
        return "no accelerometer, and no attitude with velocity or position"
    if known is None:
        return "the vehicle file states no mass and thrust"
    dt = view.dt
    half, slow = max(1, round(HALF_WINDOW / dt)), max(2, round(SLOW / dt))
    force, windows = _felt(view, half)
    u = view.drive

    def parts(values: FloatArray) -> FloatArray:
        """Means, and what is quick of them, (N, 2)."""
        mean = smoothed(values, half)
        return np.hstack([mean, mean - smoothed(values, slow)])

    def made(promised: FloatArray) -> FloatArray:
        """The same of all rotors' thrust (N, n), as smooth as the force."""
        return parts(functools.reduce(smoothed, windows, promised.sum(axis=1, keepdims=True)))

    y = parts(force * known.mass)
    x = made(known.promised(u))
    lag = round(best_lag(y[:, 1:], x[:, 1:], np.arange(round(LARGEST_LAG / dt) + 1))[0])
    rows = np.flatnonzero(np.isfinite(y).all(axis=1) & np.isfinite(shifted(x, lag)).all(axis=1))
    if rows.size < FEWEST:
        return f"fewer than {FEWEST} complete samples"
    blocks = np.array_split(rows, BLOCKS)
    begun = (_begun(u, float(v)) for v in ZEROS * float(np.nanmean(u[rows])))
    curved = (_curved(u, float(f)) for f in CURVES)
    tried = (known.promised(changed) for changed in itertools.chain(begun, curved))
    sums = np.zeros((3, ZEROS.size + CURVES.size + 1, BLOCKS))
    for k, promised in enumerate(itertools.chain(tried, [known.full * u])):
        x = shifted(made(promised), lag)
        for j, b in enumerate(blocks):
            sums[:, k, j] = x[b, 0].sum(), (x[b, 1] ** 2).sum(), (x[b, 1] * y[b, 1]).sum()
    if not y[rows, 0].mean() > LEAST * known.mass * view.vehicle.gravity:
        return "no specific force along +z"
    level = shifted(u.mean(axis=1, keepdims=True), lag)[:, 0]
    return Sums(
        count=np.array([float(b.size) for b in blocks]),
        u=np.array([np.nansum(level[b]) for b in blocks]),
        y=np.array([y[b, 0].sum() for b in blocks]),
        yy=np.array([(y[b, 1] ** 2).sum() for b in blocks]),
        x=sums[0],
        xx=sums[1],
        xy=sums[2],
    )


def _verdict(vehicle: Airframe, sums: Sums) -> Verdict | None:
    """What is wrong with the scale of the commands; None where nothing clearly is."""
    known = _map(vehicle)
    assert known is not None
    level = float(sums.total.level[0, 0])
    u = float(sums.u.sum() / sums.count.sum())
    wrong = not level > 0.0 or abs(math.log(level)) > CLEAR * known.spread(u)
    impossible = wrong and not 1.0 / UNIT < level < UNIT
    said = "the file makes no thrust of these commands"
    if 0.0 < level < math.inf:
        said = f"the thrust that carries the craft is {level:.2g} times what the file makes of "
        said += "the commands"
    begun = _begins(vehicle, known, sums) or _of_thrust(known, sums)
    if begun is None and not wrong:
        return None
    fix = "weigh the craft, compare [actuator] thrust with its data sheet, and the range of the "
    fix += "commands with the log"
    if begun is None:
        return Verdict(
            claim="level",
            severity="blocking" if impossible else "warning",
            message=f"{said}: thrust, or the mass, of which it states {_percent(known)}",
            evidence={"thrust_over_promised": level},
            fix=fix,
        )
    sure = begun.severity == "blocking" or impossible
    return replace(
        begun,
        severity="blocking" if sure else "warning",
        message=f"{said}; it {begun.message}" if wrong else f"thrust {begun.message}",
        evidence={"thrust_over_promised": level, **begun.evidence},
    )


def _percent(known: _Map) -> str:
    """The error of the mass."""
    share = 100.0 * known.mass_sigma / known.mass
    return f"an error of {share:.2g} %" if share > 0 else "no error"


def _begins(vehicle: Airframe, known: _Map, sums: Sums) -> Verdict | None:
    """Where the commands begin, if not at u = 0; None where that does not tell far more."""
    total, left = sums.total, sums.left_out.left
    if not float(total.xx[0, 0]) > (LEAST * float(total.x[0, 0])) ** 2 / float(total.count[0]):
        return None  # the commands stand still
    rest, n = total.left[:-1, 0], ZEROS.size
    zero, curve = int(np.argmin(rest[:n])), n + int(np.argmin(rest[n:]))

    def better(k: int) -> float:
        """By how much commands that begin there leave less, at most."""
        return float(rest[zero] - rest[k]) + CLEAR * jackknife(left[zero] - left[k])

    strength = float(CURVES[curve - n])
    if better(0) > math.log(LEFT) or rest[zero] > math.log(1.0 - SEEN) or strength < STRONG:
        return None
    sure = curve == rest.size - 1 and better(curve) < 0.0
    steep = float(total.steepness[0, 0])
    share, _ = peak(-rest[:n], np.arange(n))
    low = float(np.interp(share, np.arange(n), total.zeros))
    high = _full(known, float(sums.u.sum() / sums.count.sum()), low, float(total.level[0, 0]))
    grows = f"grows {steep:.2g} times as steeply with the commands as the file's map says"
    grows += ", which no craft does" if sure else " (or by a curve that the file does not state)"
    return Verdict(
        claim="range",
        severity="blocking" if sure else "warning",
        message=f"{grows}: {_said(vehicle, low)}",
        evidence={"steepness": steep, "begins_at": low, "full_at": high},
        fix=_mend(vehicle, low, high),
    )


def _of_thrust(known: _Map, sums: Sums) -> Verdict | None:
    """Commands in proportion to thrust where the map takes them for rotor speeds; None where that
    does not tell more, and far more if the map as it is carries the craft, too, or where it does
    not carry the craft any better."""
    total, left = sums.total, sums.left_out.left
    rest, level = total.left[:, 0], total.level[:, 0]
    gained = float(rest[0] - rest[-1]) - CLEAR * jackknife(left[0] - left[-1])
    if rest[-1] > math.log(1.0 - SEEN) or not min(level[0], level[-1]) > 0.0:
        return None
    off, off_shares = abs(math.log(float(level[0]))), abs(math.log(float(level[-1])))
    u = float(sums.u.sum() / sums.count.sum())
    carries = off <= CLEAR * known.spread(u)
    if gained <= (-math.log(LEFT) if carries else 0.0) or off_shares > min(
        off, CLEAR * known.spread(1.0)
    ):
        return None
    steep, sigma = float(total.steepness[0, 0]), math.hypot(*known.sigmas)
    sure = f", thrust_sigma = [0, {sigma:.2g}, 0]" * bool(sigma)
    return Verdict(
        claim="shares",
        severity="warning",
        message=f"grows {steep:.2g} times as steeply with the commands as the file's map says: they "
        "look like shares of thrust, not of rotor speed",
        evidence={"steepness": steep},
        fix="log the square roots, which are rotor speeds; or [actuator] thrust = "
        f"[0, {known.full:.4g}, 0]{sure}, torque likewise, and no speed_max",
    )


def _full(known: _Map, u: float, low: float, level: float) -> float:
    """The command at which the rotors turn fully, where they stand at `low` and u carries the
    craft; 1 where the file's thrust may as well make the difference."""
    carries = level * float(known.promised(np.array(u)))
    if low < 1.0:
        at = (u - low) / (1.0 - low)
        there = max(float(known.promised(np.array(at))), 1e-300)
        if abs(math.log(max(carries, 1e-300) / there)) <= CLEAR * known.spread(at):
            return 1.0
    made = np.maximum.accumulate(known.promised(SHARES))
    share = float(np.interp(carries, made, SHARES))
    return low + (u - low) / share if share > 0.0 and u > low else 1.0


def _limits(vehicle: Airframe) -> tuple[float, float] | None:
    """The range of the commands in the log, as the file gives it."""
    source = vehicle.columns.sources.get("command")
    return None if source is None else source.limits


def _said(vehicle: Airframe, low: float) -> str:
    text = f"the commands look as if u = 0 was at {low:.2g}"
    if (given := _limits(vehicle)) is None:
        return text
    return f"{text} ({given[0] + low * (given[1] - given[0]):.4g} in the log)"


def _mend(vehicle: Airframe, low: float, high: float) -> str:
    """The range that the commands have: a customary one where it is near."""
    given = _limits(vehicle)
    first, last = given or (0.0, 1.0)
    ends = tuple(first + u * (last - first) for u in (low, high))
    near = NEAR * (ends[1] - ends[0])
    usual = (c for c in CUSTOMARY if max(abs(c[0] - ends[0]), abs(c[1] - ends[1])) <= near)
    least, most = next(usual, (_round(ends[0], near), _round(ends[1], near)))
    of = "" if given else " in units of the u that was logged"
    return f"[columns.command] limits = [{least:g}, {most:g}]{of}?"


def _round(value: float, within: float) -> float:
    """The number of fewest figures within this distance."""
    tried = (float(f"{value:.{figures}g}") for figures in range(1, 6))
    return next((v for v in tried if abs(v - value) <= within), value)


CHECK = Check(
    name="thrust",
    question="Do the commands, as the vehicle file scales them, carry the craft?",
    run=run,
)
