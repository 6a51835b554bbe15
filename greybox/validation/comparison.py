"""Comparison: the errors of a model against those of holding the last value, by the rule of what
usable means.

A model that does not beat the last measured value knows nothing. Every group, axis and flight is
compared at every horizon by the same `Standard`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from greybox.symbolic import BoolArray, FloatArray
from greybox.validation.groups import Group
from greybox.validation.horizon_table import GroupErrors


@dataclass(frozen=True, kw_only=True)
class Standard:
    """What "usable" means: every number that decides, with its reason.

    A group is worse than the last value at a horizon where the mean error of the model is above
    that of the last value by more than `equal` of it plus the smaller of one standard error and
    `noise` of it.
    """

    minimum: float = 0.1
    """[s] No group may be worse up to here. Rotors answer within 0.1 s (lag 20 to 70 ms and a
    delay): a model that loses to the last value before they have is worth nothing to a
    controller."""
    look_ahead: float = 0.5
    """[s] Where skill is stated, and up to where no group may be wrecked: what position controllers
    and the model predictive controller of this package plan ahead."""
    look_ahead_imu: float = 0.3
    """[s] The same where only the IMU was logged: there is no attitude or place to plan for, only
    rates to hold."""
    longest: float = 1.0
    """[s] Nothing is judged beyond: open loop, attitude errors of a second are those of the
    disturbances."""
    wrecked: float = 2.0
    """Times the error of the last value, from which a model misleads whoever plans to
    `look_ahead`."""
    better: float = 0.9
    """Error over error of the last value, geometric mean over the groups of turning (rotation,
    rate) and over those of moving (the others), below which both must come somewhere from `minimum`
    to `look_ahead`. A model that equals the last value everywhere is not useful. (On-board IMU
    logs: 0.94 where motors never answered the commands in the model, 0.5 with their lag.)"""
    equal: float = 0.02
    """Share of the last value's error that nobody would notice."""
    noise: float = 0.1
    """At most this share of the last value's error is forgiven as chance: few blocks must not
    excuse a bad model."""
    short: float = 0.1
    """[s] Up to here the error is that of the state estimate, and the last value is told the
    reference itself, smoothed with later samples included. There dead reckoning, which starts from
    the same estimate, may take its place as rival, up to `unfair` times the last value's error.
    (Real flights: rates one sample ahead equal the last value, .083 to .090 against .090 rad/s.)
    A noise that repeats itself, as vibration does, is foretold by holding a value one period long:
    the last value's error is no less than it was at any shorter time.
    The last specific force is itself the measured IMU, with every constant offset that no filter
    corrects: its error at the end of this time is the rival all through it."""
    unfair: float = 2.0
    """See `short`."""
    reach: float = 0.3
    """Share of the origins that must reach a horizon: a few at the end of a short flight are no
    sample of it."""
    sensor_sample: float = 0.02
    """[s] At sample times up to this the change of a value over one sample is mostly noise."""
    noise_motion: float = 2.0
    """A group moves less than this many times its change over one sample within `look_ahead`:
    motion within noise."""


def standard_of(sample_time: float) -> Standard:
    """The standard of a model that is not a vehicle's, whose own time scale nobody knows: it counts
    samples, as many as the seconds of a vehicle are at 100 Hz (10, 50 and 100). None of its outputs
    is called calm."""
    plain = Standard()
    samples = {n: round(vars(plain)[n] / SPACING) for n in ("minimum", "look_ahead", "longest")}
    return Standard(
        **{n: k * sample_time for n, k in samples.items()}, short=0.0, sensor_sample=0.0
    )


SPACING = 0.01
"""[s] Sample time at which the standard of a vehicle is told in samples."""

CALM = {"position": 0.1, "velocity": 0.15, "rotation": 0.05, "rate": 0.2, "specific_force": 0.3}
"""Mean change of a group [its unit] within half a second below which a flight is calm: a third of
what an indoor flight of medium pace shows (NanoBench test flights: 0.44 m, 0.65 m/s, 0.15 rad, 0.77
rad/s). Below, holding the last value is nearly right whatever flies. A model whose own error is
above twice this is bad in any flight, and is not excused."""

