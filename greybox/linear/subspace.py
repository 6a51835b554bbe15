"""Subspace identification: one singular value decomposition gives starts of every order at once.

All members share the scheme (Van Overschee and De Moor 1996; Chiuso 2007): find a matrix J so that
x[k] = J z_past[k], z_past[k] = [z[k-1], ..., z[k-past]], z = [u, y]; then y[k] on (x[k], u[k])
gives C, D and the innovations, and x[k+1] on (x[k], u[k], e[k]) gives A, B, K. They differ in how
the predictable future is computed and weighted.

| method | future | weights (left, right) | under feedback |
|---|---|---|---|
| n4sid | oblique projection of Y_f along U_f on Z_p | I, I | biased |
| moesp | the same | I, orthogonal complement of U_f | biased |
| cva | the same | canonical correlation (Larimore 1990) | biased |
| ssarx | Y_f minus the VARX-predicted effect of what came after k (Jansson 2003) | canonical correlation | consistent |
| pbsid | stacked VARX predictor coefficients (Chiuso 2007, PBSID-opt) | innovation covariance | consistent |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.linalg as sla

from greybox.errors import DataError, FitError, ModelError
from greybox.linear.records import Record
from greybox.linear.varx import Varx, fit_varx, lagged, triangle
from greybox.model.matrices import Matrices, spectral_radius, steady_gain
from greybox.symbolic import FloatArray

Method = Literal["n4sid", "moesp", "cva", "ssarx", "pbsid"]
METHODS: tuple[Method, ...] = ("n4sid", "moesp", "cva", "ssarx", "pbsid")


@dataclass(frozen=True, kw_only=True)
class Subspace:
    """What one decomposition gives: singular values (largest first) and the map to the states of
    any order.

    `state_map` (n_max, past (m + p)) holds the rows of J; `realise(order)` regresses the matrices
    for that order.
    """

    method: Method
    past: int
    future: int
    singular_values: FloatArray
    state_map: FloatArray
    records: tuple[Record, ...]
    feedthrough: bool
    noise_model: bool
    varx: Varx | None

    @property
    def largest_order(self) -> int:
        """The largest order that the horizons and the numerical rank allow."""
        return len(self.state_map)

    @cached_property
    def rows(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(x[k], x[k+1], u[k], y[k]) of all records, states of the largest order at unit spread."""
        now, after, us, ys = [], [], [], []
        for r in self.records:
            if len(r) <= self.past:
                continue
            x = lagged(r, self.past, last=len(r)) @ self.state_map.T
            now.append(x[:-1])
            after.append(x[1:])
            us.append(r.u[self.past :])
            ys.append(r.y[self.past :])
        x, x1, u, y = (np.vstack(v) for v in (now, after, us, ys))
        scale = np.maximum(x.std(axis=0), 1e-300)
        return x / scale, x1 / scale, u, y

    def misfits(self, order: int) -> FloatArray:
        """N log det of what 0, 1, ..., `order` states and the direct inputs leave of y[k]: (order +
        1,), never rising."""
        x, _, u, y = self.rows
        x, direct = x[:, :order], u if self.feedthrough else u[:, :0]
        tri = triangle(np.hstack([direct, x, y]))
        first = direct.shape[1]
        left = [tri[first + k :, first + order :] for k in range(order + 1)]
        return len(y) * np.array([np.linalg.slogdet(v.T @ v / len(y))[1] for v in left])

    def realise(self, order: int, *, stable: bool = False) -> Matrices:
        """The model of that order; with `stable` A has its eigenvalues inside the unit circle by
        construction.

        The predictor A - KC is always stable. Raises `FitError` for an order above `largest_order`.
        """
        if not 0 < order <= self.largest_order:
            raise FitError(
                f"order {order} is above what the data carry",
                expected=f"1 .. {self.largest_order}",
                fix="lower the order, pass longer records, or raise `past`",
            )
        return _realise(self, order, stable)


