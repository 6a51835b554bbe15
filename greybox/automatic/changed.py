"""Whether what pushes a craft without a name changed for good within a flight, as where it picks up
a load, loses a part of a propeller or its battery sags; and what it leaves thrust and mass known to.

Gusts pass, so that what lasts longer than they do is of the craft: along the thrust, and in its
torques. A sideways force that lasts is wind. What the motion may explain is no change of the craft:
an effect that the model lacks pushes otherwise when the craft flies otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.data import Dataset, Segment
from greybox.estimation.filtering import Filter
from greybox.estimation.smoothing import smooth
from greybox.frames import numeric
from greybox.model.identified import IdentifiedModel
from greybox.statistics.lasting import FEWEST, MOST, Cause, Change, beyond, lasting_change
from greybox.symbolic import FloatArray

OWN = ("force.z", "torque.x", "torque.y", "torque.z")
"""Pushes that the craft's own parts make."""
SHOWN = {"force": ("velocity", "position"), "torque": ("rate", "rotation")}
"""What a push moves, after one integration and after two."""
PACE = 0.5
"""Time [s] that is looked at in one: what is faster lasts for no time."""
CARRIED = 0.01
"""Share of the weight from which a steady force along the thrust is worth a word: a scale and a
hover tell mass and thrust to that."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stretch:
    """Pushes y (m, n) [N, N m] of a segment, means over `step` [s] from `start` [s] of its flight
    on. `motion` is what may push, means of each kind."""

    flight: str
    start: float
    step: float
    y: FloatArray
    motion: Sequence[Cause] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Unnamed:
    """What flights of `model` were pushed by without a name: of the pushes `names`."""

    model: IdentifiedModel
    names: tuple[str, ...]
    stretches: tuple[Stretch, ...]

    @property
    def weight(self) -> float:
        """Of the craft [N]."""
        return self.model.values["mass"] * self.model.physics.vehicle.gravity

    def least(self, name: str) -> float:
        """The least push [N, N m] that is worth a word: of a torque, that of such a force at a
        rotor."""
        force = CARRIED * self.weight
        arm = self.model.physics.vehicle.arm_length
        return force if _group(name) == "force" else force * arm


@dataclass(frozen=True, kw_only=True)
class Changed:
    """In a flight pushes are higher by `sizes` [N, N m] from `at` [s] on, for good; None: they drift
    by that from its start to its end. `flown`: as far as the flight tells, that may all come of how
    it is flown."""

    flight: str
    at: float | None
    sizes: Mapping[str, float]
    flown: bool = False


def unnamed(model: IdentifiedModel, data: Dataset) -> Unnamed | None:
    """The pushes that the craft's own parts may make, smoothed; None where the model has none, or
    nothing that they move is measured. Raises `FitError` where a flight cannot be smoothed."""
    states, seen = model.dynamics.states, set(model.channel_groups)
    names = tuple(
        n for n in OWN if f"disturbance.{n}" in states.names and seen & set(SHOWN[_group(n)])
    )
    if not names:
        return None
    runner, rows = Filter(model), [states[f"disturbance.{n}"] for n in names]

    def stretch(flight: str, segment: Segment) -> Stretch:
        pace = max(round(PACE / model.sample_time), -(-segment.n // MOST))
        m = segment.n // pace
        states = smooth(runner, runner.run(segment)).states

        def means(values: FloatArray) -> FloatArray:
            return np.asarray(values[: m * pace].reshape(m, pace, -1).mean(axis=1))

        return Stretch(
            flight=flight,
            start=float(segment.t[0]),
            step=pace * model.sample_time,
            y=means(states[:, rows]),
            motion=tuple(replace(c, z=means(c.z)) for c in _motion(model, segment, states)),
        )

    found = (stretch(f.name, s) for f in data for s in f.segments if s.n * model.sample_time > PACE)
    stretches = tuple(s for s in found if np.isfinite(s.y).all())
    return Unnamed(model=model, names=names, stretches=stretches) if stretches else None


def _motion(model: IdentifiedModel, segment: Segment, states: FloatArray) -> Iterator[Cause]:
    """What may push a craft of its motion: the air by its velocity, by its turn and near the
    ground, the rotors by what they lift. Never the commands: they answer to a load as well, as a
    height does that nobody holds exactly."""
    names = model.dynamics.states.names
    q, v, rate = (
        states[:, [i for i, n in enumerate(names) if n.startswith(f"{block}.")]]
        for block in ("attitude", "velocity", "rate")
    )
    if q.size and v.size:
        yield Cause(z=numeric("rotate_inverse", q, v))
        lift = np.gradient(v, model.sample_time, axis=0)
        lift[:, 2] += model.physics.vehicle.gravity
        yield Cause(z=numeric("rotate_inverse", q, lift)[:, 2:])
    elif "az" in segment.channels and np.isfinite(segment.channels["az"]).all():
        yield Cause(z=segment.channels["az"][:, None])
    if rate.size:
        yield Cause(z=rate)
    if "position.z" in names:
        above, arm = states[:, [names.index("position.z")]], model.physics.vehicle.arm_length
        # An arm above the lowest place half of what the ground does is gone.
        yield Cause(z=arm / (arm + above - above.min()), least=1.0)


def changes(seen: Unnamed) -> tuple[Changed, ...]:
    """Those that are told from gusts, of all stretches of all flights, and are worth a word."""
    tests = len(seen.names) * sum(len(s.y) >= FEWEST for s in seen.stretches)
    return tuple(c for s in seen.stretches for c in _changes(seen, s, tests))


def steady_share(levels: Sequence[FloatArray]) -> float:
    """Share of the weight that a force along the thrust carries (negative: pulls down) in every
    flight, steadier than it varies, from its share (m,) of the weight in each; 0 where there is
    none that is worth a word."""
    means = np.array([p.mean() for p in levels])
    steady = all(abs(m) > p.std() for m, p in zip(means, levels, strict=True))
    share = float(np.concatenate(levels).mean())
    return share if steady and np.ptp(np.sign(means)) == 0 and abs(share) > CARRIED else 0.0


def lasting_share(seen: Unnamed, changed: Sequence[Changed]) -> float:
    """Share of the weight that a lasting force along the thrust takes up as if it were a part of
    it: what it carries in all flights; where it changes, the root mean square of what it carries
    before and after. 0 where that is not worth a word."""
    if "force.z" not in seen.names:
        return 0.0
    cuts = [c for c in changed if c.at is not None and "force.z" in c.sizes]
    column = seen.names.index("force.z")
    levels: dict[str, list[FloatArray]] = {}
    for s in seen.stretches:
        own = [round((c.at - s.start) / s.step) for c in cuts if c.flight == s.flight and c.at]
        inside, gone = sorted(k for k in own if 0 < k < len(s.y)), sum(k <= 0 for k in own)
        for k, part in enumerate(np.split(s.y[:, column] / seen.weight, inside), start=gone):
            levels.setdefault(f"{s.flight} {k}", []).append(part)
    parts = [np.concatenate(p) for p in levels.values()]
    if not cuts:
        return abs(steady_share(parts))
    squares = [len(p) * p.mean() ** 2 for p in parts if abs(p.mean()) > p.std()]
    share = float(np.sqrt(sum(squares) / sum(len(p) for p in parts)))
    return share if share > CARRIED else 0.0


@dataclass(frozen=True, kw_only=True)
class Said:
    """In words: `steps` and `drifts` of the craft, and what may come of how it is `flown`."""

    steps: Sequence[str]
    drifts: Sequence[str]
    flown: Sequence[str]


def said_of_changes(seen: Unnamed, changed: Sequence[Changed]) -> Said:
    """For people; of drifts of the same push one line."""
    steps, flown = list[str](), list[str]()
    drifts = dict[tuple[str, bool], list[tuple[float, str]]]()
    for c in changed:
        what = ", ".join(_size(seen, n, size) for n, size in c.sizes.items())
        since = "from start to end" if c.at is None else f"from {c.at:.1f} s on"
        if c.flown:
            flown.append(
                f"in {c.flight} {since} {what} without a name, as it flies otherwise: an effect is "
                "missing (or the craft changed just then)"
            )
            continue
        if c.at is not None:
            steps.append(
                f"in {c.flight} {since} {what} without a name, for good and however it flies: a "
                "load, a rotor or the battery changed"
            )
            continue
        for n, size in c.sizes.items():
            drifts.setdefault((n, size > 0), []).append((size, c.flight))
    lines = []
    for (n, _), all_of_it in drifts.items():
        size, _ = max(all_of_it, key=lambda d: abs(d[0]))
        flights = ", ".join(f for _, f in all_of_it)
        why = "; a battery that sags?" if n == "force.z" and size < 0 else ""
        lines.append(
            f"a push without a name drifts from start to end: {_size(seen, n, size)} in "
            f"{flights}{why}"
        )
    return Said(steps=steps, drifts=lines, flown=flown)


def _changes(seen: Unnamed, stretch: Stretch, tests: int) -> Iterator[Changed]:
    """Of one stretch, the surest first; what changed at the same place is told with it."""

    def change(name: str, tests: int) -> Change | None:
        time = seen.model.values[f"disturbance.{_group(name)}.T"]
        y = stretch.y[:, seen.names.index(name)]
        found = lasting_change(y, float(np.exp(-stretch.step / time)), tests)
        return found if found is not None and abs(found.size) > seen.least(name) else None

    def of_the_craft(name: str) -> bool:
        return beyond(stretch.y[:, seen.names.index(name)], sure[name], stretch.motion)

    sure = {n: c for n in seen.names if (c := change(n, tests)) is not None}
    left = sorted(sure, key=lambda n: sure[n].p)
    while left:
        at = sure[left[0]].at
        sizes = {n: sure[n].size for n in left if _near(sure[n].at, at)}
        if at is not None:
            others = {n: change(n, 1) for n in seen.names if n not in sure}
            sizes |= {n: c.size for n, c in others.items() if c and _near(c.at, at)}
        yield Changed(
            flight=stretch.flight,
            at=None if at is None else stretch.start + at * stretch.step,
            sizes={n: sizes[n] for n in seen.names if n in sizes},
            flown=not any(of_the_craft(n) for n in left if n in sizes),
        )
        left = [n for n in left if n not in sizes]


def _near(one: float | None, other: float | None) -> bool:
    """Whether two are drifts, or steps at the same place, as far as can be told."""
    return one == other if one is None or other is None else abs(one - other) <= 1.0


def _group(name: str) -> str:
    return name.split(".")[0]


def _size(seen: Unnamed, name: str, size: float) -> str:
    """In words."""
    if _group(name) == "torque":
        return f"{name} {size:+.2g} N m"
    return f"{name} {100.0 * size / seen.weight:+.1f} % of the weight"
