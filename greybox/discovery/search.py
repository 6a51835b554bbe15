"""Search: from the base structure by the move that gains most evidence, until none gains any.

Moves are add, add together, drop, and, where none of these gains, the first swap that does. A cause
that is not in the base costs the logarithm of how many were offered, so that many candidates make
no name (Scott and Berger 2010, Annals of Statistics 38(5)). What is tried is heuristic.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from greybox.discovery.document import StepRow
from greybox.discovery.evidence import Fitted, Flights, Structure
from greybox.discovery.left import axis_gains
from greybox.discovery.propose import (
    Proposal,
    Scores,
    proposals,
    scored,
    sensor_proposals,
    typical,
    unfelt,
)
from greybox.discovery.rules import RULES
from greybox.estimation.start import Key
from greybox.statistics.evidence import FELT

Move = tuple[Structure, list[Mapping[Key, float]]]
"""A structure and where its fit starts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rival:
    """A structure without a cause: `instead` are those in its place (none: it is dropped)."""

    instead: tuple[str, ...]
    fitted: Fitted


@dataclass(kw_only=True, eq=False)
class Search:
    """The search on `flights`. `interim` gets what is taken; no swap is sought of a structure that
    is `hopeless` once those of so many of its causes gained nothing."""

    flights: Flights
    most: int
    say: Callable[[str, float], None]
    interim: Callable[[Fitted], None] = lambda _fit: None
    hopeless: Callable[[Fitted, int], bool] = lambda _fit, _asked: False
    steps: list[StepRow] = field(default_factory=list)
    scores: Scores | None = None
    tried: set[tuple[Structure, Structure]] = field(default_factory=set)
    taken: set[str] = field(default_factory=set)
    """Effects beyond those of the base that any structure on the way had."""
    lost: dict[tuple[Structure, Structure], bool] = field(default_factory=dict)
    """Whether what was (added, dropped) lost when last asked: that waits until nothing gains."""

    @property
    def price(self) -> float:
        """Log prior odds against one more cause."""
        return float(np.log(max(len(self.flights.causes.effects), 1)))

    def score(self, found: Fitted) -> float:
        """Log posterior of a structure, up to a constant."""
        return found.log_evidence - self.price * len(self.added(found))

    def added(self, at: Fitted) -> list[str]:
        """Effects of a structure beyond those of the base."""
        return self.named(at.structure - self.flights.causes.base)

    def named(self, structure: Iterable[str]) -> list[str]:
        """Effects of a structure, in the order of the catalogue."""
        there = set(structure)
        return [n for n in self.flights.causes.effects if n in there]

    def run(self, start: Fitted | None = None) -> Fitted:
        """The structure from which no move gains evidence, or to which one leads back."""
        at = start or self.flights.fit(self.flights.causes.base)
        self.interim(at)
        seen: set[Structure] = set()
        while at.structure not in seen:
            seen.add(at.structure)
            self.taken.update(self.added(at))
            there = ", ".join(self.named(at.structure)) or "nothing added"
            self.say(f"step {len(seen)}: {there}", min(0.05 * len(seen), 0.3))
            better = self._add(at)
            if better is not None:
                better = self._leaner(better) or better
            else:
                better = self._leaner(at, last=True) or self._swap(at)
            if better is None:
                return at
            at = better
        return at

    def every(self, at: Fitted) -> Fitted | None:
        """The structure with one more cause, each fitted: the slope at none may not promise it."""
        absent = set(self.flights.causes.effects) - at.structure
        wanted = [at.structure | {n} for n in sorted(absent) if len(self.added(at)) < self.most]
        moves: list[Move] = [(s, [at.known]) for s in wanted if self._new(at, s, True)]
        return self._best(at, self._fits(at, moves))

    def _add(self, at: Fitted) -> Fitted | None:
        """The structure with one cause or several more, noise of sensors among them."""
        scores = self._scored(at)
        # What is not felt alone can only explain what is there and has no name. What acts with
        # another only (a wind with a drag) is offered before others bend into its place.
        holds = any(needed for _, needed in axis_gains(at, self.price).values())
        silent = unfelt(scores, self.flights) if holds else []
        there = self.added(at)
        room = self.most - len(there)
        silent = [p for p in silent if len(p.causes) <= room]
        won = [added for (added, gone), lost in self.lost.items() if not (gone or lost)]
        pairs = [p for p in silent if len(p.causes) > 1 and (not there or set(p.causes) in won)]
        unscored = [typical(self.flights, n) for n in scores.unscored if room > 0]
        fits = self._tried(at, scores, unscored, pairs, room)
        for last in (unscored, silent):
            if not any(self.score(f) > self.score(at) for f in fits):
                fits += self._fits(at, self._moves(at, last), fits)
        return self._best(at, fits, scores)

    def _tried(
        self, at: Fitted, scores: Scores, unscored: list[Proposal], pairs: list[Proposal], room: int
    ) -> list[Fitted]:
        """Fits of what promises most: all that still gain next to each other, single causes and
        pairs, colour of the sensors, until what one gained is more than the next promises; and of
        `pairs` that nothing can be said of, before colour, whose fits take longest."""
        chosen = self._sensors(at)
        fits: list[Fitted] = []
        if room > 0:
            together = self._together(scores, room)
            some = [p for p in proposals(scores, self.price) if len(p.causes) <= room]
            promising = [p for p in some if self._net(p) > 0]
            chosen += ([together] if together else []) + promising[: self.flights.effort.tried]
            fits += self._fits(at, self._moves(at, unscored, last=False))
        for p in sorted(chosen, key=self._net, reverse=True):
            if not p.start:
                fits += self._fits(at, self._moves(at, pairs), fits)
            gained = max((self.score(f) - self.score(at) for f in fits), default=0.0)
            if gained > 0 and gained >= self._net(p):
                break
            fits += self._fits(at, self._moves(at, [p]), fits)
        return fits + self._fits(at, self._moves(at, pairs), fits)

    def _net(self, p: Proposal) -> float:
        """What a proposal promises, less the price of its causes."""
        return p.gain - self.price * len(self.named(p.causes))

    def _sensors(self, at: Fitted) -> list[Proposal]:
        """Colour and filters of the sensors whose innovations are not white."""
        parts, gain = sensor_proposals(at, self.flights.causes)
        self.flights.causes = self.flights.causes.with_cause(*parts)
        return [Proposal(causes=tuple(p.name for p in parts), gain=gain, start={})] if parts else []

    def _together(self, scores: Scores, room: int) -> Proposal | None:
        """All causes that still gain next to those before them, most first."""
        names: list[str] = []
        gained = 0.0
        while len(names) < min(room, self.flights.effort.together):
            more = {n: scores.gain(*names, n) for n in scores.absent if n not in names}
            best = max(more, key=lambda n: more[n], default=None)
            if best is None or more[best] - gained <= self.price:
                break
            names.append(best)
            gained = more[best]
        return scores.proposal(*names) if len(names) > 1 else None

    def _moves(self, at: Fitted, chosen: Iterable[Proposal], last: bool = True) -> list[Move]:
        wanted = [(at.structure | set(p.causes), p) for p in chosen]
        return [(s, self._starts(at, p)) for s, p in wanted if self._new(at, s, last)]

    def _new(self, at: Fitted, structure: Structure, last: bool) -> bool:
        """Whether a move was not tried yet; one that waits is new at the `last`."""
        move = (at.structure, structure)
        waits = self.lost.get(_change(at, structure), False) and not last
        if structure == at.structure or move in self.tried or waits:
            return False
        self.tried.add(move)
        return True

    def _starts(self, at: Fitted, p: Proposal) -> list[Mapping[Key, float]]:
        if not p.start:
            return [at.known]
        null, begun = self.flights.causes.prior_of, self._scored(at).begun
        zero = {k: v if (own := null(k[0])) is None else own[0] for k, v in p.start.items()}
        return [
            {**at.known, **{k: begun(k, zero[k], part * (v - zero[k])) for k, v in p.start.items()}}
            for part in self.flights.effort.shares
        ]

    def _leaner(self, at: Fitted, last: bool = False) -> Fitted | None:
        """The structure without causes that are not worth their price; None where all are."""
        found, now = None, at
        while True:
            added = now.structure - self.flights.causes.base
            doubted = [n for n in sorted(added) if self.doubted(now, n)]
            wanted: list[Move] = [
                (now.structure - {n}, [now.known])
                for n in doubted
                if self._new(now, now.structure - {n}, last)
            ]
            white = frozenset(n for n in now.structure if n in self.flights.causes.effects)
            if self._new(now, white, last):  # colour that was physics goes with it
                wanted.append((white, [now.known]))
            better = self._best(now, self._fits(now, wanted))
            if better is None:
                return found
            found = now = better

    def doubted(self, at: Fitted, name: str) -> bool:
        """Whether dropping a cause may gain: its density at none against that of its prior (Dickey
        1971, Annals of Mathematical Statistics 42(1)), with the price of a cause to spare."""
        return drop_gain(at, self.flights, name) > -3 * self.price

    def _swap(self, at: Fitted) -> Fitted | None:
        """The structure with another cause in the place of one, where that is likelier."""
        cost = {n: -drop_gain(at, self.flights, n) for n in self.added(at)}
        taken = {n: max((r[0] for r in self._scored(at).instead(n)), default=0.0) for n in cost}
        order = sorted(cost, key=lambda n: min(cost[n], (1.0 - taken[n]) * max(cost[n], 0.0)))
        asked, better = 0, None
        while better is None and asked < len(order) and not self.hopeless(at, asked):
            rivals = self._rivals(at, order[asked : 2 * asked + 1], asked / len(order))
            fits = [r.fitted for rows in rivals.values() for r in rows]
            better = self._best(at, [f for f in fits if len(self.added(f)) <= self.most])
            asked = 2 * asked + 1
        return better

    def contest(self, at: Fitted) -> dict[str, list[Rival]]:
        """Every cause of `at` beyond the base against what could take its place, and nothing."""
        return self._rivals(at, self.added(at), 1.0, frozenset(self.crowded_out(at)))

    def crowded_out(self, at: Fitted) -> list[str]:
        """Causes that would gain next to those of `at`, where these are as many as may be: in the
        place of a name they would gain for what they are."""
        scores, full = self._scored(at), len(self.added(at)) >= self.most
        return [n for n in scores.absent if full and scores.gain(n) > self.price]

    def _rivals(
        self, at: Fitted, names: Sequence[str], share: float, but: frozenset[str] = frozenset()
    ) -> dict[str, list[Rival]]:
        """Of every name; `share` of the swaps have been asked."""
        rows, asked = list[tuple[str, tuple[str, ...]]](), list[Move]()
        for name in names:
            left = at.structure - {name}
            rows.append((name, ()))
            asked.append((left, [at.known]))
            near = [r for r in self._scored(at).instead(name) if r[0] >= RULES.stand_in]
            for _, causes, p in [r for r in near if not but & set(r[1])][: RULES.rivals]:
                rows.append((name, causes))
                asked.append((left | set(causes), [self._starts(at, p)[0], at.known]))
        if names:
            self.say(f"what could stand in for {', '.join(names)}", 0.3 + 0.3 * share)
        found: dict[str, list[Rival]] = {name: [] for name in names}
        for (name, causes), fit in zip(rows, self.flights.contest(asked, at), strict=True):
            found[name].append(Rival(instead=causes, fitted=fit))
        return found

    def _scored(self, at: Fitted) -> Scores:
        """Scores of all absent effects at a fit."""
        if self.scores is None or self.scores.at is not at:
            self.scores = scored(self.flights, at)
        return self.scores

    def _fits(self, at: Fitted, moves: list[Move], others: Sequence[Fitted] = ()) -> list[Fitted]:
        """Fits of moves from `at`, held against the likeliest of `others`. What adds and gains
        nothing, and what drops and falls far behind, waits until nothing else gains."""
        fits = self.flights.contest(moves, max((at, *others), key=lambda f: f.log_evidence))
        for f in fits:
            move = _change(at, f.structure)
            spare = self.flights.effort.behind if move[1] else 0.0
            self.lost[move] = self.score(f) <= self.score(at) - spare
        return fits

    def _best(
        self, at: Fitted, found: Iterable[Fitted], scores: Scores | None = None
    ) -> Fitted | None:
        fits = [f for f in found if np.isfinite(f.log_evidence)]
        best = max(fits, key=self.score, default=None)
        gained = -np.inf if best is None else self.score(best) - self.score(at)
        if scores is not None:
            tried = [(sorted(f.structure - at.structure), f) for f in fits]
            step: StepRow = {
                "structure": self.named(at.structure),
                "log_evidence": at.log_evidence,
                "predicted": {n: scores.gain(n) for n in scores.absent},
                "tried": [{"added": n, "gain": f.log_evidence - at.log_evidence} for n, f in tried],
                "added": [n for names, f in tried if f is best and gained > 0 for n in names],
            }
            self.steps.append(step)
        if best is None or gained <= 0:
            return None
        taken = self.flights.fit(best.structure)
        self.interim(taken)
        return taken