def subspace(
    records: Sequence[Record],
    method: Method = "ssarx",
    *,
    past: int | None = None,
    future: int | None = None,
    order: int = 1,
    feedthrough: bool = True,
    noise_model: bool = True,
    varx: Varx | None = None,
) -> Subspace:
    """Decompose the records. `past` None takes the AIC order of a VARX; `future` None takes the
    same.

    `order` is the largest order that will be asked for: the horizons are widened to carry it.
    Missing outputs are interpolated for this start only. `varx` is that of another method on the
    same records, to save its time. Raises `DataError` where the records are too short.
    """
    filled = tuple(_filled(r) for r in records)
    m, p = filled[0].u.shape[1], filled[0].y.shape[1]
    least = -(-(order + 1) // p) + 1
    if past is None or method in ("ssarx", "pbsid"):
        varx = varx or fit_varx(filled, past=past, feedthrough=feedthrough)
        if varx.past < least:
            varx = fit_varx(filled, past=least, feedthrough=feedthrough)
    span = max(varx.past if varx is not None else 0, past or 0, least)
    ahead = max(future or min(span, max(least, 15)), least)
    usable = tuple(r for r in filled if len(r) >= span + ahead + 1)
    rows = sum(len(r) - span - ahead + 1 for r in usable)
    if rows < (span + ahead) * (m + p):
        raise DataError(
            f"{sum(len(r) for r in filled)} samples in {len(filled)} records are too short for "
            f"order {order} with {m} inputs and {p} outputs",
            expected=f"at least {(span + ahead) * (m + p) + (span + ahead) * max(1, len(usable))} "
            "samples",
            fix="lower the order or pass longer records",
        )
    if method == "pbsid" or method == "ssarx":
        assert varx is not None
        maps = _pbsid if method == "pbsid" else _ssarx
        values, state_map = maps(usable, varx, ahead)
    else:
        values, state_map = _open_loop(usable, method, span, ahead)
    keep = int(np.sum(values > 1e-9 * values[0])) if values.size else 0
    keep = min(keep, ahead * p - 1 if ahead * p > 1 else 1)
    return Subspace(
        method=method,
        past=span,
        future=ahead,
        singular_values=values,
        state_map=state_map[:keep],
        records=filled,
        feedthrough=feedthrough,
        noise_model=noise_model,
        varx=varx,
    )


def _future(record: Record, values: FloatArray, past: int, future: int) -> FloatArray:
    stop = len(record) - future
    return np.hstack([values[past + i : stop + i + 1] for i in range(future)])


def _open_loop(
    records: Sequence[Record], method: Method, past: int, future: int
) -> tuple[FloatArray, FloatArray]:
    """N4SID, PO-MOESP and CVA by one LQ decomposition (Van Overschee and De Moor 1996, chapter
    4)."""
    blocks = []
    for r in records:
        z = lagged(r, past, last=len(r) - future)
        blocks.append(np.hstack([_future(r, r.u, past, future), z, _future(r, r.y, past, future)]))
    data = np.vstack(blocks)
    m, p = records[0].u.shape[1], records[0].y.shape[1]
    nu, nzp = future * m, past * (m + p)
    tri = triangle(data) / np.sqrt(len(data))
    r12, r22, r23 = (
        tri[:nu, nu : nu + nzp],
        tri[nu : nu + nzp, nu : nu + nzp],
        tri[nu : nu + nzp, nu + nzp :],
    )
    r33 = tri[nu + nzp :, nu + nzp :]
    diagonal = np.abs(np.diag(r22))
    if diagonal.min() > 1e-10 * diagonal.max():
        projection = sla.solve_triangular(r22, r23, check_finite=False).T
    else:
        projection = sla.lstsq(r22, r23, cond=1e-10)[0].T
    identity: FloatArray = np.eye(future * p)
    if method == "n4sid":
        left, seen = identity, projection @ np.hstack([r12.T, r22.T])
    elif method == "moesp":
        left, seen = identity, projection @ r22.T
    else:
        covariance = r23.T @ r23 + r33.T @ r33
        left = np.asarray(np.linalg.inv(_cholesky(covariance)))
        seen = left @ projection @ r22.T
    return _svd_map(seen, left @ projection)


def _ssarx(records: Sequence[Record], varx: Varx, future: int) -> tuple[FloatArray, FloatArray]:
    """Jansson (2003), "Subspace identification and ARX modeling": take off what u and y after k
    bring, then CCA."""
    past, (p, nz) = varx.past, varx.theta.shape[1:]
    m = nz - p
    clean = np.zeros((future, nz, future, p))
    for i in range(future):
        clean[i, :m, i], clean[i, m:, i] = -varx.d.T, np.eye(p)
        for j in range(1, min(i, past) + 1):
            clean[i - j, :, i] = -varx.theta[j - 1].T
    taken = clean.reshape(future * nz, future * p)
    blocks = []
    for r in records:
        after = _future(r, np.hstack([r.u, r.y]), past, future)
        blocks.append(np.hstack([lagged(r, past, last=len(r) - future), after @ taken]))
    data = np.vstack(blocks)
    nzp = data.shape[1] - future * p
    tri = triangle(data) / np.sqrt(len(data))
    r11, r12, r22 = tri[:nzp, :nzp], tri[:nzp, nzp:], tri[nzp:, nzp:]
    diagonal = np.abs(np.diag(r11))
    if diagonal.min() > 1e-10 * diagonal.max():
        projection = sla.solve_triangular(r11, r12, check_finite=False).T
    else:
        projection = sla.lstsq(r11, r12, cond=1e-10)[0].T
    left = np.linalg.inv(_cholesky(r12.T @ r12 + r22.T @ r22))
    return _svd_map(left @ projection @ r11.T, left @ projection)


def _pbsid(records: Sequence[Record], varx: Varx, future: int) -> tuple[FloatArray, FloatArray]:
    """PBSID-opt (Chiuso 2007): the product of predictor observability and reachability from VARX
    coefficients."""
    past, (p, nz) = varx.past, varx.theta.shape[1:]
    ahead = min(future, past)
    rows = np.vstack([lagged(r, past) for r in records])
    tri = triangle(rows) / np.sqrt(len(rows))
    product = np.zeros((ahead * p, past * nz))
    for i in range(ahead):
        for j in range(1, past - i + 1):
            product[i * p : (i + 1) * p, (j - 1) * nz : j * nz] = varx.theta[i + j - 1]
    left = np.kron(np.eye(ahead), np.linalg.inv(_cholesky(varx.noise)))
    return _svd_map(left @ product @ tri.T, left @ product)


def _svd_map(seen: FloatArray, weighted: FloatArray) -> tuple[FloatArray, FloatArray]:
    left, values, _ = np.linalg.svd(seen, full_matrices=False)
    safe = np.maximum(values, 1e-300)
    return values, (left / np.sqrt(safe)).T @ weighted


def _realise(s: Subspace, order: int, stable: bool) -> Matrices:
    x, x1, u, y = s.rows
    x, x1 = x[:, :order], x1[:, :order]
    n, m, p = order, u.shape[1], y.shape[1]
    left = np.hstack([x, u]) if s.feedthrough else x
    cd = _regressed(left, y)
    c, d = cd[:, :n], cd[:, n:] if s.feedthrough else np.zeros((p, m))
    e = y - left @ cd.T
    if not s.noise_model:
        ab = _regressed(np.hstack([x, u]), x1)
        a = _pulled_in(ab[:, :n], 0.998)
        return Matrices(a, ab[:, n:], c, d, np.zeros((n, p)))
    regressor = np.hstack([x, u, e])
    abk = _regressed(regressor, x1)
    a, b, k = abk[:, :n], abk[:, n : n + m], abk[:, n + m :]
    if stable and spectral_radius(a) >= 1.0:
        a = _pulled_in(a, 0.998)
    if spectral_radius(a - k @ c) >= 0.9999:
        k = _stabilising_gain(a, b, c, k, np.hstack([x, u]), x1, e)
    return Matrices(a, b, c, d, k)


def _regressed(regressor: FloatArray, target: FloatArray) -> FloatArray:
    """Least squares coefficients (targets, regressors)."""
    width = regressor.shape[1]
    tri = triangle(np.hstack([regressor, target]))
    diagonal = np.abs(np.diag(tri)[:width])
    if len(tri) > width and diagonal.min() > 1e-5 * diagonal.max():
        return np.asarray(
            sla.solve_triangular(tri[:width, :width], tri[:width, width:], check_finite=False)
        ).T
    return np.asarray(
        sla.lstsq(regressor, target, cond=1e-12, lapack_driver="gelsy", check_finite=False)[0]
    ).T


def _stabilising_gain(
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    k: FloatArray,
    xu: FloatArray,
    x1: FloatArray,
    e: FloatArray,
) -> FloatArray:
    """A gain with a stable predictor: the Riccati gain of the regression residuals, else that of
    unit noises."""
    w = x1 - xu @ np.hstack([a, b]).T
    both = np.hstack([w, e])
    covariance = both.T @ both / len(both)
    n = len(a)
    try:
        gain, _, _ = steady_gain(
            a,
            c,
            covariance[:n, :n] + 1e-9 * np.eye(n),
            covariance[n:, n:] + 1e-12 * np.eye(len(c)),
            covariance[:n, n:],
        )
        if spectral_radius(a - gain @ c) < 0.9999:
            return gain
    except (ModelError, np.linalg.LinAlgError):
        pass
    try:
        gain, _, _ = steady_gain(a, c, np.eye(n), np.eye(len(c)))
        return gain
    except (ModelError, np.linalg.LinAlgError):
        return np.zeros_like(k)


def _pulled_in(a: FloatArray, radius: float) -> FloatArray:
    """A with every eigenvalue at most `radius` in size: those outside are mirrored at the unit
    circle, then limited."""
    values, vectors = np.linalg.eig(a)
    size = np.abs(values)
    if size.max(initial=0.0) <= radius:
        return a
    new = np.where(size > 1.0, values / np.maximum(size, 1e-300) ** 2, values)
    new = new * np.minimum(1.0, radius / np.maximum(np.abs(new), 1e-300))
    return np.asarray((vectors * new) @ np.linalg.inv(vectors)).real


def _cholesky(covariance: FloatArray) -> FloatArray:
    symmetric = (covariance + covariance.T) / 2
    floor = 1e-12 * float(np.trace(symmetric)) / len(symmetric)
    return np.asarray(np.linalg.cholesky(symmetric + max(floor, 1e-300) * np.eye(len(symmetric))))


def _filled(record: Record) -> Record:
    """Missing outputs interpolated linearly (for the start only)."""
    if not record.missing:
        return record
    y = record.y.copy()
    k = np.arange(len(y))
    for i in range(y.shape[1]):
        seen = np.isfinite(y[:, i])
        y[:, i] = np.interp(k, k[seen], y[seen, i]) if seen.any() else 0.0
    return Record(u=record.u, y=y, name=record.name)
