"""Screen: score tests of every candidate effect through the predictor, at the fit without it.

At the estimate of the smaller model the score s of a further parameter has mean zero if its null is true. With the
nuisance parameters (everything that is free already) projected out,

    s~ = s_c - H_cn H_nn^-1 s_n,   V = H_cc - H_cn H_nn^-1 H_nc,   T = s~' V^-1 s~  ~  chi^2 (Rao 1948)

and V^-1 s~ (with a minus, for a cost) is the first estimate of the parameters (Engle 1984, Handbook of Econometrics II,
ch. 13). One evaluation of the likelihood with all sensitivities serves the whole catalogue. Many effects are tested at
once and innovations are coloured, so that the largest of all statistics is calibrated by a multiplier bootstrap of the
projected scores of blocks of samples (Chernozhukov, Chetverikov and Kato 2013, Annals of Statistics 41(6)).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from greybox.discovery.burst import FEW, effective_blocks, information, overdispersion
from greybox.estimation.problem import Block, Problem, Value
from greybox.statistics.chi_square import log_tail
from greybox.symbolic import FloatArray

Key = tuple[str, str | None]
"""A parameter and, where it has one value per flight, the flight."""
DEAD = 1e-8
"""Information on a parameter, per typical size, that is the rounding of a difference: a shape (the time constant of a
memory) that is not felt where the effect is not there."""
COLLINEAR = 1e-3
"""Share of a parameter's information that must be left when the free parameters are projected out: below it only what the
vehicle file says of the free ones tells them apart. Above it the test knows what it has lost: a battery that sags by one
per cent is clear although nearly all of it looks like weaker thrust."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Score:
    """Test of one candidate. `statistic` is chi^2 with `dof` degrees of freedom in the Fisher metric, `robust` the same
    in the metric of the block scores; `p` for this test alone (robust), `p_family` for the largest of all, `limit` the `p`
    below which the largest of all passes at the level that `screen` was given. `estimate` and `std` are the one-step
    estimates by parameter and flight. `left` is the smallest share of information that the free parameters leave to a
    direction of the candidate; `judged` is false where nothing is left (collinear, or no sensitivity), `allowed` where
    every first estimate lies beyond a bound (a negative delay). `refit`: at its null the candidate has no score (nothing
    shows the velocity that it acts on), and only a refit from the size that `estimate` holds can test it. `threshold`: at
    its null it does nothing (a limit that no command reaches), and it was moved until it is felt. `burst`: it is felt in few
    blocks, which `robust` cannot exceed, and `p_family` is that of Fisher's metric (greybox.discovery.burst)."""

    name: str
    statistic: float
    robust: float
    dof: int
    p: float
    p_family: float
    estimate: Mapping[Key, float]
    std: Mapping[Key, float]
    left: float
    judged: bool
    reason: str = ""
    limit: float = 0.0
    allowed: bool = True
    refit: bool = False
    threshold: bool = False
    burst: bool = False


def screen(
    problem: Problem,
    value: Value,
    groups: Mapping[str, Sequence[str]],
    *,
    alpha: float = 0.05,
    draws: int = 999,
    seed: int = 0,
    predicted: Sequence[Block] = (),
    samples: int = 1,
) -> list[Score]:
    """Score tests of `groups` (candidate -> parameter names), best first; `alpha` sets their `limit`.

    `problem` has all of their parameters free, and `value` is its evaluation at the smaller model's estimate with block
    scores; every unknown that is in no group is a nuisance. With the predictions behind it and the `samples` of its
    blocks, candidates that are felt in few blocks are tested by `burst`. Deterministic for a seed.
    """
    assert value.gradient is not None
    assert value.hessian is not None
    assert value.scores is not None
    names = [u.name for u in problem.unknowns]
    owner = {p: g for g, ps in groups.items() for p in ps}
    nuisance = np.array([i for i, n in enumerate(names) if n not in owner], dtype=int)
    scale = np.sqrt(np.maximum(np.diag(value.hessian), 1e-300))
    h = value.hessian / np.outer(scale, scale)
    block = value.scores / scale
    prior = (value.gradient - value.scores.sum(axis=0)) / scale
    hnn = h[np.ix_(nuisance, nuisance)] + 1e-10 * np.eye(nuisance.size)
    factor = scipy.linalg.cho_factor(hnn)
    parts: dict[str, tuple[FloatArray, FloatArray, FloatArray]] = {}
    ways: dict[str, FloatArray] = {}
    out: list[Score] = []
    for group, members in groups.items():
        at = [i for i, n in enumerate(names) if n in set(members)]
        felt = {i: value.hessian[i, i] * problem.unknowns[i].scale ** 2 for i in at}
        alive = np.array([i for i in at if DEAD < felt[i] < np.inf], dtype=int)
        if not alive.size:
            out.append(_unjudged(group, "the log has no sensitivity to it"))
            continue
        cross = h[np.ix_(alive, nuisance)]
        solved = scipy.linalg.cho_solve(factor, cross.T)
        v = h[np.ix_(alive, alive)] - cross @ solved
        projected = block[:, alive] - block[:, nuisance] @ solved
        offset = prior[alive] - prior[nuisance] @ solved
        # Directions that the free parameters imitate carry no test.
        whole = h[np.ix_(alive, alive)]
        shares, directions = scipy.linalg.eigh(v, whole + 1e-12 * np.eye(alive.size))
        keep = shares > COLLINEAR
        if not keep.any():
            out.append(_unjudged(group, "collinear with the free parameters", left=float(shares.max())))
            continue
        # In these directions V is diagonal with `shares`.
        d = directions[:, keep]
        parts[group] = (projected @ d, offset @ d, shares[keep])
        ways[group] = np.zeros((len(names), d.shape[1]))
        ways[group][alive], ways[group][nuisance] = d, -solved @ d
        estimate = -(d / shares[keep]) @ (d.T @ (projected.sum(axis=0) + offset))
        spread = np.sqrt(np.maximum(np.diag((d / shares[keep]) @ d.T), 0.0))
        out.append(
            Score(
                name=group,
                statistic=0.0,
                robust=0.0,
                dof=int(keep.sum()),
                p=1.0,
                p_family=1.0,
                estimate={_label(problem, i): float(e / scale[i]) for i, e in zip(alive, estimate, strict=True)},
                std={_label(problem, i): float(s / scale[i]) for i, s in zip(alive, spread, strict=True)},
                left=float(shares[keep].min()),
                judged=True,
                threshold=any(m in problem.thresholds for m in members),
                allowed=any(_allowed(problem, i, e) for i, e in zip(alive, estimate, strict=True)),
            )
        )
    tested = _calibrated(out, parts, alpha, draws, seed)
    if not predicted or not parts:
        return tested
    told = information(predicted, np.concatenate(list(ways.values()), axis=1) / scale[:, None], samples)
    return _bursts(tested, parts, told)


