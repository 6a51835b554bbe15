"""Verify: take back names whose law does not fit, write down what is left, and measure how far the gap closed.

The disturbance states of the last model say what is left. Names that leave more on their main axis than they explained
are taken back (greybox.discovery.veto) and the model is fitted without them, so that what they had bent towards the data is
reported as unnamed. Refitted with the laws of unnamed axes (greybox.discovery.written), the model shows what they close. On
request a Gaussian process learns what the bare model misses: the attainable line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from greybox.data import Dataset
from greybox.discovery.gap import GapRow, Squares, gap, squares
from greybox.discovery.leftover import Promoted, promote
from greybox.discovery.name import Addition, prune
from greybox.discovery.nested import Nest, NestedFit
from greybox.discovery.veto import HALF, HeldOut, Withheld, likeness, misfit, misread, undone, white_levels, wrench_of
from greybox.discovery.written import Looked, looked_again
from greybox.errors import FitError, GreyboxError
from greybox.estimation.fit import Fit
from greybox.model.identified import IdentifiedModel
from greybox.statistics.evidence import CLEAR

MOST = 0.5
"""Share of what was missing above which a name is not believed on logs of gyro and accelerometer alone: drag, which nothing
shows without a velocity, bends the rates as a damping does."""
ALIKE = 0.7
"""Correlation of the wrenches of a name and of a law from which on the law is the name in other words: it shares half of
its variance."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Verified:
    """The last fit, the additions that stay, the names that were taken back, what is left, and the fit with its laws
    `written` (None without one); `first` is what was left before any name was taken back."""

    at: NestedFit
    additions: list[Addition]
    withheld: list[Withheld]
    leftover: Promoted
    written: Fit | None
    first: Promoted


def verified(
    nest: Nest, at: NestedFit, additions: Sequence[Addition], train: Dataset, held_out: HeldOut | None = None, *,
    before: Promoted | None = None, seed: int = 0,
) -> Verified:  # fmt: skip
    """Take back names that leave more than they explain and have not proven themselves on the flights of `held_out`, or
    have, but do nothing that a law does not do without them; repeated, as what was taken back may have served another. On
    logs of gyro and accelerometer alone laws of force and torque go, proven or not, while most of what was missing without
    any addition (`before`) is left."""
    kept, withheld = list(additions), list[Withheld]()
    proven = {a.effects for a in kept if held_out is not None and held_out.proven(a.before, a.after)}
    first = leftover = promote(at.fit, train, seed=seed)
    looked: Looked | None = None
    while kept and leftover.unnamed:
        doubts = [(a, w) for a in kept if (w := _misfit(nest, at, a, leftover, train)) is not None]
        plain = [a for a, _ in doubts if any(set(a.effects) <= set(p) for p in proven)]
        wrong = [w for a, w in doubts if a not in plain]
        if plain and not wrong:  # what proved itself is asked last, once nothing else bends the fit
            looked = looked_again(at.fit, leftover, train, seed=seed)
            wrong += [w for a in plain if (w := _replaced(nest, at, a, looked, train, held_out, seed)) is not None]
        if not wrong and leftover.laws:
            looked = looked or looked_again(at.fit, leftover, train, seed=seed)
            weak = [a for a in kept if not any(set(a.effects) <= set(p) for p in proven)]
            wrong += [w for a in weak if (w := _undone(nest, at, a, looked, train)) is not None]
        if not wrong:
            break
        withheld += wrong
        gone = {n for w in wrong for n in w.effects}
        kept = [replace(a, effects=tuple(e for e in a.effects if e not in gone)) for a in kept]
        kept = [a for a in kept if a.effects]
        at = nest.refit(tuple(e for e in at.effects if e not in gone), start=at)
        leftover, looked = promote(at.fit, train, seed=seed), None
    # What a velocity that nobody measures does to force and torque looks like another law of force and torque.
    weak = [a for a in kept if _all_of(at, a, "wrench")] if nest.candidates.blind else []
    if weak and before is not None and before.deficient and leftover.unnamed and leftover.gain > MOST * before.gain:
        share = min(leftover.gain / before.gain, 1.0)
        reason = f"without position, velocity or attitude, and with {share:.0%} of what was missing left"
        withheld += [Withheld(effects=a.effects, reason=reason) for a in weak]
        kept = [a for a in kept if a not in weak]
        at = nest.refit([e for a in kept for e in a.effects], start=at)
        leftover = promote(at.fit, train, seed=seed)
    if kept and withheld:
        # A wind is nothing without the drag that it acts through.
        at, still, _ = prune(nest, at, kept, single=True)
        lost = {n for a in kept for n in a.effects} - {n for a in still for n in a.effects}
        if lost:
            withheld += [
                Withheld(effects=(n,), reason="it is not needed without what was taken back") for n in sorted(lost)
            ]
            kept, leftover = still, promote(at.fit, train, seed=seed)
    if looked is None or looked.first is not leftover:
        looked = looked_again(at.fit, leftover, train, seed=seed)
    return Verified(
        at=at, additions=kept, withheld=withheld, leftover=looked.leftover, written=looked.written, first=first
    )


