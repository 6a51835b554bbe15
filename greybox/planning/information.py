"""Information: what a flight says about the parameters, through the predictor of the fit, and
choices that make it large.

The Fisher information of the innovation form (sum of J' S^-1 J and the part of the noise levels;
Ljung 1999, ch. 7 and 13) is evaluated along a noise-free closed-loop flight; initial states are
eliminated. Its inverse is the Cramer-Rao bound, which maximum likelihood reaches for long records.
D-optimal choice (Kiefer and Wolfowitz 1960, Canadian Journal of Mathematics 12; Fedorov 1972,
Theory of Optimal Experiments, ch. 3): the determinant of the information about the wanted
parameters, all others eliminated (D_s), is made large by greedy choice and exchange.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from greybox.data import Dataset
from greybox.errors import FitError
from greybox.estimation.covariance import scaled_inverse
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.identifiability import marginal_information
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import make_problem
from greybox.planning.planning_case import Estimated, PlanningCase
from greybox.statistics.evidence import CLEAR_LOG_RATIO
from greybox.symbolic import FloatArray

GAIN = 1e-3
"""Smallest gain in log determinant for which a piece is exchanged."""


@dataclass(frozen=True, kw_only=True)
class Information:
    """`matrix` (m, m) about `names`: free parameters of the model, then the logarithms of the noise
    levels."""

    names: tuple[str, ...]
    matrix: FloatArray

    def __add__(self, other: Information) -> Information:
        return Information(names=self.names, matrix=self.matrix + other.matrix)


def information(subject: Estimated, data: Dataset) -> Information:
    """Information of noise-free flights; a per-flight parameter counts as shared, as within one
    flight.

    Raises `FitError` where the predictor's numbers are not finite along the flight.
    """
    d = subject.dynamics
    problem = make_problem(
        d,
        data,
        predictor=Innovation(),
        criterion=Gaussian(),
        free=subject.free,
        values=subject.values,
        noise=subject.noise,
        shared=[p.name for p in d.parameters],
        estimate_noise=True,
    )
    value = problem.evaluate(problem.start)
    if value.data_hessian is None:
        raise FitError(
            "the predictor's numbers are not finite along the planned flight",
            fix="check the values of the effects",
        )
    initial = np.array([u.sigma**-2 if u.kind == "initial" else 0.0 for u in problem.unknowns])
    keep = [i for i, u in enumerate(problem.unknowns) if u.kind != "initial"]
    return Information(
        names=tuple(problem.unknowns[i].name for i in keep),
        matrix=marginal_information(value.data_hessian + np.diag(initial), keep),
    )


def prior(subject: Estimated, names: Sequence[str]) -> FloatArray:
    """What is known before, over `names` (m, m); nothing is known of the noise levels."""
    out = np.zeros((len(names), len(names)))
    places = [list(names).index(n) for n in subject.free]
    out[np.ix_(places, places)] = subject.precision
    return out


def errors(subject: Estimated, found: Information) -> dict[str, tuple[float, float]]:
    """Expected standard error of every free parameter: (with what is known before, from the flights
    alone).

    Infinite where nothing is said (more than a million times the size of a typical change counts as
    nothing).
    """
    place = {n: i for i, n in enumerate(found.names)}
    declared = subject.declared
    columns = []
    for h in (found.matrix + prior(subject, found.names), found.matrix):
        spread, empty = scaled_inverse(h)
        std = np.sqrt(np.maximum(np.diag(spread), 0.0))
        blind = empty | (np.diag(h) <= 0)
        columns.append(
            [
                np.inf
                if blind[place[n]] or std[place[n]] > 1e6 * declared[n].scale
                else std[place[n]]
                for n in subject.free
            ]
        )
    return {n: (float(a), float(b)) for n, a, b in zip(subject.free, *columns, strict=True)}


class Score:
    """log det of the information about the wanted parameters, all else eliminated; a vague prior
    keeps it finite.

    `known` False leaves out what is known before.
    """

    def __init__(self, subject: Estimated, names: Sequence[str], *, known: bool = True) -> None:
        declared = subject.declared
        self.scale = np.array([declared[n].scale if n in declared else 1.0 for n in names])
        self.before = np.diag((1e-2 / self.scale) ** 2) + (prior(subject, names) if known else 0.0)
        self.wanted = [i for i, n in enumerate(names) if n in subject.wanted]

    def __call__(self, matrix: FloatArray) -> float:
        """The score of an information matrix (m, m)."""
        whole = (matrix + self.before) * np.outer(self.scale, self.scale)
        rest = [i for i in range(len(whole)) if i not in self.wanted]
        value = float(np.linalg.slogdet(whole)[1])
        return value - (float(np.linalg.slogdet(whole[np.ix_(rest, rest)])[1]) if rest else 0.0)


def choose(candidates: Mapping[str, Information], count: int, score: Score) -> list[str]:
    """`count` names whose summed information scores highest (greedy, then exchange until nothing
    gains).

    No name more often than a third of `count`: a design that trusts its model entirely is worth
    little where that is wrong.
    """
    names = list(candidates)
    most = max(-(-count // 3), -(-count // len(names)))
    chosen: list[str] = []
    total = np.zeros_like(candidates[names[0]].matrix)

    def best(others: Sequence[str], rest: FloatArray) -> str:
        open_ = [n for n in names if others.count(n) < most]
        return max(open_, key=lambda n: score(rest + candidates[n].matrix))

    for _ in range(count):
        chosen.append(best(chosen, total))
        total = total + candidates[chosen[-1]].matrix
    for _ in range(10):
        moved = False
        for slot in range(count):
            rest = total - candidates[chosen[slot]].matrix
            other = best(chosen[:slot] + chosen[slot + 1 :], rest)
            if score(rest + candidates[other].matrix) > score(total) + GAIN:
                chosen[slot], total, moved = other, rest + candidates[other].matrix, True
        if not moved:
            break
    order = {n: i for i, n in enumerate(names)}
    return sorted(chosen, key=order.__getitem__)


def efficiency(subject: Estimated, better: Information, other: Information) -> float:
    """How many times as long the `other` flight would have to last for the same volume of the
    confidence region.

    (det ratio)^(1/k) of the information that the flights alone give about the k wanted parameters.
    """
    score = Score(subject, better.names, known=False)
    return float(np.exp((score(better.matrix) - score(other.matrix)) / len(score.wanted)))


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two effects: how much less likely the data are expected to be if one is true and the other is
    fitted in its place.

    `expected` is that log likelihood ratio, the less of both ways; `overlap` the share of the one's
    trace that the other can imitate, the larger of both ways; `unseen` the effects that would not
    even be told from nothing.
    """

    effects: tuple[str, str]
    overlap: float
    expected: float
    unseen: tuple[str, ...]

    @property
    def separated(self) -> bool:
        """Whether BIC is expected to differ by more than `CLEAR`."""
        return self.expected > CLEAR_LOG_RATIO

    @property
    def verdict(self) -> str:
        """In words."""
        if self.separated:
            return "separated"
        if self.unseen:
            return f"NOT separated: {' and '.join(self.unseen)} of this size would not be seen"
        return "NOT separated: they look alike on this flight"


