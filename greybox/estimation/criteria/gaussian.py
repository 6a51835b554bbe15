"""Gaussian likelihood of the innovations, with log det: cost = 1/2 sum (e' S^-1 e + log det S + n
log 2 pi).

Where the predictor gives S, its dependence on the unknowns is part of the gradient, and the Hessian
is the Fisher information, sum J' S^-1 J + 1/2 tr(S^-1 dS S^-1 dS) (Astrom 1980, Automatica 16(5);
Jategaonkar 2015, ch. 5). Where it does not, S is diagonal and concentrated out: sigma_i^2 = mean of
e_i^2 over all records.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from greybox.estimation.predictor import Block
from greybox.estimation.solver import IndexArray, Value
from greybox.symbolic import FloatArray

if TYPE_CHECKING:
    from greybox.estimation.problem import Problem

LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True, kw_only=True)
class Gaussian:
    """Maximum likelihood for Gaussian innovations; members with another loss override `loss`."""

    name: str = "gaussian"

    def loss(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(rho(z), rho'(z)/z) for whitened residuals; here z^2/2 and 1."""
        return 0.5 * z * z, np.ones_like(z)

    def variances(self, blocks: list[Block]) -> FloatArray:
        """Concentrated variance per channel (n_e,), 1 where a channel is never measured."""
        total = sum((b.e * b.e).sum(axis=0) for b in blocks)
        count = sum(b.mask.sum(axis=0) for b in blocks)
        return np.where(count > 0, np.maximum(total / np.maximum(count, 1), 1e-300), 1.0)

    def evaluate(
        self, problem: Problem, blocks: Iterable[Block], order: int, scores: int | None
    ) -> Value:
        """Sum over all records; blocks that bring their covariance are looked at once, in order,
        and not kept."""
        rest = iter(blocks)
        first = next(rest, None)
        blocks = rest if first is None else itertools.chain([first], rest)
        if first is not None and first.covariance is None and first.variance is None:
            blocks = list(blocks)
            if any(b.group is not None for b in blocks):
                return self._grouped(problem, blocks, order, scores)
            blocks = [
                weighted(b, variance) for variance in [self.variances(blocks)] for b in blocks
            ]
        n = problem.n
        cost = 0.0
        gradient, hessian = np.zeros(n), np.zeros((n, n))
        rows: list[FloatArray] = []

        def part_of(
            b: Block,
        ) -> tuple[IndexArray, tuple[float, FloatArray, FloatArray, FloatArray]]:
            with np.errstate(
                over="ignore", invalid="ignore", divide="ignore"
            ):  # does not reach threads from outside
                return b.columns, self.of_block(
                    b, order, scores
                )  # not the block: its sensitivities are large

        for columns, part in problem.map_blocks(part_of, blocks) if order else map(part_of, blocks):
            cost += part[0]
            if order:
                gradient[columns] += part[1]
                hessian[np.ix_(columns, columns)] += part[2]
                if scores is not None:
                    wide = np.zeros((len(part[3]), n))
                    wide[:, columns] = part[3]
                    rows.append(wide)
        if not order:
            return Value(cost=cost, likelihood=cost)
        return Value(
            cost=cost,
            likelihood=cost,
            gradient=gradient,
            hessian=hessian,
            scores=np.concatenate(rows) if rows else None,
        )

    def _grouped(
        self, problem: Problem, blocks: list[Block], order: int, scores: int | None
    ) -> Value:
        """Rows in groups (horizons), each with its own concentrated variances; groups of one window
        share its score. Scores cost nothing here, and come unasked."""
        n, scores = problem.n, scores or problem.score_block
        cost = 0.0
        gradient, hessian = np.zeros(n), np.zeros((n, n))
        tables: list[FloatArray] = []
        groups = sorted({int(g) for b in blocks if b.group is not None for g in np.unique(b.group)})
        parts = [[_rows(b, g) for g in groups] for b in blocks]
        variances = [self.variances([p[j] for p in parts]) for j in range(len(groups))]
        for b, members in zip(blocks, parts, strict=True):
            windows = max(1, round(scores / b.spacing))  # samples to windows
            table = np.zeros((0, n))
            for part, variance in zip(members, variances, strict=True):
                spread = np.where(part.mask != 0, variance, 1.0)
                c, g_, h_, t_ = self._decorrelated(replace(part, variance=spread), order, windows)
                cost += b.weight * c
                if order:
                    gradient[b.columns] += b.weight * g_
                    hessian[np.ix_(b.columns, b.columns)] += b.weight * h_
                    wide = np.zeros((max(len(t_), len(table)), n))
                    wide[: len(table)] = table
                    wide[: len(t_), b.columns] += b.weight * t_
                    table = wide
            tables.append(table)
        if not order:
            return Value(cost=cost, likelihood=cost)
        return Value(
            cost=cost,
            likelihood=cost,
            gradient=gradient,
            hessian=hessian,
            scores=np.concatenate(tables),
        )

    def _decorrelated(
        self, b: Block, order: int, scores: int | None
    ) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """As `_block` for residuals with a variance of their own per sample and channel."""
        assert b.variance is not None
        (n, ne), ns = b.e.shape, b.columns.size
        root = np.sqrt(b.variance)
        z = b.e / root
        rho, weight = self.loss(z)
        cost = 0.5 * LOG_2PI * float(b.mask.sum()) + float(rho.sum()) + float(np.log(root).sum())
        size = scores or n
        table = np.zeros((-(-n // size), ns))
        if not order:
            return cost, np.zeros(ns), np.zeros((ns, ns)), table
        assert b.jacobian is not None
        jz = b.jacobian / root[:, :, None]
        flat = (jz * np.sqrt(weight)[:, :, None]).reshape(n * ne, ns)
        per_sample = np.einsum("nis,ni->ns", jz, weight * z)
        if b.variance_slope is None:
            np.add.at(table, np.arange(n) // size, per_sample)
            return cost, per_sample.sum(axis=0), flat.T @ flat, table
        half = (0.5 * b.variance_slope / b.variance[:, :, None]).reshape(n * ne, ns)  # d ln(root)
        there = b.mask != 0
        per_sample -= np.einsum("nis,ni->ns", half.reshape(n, ne, ns), weight * z * z - there)
        np.add.at(table, np.arange(n) // size, per_sample)
        return cost, per_sample.sum(axis=0), flat.T @ flat + 2.0 * half.T @ half, table

    def of_block(
        self, b: Block, order: int, scores: int | None
    ) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """(cost, gradient (n_s,), Hessian (n_s, n_s), scores) of one record that brings its
        covariance, in its own columns."""
        if b.variance is not None:
            return self._decorrelated(b, order, scores)
        assert b.covariance is not None
        n, ns = b.e.shape[0], b.columns.size
        cost = 0.5 * LOG_2PI * float(b.mask.sum())
        gradient, hessian = np.zeros(ns), np.zeros((ns, ns))
        size = scores or n
        count = -(-n // size)
        table = np.zeros((count, ns))
        for g in range(b.covariance.shape[0]):
            at = np.flatnonzero(b.pattern == g)
            if not at.size:
                continue
            root = np.linalg.cholesky(b.covariance[g])
            inverse = np.linalg.inv(root)
            rows = _evenly(at)
            z = b.e[rows] @ inverse.T
            rho, weight = self.loss(z)
            cost += float(rho.sum()) + at.size * float(np.log(np.diag(root)).sum())
            if not order:
                continue
            assert b.jacobian is not None
            jz = np.matmul(inverse, b.jacobian[rows])
            pull = weight * z
            plain = bool((weight == 1).all())
            flat = (jz if plain else jz * np.sqrt(weight)[:, :, None]).reshape(-1, ns)
            hessian += flat.T @ flat
            flat_m = None
            k = 0
            if b.covariance_slope is not None:
                m = inverse @ b.covariance_slope[g] @ inverse.T  # (n_k, n_e, n_e)
                k = len(m)
                flat_m = m.reshape(k, -1)
                hessian[:k, :k] += 0.5 * at.size * flat_m @ flat_m.T
                # dL = L (lower triangle of m, half its diagonal); for the Gaussian loss both
                # triangles add up to m / 2.
                half = (
                    0.5 * flat_m
                    if plain
                    else (np.tril(m, -1) + 0.5 * m * np.eye(m.shape[1])).reshape(k, -1)
                )
            there = np.diag((b.mask[at[0]] != 0).astype(float))
            if scores is None:
                gradient += jz.reshape(-1, ns).T @ pull.ravel()
                if flat_m is not None:
                    gradient[:k] -= half @ (pull.T @ z - at.size * there).ravel()
                continue
            per_sample = np.matmul(pull[:, None, :], jz)[:, 0]
            if flat_m is not None:
                outer = pull[:, :, None] * z[:, None, :] - there
                per_sample[:, :k] -= outer.reshape(at.size, -1) @ half.T
            gradient += per_sample.sum(axis=0)
            np.add.at(table, at // size, per_sample)
        return cost, gradient, hessian, table


def _evenly(at: IndexArray) -> slice | IndexArray:
    """Samples in a row, or every so many, as a slice: they are looked at where they are, without a
    copy."""
    step = int(at[1] - at[0]) if at.size > 1 else 1
    return slice(int(at[0]), int(at[-1]) + 1, step) if (np.diff(at) == step).all() else at


def _rows(b: Block, group: int) -> Block:
    """The rows of one group."""
    assert b.group is not None
    at = np.flatnonzero(b.group == group)
    return replace(
        b, e=b.e[at], mask=b.mask[at], jacobian=None if b.jacobian is None else b.jacobian[at]
    )


def weighted(b: Block, variance: FloatArray) -> Block:
    """The block with a fixed diagonal covariance: `variance` (n_e,) per channel."""
    patterns = b.record.patterns
    covariance = np.array([np.diag(np.where(m != 0, variance, 1.0)) for m in patterns])
    return replace(b, covariance=covariance, pattern=b.record.pattern)
