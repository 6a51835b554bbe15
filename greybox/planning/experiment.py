"""Experiment: which manoeuvre tells the rivals of an ambiguous group apart, and for how long it
must be flown.

For every manoeuvre of the library that the vehicle can fly, each rival in turn is taken for the
truth and flown; the other one predicts that noise-free log. Half the sum of its squared, whitened
innovations is the expected log likelihood ratio (the Kullback-Leibler divergence of the two
predictors at equal noise; Ljung, System Identification, 2nd ed., sec. 13). The predictor that is
wrong may bend its parameters as far as the flights already flown allow: one Gauss-Newton step with
their information is taken off,

    L = e'e/2 - g' (H_manoeuvre + H_flown)^-1 g / 2.

The manoeuvre with the largest L of the worse of both directions is proposed (discrimination
designs: Atkinson and Fedorov 1975, Biometrika 62(1)). BIC 10 needs L = 5; L grows with the time
flown.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NotRequired, TypedDict

import numpy as np

from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.fit import Fit, noise_of
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import Problem, make_problem
from greybox.planning.manoeuvres import LIBRARY, SECONDS, Manoeuvre, flown_together, flying_model
from greybox.statistics.evidence import CLEAR_LOG_RATIO
from greybox.symbolic import FloatArray

OTHERS = 3
"""How many runners-up are listed."""
ROUNDED = 0.02
"""Share of what the truth itself loses that two models lose apart by the rounding of their fits."""


class ManoeuvreRow(TypedDict):
    """A manoeuvre as in discovery.json: `seconds_to_bic_10` is None where the rivals predict the
    same."""

    name: str
    text: str
    amplitude: float
    unit: str
    seconds: float
    expected_log_likelihood_ratio: float
    seconds_to_bic_10: float | None


class Manoeuvres(ManoeuvreRow):
    """The most telling one, and those that follow."""

    runners_up: NotRequired[list[ManoeuvreRow]]


@dataclass(frozen=True, kw_only=True)
class Separation:
    """What a manoeuvre is expected to say: log likelihood ratio between the truth and the nearest
    rival after `seconds`, and how long it takes to a BIC difference of 10 (infinite where the
    rivals predict the same)."""

    manoeuvre: Manoeuvre
    amplitude: float
    seconds: float
    expected: float

    @property
    def seconds_to_clear(self) -> float:
        """Time to BIC 10 [s]."""
        return (
            float("inf") if self.expected <= 0 else self.seconds * CLEAR_LOG_RATIO / self.expected
        )

    def to_dict(self) -> ManoeuvreRow:
        """As in discovery.json."""
        return {
            "name": self.manoeuvre.name,
            "text": self.manoeuvre.text,
            "amplitude": self.amplitude,
            "unit": self.manoeuvre.unit,
            "seconds": self.seconds,
            "expected_log_likelihood_ratio": self.expected,
            "seconds_to_bic_10": self.seconds_to_clear
            if np.isfinite(self.seconds_to_clear)
            else None,
        }


def separations(
    rivals: Mapping[str, Fit],
    *,
    library: Sequence[Manoeuvre] = LIBRARY,
    seconds: float = SECONDS,
    say: Callable[[str], None] | None = None,
) -> list[Separation]:
    """Every manoeuvre that all rivals can fly, the most telling first. `rivals`: name -> fit, two
    or more."""
    out = []
    known = {n: _information(f) for n, f in rivals.items()}
    flying = {n: flying_model(f.model) for n, f in rivals.items()}
    battery = all("vbat" in f.model.dynamics.inputs.names for f in rivals.values())
    flights = [(m, a) for m in library if battery or not m.needs_battery for a in m.amplitudes]
    logs = {n: flown_together(m, flights, seconds=seconds) for n, m in flying.items()}
    for i, (manoeuvre, amplitude) in enumerate(flights):
        own = {n: of[i] for n, of in logs.items()}
        if any(log is None for log in own.values()):
            continue
        if say is not None:
            say(manoeuvre.text)
        try:
            told = [
                against_truth
                for truth, log in own.items()
                if log is not None
                for against_truth in _ratios(rivals, log, known, truth)
            ]
        except GreyboxError:
            continue
        out.append(
            Separation(
                manoeuvre=manoeuvre, amplitude=amplitude, seconds=seconds, expected=min(told)
            )
        )
    return sorted(out, key=lambda s: -s.expected)


def _ratios(
    rivals: Mapping[str, Fit],
    log: Dataset,
    known: Mapping[str, Mapping[str, Mapping[str, float]]],
    truth: str,
) -> list[float]:
    """Log likelihood that each rival loses against the `truth` that flew the log, which is not
    quite its own: how a flight starts is not told. Where two differ by no more than that rounds
    they are one model in other words."""
    lost = {n: divergence(fitted, log, known[n]) for n, fitted in rivals.items()}
    own = lost.pop(truth)
    ratios = [max(v - own, 0.0) for v in lost.values()]
    rounded = min(ROUNDED * max(own, 1.0), CLEAR_LOG_RATIO / 10)
    return [r if r > rounded else 0.0 for r in ratios]


def separating_manoeuvre(
    rivals: Mapping[str, Fit],
    *,
    library: Sequence[Manoeuvre] = LIBRARY,
    seconds: float = SECONDS,
    say: Callable[[str], None] | None = None,
) -> Manoeuvres | None:
    """The most telling manoeuvre with its runners-up, as in discovery.json; None where none can be
    flown."""
    found = separations(rivals, library=library, seconds=seconds, say=say)
    if not found:
        return None
    # One amplitude of every manoeuvre is enough among the runners-up.
    best = [
        next(g)
        for _, g in itertools.groupby(
            sorted(found, key=lambda s: (s.manoeuvre.name, -s.expected)),
            key=lambda s: s.manoeuvre.name,
        )
    ]
    best.sort(key=lambda s: -s.expected)
    return {**best[0].to_dict(), "runners_up": [s.to_dict() for s in best[1 : 1 + OTHERS]]}


def divergence(fitted: Fit, log: Dataset, known: Mapping[str, Mapping[str, float]]) -> float:
    """Expected log likelihood ratio against `fitted` on a noise-free `log`; `known` is what it was
    fitted with."""
    names = [n for n in fitted.parameters if fitted.parameters[n].scope != "flight"]
    problem = make_problem(
        fitted.model.dynamics,
        log,
        predictor=Innovation(),
        criterion=Gaussian(),
        free=list(fitted.parameters),
        values=dict(fitted.model.values),
        noise=noise_of(fitted.model),
        estimate_noise=False,
        per_flight=[n for n in fitted.parameters if n not in names],
    )
    value = problem.evaluate(problem.start)
    assert value.gradient is not None
    assert value.hessian is not None
    prior = np.zeros((problem.n, problem.n))
    place = {
        u.name: i
        for i, u in enumerate(problem.unknowns)
        if u.kind == "parameter" and u.flight is None
    }
    for a, row in known.items():
        for b, h in row.items():
            if a in place and b in place:
                prior[place[a], place[b]] = h
    squared = value.likelihood - _level(problem)
    scale = np.sqrt(np.maximum(np.diag(value.hessian + prior), 1e-300))
    h = (value.hessian + prior) / np.outer(scale, scale) + 1e-9 * np.eye(problem.n)
    g = value.gradient / scale
    return max(float(squared - 0.5 * g @ np.linalg.solve(h, g)), 0.0)


def _level(problem: Problem) -> float:
    """What the cost is where every innovation is zero."""
    quiet = 0.0
    for block in problem.predictor.blocks(problem, problem.start, False):
        assert block.covariance is not None  # the innovation form gives it
        for g in range(len(block.covariance)):
            rows = np.flatnonzero(block.pattern == g)
            count, there = rows.size, block.mask[rows[:1]].any(axis=0)
            if there.any():
                _, logdet = np.linalg.slogdet(2 * np.pi * block.covariance[g][np.ix_(there, there)])
                quiet += 0.5 * count * float(logdet)
    return quiet


def _information(fitted: Fit) -> dict[str, dict[str, float]]:
    """Information of the training flights about the shared parameters, the other unknowns (noise,
    starts) projected out."""
    value = fitted.problem.evaluate(fitted.theta)
    assert value.hessian is not None
    h: FloatArray = value.hessian
    shared = [
        i
        for i, u in enumerate(fitted.problem.unknowns)
        if u.kind == "parameter" and u.flight is None
    ]
    rest = [i for i in range(len(h)) if i not in set(shared)]
    scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
    h = h / np.outer(scale, scale)
    own = h[np.ix_(shared, shared)]
    if rest:
        cross = h[np.ix_(shared, rest)]
        own = own - cross @ np.linalg.solve(
            h[np.ix_(rest, rest)] + 1e-9 * np.eye(len(rest)), cross.T
        )
    own = own * np.outer(scale[shared], scale[shared])
    names = [fitted.problem.unknowns[i].name for i in shared]
    return {
        a: dict(zip(names, row, strict=True)) for a, row in zip(names, own.tolist(), strict=True)
    }
