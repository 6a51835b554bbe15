"""Check of the measured channels against each other: axes, frames, signs, factors, delays, and the
clock's rate, in each flight and over those of the craft together (`together.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.data.checks import mixture
from greybox.data.checks.finding import Finding, Outcome, Severity, Unjudged
from greybox.data.checks.relations import (
    FARTHEST,
    LEFT,
    REACH,
    SEEN,
    WHOLE,
    Better,
    Factor,
    Moments,
    Reading,
    Tried,
    at_the_edge,
    better_reading,
    factor,
    far_better,
    joined,
    long_enough,
    mixed,
    moments,
    searched,
)
from greybox.data.checks.spans import STARTS, Spans
from greybox.data.checks.together import Told, alone_and_together
from greybox.data.checks.view import View
from greybox.data.raw import FloatArray

PART = 0.1
"""Share of the motion that is a good part of it."""
MOST_OTHERS = 2
"""Other readings that are named where they explain about as much."""
STILL = 1e-9
"""Share of the motion of one stream below which another does not move at all."""
LATE = 0.05
"""Delays from here on are said [s], and from two samples."""
NO_WITNESS = "which no gyro tells"
BY_GYRO = "the attitude is what the gyro makes of it"
ESTIMATED = (
    "log an attitude that was measured: this one errs with the motion, as an estimator's does; with "
    "it, predicted attitudes are no better"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Streams:
    """Two streams of a flight in all readings, the one given first. `axes` names those of x, `spans`
    those of the increments. A clock that runs c times as fast makes y c ** `power` times as
    large against x; `scaled` is False where sizes mean nothing. `apart` gives the readings with
    what a craft may have besides set aside: another reading must be better there, too. `suspects`
    are the readings that accuse a sensor beside an attitude that may be wrong instead; `witness`
    gives the first reading and those by the gyro's attitude, None where there is no gyro."""

    readings: tuple[Reading, ...]
    axes: tuple[str, str, str]
    spans: Spans
    power: float = -1.0
    scaled: bool = True
    where: str = ""
    apart: Callable[[], tuple[Reading, ...]] | None = None
    suspects: tuple[str, ...] = ()
    witness: Callable[[], tuple[Reading, ...]] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Relation:
    """Two streams that kinematics makes equal: `name` of the check, its words, and how large motion
    must be (RMS of the increments of y): `least` to be judged, `much` to be missed where no
    reading explains it. `units` are factors that have a name: (factor, what it means, fix).
    `blocking` is the factor from which a fit is blocked."""

    name: str
    streams: str
    factor: str
    where: str
    fix: str
    least: float
    much: float
    units: tuple[tuple[float, str, str], ...]
    blocking: float
    streams_of: Callable[[View], Streams | str]


@dataclass(frozen=True, kw_only=True, eq=False)
class Related:
    """One relation in one flight (or in several): sums of every reading and of the given one
    without a delay, and the size of the motion. `apart` and `witness` try those of `Streams`, and
    `late_apart` the first of `apart` at its delay and without one, where sizes mean nothing;
    None where there are none."""

    streams: Streams
    tried: tuple[Tried, ...]
    prompt: Moments | None
    size: float
    sample: float
    apart: Callable[[], tuple[Tried, ...]] | None = None
    witness: Callable[[], tuple[Tried, ...]] | None = None
    late_apart: Callable[[], tuple[Moments, Moments | None] | None] | None = None

    @property
    def given(self) -> Moments:
        """Sums of the reading given."""
        return self.tried[0].sums


def related(relation: Relation, view: View) -> Related | str:
    """The relation in one flight, or why it cannot be judged there."""
    found = view.found.get(relation)
    if isinstance(found, Related | str):
        return found
    if view.flight is None:
        return "no airborne stretch"
    streams = relation.streams_of(view)
    found = streams if isinstance(streams, str) else _of_streams(relation, view, streams)
    view.keep(relation, found)
    return found


