"""VARX: the long vector autoregression with inputs from which closed-loop subspace methods start.

y[k] = D u[k] + sum_j Theta_j [u[k-j]; y[k-j]] + e[k]. One QR gives every order up to the largest,
and AIC chooses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sla

from greybox.errors import DataError
from greybox.linear.records import Record
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class Varx:
    """Coefficients of lag 1, 2, ...: `theta` (past, p, m + p), feedthrough `d` (p, m), innovation
    covariance (p, p)."""

    past: int
    theta: FloatArray
    d: FloatArray
    noise: FloatArray


def lagged(record: Record, past: int, *, last: int | None = None) -> FloatArray:
    """Rows k = past .. last of [z[k-1], ..., z[k-past]] with z = [u, y]: (last - past + 1, past (m
    + p)).

    `last` defaults to N - 1; N itself is allowed (everything it needs is known).
    """
    z = np.hstack([record.u, record.y])
    stop = len(z) - 1 if last is None else last
    return np.hstack([z[past - j : stop + 1 - j] for j in range(1, past + 1)])


def fit_varx(
    records: Sequence[Record],
    *,
    past: int | None = None,
    feedthrough: bool = True,
    largest: int | None = None,
) -> Varx:
    """Least squares VARX; `past` None lets AIC choose among 1 .. `largest` (default 10 log10 N,
    within the data).

    Rows with a missing value are left out. Raises `DataError` where fewer rows than coefficients
    remain.
    """
    m, p = records[0].u.shape[1], records[0].y.shape[1]
    total = sum(len(r) for r in records)
    nz = m + p
    if past is None:
        limit = largest or min(40, max(4, round(10 * np.log10(max(total, 10)))))
        shortest = max(len(r) for r in records)
        limit = max(1, min(limit, (total // 3 - m - p) // (nz + len(records)), shortest // 3))
    else:
        limit = past
    head = m if feedthrough else 0
    columns = head + limit * nz
    usable = [r for r in records if len(r) > limit]
    whole = all(not r.missing for r in usable)
    data = np.zeros((0, 1))
    rows = sum(len(r) - limit for r in usable)
    r = (
        _triangle_from_covariances(usable, limit, feedthrough)
        if whole and rows > 2 * columns
        else None
    )
    if r is None:
        blocks = [_rows(q, limit, feedthrough) for q in usable]
        data = np.vstack(blocks) if blocks else np.zeros((0, 1))
        data = data[np.isfinite(data).all(axis=1)]
        rows = len(data)
    if rows < columns + p + 1:
        raise DataError(
            f"{rows} complete rows are too few for {columns} coefficients per output",
            fix="pass a longer record, or ask for a lower order",
        )
    if r is None:
        r = sla.qr(data, mode="r", overwrite_a=True, check_finite=False)[0][: columns + p]
    chosen = limit if past is not None else _aic(r, rows, head, nz, limit, p)
    used = head + chosen * nz
    tri, right = r[:used, :used], r[:used, columns:]
    coefficients = _solve_triangular(tri, right)
    rest = r[used:, columns:]
    noise = rest.T @ rest / max(rows - used, 1)
    d = coefficients[:head].T if feedthrough else np.zeros((p, m))
    theta = coefficients[head:].T.reshape(p, chosen, nz).transpose(1, 0, 2)
    return Varx(past=chosen, theta=np.ascontiguousarray(theta), d=d, noise=noise)


def _triangle_from_covariances(
    records: Sequence[Record], limit: int, feedthrough: bool
) -> FloatArray | None:
    """R of the QR of the regression, from lagged covariances; None where squaring the data would
    cost digits.

    The Gram matrix of lagged data is block Toeplitz up to the ends of the records: G[i+1, j+1] =
    G[i, j] plus one product of first samples minus one of last samples. That is far cheaper than
    forming and factoring the lagged data.
    """
    nz = records[0].u.shape[1] + records[0].y.shape[1]
    m, p = records[0].u.shape[1], records[0].y.shape[1]
    gram = np.zeros(((limit + 1) * nz, (limit + 1) * nz))
    for r in records:
        z = np.hstack([r.u, r.y])
        count = len(z)
        own = np.zeros((limit + 1, limit + 1, nz, nz))
        for j in range(limit + 1):
            own[0, j] = z[limit:].T @ z[limit - j : count - j]
        for i in range(limit):
            # lag i + 1 sees one sample more at the beginning and one less at the end than lag i
            first, last = z[limit - i - 1], z[count - 1 - i]
            early, late = z[: limit - i][::-1], z[count - limit : count - i][::-1]
            own[i + 1, i + 1 :] = (
                own[i, i:limit]
                + first[:, None] * early[:, None, :]
                - last[:, None] * late[:, None, :]
            )
        for i in range(limit + 1):
            for j in range(i):
                own[i, j] = own[j, i].T
        gram += own.transpose(0, 2, 1, 3).reshape(gram.shape)
    now_u, now_y, past = np.arange(m), np.arange(m, m + p), np.arange(nz, (limit + 1) * nz)
    order = np.concatenate([now_u, past, now_y] if feedthrough else [past, now_y])
    gram = gram[np.ix_(order, order)]
    try:
        triangle = np.linalg.cholesky(gram).T
    except np.linalg.LinAlgError:
        return None
    diagonal = np.diag(triangle)
    if diagonal.min() < 1e-5 * np.sqrt(np.diag(gram).max()):
        return None
    return np.asarray(triangle)


def estimate_delays(
    records: Sequence[Record], *, largest: int = 20, level: float = 3.3
) -> tuple[int, ...]:
    """Whole-sample input delay per channel: the leading impulse-response lags that cannot be told
    from zero.

    A VARX with lags 0 .. past is fitted; lag j of input i is silent while every output's
    coefficient stays within `level` standard errors of zero. Lag 0 alone silent is the usual
    strictly proper system, so that the delay returned is one less than the first audible lag (and 0
    where lag 0 is audible).
    """
    m, p = records[0].u.shape[1], records[0].y.shape[1]
    first = fit_varx(records)
    past = max(first.past, min(largest + 2, 24))
    rows = [_rows(r, past, True) for r in records if len(r) > past]
    data = np.vstack(rows) if rows else np.zeros((0, 1))
    data = data[np.isfinite(data).all(axis=1)]
    columns = m + past * (m + p)
    if len(data) < 2 * columns:
        return (0,) * m
    r = sla.qr(data, mode="r", overwrite_a=True)[0][: columns + p]
    tri = r[:columns, :columns]
    coefficients = _solve_triangular(tri, r[:columns, columns:])
    variance = (_solve_triangular(tri, np.eye(columns)) ** 2).sum(axis=1)
    sigma2 = (r[columns:, columns:] ** 2).sum(axis=0) / (len(data) - columns)
    t = np.abs(coefficients) / np.sqrt(np.maximum(variance[:, None] * sigma2, 1e-300))
    delays = []
    for i in range(m):
        audible = [
            j
            for j in range(past + 1)
            if (t[i if j == 0 else m + (j - 1) * (m + p) + i] > level).any()
        ]
        delays.append(min(max(audible[0] - 1, 0), largest) if audible else 0)
    return tuple(delays)


def _rows(record: Record, past: int, feedthrough: bool) -> FloatArray:
    parts = [lagged(record, past), record.y[past:]]
    return np.hstack([record.u[past:], *parts] if feedthrough else parts)


def _aic(r: FloatArray, rows: int, head: int, nz: int, limit: int, p: int) -> int:
    columns = head + limit * nz
    tail = r[head:columns, columns:].reshape(limit, nz, p)
    sums = np.cumsum(np.einsum("kai,kaj->kij", tail, tail)[::-1], axis=0)[::-1]
    last = r[columns:, columns:]
    rest = np.concatenate([sums[1:], np.zeros((1, p, p))]) + last.T @ last
    sign, value = np.linalg.slogdet(rest / rows + 1e-300 * np.eye(p))
    used = head + nz * np.arange(1, limit + 1)
    return 1 + int(np.argmin(rows * np.where(sign > 0, value, -np.inf) + 2 * p * used))


def triangle(data: FloatArray) -> FloatArray:
    """R of data = Q R, (columns, columns): by the Cholesky factor of data'data, by QR where
    squaring would cost digits."""
    if len(data) > data.shape[1]:
        gram = data.T @ data
        try:
            root = np.linalg.cholesky(gram).T
        except np.linalg.LinAlgError:
            root = np.zeros((1, 1))
        if np.diag(root).min() > 1e-5 * np.sqrt(np.diag(gram).max()):
            return np.asarray(root)
    return np.asarray(sla.qr(data, mode="r", check_finite=False)[0][: data.shape[1]])


def _solve_triangular(tri: FloatArray, right: FloatArray) -> FloatArray:
    """Solve R x = b; least squares of smallest norm where R is numerically singular (noise-free or
    short data)."""
    diagonal = np.abs(np.diag(tri))
    if diagonal.size and diagonal.min() > 1e-11 * diagonal.max():
        return np.asarray(sla.solve_triangular(tri, right, check_finite=False))
    return np.asarray(sla.lstsq(tri, right, cond=1e-11)[0])
