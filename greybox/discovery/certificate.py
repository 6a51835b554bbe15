"""Certificate: an e-value for every name, from flights that did not propose it.

For a structure S with the cause c and a rival R without it, and flights D1 and D2,

    E = p(D2 | S, D1) / sup over theta of p(D2 | R, theta).

If R is the truth, P(E >= 1/a) <= a in finite samples, whatever the number of parameters, at bounds,
with thresholds and delays (Wasserman, Ramdas and Balakrishnan 2020, PNAS 117(29): universal
inference). The numerator is evidence of D1 and D2 together less that of D1. Some forty unknowns
that S and R share are fitted to D2 in the denominator alone. So the e-value of a name, against its
strongest rival, is the mean of this one and of the sharper

    E = p(D2 | S, D1) / p(D2 | R, D1) / regret,

in which both sides integrate what they share over what D1 taught, as group invariance allows
(Perez-Ortiz, Lardy, de Heide and Gruenwald 2024, Annals of Statistics 52(4)), and only what R has
in the place of c is at its worst: `regret` is the supremum over D2 against the integral. Against a
rival with nothing there the sharper one counts alone; else the first, at most that without its
regret, counts as nothing where it cannot decide. For a vehicle the bound holds as well as Laplace's
approximation and the invariance do. Without D2 flights are halved: the mean of both ways is one.

The sharper one on all flights, against the prior, is a second e-value. No flight refutes a rival
with more causes or numbers, nearly the name at its worst: no regret there, as the Bayes factor is
an e-value at sizes that its prior expects (Gruenwald, de Heide and Koolen 2024, JRSS B 86(5)).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from greybox.data import Dataset
from greybox.data.halves import halves, renamed
from greybox.discovery.evidence import Fitted, Flights, Structure
from greybox.discovery.search import Rival
from greybox.estimation.prior import spread_at
from greybox.estimation.solvers.levenberg_marquardt import BEYOND
from greybox.estimation.start import Key, Start, vector
from greybox.statistics import regret as of_arrays
from greybox.statistics.betting import log_mean

_Told = tuple[tuple[float, float], tuple[float, Start]]
Instead = tuple[str, ...]
"""Causes in the place of a name."""


@dataclass(frozen=True, kw_only=True)
class Whole:
    """Of a name against a rival on all flights: log `odds` (Bayes factor), `log_e`, and of the odds
    what those that `judge` add to what was taught; less what fits may still gain."""

    odds: float
    log_e: float
    judge: float

    def refutes(self, bar: float, alpha: float) -> bool:
        """Whether the rival is, and flights that judge do not speak for it by `alpha`."""
        return self.log_e >= bar and self.judge >= np.log(alpha)


UNKNOWN = Whole(odds=-np.inf, log_e=-np.inf, judge=-np.inf)


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """Log e-values of a name against every rival that was asked (empty: dropped), the most that the
    first may be where fits behind it did not arrive, what was to be `expected` of it from how
    clear the name was, and what all flights say of the rivals."""

    name: str
    rivals: Mapping[Instead, float]
    whole: Mapping[Instead, Whole] = field(default_factory=dict)
    most: float = -np.inf
    expected: float = np.inf

    @property
    def against(self) -> Instead:
        """The strongest rival."""
        return min(self.rivals, key=self.rivals.__getitem__, default=())

    @property
    def log_e(self) -> float:
        """That against the strongest rival."""
        return self.rivals.get(self.against, -np.inf)

    def unbeaten(self, bar: float, alpha: float) -> tuple[list[Instead], list[Instead]]:
        """Rivals in the place of the name that the e-value does not beat by the `bar`: (alike,
        unlikely, for all flights refute them)."""
        near = [r for r, e in self.rivals.items() if r and e < bar]
        out = [r for r in near if self.whole.get(r, UNKNOWN).refutes(bar, alpha)]
        return [r for r in near if r not in out], out


@dataclass(frozen=True, kw_only=True, eq=False)
class Split:
    """Flights that taught (`first`), those that judge, without priors (`judge`), and `both`."""

    first: Flights
    judge: Flights
    both: Flights


def splits(train: Flights, test: Dataset | None) -> list[Split]:
    """Training against test flights where there are any, else halves of the training flights both
    ways: by flights, those of a single one by time."""
    if test is not None:
        new = renamed(test, train.data.names)
        both = train.on(train.data + new)
        return [Split(first=train, judge=train.on(new, flat=True), both=both)]
    one, other = halves(train.data)
    both = train if len(train.data.flights) > 1 else train.on(one + other)
    ways = (one, other), (other, one)
    return [Split(first=train.on(a), judge=train.on(b, flat=True), both=both) for a, b in ways]


def certificates(
    at: Fitted, rivals: Mapping[str, Sequence[Rival]], judges: Sequence[Split], bar: float
) -> dict[str, Certificate]:
    """Name -> certificate, of every name of `rivals` in the structure `at`: each of the four fits
    behind an e-value no nearer than what decides, and the e-value less what they may still gain.
    Rivals that are far behind are fitted as roughly as that allows."""
    effort, say = judges[0].both.effort, judges[0].both.say
    near, share = 4 * BEYOND * effort.rough, effort.stake / BEYOND
    asked = [(name, r) for name, rows in rivals.items() for r in rows]
    stakes = {f.structure: effort.rough for f in (at, *(r.fitted for _, r in asked))}
    for f in (r.fitted for _, r in asked if np.isfinite(r.fitted.log_evidence)):
        behind = at.log_evidence - f.log_evidence
        stakes[f.structure] = max(share * behind, effort.rough)
    found: dict[str, dict[Instead, float]] = {name: {} for name in rivals}
    reach = dict.fromkeys(rivals, -np.inf)
    tiers = stakes, dict.fromkeys(stakes, effort.rough), dict.fromkeys(stakes, 0.0)
    for k, within in enumerate(tiers):
        if asked:
            say(f"certificates: {len(asked)} rivals{', more closely' * (k > 0)}", 0.6 + 0.06 * k)
        logs = _log_es(at, [r for _, r in asked], judges, bar, within) if asked else []
        every, asked = list(zip(asked, logs, strict=True)), []
        for (name, rival), (least, most) in every:
            found[name][rival.instead] = least
            reach[name] = reach[name] if rival.instead else most
            if any(least < b + near and most >= b - near for b in (0.0, bar)):
                asked.append((name, rival))
    out = {}
    for name, rows in rivals.items():
        said = [(r.instead, _whole(at, name, r, judges)) for r in rows]
        whole = {instead: w for instead, w in said if np.isfinite(w.odds)}
        out[name] = Certificate(name=name, rivals=found[name], whole=whole, most=reach[name])
        taught = whole[()].odds - whole[()].judge if () in whole else np.inf
        if found[name].get((), bar) < bar and 0 < taught < np.inf:
            out[name] = replace(out[name], expected=taught * _more_told(at, name, judges))
    return out


def _more_told(at: Fitted, name: str, judges: Sequence[Split]) -> float:
    """Share that flights that judge add to what was told of a name; infinite for a flight's own."""
    rows = []
    for split in judges:
        first, both = (on.fit(at.structure, within=np.inf) for on in (split.first, split.both))
        theta, keys = vector(both.space, first.known), _keys(both, split, [name])
        there = replace(both, theta=theta, value=both.problem.evaluate(theta))
        valid = first.value.valid and there.value.valid
        if not valid or any(k not in first.space.index for k in keys):
            return np.inf
        old, new = (f.information([f.space.index[k] for k in keys]) for f in (first, there))
        rows.append(float(np.trace(np.linalg.solve(old, new))) / len(keys) - 1.0)
    return max(0.0, *rows)