def _change(at: Fitted, structure: Structure) -> tuple[Structure, Structure]:
    """What is (added, dropped) from a fit to a structure."""
    return structure - at.structure, at.structure - structure


def drop_gain(at: Fitted, flights: Flights, name: str) -> float:
    """Log evidence that leaving a cause out is predicted to gain (Savage and Dickey)."""
    cause = flights.causes.offered[name]
    rows = [i for i, u in enumerate(at.space.unknowns) if u.name in cause.parameters]
    if not rows or at.value.hessian is None:
        return 0.0 if rows else np.inf
    if cause.kind == "sensor noise" and (at.theta[rows] >= at.space.upper[rows]).all():
        return -np.inf  # it lasts longer than flights tell
    live = [i for i in rows if not at.held[i]]
    if not live:
        return np.inf
    told = at.information(live)
    if cause.kind == "sensor noise":  # its time constant is there, or at its bound within its error
        std = np.sqrt(np.diag(np.linalg.pinv(told, hermitian=True)))
        clear = at.theta[live] - at.space.lower[live] > FELT * std
        return -np.inf if clear.all() else 0.0
    null, sigma = np.array([cause.prior[at.space.unknowns[i].name] for i in live]).T
    off = at.theta[live] - null
    here = -0.5 * float(off @ told @ off) + 0.5 * float(np.linalg.slogdet(told)[1])
    return here + float(np.log(sigma).sum())
