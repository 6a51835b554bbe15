"""What lasts: how the innovations of a fit change with a push or a parameter that becomes another one
within a flight and stays, through the predictor.

What a steady push does to the predictor follows from the derivatives of a disturbance state, which
holds one for a while, without what decays. Its slope runs along the flight from where it begins, and
so does that of a parameter.
Where that is likeliest is told for all samples by one run backward: with what lasts as a constant
state z, of which the slope of the innovation is H_k and the transition F_k, what a push from sample
k on adds to information, score and what it shares with the other unknowns is

    M_k = H_k' S^-1 H_k + F_k' M_{k+1} F_k,   r_k = H_k' S^-1 e_k + F_k' r_{k+1},
    X_k = H_k' S^-1 J_k + F_k' X_{k+1}

in the rows of z (gains stay; the generalised likelihood ratio of Willsky and Jones 1976, IEEE
Trans. Automatic Control 21(1), with the parameters of the model along).
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from greybox.estimation.differences import Given, padded
from greybox.estimation.predictor import Block
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.prior import Prior, unknown_of
from greybox.estimation.problem import Problem, Unknown
from greybox.estimation.settling import RecordGains
from greybox.estimation.smoothing import transitions
from greybox.model.parameter import Parameter
from greybox.statistics.distributions import chi_square_quantile
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Lasting:
    """What lasts in record `record` of a problem: pushes on its disturbance states and changes of
    the parameters that were fitted, by `names`, believed within `sigma` (k,) of nothing. `share`
    (n,) is how much of them there is at every sample: 0 before a step and 1 after it, or what
    grows."""

    record: int
    names: tuple[str, ...]
    sigma: FloatArray
    share: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Felt:
    """What lasts, and the slopes (n, n_e, k) of the innovations of its record in it."""

    push: Lasting
    slopes: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _Slopes:
    """Of one record: slopes (n, n_e, n_d + k) of the innovation and transition (n, n_d + k, n_d +
    k) of the predictor's error states and of k things that last behind them."""

    seen: FloatArray
    passed: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class LastingPushes:
    """What may last in the flights of a fit in innovation form, `problem` at `theta` (n,). Every
    method raises `FitError` where a prediction is not finite."""

    problem: Problem
    theta: FloatArray
    _of_one_record: dict[tuple[int, tuple[str, ...]], _Slopes] = field(
        init=False, repr=False, default_factory=dict
    )
    """Slopes are long, and are asked for record by record."""

    @cached_property
    def blocks(self) -> Sequence[Block]:
        """Innovations of every record with their slopes."""
        return list(Innovation(piece=sys.maxsize).blocks(self.problem, self.theta, True))

    @cached_property
    def _gains(self) -> Sequence[RecordGains]:
        return Innovation().gains(self.problem, self.theta, False)

    def _slopes(self, push: Lasting) -> _Slopes:
        asked, known = (push.record, push.names), self._of_one_record
        if asked not in known:
            if any(record != push.record for record, _ in known):
                known.clear()
            gains = self._gains[push.record]
            known[asked] = _slopes(self.problem, self.theta, gains, push.record, push.names)
        return known[asked]

    def felt(self, push: Lasting) -> Felt:
        """The push with what it does to the innovations."""
        slopes, k = self._slopes(push), len(push.names)
        z = np.zeros((slopes.passed.shape[1], k))
        e = np.zeros((len(slopes.seen), slopes.seen.shape[1], k))
        for t, share in enumerate(push.share):
            z[-k:] = share * np.eye(k)
            e[t], z = slopes.seen[t] @ z, slopes.passed[t] @ z
        return Felt(push=push, slopes=e)

    def with_pushes(self, pushes: Mapping[str, Felt]) -> tuple[Problem, FloatArray]:
        """(the fit with all that lasts, by what they are called, as further unknowns, in that
        order; `theta` with these at nothing). The result can be evaluated at that point only."""
        small, blocks = self.problem, list(self.blocks)
        added: list[Unknown] = []
        for name, felt in pushes.items():
            push = felt.push
            block, k = blocks[push.record], len(push.names)
            assert block.jacobian is not None and block.covariance_slope is not None
            columns = np.concatenate([block.columns, small.n + len(added) + np.arange(k)])
            blocks[push.record] = replace(
                block,
                jacobian=np.concatenate([block.jacobian, felt.slopes], axis=2),
                covariance_slope=tuple(padded(s, columns.size) for s in block.covariance_slope),
                columns=columns,
            )
            both = zip(push.names, push.sigma.tolist(), strict=True)
            added += [_unknown(f"{name} {s}", sigma) for s, sigma in both]
        wide = replace(small, unknowns=(*small.unknowns, *added), predictor=Given(given=blocks))
        return wide, np.concatenate([self.theta, np.zeros(len(added))])

    def log_odds_from(self, push: Lasting) -> FloatArray:
        """Log odds (n,) of a push that lasts, whatever its share, from each sample of its record
        on. The unknowns of the fit go along. Where scores of most places are larger than white
        errors make them, all count for less."""
        block, sigma = self.blocks[push.record], push.sigma
        assert block.jacobian is not None and block.covariance is not None
        slopes, k, n = self._slopes(push), len(sigma), len(block.e)
        weights = np.linalg.inv(block.covariance)
        m, ns = slopes.passed.shape[1], block.columns.size
        held, told = np.zeros((m, m)), np.zeros((m, 1 + ns))
        own, other = np.zeros((n, k, k)), np.zeros((n, k, 1 + ns))
        for t in range(n - 1, -1, -1):
            h, f = slopes.seen[t], slopes.passed[t]
            weighted = h.T @ weights[block.pattern[t]]
            held = weighted @ h + f.T @ held @ f
            told = weighted @ np.column_stack([block.e[t], block.jacobian[t]]) + f.T @ told
            own[t], other[t] = held[-k:, -k:], told[-k:]
        score, across = other[:, :, 0] * sigma, other[:, :, 1:] * sigma[:, None]
        information = self.problem.evaluate(self.theta).hessian
        assert information is not None
        scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
        inner = np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-12, hermitian=True)
        inner = (inner / np.outer(scale, scale))[np.ix_(block.columns, block.columns)]
        unit = np.eye(k) + own * np.outer(sigma, sigma) - across @ inner @ across.transpose(0, 2, 1)
        gain = (score * np.linalg.solve(unit, score[:, :, None])[:, :, 0]).sum(axis=1)
        usual = float(np.median(gain)) / chi_square_quantile(0.5, k)
        return np.asarray(0.5 * (gain / max(usual, 1.0) - np.linalg.slogdet(unit)[1]))