def _of_streams(relation: Relation, view: View, streams: Streams) -> Related | str:
    """The relation of two streams, or why the flight does not tell it."""
    first, spans = streams.readings[0], streams.spans
    # A stream of the wrong unit may seem to stand still: the craft moves where either says so.
    sizes = _moved(first.y, spans), _moved(spans.over(first.x), spans)
    size = max(sizes)
    given = searched(first, spans, view.dt)
    if given is None:
        return _too_few(view, first, spans)
    if size < relation.least:
        return f"the craft hardly moves ({size:.2g} per {spans.length * view.dt:.2g} s)"
    if min(sizes) <= STILL * size:  # `frozen` names it
        return "one of the streams stands still"
    other, witness = streams.apart, streams.witness
    return Related(
        streams=replace(streams, readings=()),  # as long as the flight, and summed up
        tried=_tried(streams.readings, view.dt, spans, given[0]),
        prompt=moments(first, spans, view.dt, np.array([0]), given[1]),
        size=size,
        sample=view.dt,
        apart=None if other is None else lambda: _tried(other(), view.dt, spans),
        witness=None if witness is None else lambda: _tried(witness(), view.dt, spans),
        late_apart=None
        if other is None or streams.scaled  # an accelerometer feels drag
        else lambda: _lagged(other()[0], view.dt, spans),
    )


def _lagged(reading: Reading, dt: float, spans: Spans) -> tuple[Moments, Moments | None] | None:
    """The sums of a reading at its delay, and without one; None where it has too few spans."""
    found = searched(reading, spans, dt)
    return found and (found[0], moments(reading, spans, dt, np.array([0]), found[1]))