def _whole(at: Fitted, name: str, rival: Rival, judges: Sequence[Split]) -> Whole:
    """That of a name against a rival, as far as both were fitted."""
    offered = judges[0].both.causes.offered
    own = [p for n in rival.instead for p in offered[n].parameters]
    larger = len(rival.instead) > 1 or len(own) > len(offered[name].parameters)
    rows = []
    for split in judges:
        ways = split.first, split.both
        old, new = (on.fit(at.structure, within=np.inf) for on in ways)
        before, other = (on.fit(rival.fitted.structure, within=np.inf) for on in ways)
        odds = _less(new.log_evidence - other.log_evidence, new, other)
        told = _less(odds - old.log_evidence + before.log_evidence, old, before)
        keys = [] if larger else _keys(other, split, rival.instead)
        paid = regret(None, other, keys) if keys and other.value.valid else 0.0
        rows.append((odds, odds - paid, told))
    odds, log_e, judge = (log_mean(r) for r in zip(*rows, strict=True))
    return Whole(odds=odds, log_e=log_e, judge=judge)


def certificates_beside(
    flights: Flights, written: Fitted, names: Iterable[str], judges: Sequence[Split], bar: float
) -> dict[str, Certificate]:
    """Certificates of names next to laws, of the structure `written` with both on `flights`."""
    asked = {n: (written.structure - {n}, [written.known]) for n in names}
    fits = flights.fits(list(asked.values()), [flights.effort.rough] * len(asked))
    rivals = {n: [Rival(instead=(), fitted=f)] for n, f in zip(asked, fits, strict=True)}
    return certificates(written, rivals, judges, bar)