def _slopes(
    problem: Problem, theta: FloatArray, filters: RecordGains, i: int, names: Sequence[str]
) -> _Slopes:
    errors = problem.dynamics.error_states.names
    parameters = tuple(n for n in names if f"d_{n}" not in errors)
    record, engine = problem.records[i], problem.engine.select(parameters)
    table, p = filters.tables()[0], problem.parameters_of(theta, record.flight)
    run = engine.run(
        x0=problem.start_of(theta, i)[0],
        pattern=filters.pattern,
        gains=table,
        p=p,
        want=frozenset({"states"}),
        **record.samples,
    )
    run.demand_finite(f"the prediction of flight {record.flight}")
    assert run.states is not None
    n, nd, na, k = record.n, engine.nd, len(parameters), len(names)
    start = np.repeat(np.eye(nd, na + nd, na)[None], n, axis=0)
    linear = transitions(engine, run.states, np.arange(n), record.inputs, p, record.dt, start)
    assert linear.end_sensitivity is not None and linear.sensitivity is not None
    states = [na + errors.index(f"d_{s}") for s in names if s not in parameters]
    columns = [parameters.index(s) if s in parameters else states.pop(0) for s in names]
    there = filters.there[filters.pattern] * record.mask
    order = [*range(na, na + nd), *columns]
    seen = linear.sensitivity[:, :, order] * there[:, :, None]
    passed = np.zeros((n, nd + k, nd + k))
    passed[:, :nd] = linear.end_sensitivity[:, :, order]
    for j, column in enumerate(columns):
        if column >= na:
            passed[:, column - na, nd + j] = 0.0  # the state itself holds a gust
    passed[:, :nd] += table.gain[filters.pattern] @ seen
    passed[:, nd:, nd:] = np.eye(k)
    return _Slopes(seen=seen, passed=passed)


def _unknown(name: str, sigma: float) -> Unknown:
    d = Parameter(name=name, unit="", nominal=0.0, sigma=sigma, scale=sigma)
    return unknown_of(d, 0.0, Prior(0.0, sigma))
