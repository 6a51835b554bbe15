"""Certificate: an e-value for every name, from flights that did not propose it.

For a structure S with the cause c and a rival R without it, and flights D1 and D2,

    E = p(D2 | S, D1) / sup over theta of p(D2 | R, theta).

If R is the truth, P(E >= 1/a) <= a in finite samples, whatever the number of parameters, at bounds,
with thresholds and delays (Wasserman, Ramdas and Balakrishnan 2020, PNAS 117(29): universal
inference). The numerator is evidence of D1 and D2 together less that of D1. Some forty unknowns
that S and R share (noise levels, core, biases and start of a flight) are then fitted to D2 in the
denominator alone. The e-value of a name is therefore the mean of this one and of the sharper

    E = p(D2 | S, D1) / p(D2 | R, D1) / regret,

in which both sides integrate what they share over what D1 taught, as group invariance allows
(Perez-Ortiz, Lardy, de Heide and Gruenwald 2024, Annals of Statistics 52(4)), and only what R has
in the place of c is taken at its worst: `regret` is the supremum over D2 against the integral.
Where the sharper one decides, or the first cannot (it is at most the sharper one without its
regret), the first is not worked out, and counts as nothing. Evidence is Laplace's approximation and
the invariance that of a linear model, so that for a vehicle the bound holds as well as these do,
and not in finite samples. The e-value of a name is that against its strongest rival. Without D2
flights are halved, and the mean of both ways is an e-value, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from greybox.data import Dataset
from greybox.data.halves import halves, renamed
from greybox.discovery.evidence import Fitted, Flights, Key
from greybox.discovery.search import Rival
from greybox.estimation.solvers.levenberg_marquardt import BEYOND
from greybox.statistics import regret as of_arrays
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """`log_e` of a name against its strongest rival, `against` (empty: dropped), and against every
    rival that was asked."""

    name: str
    log_e: float
    against: tuple[str, ...]
    rivals: Mapping[tuple[str, ...], float]
    evidence: Mapping[tuple[str, ...], float] = field(default_factory=dict)
    """Rival -> its log evidence on the flights that taught, less that of the name: even-handed,
    where the e-value is against the name."""

    def beaten(self, bar: float) -> bool:
        """Whether every rival is beaten by the `bar`."""
        return self.log_e >= bar

    def alike(self, bar: float) -> list[tuple[str, ...]]:
        """Rivals that take the place of the name and are not beaten by the `bar`."""
        return [r for r, e in self.rivals.items() if r and e < bar]


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
    behind an e-value no nearer than what decides, and the e-value less what they may still gain."""
    effort = judges[0].both.effort
    near, share = 4 * BEYOND * effort.rough, effort.stake / BEYOND
    every = [r.fitted for rows in rivals.values() for r in rows]
    stakes = {f.structure: effort.rough for f in every}
    for f in (r.fitted for rows in rivals.values() for r in rows if not r.instead):
        behind = at.log_evidence - f.log_evidence  # of others a regret rests on where they are
        stakes[f.structure] = max(share * behind, effort.rough) if behind < np.inf else effort.rough
    for split in judges:
        _predictives([at, *every], at, split, [effort.rough, *(stakes[f.structure] for f in every)])
    out = {}
    for name, rows in rivals.items():
        found: dict[tuple[str, ...], float] = {}
        for rival in rows:
            for within in (stakes[rival.fitted.structure], effort.rough, 0.0):
                least, most = _log_e(at, rival, judges, bar, within)
                if not any(least < b + near and most >= b - near for b in (0.0, bar)):
                    break
            found[rival.instead] = least
        strongest = min(found, key=lambda r: found[r], default=())
        log_e = found[strongest] if found else -np.inf
        evidence = {r.instead: r.fitted.log_evidence - at.log_evidence for r in rows}
        out[name] = Certificate(
            name=name, log_e=log_e, against=strongest, rivals=found, evidence=evidence
        )
    return out