def _log_es(
    at: Fitted,
    rivals: Sequence[Rival],
    judges: Sequence[Split],
    bar: float,
    within: Mapping[Structure, float],
) -> list[tuple[float, float]]:
    """(least, most) that the log e-value against each rival is. The first is at most the sharper
    one without its regret: where that is below the bar the supremum is not sought, nor where the
    sharper one decides, nor where there is no regret."""
    fits = {f.structure: f for f in (at, *(r.fitted for r in rivals))}
    near, half = [within[s] for s in fits], float(np.log(2))
    told: list[list[_Told]] = [[] for _ in rivals]
    for split in judges:
        pair = dict(zip(fits, _predictives(list(fits.values()), at, split, near), strict=True))
        for rows, r in zip(told, rivals, strict=True):
            rows.append(_told(pair[at.structure], pair[r.fitted.structure], r, split))
    out, strict = [], dict[int, list[float]]()
    for i, (r, rows) in enumerate(zip(rivals, told, strict=True)):
        sharp, most = (log_mean([bounds[j] for bounds, _ in rows]) for j in range(2))
        most = most if np.isfinite(most) else np.inf  # else a fit says nothing
        out.append((sharp - half if r.instead else sharp, most))
        unfit = not (r.instead or np.isfinite(sharp))  # there the supremum is all that there is
        clear = sharp >= bar + half or most < 0 or half <= sharp <= most < bar
        if unfit or (r.instead and not clear):
            strict[i] = []
    for k, split in enumerate(judges):
        now = [(rivals[i].fitted, *told[i][k][1]) for i in strict]
        asked = [(f.structure, [f.known, {**at.known, **f.known}, new]) for f, _, new in now]
        worst = split.judge.fits(asked, [within[at.structure]] * len(asked))
        for logs, fit, (_, lead, _) in zip(strict.values(), worst, now, strict=True):
            logs.append(_less(lead + fit.value.likelihood, fit))
    for i, logs in strict.items():
        out[i] = log_mean([log_mean(logs), out[i][0] + half]), out[i][1]
    return out


def _told(
    mine: tuple[Fitted, Fitted], other: tuple[Fitted, Fitted], rival: Rival, split: Split
) -> _Told:
    """Of a name against a rival on one split: logs of (the sharper e-value, the most that any may
    be), and (the lead of the name, the unknowns where both are fitted)."""
    first, both = other
    lead = mine[1].log_evidence - mine[0].log_evidence
    lost = both.log_evidence - first.log_evidence
    keys = _keys(both, split, rival.instead)
    paid = regret(first, both, keys) if keys and first.value.valid and both.value.valid else 0.0
    fits, known = (*mine, *other), {**mine[1].known, **both.known}
    most = lead - lost + sum(f.may_gain for f in fits)
    return (_less(lead - lost - paid, *fits), most), (_less(lead, *mine), known)


def _less(log_e: float, *fits: Fitted) -> float:
    """A log e-value less what its fits may still gain; -inf where a fit predicts nothing."""
    if not all(f.value.valid for f in fits) or not np.isfinite(log_e):
        return -np.inf
    return log_e - sum(f.may_gain for f in fits)


def _predictives(
    every: Sequence[Fitted], at: Fitted, split: Split, within: Sequence[float]
) -> list[tuple[Fitted, Fitted]]:
    """Structures, `at` first, on the flights that taught, and on all from where `at` ended there,
    or by as much elsewhere as `at` moved, side by side."""
    starts = [[f.known] if f is at else [f.known, {**at.known, **f.known}] for f in every]
    asked = [(f.structure, s) for f, s in zip(every, starts, strict=True)]
    first = split.first.fits(asked, within)
    old = first[0].known
    new = split.both.fit(at.structure, [at.known, old], within=within[0]).known
    moved = {k: v - old[k] for k, v in new.items() if k in old}

    def starts_of(f: Fitted, g: Fitted) -> list[Mapping[Key, float]]:
        beside = {k: v + moved.get(k, 0.0) for k, v in g.known.items()}
        return [f.known, g.known, {**new, **f.known}, {**new, **beside}]

    both = [starts_of(f, g) for f, g in zip(every, first, strict=True)]
    whole = split.both.fits([(f.structure, s) for f, s in zip(every, both, strict=True)], within)
    return list(zip(first, whole, strict=True))


def _keys(both: Fitted, split: Split, causes: Sequence[str]) -> list[Key]:
    own = {p for n in causes for p in split.both.causes.offered[n].parameters}
    return [(u.name, u.flight) for u in both.space.unknowns if u.name in own]


def regret(first: Fitted | None, both: Fitted, keys: Sequence[Key]) -> float:
    """`greybox.statistics.regret` of the unknowns `keys` of a rival, all others integrated, over
    what the fit `first` taught (None: the prior)."""
    places = [both.space.index[k] for k in keys]
    unknowns = [both.space.unknowns[i] for i in places]
    v1 = np.diag([spread_at(u, both.theta[i]) ** -2 for u, i in zip(unknowns, places)])
    theta1 = np.array([u.mean for u in unknowns])
    old = [] if first is None else [i for i, k in enumerate(keys) if k in first.space.index]
    if first is not None and old:
        before = [first.space.index[keys[i]] for i in old]
        v1[np.ix_(old, old)], theta1[old] = first.information(before), first.theta[before]
    return of_arrays.regret(both.information(places), both.theta[places], v1, theta1)
