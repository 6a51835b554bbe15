"""Small dense linear algebra written out in SX: Cholesky factor and solution, as expressions that
any backend can run."""

from __future__ import annotations

import functools

import casadi as ca

from greybox.symbolic import Expr


def cholesky(m: Expr) -> list[list[Expr]]:
    """Rows of the lower factor L, L L' = m (SX, n x n), written out."""
    n = m.shape[0]
    low: list[list[Expr]] = [[] for _ in range(n)]
    for i in range(n):
        for k in range(i + 1):
            rest = m[i, k]
            for q in range(k):
                rest = rest - low[i][q] * low[k][q]
            low[i].append(ca.sqrt(rest) if k == i else rest / low[k][k])
    return low


def cholesky_solve(low: list[list[Expr]], b: Expr) -> Expr:
    """x with L L' x = b for a column b, or for every column of a matrix."""
    columns = []
    n = len(low)
    for j in range(b.shape[1]):
        y: list[Expr] = []
        for i in range(n):
            rest = b[i, j]
            for k in range(i):
                rest = rest - low[i][k] * y[k]
            y.append(rest / low[i][i])
        z: list[Expr] = [ca.SX(0)] * n
        for i in reversed(range(n)):
            rest = y[i]
            for k in range(i + 1, n):
                rest = rest - low[k][i] * z[k]
            z[i] = rest / low[i][i]
        columns.append(ca.vertcat(*z))
    return ca.horzcat(*columns)


@functools.cache
def cholesky_solution(n: int) -> ca.Function:
    """(m (n, n), b (n,)) -> x with m x = b for a positive definite m: written out once per size."""
    m, b = ca.SX.sym("m", n, n), ca.SX.sym("b", n)
    return ca.Function("cholesky_solution", [m, b], [cholesky_solve(cholesky(m), b)])
