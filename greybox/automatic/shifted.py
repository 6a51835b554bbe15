"""Shifted: how far the estimates of a fit are from where they were, had the craft not changed.

What changed for good within a flight (`greybox.automatic.changed`) is bent into what the model has,
a weaker rotor into lags, dampings and inertias. The likelihood with a push that begins there and
stays, of unknown size, tells where the estimates would go without a fit (`greybox.statistics.rivals`);
so does that with other rotors from there on, whose push goes with their commands: a battery that sags
weakens all that they do. What would go further than its error allows is no measurement, and the
errors hold the way there.

What changed one flight may have changed others by less than their gusts let see: every other one is
asked for the place where such a push makes it likeliest, and keeps it where that is worth the price
of having looked everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from greybox.automatic.changed import PACE, Changed, Unnamed
from greybox.automatic.widened import HELD, moved_away, no_measurement, widened
from greybox.estimation.laplace import at_bound
from greybox.estimation.lasting_pushes import Felt, Lasting, LastingPushes
from greybox.estimation.problem import Problem
from greybox.estimation.result import Fit
from greybox.statistics.lasting import MOST, TRIM
from greybox.statistics.rivals import Parabola, likeliest, room
from greybox.symbolic import FloatArray

SIZE = 10.0
"""Of a change of the craft that is believed before, in least pushes that are worth a word."""


def with_shift(found: Fit, seen: Unnamed, changed: Sequence[Changed]) -> tuple[Fit, str]:
    """(the fit with errors that hold what is `changed` for good in its flights does to its
    estimates; which of these are no measurement, in words). As it was where nothing did, and where
    the fit is not one of innovations and their likelihood. Raises `FitError` where a prediction is
    not finite."""
    of_innovations = found.settings["predictor"] == "innovation"
    told = [c for c in changed if not c.flown]
    if not told or not of_innovations or found.settings["criterion"] != "gaussian":
        return found, ""
    asked = Asked(found=found, seen=seen, told=told)
    rivals = list(asked.rivals())
    at = _parabola(asked.lasting, [r.felt for r in rivals])
    form = likeliest(at, {f"{k}": r.price for k, r in enumerate(rivals)})
    if form is None:
        return found, ""
    rows: dict[str, list[int]] = {}
    for k, i in enumerate(at.fitted):
        rows.setdefault(found.problem.unknowns[i].name, []).append(k)
    away = moved_away(found, form.shift, rows)
    chosen = [rivals[int(n)] for n in form.causes]
    others = ", in ".join(dict.fromkeys(r.when for r in chosen if r.price))
    why = f"that, and a change in {others}, would" if others else "that would"
    held = widened(found, form.more + np.outer(form.shift, form.shift), rows)
    return held, no_measurement(away, why, HELD)


@dataclass(frozen=True, kw_only=True, eq=False)
class Rival:
    """What may last in a flight, since `when` in words. `price`: log of how many places were asked
    for it, 0 where it was told."""

    felt: Felt
    when: str
    price: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Asked:
    """What in the flights of a fit may last, given what is `told` of some of them."""

    found: Fit
    seen: Unnamed
    told: Sequence[Changed]

    @cached_property
    def problem(self) -> Problem:
        """Of the fit."""
        return self.found.problem

    @cached_property
    def lasting(self) -> LastingPushes:
        """What lasting pushes do to the innovations."""
        return LastingPushes(problem=self.problem, theta=self.found.theta)

    @cached_property
    def times(self) -> list[FloatArray]:
        """Of the samples of every record [s]."""
        return [r.segment.t[0] + r.dt * np.arange(r.n) for r in self.problem.records]

    def rivals(self) -> Iterator[Rival]:
        """Of every change that is told, then of the flights without one."""
        flights = [r.flight for r in self.problem.records]
        for c in self.told:
            for i in (k for k, f in enumerate(flights) if f == c.flight):
                if c.at is None:
                    yield from self.either(i, self.drift(i))
                elif self.times[i][0] < c.at <= self.times[i][-1]:
                    # A value of the series that told it is as long.
                    pace = max(PACE, self.times[i].size * self.problem.records[i].dt / MOST)
                    share, _, _ = self.step(i, c.at - pace, c.at + pace)
                    yield from self.either(i, share)
        others = [i for i, f in enumerate(flights) if f not in {c.flight for c in self.told}]
        if any(c.at is None for c in self.told):
            for i in others:
                yield from self.either(i, self.drift(i), len(others))
        if any(c.at is not None for c in self.told):
            steps = {i: self.step(i, *self.inner(i)) for i in others}
            places = sum(count for _, _, count in steps.values())
            for i, (share, odds, _) in steps.items():
                if odds > np.log(places):
                    yield from self.either(i, share, places)

    def drift(self, i: int) -> FloatArray:
        """Share (n,) in record i of what grows from the start of its flight to its end."""
        of_flight = [
            t
            for t, r in zip(self.times, self.problem.records, strict=True)
            if r.flight == self.problem.records[i].flight
        ]
        first, last = of_flight[0][0], of_flight[-1][-1]
        return np.asarray((self.times[i] - first) / (last - first))

    def inner(self, i: int) -> tuple[float, float]:
        """Record i without its ends [s], where a step is looked for."""
        first, last = float(self.times[i][0]), float(self.times[i][-1])
        edge = TRIM * (last - first)
        return first + edge, last - edge

    def step(self, i: int, first: float, last: float) -> tuple[FloatArray, float, int]:
        """(share (n,) of the likeliest push in record i that begins after `first` and until `last`
        [s], and stays; log of its odds; of how many)."""
        asked = np.flatnonzero((self.times[i] > first) & (self.times[i] <= last))
        push = self.pushed(i, np.zeros_like(self.times[i]))
        odds = self.lasting.log_odds_from(push)[asked]
        if not len(asked):
            return push.share, -np.inf, 0
        begin, n = asked[np.argmax(odds)], len(push.share)
        return np.where(np.arange(n) >= begin, 1.0, 0.0), float(odds.max()), len(asked)

    def either(self, i: int, share: FloatArray, places: int = 1) -> Iterator[Rival]:
        """Pushes, and other rotors, with this `share` (n,)."""
        if not share.any():
            return
        since = f"{self.times[i][int(np.argmax(share > 0))]:.1f} s on"
        what = "start to end" if np.unique(share).size > 2 else since
        for lasting in (self.pushed(i, share), self.rotors(i, share)):
            if lasting.names:
                when = f"{self.problem.records[i].flight} from {what}"
                felt = self.lasting.felt(lasting)
                yield Rival(felt=felt, when=when, price=float(np.log(places)))

    def pushed(self, i: int, share: FloatArray) -> Lasting:
        """What the craft's own parts may push without a name."""
        names = tuple(f"disturbance.{n}" for n in self.seen.names)
        sigma = np.array([SIZE * self.seen.least(n) for n in self.seen.names])
        return Lasting(record=i, names=names, sigma=sigma, share=share)

    def rotors(self, i: int, share: FloatArray) -> Lasting:
        """What rotors make of their speed, as far as it was fitted."""
        effects = self.found.model.physics.effects
        own = {"thrust", "torque"} | {e.name for e in effects if e.stage == "thrust"}
        flight = self.problem.records[i].flight
        free = [
            u
            for u in self.problem.unknowns
            if u.kind == "parameter" and u.flight in (None, flight) and u.name.split(".")[0] in own
        ]
        sigma = np.array([u.scale for u in free])
        return Lasting(record=i, names=tuple(u.name for u in free), sigma=sigma, share=share)


def _parabola(lasting: LastingPushes, pushes: Sequence[Felt]) -> Parabola:
    """The cost about the fit, with what lasts as causes, by their number. Scatter of scores says
    nothing of a place: one jump scatters as it should."""
    small, theta = lasting.problem, lasting.theta
    held = at_bound(small, theta, small.evaluate(theta))
    named = {f"{k}": each for k, each in enumerate(pushes)}
    wide, at = lasting.with_pushes(named)
    value = wide.evaluate(at)
    assert value.gradient is not None and value.data_hessian is not None
    prior = np.array([u.sigma for u in wide.unknowns]) ** -2.0
    causes, n = dict[str, range](), small.n
    for name, each in named.items():
        causes[name] = range(n, n + len(each.push.names))
        n += len(each.push.names)
    loose = np.flatnonzero(~held).tolist()
    low, high = room(at, wide.lower, wide.upper, np.arange(wide.n) < small.n)
    return Parabola.about(
        value.data_hessian, value.gradient, prior, loose, causes, low=low, high=high
    )
