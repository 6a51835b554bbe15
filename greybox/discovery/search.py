"""Search: screen, add the best candidate that holds, repeat, leave out what is not needed.

One run has one model of the noise. White noise comes first; then what was found must prove itself with the noise that the
sensors have, with or without a filter of the IMU, and with force and torque that are carried along.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace

from greybox.discovery.candidates import TIMING
from greybox.discovery.carried import all_white, whitens
from greybox.discovery.imu_filter import filtered_after_all, filtered_imu, may_be_filtered, unfiltered
from greybox.discovery.name import Addition, next_addition, prune, stands_in, still_there
from greybox.discovery.nested import Nest, NestedFit
from greybox.discovery.screen import Score
from greybox.discovery.velocity import drifts
from greybox.discovery.veto import HeldOut, Withheld, unseen

TRIES = 12
"""Candidates of one step that may fail to prove themselves before a search that carries what is left stops: each costs fits
with disturbance states."""
Progress = Callable[[str, float], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """What one search gave; `filters`: BIC gain of filters of the IMU that came in on the way."""

    nest: Nest
    at: NestedFit
    additions: list[Addition]
    scores: list[Score]
    withheld: list[Withheld]
    warnings: list[str]
    filters: dict[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Search:
    """Screen, add, repeat, prune: with the settings of one run. `may_filter`: whether a filter of the IMU may come in;
    `carries`: whether what is left is carried along, and names must prove themselves or explain it."""

    held_out: HeldOut | None
    alpha: float
    seed: int
    max_effects: int
    say: Progress
    interim: Callable[[NestedFit, Iterable[Addition]], None]
    may_filter: bool = True
    carries: bool = False

    def run(self, nest: Nest, at: NestedFit, before: Found | None = None) -> Found:
        """From the fit `at` until no candidate passes; what was found `before`, with other noise, must prove itself, unless
        this search carries what is left along."""
        additions, withheld, warnings = list[Addition](), list[Withheld](), list[str]()
        scores: list[Score] = []
        filters: dict[str, float] = {}
        spared: set[str] = set()
        if before is not None:
            filters |= before.filters
            if self.carries:  # what a disturbance can take up has lost power, not its evidence
                additions, spared = list(before.additions), set(at.effects)
            else:
                at, additions, warnings = prune(nest, at, before.additions, single=True)
        ready: list[Score] | None = None
        plain: tuple[Nest, NestedFit] | None = None
        for step in range(len(additions), self.max_effects + 1):
            if drifts(at.fit.model):
                scores = []
                warnings.append(
                    f"nothing further was sought: with {' and '.join(at.effects)} the model has a velocity that its filter "
                    "does not see at rest"
                )
                break
            scores, ready = ready or self._screen(nest, at, step), None
            if step == self.max_effects:
                if any(s.judged and s.p_family <= self.alpha for s in scores):
                    warnings.append(f"stopped at {self.max_effects} additions: more would pass the tests")
                break
            found, refused_now = _earned(nest, at, scores, self.alpha, self.held_out, self.carries)
            withheld += refused_now
            if found is None:
                break
            if self.may_filter and set(TIMING) & set(found.effects):
                # A filter of the IMU looks like a lag or a delay.
                ready = self._screen(nest, found.after, step + 1)
                instead = filtered_imu(nest, at, found.after) if may_be_filtered(found.after, ready, self.alpha) else None
                if instead is not None:
                    self.say("the IMU is filtered", min(0.14 + 0.08 * step, 0.7))
                    plain = nest, found.after
                    nest, at, gains = instead
                    filters |= gains
                    ready = None
                    continue
            self.say(f"added {' and '.join(found.effects)}", min(0.14 + 0.08 * step, 0.7))
            at = found.after
            additions = still_there([*additions, found], at)
            self.interim(at, additions)
        at, additions, removed = prune(nest, at, additions, spared=spared)
        at, additions, off = without_bent(nest, at, additions)
        withheld += off
        done = Found(
            nest=nest, at=at, additions=additions, scores=scores, withheld=withheld, warnings=warnings + removed,
            filters=filters,
        )  # fmt: skip
        if plain is not None:
            lean = unfiltered(*plain, at)
            return done if lean is None else self._again(done, "the IMU is not filtered after all", plain[0], lean, {})
        after_all = filtered_after_all(nest, at) if self.may_filter and set(TIMING) & set(at.effects) else None
        return done if after_all is None else self._again(done, "the IMU is filtered after all", *after_all)

    def _again(
        self, done: Found, why: str, nest: Nest, at: NestedFit, filters: dict[str, float]
    ) -> Found:  # fmt: skip
        """The search from the fit `at`, which has a filter of the IMU more or less than what was `done`."""
        self.say(why, 0.71)
        kept = [replace(a, effects=tuple(e for e in a.effects if e in at.effects)) for a in done.additions]
        left = replace(done, nest=nest, at=at, additions=[a for a in kept if a.effects], filters=filters)
        return replace(self, may_filter=False).run(nest, at, left)

    def _screen(self, nest: Nest, at: NestedFit, step: int) -> list[Score]:
        self.say(f"screening, step {step + 1}", min(0.1 + 0.08 * step, 0.7))
        return nest.screen(at, alpha=self.alpha, seed=self.seed)


def without_bent(
    nest: Nest, at: NestedFit, additions: Sequence[Addition]
) -> tuple[NestedFit, list[Addition], list[Withheld]]:
    """The fit and the additions without names that later ones, or other noise, drove to a bound, and of which no other
    estimate is clear of none: such a name stands in for something else."""
    off = []
    for name in at.effects:
        null = nest.candidates.null
        own = [(n, e) for n, e in at.fit.parameters.items() if n.split(".")[0] == name]
        bent = [n for n, e in own if e.at_bound and e.value != null[n]]
        if bent and (len(bent) == len(own) or unseen(at, (name,), null) is not None):
            off.append(Withheld(effects=(name,), reason="its estimates ran to a bound: it stands in for something else"))
    if not off:
        return at, list(additions), []
    gone = {n for w in off for n in w.effects}
    at = nest.refit(tuple(e for e in at.effects if e not in gone), start=at)
    return at, still_there(additions, at), off


def _earned(
    nest: Nest, at: NestedFit, scores: Sequence[Score], alpha: float, held_out: HeldOut | None, carries: bool = False
) -> tuple[Addition | None, list[Withheld]]:
    """The best addition that flights which were not searched do not contradict, and those that they did. Where what is left
    is carried along (`carries`) these flights must speak for it and, unless it makes innovations white, errors ahead must
    fall there, clearly more than with a rival: `TRIES` tries."""
    withheld: list[Withheld] = []
    contradicted: list[Addition] = []
    while True:
        # Of a pair that failed either may stand alone.
        refused = {frozenset(w.effects) for w in withheld}
        out = {w.effects[0] for w in withheld if len(w.effects) == 1}
        found = next_addition(nest, at, [s for s in scores if s.name not in out], alpha, refused)
        if found is None or (carries and len(withheld) >= TRIES):
            return None, withheld
        doubt = carries and not _plain(at, found)
        refusal = unseen(found.after, found.effects, nest.candidates.null)
        if refusal is None and held_out is not None:
            refusal = held_out.withheld(found.before, found.after, supported=carries, nearer=doubt)
            if refusal is not None:
                contradicted.append(found)
            elif (other := stands_in(nest, found, contradicted)) is not None:
                reason = f"it adds nothing to {' and '.join(other.effects)}, which is far likelier and was withheld"
                refusal = Withheld(effects=found.effects, reason=reason)
            elif doubt and found.rivals:
                behind = _outdone(nest, at, found, held_out, refused)
                withheld += behind
                if behind:
                    continue
        if refusal is None:
            return found, withheld
        withheld.append(refusal)


def _plain(at: NestedFit, found: Addition) -> bool:
    """Whether the tests hold for an addition to `at` that carries what is left: innovations become white. Next to a lag or a
    delay all must be, or it may stand in for a filter of the IMU, whose noise is coloured."""
    late = set(TIMING) & set(found.effects)
    return all_white(found.after.fit) if late else whitens(at.fit, found.after.fit)


def _outdone(
    nest: Nest, at: NestedFit, found: Addition, held_out: HeldOut, refused: Collection[frozenset[str]]
) -> list[Withheld]:
    """The rivals of `found` with which errors ahead on flights that were not searched stay clearly larger."""
    estimates = {k: v for s in found.scores for k, v in s.estimate.items()}
    out = []
    for rival in (tuple(n.split("+")) for n in found.rivals):
        if set(rival) & set(found.effects) or frozenset(rival) in refused:
            continue
        first = {k: v for k, v in estimates.items() if k[0].split(".")[0] in rival}
        other = nest.refit((*at.effects, *rival), start=at, first=first)
        if held_out.outdoes(found.after.fit, other.fit):
            reason = f"errors ahead on flights that were not searched fall clearly more with {' and '.join(found.effects)}"
            out.append(Withheld(effects=rival, reason=reason))
    return out