def _all_of(at: NestedFit, addition: Addition, stage: str) -> bool:
    """Whether all effects of the addition belong to the stage."""
    stages = {e.name: e.stage for e in at.fit.model.physics.effects}
    return all(stages.get(n) == stage for n in addition.effects)


def _misfit(nest: Nest, at: NestedFit, addition: Addition, leftover: Promoted, train: Dataset) -> Withheld | None:
    if _all_of(at, addition, "sensor"):
        return misread(addition.effects, leftover.unnamed, addition.delta_bic, leftover.gain)
    try:
        wrench = wrench_of(at.fit.model, train, addition.effects, nest.candidates.null, nest.candidates.core)
    except FitError:
        return None  # a velocity that nothing holds ran away: what the effect does along the flights is not known
    return misfit(addition.effects, wrench, white_levels(at.fit.model), leftover.unnamed, addition.delta_bic, leftover.gain)


def _undone(nest: Nest, at: NestedFit, addition: Addition, looked: Looked, train: Dataset) -> Withheld | None:
    """Why a name goes that brings a force or torque which the laws of what is left take away again."""
    if looked.written is None or not _all_of(at, addition, "wrench"):
        return None
    lawful = looked.written.model
    null = {d.name: d.null for d in lawful.dynamics.parameters if d.null is not None}
    laws = {n.split(".")[0] for n in looked.written.parameters} - {n.split(".")[0] for n in at.fit.parameters}
    try:
        own = wrench_of(lawful, train, addition.effects, null)
        other = wrench_of(lawful, train, sorted(laws), null)
    except FitError:
        return None
    return undone(addition.effects, own, other, looked.leftover.unnamed)


def _replaced(
    nest: Nest, at: NestedFit, addition: Addition, looked: Looked, train: Dataset, held_out: HeldOut | None, seed: int
) -> Withheld | None:  # fmt: skip
    """Why a name that proved itself goes nevertheless: next to another law, of what is left without it, it does not half of
    what it did, against the fit with the laws next to it (`looked`). What bends towards a missing law improves everything,
    too. A law that pushes as the name does, and explains little more, is the name in other words; one against which the
    name, with or without laws, proves itself on the flights of `held_out` replaces nothing."""
    named = [at.fit] if looked.written is None else [at.fit, looked.written]
    bic = min(fit.bic for fit in named)
    without = nest.refit(tuple(e for e in at.effects if e not in addition.effects), start=at)
    lawful = looked_again(without.fit, promote(without.fit, train, seed=seed), train, seed=seed).written
    if lawful is None or lawful.bic - bic >= max(HALF * addition.delta_bic, CLEAR):
        return None
    null = {d.name: d.null for d in lawful.model.dynamics.parameters if d.null is not None}
    laws = {n.split(".")[0] for n in lawful.parameters} - {n.split(".")[0] for n in without.fit.parameters}
    core = nest.candidates.core
    try:
        own = wrench_of(at.fit.model, train, addition.effects, nest.candidates.null, core)
        other = wrench_of(lawful.model, train, sorted(laws), null, core)
    except FitError:
        return None
    if likeness(own, other, white_levels(at.fit.model)) > ALIKE and bic - lawful.bic < HALF * addition.delta_bic:
        return None
    if held_out is not None and any(held_out.outdoes(fit, lawful) for fit in named):
        return None
    return Withheld(effects=addition.effects, reason="another law explains as much without it")


def gap_rows(
    null: NestedFit, after: IdentifiedModel, extended: IdentifiedModel | None, train: Dataset, judge: HeldOut, *,
    attainable: bool, seed: int, say: Callable[[str], None], notes: list[str],
) -> tuple[GapRow, ...]:  # fmt: skip
    """The gap table on the flights of `judge`, of the models that are handed out: both with white sensors, as the one before
    has them. What could not be computed is said in `notes`."""
    judged, adapt = judge.data, judge.adapt
    try:
        before, reached = ((seen.own, seen.floor) for seen in (judge.foresight(null), judge.of(after)))
    except GreyboxError as error:
        notes.append(f"no gap table: {error}")
        return ()
    proposed_laws: Squares | None = None
    learned: Squares | None = None
    if extended is not None:
        try:
            proposed_laws = judge.of(extended).own
        except GreyboxError as error:
            notes.append(f"the proposed laws could not be judged: {error}")
    if attainable:
        say("attainable line")
        try:
            learned = _learned(null.fit, train, judged, adapt=adapt, seed=seed)
        except GreyboxError as error:
            notes.append(f"no attainable line: {error}")
    return tuple(gap(before, reached, proposals=proposed_laws, attainable=learned, seed=seed))


def _learned(null: Fit, train: Dataset, judged: Dataset, *, adapt: float | None, seed: int) -> Squares:
    """Errors of the bare model with a Gaussian process that learned what it misses, without any name."""
    from greybox.residual.learn import learn

    learned = learn(null.model, train, seed=seed)
    return squares(learned.model, judged, adapt=adapt)[0]
