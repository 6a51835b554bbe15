"""Propose: what the flights would gain in evidence by every absent cause, to second order.

One run of the filter per parameter gives the score s and the information V of all absent causes at
the fit of a structure, with everything that is free projected out (Rao 1948). With a Gaussian prior
of precision L about absence, the estimate is -(V + L)^-1 s, the gain s' (V + L)^-1 s / 2
- log det(I + V L^-1) / 2: the whole truth for a linear model. A proposal decides nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from threadpoolctl import threadpool_limits

from greybox.discovery.cause import Cause, Causes, sensor_cause
from greybox.discovery.evidence import Fitted, Flights
from greybox.discovery.rules import RULES
from greybox.estimation.differences import with_candidate_sensitivities
from greybox.estimation.start import Key
from greybox.model.layer import physics_of
from greybox.model.noise import Coloured, LowPass, SensorPart
from greybox.model.noise.low_pass import FILTERED
from greybox.statistics.regret import projected
from greybox.symbolic import FloatArray
from greybox.validation.whiteness import whiteness_of_blocks

BODY = ("position", "velocity", "attitude", "rate")
"""States of the rigid body, by the beginning of their names."""
CLEARLY = 5.0
"""Log evidence by which a pair must stand in for a cause better than its members to be tried."""
LAGS = 25
"""Lags of the autocorrelation that are looked at for colour, which is never a name."""
LEVEL = 0.01
"""Level, over all channels, at which one counts as not white."""
DEAD = 1e-8
"""Information on a parameter, per typical size, that is the rounding of a difference."""


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """Causes to add together, what they would gain in log evidence, and where to start."""

    causes: tuple[str, ...]
    gain: float
    start: dict[Key, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Scores:
    """Score and information of parameters of causes at a fit, all other unknowns projected out.

    Everything is in units of the prior's standard deviation: `score` (m,), `information` (m, m),
    `null` (m,), `sigma` (m,), `lower` and `upper` (m,) the bounds; `keys` the unknowns, `places`
    those of every cause. `value` (m,) is where the fit stands: those of causes that it has come
    after the `absent` ones.
    """

    at: Fitted
    keys: tuple[Key, ...]
    score: FloatArray
    information: FloatArray
    sigma: FloatArray
    null: FloatArray
    value: FloatArray
    lower: FloatArray
    upper: FloatArray
    places: dict[str, tuple[int, ...]]
    absent: tuple[str, ...]
    readings: int = 0
    """Readings of all sensors that were foretold."""
    least: Mapping[Key, float] = field(default_factory=dict)
    """Sizes below which nothing is felt of a parameter (a limit that no command reaches)."""
    unscored: tuple[str, ...] = ()
    """Causes that bring a motion which the fit does not have (a velocity that nothing measures):
    their score would be that of a state that nobody holds, and only a fit can tell."""

    def _rows(self, names: Iterable[str]) -> list[int]:
        rows = [i for n in names for i in self.places.get(n, ())]
        return [i for i in rows if self.information[i, i] > DEAD]

    def _apart(self, gone: Collection[str] = ()) -> tuple[FloatArray, FloatArray]:
        """Information and score, causes of the fit projected out but `gone` and those at bounds."""
        there = [i for n in self.places if n not in (*self.absent, *gone) for i in self.places[n]]
        there = [i for i in there if self.lower[i] < self.value[i] < self.upper[i]]
        near = self.information[there]
        moved = np.linalg.solve(near[:, there] + np.eye(len(there)), near)
        return self.information - near.T @ moved, self.score - moved.T @ self.score[there]

    def felt(self, name: str) -> bool:
        """Whether the flights have any sensitivity to a cause."""
        return bool(self._rows([name]))

    def solved(self, names: Iterable[str]) -> tuple[FloatArray, list[int], float]:
        """(estimate in prior units, its rows, gain in log evidence) of absent causes together."""
        rows, (information, score) = self._rows(names), self._apart()
        while rows:
            m = information[np.ix_(rows, rows)] + np.eye(len(rows))
            s = score[rows]
            estimate = -np.linalg.solve(m, s)
            low, high = self.null[rows] <= self.lower[rows], self.null[rows] >= self.upper[rows]
            beyond = np.where(estimate < 0, low, high)  # what would run through a bound
            if not beyond.any():
                _, logdet = np.linalg.slogdet(m)
                gain = float(-0.5 * s @ estimate - 0.5 * logdet)
                return np.asarray(estimate, dtype=float), rows, gain
            rows = [i for i, out in zip(rows, beyond, strict=True) if not out]
        return np.zeros(0), [], 0.0

    def gain(self, *names: str) -> float:
        """Predicted gain in log evidence of absent causes together."""
        return self.solved(names)[2]

    def proposal(self, *names: str) -> Proposal:
        """Absent causes with their first estimate."""
        estimate, rows, gain = self.solved(names)
        start = {self.keys[i]: float(self.null[i]) for n in names for i in self.places[n]}
        for e, i in zip(estimate, rows, strict=True):
            start[self.keys[i]] = float(
                np.clip(self.null[i] + self.sigma[i] * e, self.lower[i], self.upper[i])
            )
        return Proposal(causes=tuple(names), gain=gain, start=start)

    def begun(self, key: Key, null: float, step: float) -> float:
        """Where a fit begins, a `step` from none: no slope leads to where it is felt first."""
        return null + float(np.sign(step)) * max(abs(step), self.least.get(key, 0.0))

    def smallest(self, name: str, bar: float, share: float) -> dict[str, float]:
        """Per parameter of an absent cause, the size that is certain and worth a name: its expected
        log e-value is `bar` on flights with `share` of the information of these, and it is no trace
        of one reading, let alone ahead. Sizes beyond a bound are left out."""
        out, (information, _) = {}, self._apart()
        for i in self._rows([name]):
            whole = float(information[i, i])
            v = share * whole
            certain = np.sqrt((2 * bar + np.log1p(v)) * (v + 1)) / v
            size = float(self.sigma[i]) * max(certain, np.sqrt(RULES.trace * self.readings / whole))
            size = max(size, self.least.get(self.keys[i], 0.0))
            room = max(self.upper[i] - self.null[i], self.null[i] - self.lower[i])
            if np.isfinite(size) and size <= room:
                out[self.keys[i][0]] = size
        return out

    def instead(self, gone: str) -> list[Instead]:
        """For a cause that is present: (share of what its absence costs that they take over, names,
        first estimate) of absent causes, alone and in pairs, most first."""
        own, (information, score) = self._rows([gone]), self._apart([gone])
        if not own:
            return []
        move = (self.null[own] - self.value[own]) / self.sigma[own]
        push = information[:, own] @ move
        cost = 0.5 * float(move @ push[own])
        found: dict[tuple[str, ...], tuple[float, Proposal]] = {}

        def ask(names: tuple[str, ...]) -> float:
            rows = self._rows(names)
            if not rows or cost <= 0:
                return 0.0
            v = information[np.ix_(rows, rows)] + np.eye(len(rows))
            s = push[rows] + score[rows]
            estimate = -np.linalg.solve(v, s)
            ends = self.null[rows] + self.sigma[rows] * estimate
            inside = np.clip(ends, self.lower[rows], self.upper[rows])
            step = (inside - self.null[rows]) / self.sigma[rows]
            recovered = float(-s @ step - 0.5 * step @ v @ step)
            start = {self.keys[i]: float(e) for i, e in zip(rows, inside, strict=True)}
            found[names] = recovered / cost, Proposal(causes=names, gain=recovered, start=start)
            return recovered / cost

        singles = {n: ask((n,)) for n in self.absent}
        best = sorted(singles, key=lambda n: -singles[n])
        for a, b in itertools.combinations(best, 2):
            ask((a, b))
        rows = []
        for names, (share, p) in found.items():
            alone = max((singles[n] for n in names), default=0.0)
            # A pair counts where it closes half of what the better of both leaves, and clearly.
            if len(names) == 1 or share - alone > max(0.5 * (1 - alone), CLEARLY / cost):
                rows.append((share, names, p))
        return _members_first(sorted(rows, key=lambda row: (-row[0], len(row[1]))), singles)


Instead = tuple[float, tuple[str, ...], Proposal]


def _members_first(rows: Sequence[Instead], singles: Mapping[str, float]) -> list[Instead]:
    """The same rows, before each pair those of its members that take over enough alone: what the
    straight line says of a large delay leaves room for any partner, and the fit does not."""
    alone = {names[0]: row for row in rows if len(names := row[1]) == 1}
    ordered: dict[tuple[str, ...], Instead] = {}
    for row in rows:
        for name in sorted(row[1], key=lambda n: -singles[n]):
            if singles[name] >= RULES.stand_in:
                ordered.setdefault((name,), alone[name])
        ordered.setdefault(row[1], row)
    return list(ordered.values())


def scored(flights: Flights, at: Fitted) -> Scores:
    """Scores of all absent effects at the fit `at`. Raises `FitError` where it predicts nothing."""
    causes = flights.causes
    gone = [n for n in causes.effects if n not in at.structure]
    unscored = [n for n in gone if _brings_motion(flights, at, n)]
    absent = [n for n in gone if n not in unscored]
    null = {p: causes.offered[n].prior[p][0] for n in absent for p in causes.offered[n].parameters}
    late = {n for n in absent if causes.offered[n].early}
    near = causes.built(sorted({*at.structure, *absent} - late))
    whole = causes.built(sorted({*at.structure, *absent}))
    with threadpool_limits(limits=1):
        problem, theta = with_candidate_sensitivities(
            at.problem,
            at.theta,
            near,
            flights.data,
            null,
            per_flight=causes.per_flight,
            apart=whole if late else None,
        )
        value = problem.evaluate(theta)
    assert value.gradient is not None and value.data_hessian is not None
    unknowns = problem.unknowns
    owner = {p: n for n, c in causes.offered.items() for p in c.parameters}
    mine = {
        n: tuple(i for i, u in enumerate(unknowns) if owner.get(u.name) == n)
        for n in (*absent, *sorted(at.structure & set(causes.effects)))
    }
    chosen = [i for rows in mine.values() for i in rows]
    # Of what the fit has, bounds hold some: they do not move.
    held = {*chosen, *np.flatnonzero(at.held).tolist()}
    rest = [i for i in range(problem.n) if i not in held]
    own = [causes.prior_of(u.name) for u in unknowns]
    prior = np.array([u.sigma if o is None else o[1] for u, o in zip(unknowns, own, strict=True)])
    h = value.data_hessian + np.diag(np.where(np.isfinite(prior), prior, np.inf) ** -2.0)
    v, s = projected(h, value.gradient, chosen, rest)
    sigma = prior[chosen]
    place = {i: k for k, i in enumerate(chosen)}
    return Scores(
        at=at,
        keys=tuple((unknowns[i].name, unknowns[i].flight) for i in chosen),
        score=s * sigma,
        information=v * np.outer(sigma, sigma) - np.eye(len(chosen)),
        sigma=sigma,
        null=np.array([o[0] for i in chosen if (o := own[i]) is not None]),
        value=theta[chosen],
        lower=np.array([unknowns[i].lower for i in chosen]),
        upper=np.array([unknowns[i].upper for i in chosen]),
        places={n: tuple(place[i] for i in rows) for n, rows in mine.items()},
        absent=tuple(absent),
        readings=sum(int(np.count_nonzero(r.mask)) for r in problem.records),
        least=problem.thresholds,
        unscored=tuple(unscored),
    )


def _brings_motion(flights: Flights, at: Fitted, name: str) -> bool:
    """Whether a cause brings states of the rigid body that the fit does not have."""
    have = set(at.problem.dynamics.states.names)
    if {n.split(".")[0] for n in have} >= set(BODY):
        return False
    more = set(flights.causes.built(sorted({*at.structure, name})).states.names) - have
    return any(n.split(".")[0] in BODY for n in more)


def typical(flights: Flights, *names: str) -> Proposal:
    """Causes with a fit from their typical size as the only test."""
    prior = [p for n in names for p in flights.causes.offered[n].prior.items()]
    start: dict[Key, float] = {(p, None): at + sigma / RULES.typical for p, (at, sigma) in prior}
    return Proposal(causes=names, gain=0.0, start=start)


def proposals(scores: Scores, price: float) -> list[Proposal]:
    """Single causes and pairs, those that promise most first. A pair is proposed where it promises
    more than its members alone: each leaves room for the other only."""
    single = {n: scores.gain(n) for n in scores.absent if scores.felt(n)}
    out = [scores.proposal(n) for n, gain in single.items() if gain > 0]
    for a, b in itertools.combinations(single, 2):
        both = scores.gain(a, b)
        if both - price > max(single[a], 0.0) + max(single[b], 0.0):
            out.append(scores.proposal(a, b))
    return sorted(out, key=lambda p: -(p.gain - price * len(p.causes)))


def unfelt(scores: Scores, flights: Flights) -> list[Proposal]:
    """Causes that nothing can be said of alone, with what makes them felt: a wind with a drag, a
    drag where no velocity is measured. They start from their typical size."""
    there = scores.at.structure
    out = []
    for name in scores.absent:
        cause = flights.causes.offered[name]
        if scores.felt(name) or there & set(cause.needs):
            continue
        partners = [n for n in cause.needs if n in scores.absent]
        if not partners and cause.needs:
            continue
        best = max(partners, key=lambda n: scores.gain(n), default=None)
        names = (name,) if best is None else (best, name)
        begins = typical(flights, *names)
        if best is not None:
            begins.start.update({(p, None): null for p, (null, _) in cause.prior.items()})
        out.append(begins)
    return out


def sensor_proposals(at: Fitted, causes: Causes) -> tuple[list[Cause], float]:
    """(colour of every sensor whose innovations are clearly not white, and a low-pass of those that
    firmware filters; log likelihood that they promise together: what the channels' own past tells).
    What is not felt goes again; none where all are white."""
    physics = physics_of(at.problem.dynamics)
    if physics is None:  # nothing is known of the sensors of a model of the user's own
        return [], 0.0
    names = at.problem.dynamics.innovations.names
    tested = whiteness_of_blocks(
        at.problem.predictor.blocks(at.problem, at.theta, False), names, max_lag=LAGS
    )
    parts: list[SensorPart] = []
    gain = 0.0
    for sensor in physics.sensors:
        own = [s.name for s in sensor.innovation_signals(physics.vehicle)]
        told = [tested[n] for n in own if n in tested]
        clear = [c.predictable for c in told if c.test.p_value < LEVEL / len(tested)]
        if max(clear, default=0.0) > RULES.colour:
            more: list[SensorPart] = [Coloured(sensor=sensor.name)]
            # Where the clocks of gyro and attitude wander nothing tells how late a filter is.
            if sensor.name in FILTERED and not physics.kinematic_noise:
                more.append(LowPass(sensor=sensor.name))
            if new := [p for p in more if p.name not in at.structure]:
                parts += new
                gain -= sum(0.5 * c.n * np.log1p(-c.predictable) for c in told)
    return [sensor_cause(p, causes.model) for p in parts], gain