KINDS = (("rotation", "rate"), ("position", "velocity", "specific_force"))
"""Turning and moving: a model that knows one of them says nothing of the other."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Grid:
    """The horizons (H,) that a group is judged at [s], the place of that where skill is stated, and
    the rule."""

    seconds: FloatArray
    at: int
    rule: Standard

    @property
    def ahead(self) -> float:
        """The horizon where skill is stated [s]."""
        return float(self.seconds[self.at])

    @property
    def first(self) -> int:
        """The place of the horizon up to which no group may be worse."""
        return nearest(self.seconds, self.rule.minimum)


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """One group on the grid of horizons: errors (H,), and where the last value is better."""

    name: str
    kind: Group
    model: FloatArray
    last: FloatArray
    floor: FloatArray | None
    worse: BoolArray
    calm: bool
    excused: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Weighed:
    """The groups by what speaks for and against them, and how many horizons are useful."""

    compared: Sequence[Comparison]
    counted: Sequence[Comparison]
    """All but the excused ones."""
    excused: Sequence[Comparison]
    """Worse than the last value, in flights that are too calm to tell."""
    idle: Sequence[Comparison]
    """Nowhere better than the last value."""
    wrecked: Sequence[Comparison]
    """So bad that whoever plans ahead is misled."""
    ends: int
    """Horizons before the first one at which a counted group is worse."""

    def lost(self, grid: Grid) -> bool:
        """Whether a group is worse too early, or wrecked."""
        return self.ends <= grid.first or bool(self.wrecked)

    def useful(self, grid: Grid) -> float:
        """How far ahead the model is useful [s]."""
        return float(grid.seconds[self.ends - 1]) if self.ends else 0.0


Alone = tuple[str, Weighed, Grid]
"""Name of a flight, and its errors alone."""


def compare(
    kind: Group,
    model: GroupErrors,
    last: GroupErrors,
    floor: GroupErrors | None,
    grid: Grid,
    *,
    name: str = "",
) -> Comparison:
    """One group, or the axis of it that is called `name`."""
    seconds, at, rule = grid.seconds, grid.at, grid.rule
    steps = len(seconds)
    own, held = model.mae[:steps], last.mae[:steps]
    best = None if floor is None or len(floor.mae) < steps else floor.mae[:steps]
    short = seconds <= rule.short + 1e-9
    rival = np.where(short, np.fmax.accumulate(held), held)
    if kind.name == "specific_force" and not kind.own:
        rival[short] = np.maximum(rival, held[nearest(seconds, rule.short)])[short]
    elif best is not None:
        short &= np.isfinite(best)
        rival[short] = np.maximum(rival, np.minimum(best, rule.unfair * held))[short]
    chance = np.minimum(standard_error(model, last, steps), rule.noise * held)
    # A sample that is missing at a horizon (references sampled more slowly) says nothing.
    known = np.isfinite(held) & ~np.isnan(own)
    worse = known & ~(own <= rival + rule.equal * held + np.where(np.isfinite(chance), chance, 0.0))
    scale = 0.0 if kind.own else CALM[kind.name] / math.sqrt(len(kind.axes) if name else 1)
    if seconds[0] <= rule.sensor_sample:
        scale = max(scale, rule.noise_motion * float(held[0]))
    calm = bool(held[at] < scale)
    excused = calm and bool(np.nanmax(own[: at + 1]) <= 2.0 * scale)
    return Comparison(
        name=name or kind.name,
        kind=kind,
        model=own,
        last=held,
        floor=best,
        worse=worse,
        calm=calm,
        excused=excused,
    )


def standard_error(model: GroupErrors, last: GroupErrors, steps: int) -> FloatArray:
    """Standard error (steps,) of the difference between the two mean errors, from blocks of
    consecutive origins.

    Ratio estimator over blocks of unequal size (W. G. Cochran, "Sampling Techniques", 1977, section
    6.3). NaN where fewer than two blocks are there or an error is not finite.
    """
    out = np.full(steps, np.nan)
    if len(model.block_sums) != len(last.block_sums) or len(model.block_sums) < 2:
        return out
    counts = model.block_counts[:, :steps]
    with np.errstate(invalid="ignore"):
        difference = model.block_sums[:, :steps] - last.block_sums[:, :steps]
        total, used = counts.sum(axis=0), (counts > 0).sum(axis=0)
        safe = np.maximum(total, 1.0)
        left = difference - difference.sum(axis=0) / safe * counts
        variance = used / np.maximum(used - 1, 1) * (left * left).sum(axis=0) / safe**2
        out[:] = np.where(used > 1, np.sqrt(variance), np.nan)
    return out


def nearest(seconds: FloatArray, wanted: float) -> int:
    """The horizon nearest to `wanted` [s]."""
    return int(np.argmin(np.abs(seconds - wanted)))


def weigh(compared: Sequence[Comparison], grid: Grid) -> Weighed:
    """What speaks for a model and what against it."""
    at, rule = grid.at, grid.rule
    excused = [c for c in compared if c.excused and c.worse[: at + 1].any()]
    counted = [c for c in compared if c not in excused]
    bad = (
        np.any([c.worse for c in counted], axis=0)
        if counted
        else np.zeros(len(grid.seconds), dtype=bool)
    )
    usual = [[c for c in counted if c.kind.name in kind and not c.kind.own] for kind in KINDS]
    together = [*usual, *([c] for c in counted if c.kind.own)]
    return Weighed(
        compared=compared,
        counted=counted,
        excused=excused,
        idle=[c for kind in together for c in _no_better(kind, slice(grid.first, at + 1), rule)],
        # NaN: nothing to compare
        wrecked=[c for c in counted if c.model[at] > rule.wrecked * c.last[at]],
        ends=int(np.argmax(bad)) if bad.any() else len(grid.seconds),
    )


def _no_better(kind: Sequence[Comparison], span: slice, rule: Standard) -> list[Comparison]:
    """The groups of a kind that together come nowhere in `span` clearly below the last value."""
    if not kind:
        return []
    ratio = np.array([c.model[span] / np.maximum(c.last[span], 1e-300) for c in kind])
    known = ratio[:, np.isfinite(ratio).all(axis=0)]
    best = (
        float(np.exp(np.log(np.maximum(known, 1e-300)).mean(axis=0)).min())
        if known.size
        else np.inf
    )
    return [] if best < rule.better else list(kind)