def _too_few(view: View, first: Reading, spans: Spans) -> str:
    """Why a reading has too few spans: the flight is too short, or too much of it is missing."""
    rows = len(view.time)
    seconds = rows * view.dt
    if not long_enough(rows, view.dt, spans.length, REACH):
        return f"too short: {seconds:.2g} s"
    known = np.isfinite(first.y).all(axis=1) & spans.known(first.x, 0)
    whole = max(1, (rows - spans.length) // max(1, spans.length // STARTS))
    return (
        f"too many gaps: only {100 * known.sum() / whole:.0f} % of {seconds:.2g} s have no missing "
        f"sample within {spans.length * view.dt:.2g} s"
    )


def _tried(
    readings: Sequence[Reading], dt: float, spans: Spans, given: Moments | None = None
) -> tuple[Tried, ...]:
    """Readings with their sums (those of the first where they are `given`); none where that of the
    first has too few spans."""
    tried: list[Tried] = []
    for reading in readings:
        if tried and _share(tried[0].sums) > WHOLE:
            break
        sums = None if tried else given
        if sums is None and (found := searched(reading, spans, dt)) is not None:
            sums = found[0]
        if sums is not None:
            lag = tried[0].sums.lag if tried else 0.0
            between = mixed(readings[0], reading, spans, dt, lag) if tried else None
            tried.append(Tried(text=reading.text, fix=reading.fix, sums=sums, mixed=between))
        elif not tried:
            break
    return tuple(tried)


def _moved(increments: FloatArray, spans: Spans) -> float:
    """Size of the motion (rms) in increments (M, 3)."""
    known = np.flatnonzero(np.isfinite(increments).all(axis=1))
    if not known.size:
        return 0.0
    moved = spans.without_bias(increments[known], known)
    return float(np.sqrt((moved**2).sum(axis=1).mean()))


def together(parts: Sequence[Related]) -> Related:
    """Several flights as one, with the readings that all have."""
    if len(parts) == 1:
        return parts[0]
    sets = [p.apart for p in parts if p.apart is not None]
    witnesses = [p.witness for p in parts if p.witness is not None]
    size = float(np.sqrt(np.mean([p.size**2 for p in parts])))
    return Related(
        streams=parts[0].streams,
        tried=_common([p.tried for p in parts]),
        prompt=None,
        size=size,
        sample=parts[0].sample,
        apart=None if len(sets) < len(parts) else lambda: _common([s() for s in sets]),
        witness=None if len(witnesses) < len(parts) else lambda: _common([w() for w in witnesses]),
    )


def _common(parts: Sequence[tuple[Tried, ...]]) -> tuple[Tried, ...]:
    """The readings that all flights have, with the sums of all."""
    tried = []
    for first in parts[0] if parts else ():
        found = [next((s for s in p if s.text == first.text), None) for p in parts]
        every = [f for f in found if f is not None]
        if len(every) == len(parts):
            between = [f.mixed for f in every if f.mixed is not None]
            tried.append(
                Tried(
                    text=first.text,
                    fix=first.fix,
                    sums=joined([f.sums for f in every]),
                    mixed=mixture.joined(between) if between else None,
                )
            )
    return tuple(tried)


def judge(relation: Relation, views: Sequence[View]) -> tuple[list[Outcome], dict[str, Related]]:
    """The findings of a relation on all flights, and the flights on which the reading given
    holds."""
    out: list[Outcome] = []
    holds: dict[str, Related] = {}
    for view in views:
        found = related(relation, view)
        if isinstance(found, str):
            there = view.flight is not None and not isinstance(relation.streams_of(view), str)
            out.append(Unjudged(check=relation.name, flight=view.name, reason=found, open=there))
        else:
            holds[view.name] = found
    told = alone_and_together(
        holds, lambda some: _better(relation, together(some)), claim=lambda better: better.text
    )
    for one in told:
        out += [_another_reading_fits(relation, name, holds.pop(name), one) for name in one.flights]
    for name, found in list(holds.items()):
        if _share(found.given) < SEEN:
            del holds[name]
            if found.size > relation.much:
                out.append(_unlike(relation, name, found))
    return out, holds


def _share(sums: Moments) -> float:
    return float(sums.total.share(np.eye(3))[0])


def _better(relation: Relation, found: Related) -> Better | None:
    """A better reading that does not only stand for what a craft may have besides."""
    axes = found.streams.axes
    better = better_reading(found.tried, axes, relation.fix)
    if better is not None and found.apart is not None and (apart := found.apart()):
        better = better_reading(apart, axes, relation.fix)
    if better is None or better.text not in found.streams.suspects:
        return better
    return _of_two_suspects(better, found, relation)


def _of_two_suspects(better: Better, found: Related, relation: Relation) -> Better:
    """A reading that accuses a sensor, where the attitude may be wrong instead: the one that the
    gyro supports is not accused; both are named where it cannot tell."""
    either = replace(better, others=(f"the attitude errs, {NO_WITNESS}", *better.others))
    seen = found.witness() if found.witness is not None else ()
    most = max((_share(t.sums) for t in seen), default=0.0)
    if 1.0 - most > (1.0 - better.share) / LEFT:  # its gyro is no better than that
        return either
    again = better_reading(seen, found.streams.axes, relation.fix)
    if again is not None and again.text in found.streams.suspects:
        return better
    share = _share(seen[0].sums)
    if share < better.share:
        return either
    return replace(better, text=BY_GYRO, fix=ESTIMATED, share=share, others=(), sure=False)


def _another_reading_fits(
    relation: Relation, flight: str, found: Related, told: Told[Better]
) -> Finding:
    better = told.said
    evidence = {"share_as_given": better.given_share, "share_explained": better.share}
    if better.angle:
        evidence |= {"angle_deg": better.angle, "angle_error_deg": better.angle_error}
    if len(told.flights) > 1:
        evidence["flights"] = len(told.flights)
    message = f"{relation.streams} agree only when {better.text}"
    message += (
        f" (explains {100 * better.share:.0f} % of the motion, as given "
        f"{100 * better.given_share:.0f} %)"
    )
    if better.others:
        message += f", or about as well when {' or when '.join(better.others[:MOST_OTHERS])}"
    return Finding(
        check=relation.name,
        severity="blocking" if better.blocks else "warning",
        flight=flight,
        where=found.streams.where or relation.where,
        message=message + (told.against if better.blocks else ""),
        evidence=evidence,
        fix=better.fix,
    )


def _unlike(relation: Relation, flight: str, found: Related) -> Finding:
    share = _share(found.given)
    message = f"{relation.streams} agree poorly (correlation {np.sqrt(share):.2f}) in every reading"
    fix = "check what both columns hold, their noise, and that both are on one clock"
    apart = _apart(found) if found.streams.scaled else {}
    if apart:
        least = min(apart.values(), key=lambda f: -abs(np.log(f)))
        message += f": {relation.factor.format(f'{least:.2g}')} in {', '.join(apart)}"
        fix = "check the units in [columns]; degrees of longitude and latitude are no metres"
    return Finding(
        check=relation.name,
        severity="blocking" if apart else "warning",
        flight=flight,
        where=found.streams.where or relation.where,
        message=message,
        evidence={"share_as_given": share, "motion_rms": found.size},
        fix=fix,
    )


def _apart(found: Related) -> dict[str, float]:
    """Axis -> by which factor y is larger there, where a good part of the motion is in one of both
    and next to nothing of it in the other."""
    yy, xx = (v.sum(axis=0) for v in (found.given.yy, found.given.xx))
    sizes = np.sqrt(np.maximum(yy, 1e-300) / np.maximum(xx, 1e-300))
    part = np.maximum(yy / max(float(yy.sum()), 1e-300), xx / max(float(xx.sum()), 1e-300))
    other = (part > PART) & (np.abs(np.log10(sizes)) > 1.0)
    return {a: float(f) for a, f, o in zip(found.streams.axes, sizes, other, strict=True) if o}


def run(views: Sequence[View], relations: Sequence[Relation]) -> Iterator[Outcome]:
    """Findings of all relations; a factor that all of them share is the clock's."""
    held: dict[str, dict[str, Related]] = {}
    for relation in relations:
        outcomes, held[relation.name] = judge(relation, views)
        yield from outcomes
    wrong: set[str] = set()
    for view in views:
        there = {n: found[view.name] for n, found in held.items() if view.name in found}
        clock = _clock(view.name, there)
        if clock is not None:
            yield clock
            wrong |= {view.name} if clock.severity == "blocking" else set()
    for relation in relations:
        sized = {n: f for n, f in held[relation.name].items() if f.streams.scaled}
        yield from _sizes(relation, {n: f for n, f in sized.items() if n not in wrong})
        if relation.name != "attitude":  # its delay is the alignment's
            for name, found in held[relation.name].items():
                yield from _late(relation, name, found)


def _clock(flight: str, there: Mapping[str, Related]) -> Finding | None:
    """A finding where relations give the same factor: it is the clock's."""
    factors = {
        n: f for n, r in there.items() if r.streams.scaled and (f := factor(r.given)) is not None
    }
    clocks = {n: f.to_the(1.0 / there[n].streams.power) for n, f in factors.items()}
    off = [c for c in clocks.values() if c.clear]
    low, high = max((c.low for c in off), default=0.0), min((c.high for c in off), default=0.0)
    if len(off) >= 2 and low <= high:
        rate = 0.5 * (low + high)
        return Finding(
            check="clock",
            severity="blocking",
            flight=flight,
            where="t",
            message=f"the time runs {rate:.3g} times as fast as the motion: {', '.join(clocks)} "
            "say so alike",
            evidence={"clock_rate": rate, "lowest": low, "highest": high},
            fix="correct the time stamps (unit in [columns.time]), or the rate at which the log "
            "was written",
        )
    common = common_rate(list(clocks.values()))
    if common is None:
        return None
    shown = ", ".join(f"{n} {c.value:.3g}" for n, c in clocks.items())
    return Finding(
        check="clock",
        severity="warning",
        flight=flight,
        where="t",
        message=f"the time may run {common:.3g} times as fast as the motion: no factor is "
        f"nearer to 1 than to that ({shown})",
        evidence={
            "clock_rate": common,
            **{f"clock_rate_{n}": c.value for n, c in clocks.items()},
        },
        fix="compare the rate of the log with the one that was set; if it is right, check the "
        "units and scales in [columns]",
    )


def common_rate(clocks: Sequence[Factor]) -> float | None:
    """The rate of the clock that explains all factors, which are given as rates of a clock.

    One is clear; at least two are nearer to that one than to 1, none is nearer to 1, and none is
    clear once the rate is set aside. None where there is no such rate.
    """
    clear = [c.value for c in clocks if c.clear]
    if not clear:
        return None
    most = max(clear, key=lambda v: abs(np.log(v)))
    side = 1.0 if most > 1.0 else -1.0
    middle = most ** (0.5 * side)
    nearer = [c for c in clocks if c.to_the(side).low > middle]
    against = any(c.to_the(side).high < middle for c in clocks)
    rate = float(np.median([c.value for c in nearer])) if nearer else 1.0
    left = [Factor(value=c.value / rate, low=c.low / rate, high=c.high / rate) for c in clocks]
    return None if len(nearer) < 2 or against or any(c.clear for c in left) else rate


def _sizes(relation: Relation, flights: Mapping[str, Related]) -> Iterator[Finding]:
    """Findings where y and x differ by a factor, in all axes or in some."""
    told = alone_and_together(
        flights,
        lambda some: _size(together(some)),
        claim=lambda size: (size[1], f"{size[0].value:.2g}"),
    )
    for one in told:
        for name in one.flights:
            yield _of_size(relation, name, flights[name], one)


def _size(found: Related) -> tuple[Factor, str] | None:
    """(factor that is clear, in which axes)."""
    axes = {a: factor(found.given, [i]) for i, a in enumerate(found.streams.axes)}
    clear = {a: f for a, f in axes.items() if f is not None and f.clear}
    total = factor(found.given)
    sound = [a for a, f in axes.items() if f is not None and f.low < 1.0 < f.high]
    if total is not None and total.clear and not (clear and sound):
        return total, ""
    if not clear:
        return None
    worst = max(clear, key=lambda a: abs(np.log(clear[a].value)))
    return clear[worst], f" in {', '.join(clear)}"


def _of_size(
    relation: Relation, flight: str, found: Related, told: Told[tuple[Factor, str]]
) -> Finding:
    size, which = told.said
    text, fix = (
        relation.factor.format(f"{size.value:.3g}") + which,
        "check the units of both in [columns]",
    )
    for usual, meaning, mend in relation.units:
        if 0.5 < size.value / usual < 2.0:
            text, fix = f"{meaning} ({text})", mend
    severity: Severity = (
        "blocking" if max(size.low, 1.0 / size.high) > relation.blocking else "warning"
    )
    return Finding(
        check=relation.name,
        severity=severity,
        flight=flight,
        where=found.streams.where or relation.where,
        message=text + (told.against if severity == "blocking" else ""),
        evidence={"factor": size.value, "lowest": size.low, "highest": size.high},
        fix=fix,
    )


def _late(relation: Relation, flight: str, found: Related) -> Iterator[Finding]:
    """A finding where the streams agree far better with a delay; what a craft may have besides is
    set aside: drag follows the motion, too."""
    delayed = (found.given, found.prompt) if found.late_apart is None else found.late_apart()
    if delayed is None or delayed[1] is None:
        return
    late = delayed[0].lag
    if abs(late) < max(LATE, 2.0 * found.sample):
        return
    shares = far_better(delayed[0], delayed[1])
    if shares is None:
        return
    first, _, second = relation.streams.partition(" and ")
    way = "late" if late > 0 else "early"
    message = f"{first} is {1e3 * abs(late):.0f} ms {way} against {second}"
    if at_the_edge(late):
        message = (
            f"{first} is {way} against {second} by about {1e3 * FARTHEST:.0f} ms or more: the search "
            "ends there, which is no estimate"
        )
    yield Finding(
        check=relation.name,
        severity="warning",
        flight=flight,
        where=found.streams.where or relation.where,
        message=message,
        evidence={"delay_s": late, "share_explained": shares[0], "share_as_given": shares[1]},
        fix="log all streams with one clock, stamped at the source; or shift one of them",
    )