def _calibrated(
    scores: list[Score],
    parts: Mapping[str, tuple[FloatArray, FloatArray, FloatArray]],
    alpha: float,
    draws: int,
    seed: int,
) -> list[Score]:
    """Fill in statistics and p values; the bootstrap multiplies block scores by independent normal numbers."""
    rng = np.random.default_rng(seed)
    count = max((len(p[0]) for p in parts.values()), default=0)
    multipliers = rng.standard_normal((draws, count))
    highest = np.zeros(draws)
    levels: dict[str, tuple[float, float, float]] = {}
    for name, (blocks, offset, shares) in parts.items():
        total = blocks.sum(axis=0) + offset
        centred = blocks - blocks.mean(axis=0)
        metric = centred.T @ centred + 1e-12 * np.diag(shares)
        # A candidate with more directions than blocks can support falls back on the Fisher metric.
        if len(blocks) < 5 * shares.size:
            metric = np.diag(shares)
        inverse = np.linalg.inv(metric)
        fisher, robust = float((total**2 / shares).sum()), float(total @ inverse @ total)
        drawn = multipliers @ centred
        statistic = np.einsum("bi,ij,bj->b", drawn, inverse, drawn)
        highest = np.maximum(highest, -log_tail(statistic, shares.size))
        levels[name] = (fisher, robust, float(-log_tail(robust, shares.size)[0]))
    limit = float(np.exp(-np.quantile(highest, 1 - alpha))) if levels else 0.0
    out = []
    for s in scores:
        if s.name not in levels:
            out.append(s)
            continue
        fisher, robust, logp = levels[s.name]
        family = float((1 + (highest >= logp).sum()) / (draws + 1))
        out.append(replace(s, statistic=fisher, robust=robust, p=float(np.exp(-logp)), p_family=family, limit=limit))
    return sorted(out, key=lambda s: (not s.judged, s.p, -s.robust))


def _bursts(
    scores: Sequence[Score], parts: Mapping[str, tuple[FloatArray, FloatArray, FloatArray]], told: FloatArray
) -> list[Score]:
    """The scores, those of candidates that few blocks feel with a p value by Fisher's metric where that is smaller."""
    ends = np.cumsum([len(p[2]) for p in parts.values()])
    own = dict(zip(parts, np.split(told, ends[:-1], axis=1), strict=True))
    few = {n for n, (_, _, shares) in parts.items() if effective_blocks(own[n], shares) < FEW}
    spread = overdispersion(
        {n: p[0] for n, p in parts.items() if n not in few}, {n: p[2] for n, p in parts.items() if n not in few}
    )
    out = []
    for s in scores:
        p = len(parts) * float(np.exp(log_tail(s.statistic / spread, s.dof)[0])) if s.name in few else np.inf
        found = p < s.p_family
        out.append(replace(s, p_family=max(p, float(np.finfo(float).tiny)), burst=True) if found else s)
    return out


def _unjudged(name: str, reason: str, left: float = 0.0) -> Score:
    return Score(
        name=name, statistic=0.0, robust=0.0, dof=0, p=1.0, p_family=1.0, estimate={}, std={}, left=left, judged=False,
        reason=reason,
    )  # fmt: skip


def unscored(name: str, estimate: Mapping[Key, float]) -> Score:
    """A candidate that only a refit can test, with the `estimate` to start from."""
    return replace(_unjudged(name, "judged by a refit"), dof=len(estimate), estimate=estimate, refit=True)


def _allowed(problem: Problem, i: int, step: float) -> bool:
    """Whether the unknown may move from its start in the direction of `step`."""
    u = problem.unknowns[i]
    return u.start < u.upper if step > 0 else u.start > u.lower


def _label(problem: Problem, i: int) -> Key:
    u = problem.unknowns[i]
    return u.name, u.flight