def certificates_beside(
    flights: Flights, written: Fitted, names: Iterable[str], judges: Sequence[Split], bar: float
) -> dict[str, Certificate]:
    """Certificates of names next to laws: `written` is the structure on `flights` with both, and
    its rivals are those without a name."""
    rivals, rough = {}, flights.effort.rough
    for name in names:
        without = flights.fit(written.structure - {name}, [written.known], within=rough)
        rivals[name] = [Rival(instead=(), share=0.0, fitted=without)]
    return certificates(written, rivals, judges, bar)


def _log_e(
    at: Fitted, rival: Rival, judges: Sequence[Split], bar: float, within: float
) -> tuple[float, float]:
    """(least, most) that the log e-value against one rival is. A supremum is at least the mean over
    what was taught, so that the first e-value is at most the sharper one without its regret: where
    that is below the bar the supremum is not sought, nor where the sharper one decides."""
    told, most, gained = [], [], []
    rough = judges[0].both.effort.rough
    for split in judges:
        mine, other = _predictives([at, rival.fitted], at, split, [min(within, rough), within])
        first, both = other
        lead = mine[1].log_evidence - mine[0].log_evidence
        lost = both.log_evidence - first.log_evidence
        keys = _keys(both, split, rival.instead)
        paid = regret(first, both, keys) if keys and first.value.valid and both.value.valid else 0.0
        told.append(_less(lead - lost - paid, *mine, *other))
        most.append(lead - lost + sum(f.may_gain for f in (*mine, *other)))
        gained.append((_less(lead, *mine), {**mine[1].known, **other[1].known}))
    sharp, highest = _mean(told), _mean(most)
    highest = highest if np.isfinite(highest) else np.inf  # else a fit says nothing
    if sharp >= bar + np.log(2) or highest < 0 or (highest < bar and sharp >= np.log(2)):
        return sharp - float(np.log(2)), highest
    known, structure = rival.fitted.known, rival.fitted.structure
    logs = []
    for split, (lead, new) in zip(judges, gained, strict=True):
        starts = [known, {**at.known, **known}, new]
        worst = split.judge.fit(structure, starts, within=min(within, rough))
        logs.append(_less(lead + worst.value.likelihood, worst))
    return _mean([_mean(logs), sharp]), highest


def _less(log_e: float, *fits: Fitted) -> float:
    """A log e-value less what its fits may still gain; -inf where a fit predicts nothing."""
    if not all(f.value.valid for f in fits) or not np.isfinite(log_e):
        return -np.inf
    return log_e - sum(f.may_gain for f in fits)


def _mean(logs: Sequence[float]) -> float:
    """Log of the mean of numbers that are given by their logarithms."""
    return float(np.logaddexp.reduce(logs) - np.log(len(logs)))


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
    return [(u.name, u.flight) for u in both.problem.unknowns if u.name in own]


def regret(first: Fitted, both: Fitted, keys: Sequence[Key]) -> float:
    """`greybox.statistics.regret` of the unknowns `keys` of a rival, all others integrated."""
    v, theta = _information(both, keys)
    there = {(u.name, u.flight) for u in first.problem.unknowns}
    old = [i for i, k in enumerate(keys) if k in there]
    unknowns = [both.problem.unknowns[both.problem.index[k]] for k in keys]
    v1 = np.diag([1.0 / u.sigma**2 for u in unknowns])
    theta1 = np.array([u.mean for u in unknowns])
    if old:
        v1[np.ix_(old, old)], theta1[old] = _information(first, [keys[i] for i in old])
    return of_arrays.regret(v, theta, v1, theta1)


def _information(fitted: Fitted, keys: Sequence[Key]) -> tuple[FloatArray, FloatArray]:
    """Information on some unknowns with all others integrated out, and their estimates."""
    assert fitted.value.hessian is not None
    places = [fitted.problem.index[k] for k in keys]
    rest = [i for i in range(fitted.problem.n) if i not in set(places) and not fitted.held[i]]
    return of_arrays.information_on(fitted.value.hessian, places, rest), fitted.theta[places]