def pairs(subject: PlanningCase, found: Information) -> list[Pair]:
    """Every pair of effects with free parameters, linearised at the values that are taken for true.

    For A true with sizes a: L = a' (H_aa - H_ab H_bb^-1 H_ba) a / 2, all other unknowns eliminated
    before (the expected log likelihood ratio; Atkinson and Fedorov 1975, Biometrika 62(1)). Against
    nothing: a' H_aa a / 2.
    """
    whole = found.matrix + prior(subject, found.names)
    place = {n: i for i, n in enumerate(found.names)}
    declared = subject.declared
    size = {n: subject.values[n] - (declared[n].null or 0.0) for n in subject.free}
    out = []
    for first, second in itertools.combinations(subject.groups, 2):
        names = [[*subject.groups[e]] for e in (first, second)]
        h = marginal_information(whole, [place[n] for ns in names for n in ns])
        cut = len(names[0])
        blocks = [np.arange(cut), np.arange(cut, len(h))]
        expected, overlap, unseen = np.inf, 0.0, []
        for effect, ns, own, other in zip(
            (first, second), names, blocks, blocks[::-1], strict=True
        ):
            a = np.array([size[n] for n in ns])
            alone = 0.5 * float(a @ h[np.ix_(own, own)] @ a)
            order = np.r_[own, other]
            left = 0.5 * float(
                a @ marginal_information(h[np.ix_(order, order)], list(range(own.size))) @ a
            )
            expected = min(expected, max(left, 0.0))
            overlap = max(overlap, float(np.clip(1 - left / alone, 0.0, 1.0)) if alone > 0 else 1.0)
            unseen += [effect] if alone <= CLEAR_LOG_RATIO else []
        out.append(
            Pair(effects=(first, second), overlap=overlap, expected=expected, unseen=tuple(unseen))
        )
    return out
