"""The one-step predictor of a linear model over a record, and its exact sensitivities. NumPy only.

The predictor x+ = F x + G z, y_hat = C x + D u, with F = A - KC, G = [B - KD, K], z = [u, y], is
simulated in its modal coordinates: every mode is one first-order filter, and the sensitivity to any
entry of F and G is the same bank of filters applied to the states and signals, recombined by small
matrices. Where modes (nearly) coincide, or where samples miss, a plain time-varying recursion gives
the same numbers more slowly.

Missing outputs: the gain is the Kalman gain of the model for what was measured, K[k] = (A P C' + K
L) S^-1 over the measured channels; innovations after a hole have covariance S[k] > Lambda and are
weighted by it. The sensitivities hold that gain sequence fixed while it differs from K, which
leaves the estimating equation unbiased (the innovations are exact and uncorrelated with everything
earlier) but is not the gradient of the likelihood to the last digit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from greybox.linear.records import Record
from greybox.model.matrices import Matrices
from greybox.symbolic import FloatArray

WORST_MODES = 1e6


class Prediction(NamedTuple):
    """States x (N, n), innovations e (N, p) (0 where missing), and, with holes, whitening factors
    (N, p, p) or None."""

    x: FloatArray
    e: FloatArray
    whitener: FloatArray | None
    gains: FloatArray | None
    log_det: float


class Modes:
    """Modal coordinates of a state matrix; `usable` is False where the eigenvectors are nearly
    dependent."""

    def __init__(self, f: FloatArray) -> None:
        self.values, self.vectors = np.linalg.eig(f)
        try:
            self.inverse = np.linalg.inv(self.vectors)
        except np.linalg.LinAlgError:
            self.inverse = np.full_like(self.vectors, np.inf)
        # Frobenius norms: at most n times the condition number, and far cheaper
        self.condition = (
            float(np.linalg.norm(self.vectors) * np.linalg.norm(self.inverse)) if len(f) else 1.0
        )
        self.usable = self.condition < WORST_MODES
        self.half = np.flatnonzero(self.values.imag >= 0.0)
        self.weight = np.where(self.values[self.half].imag > 0.0, 2.0, 1.0)

    def filtered(self, signals: FloatArray) -> list[FloatArray]:
        """Per kept mode i the response of xi+ = lambda_i xi + w from xi = 0 to each column of
        signals (N, q)."""
        out = []
        for value in self.values[self.half]:
            pole = value.real if value.imag == 0.0 else value
            response = np.zeros(signals.shape, dtype=type(pole))
            response[1:] = lfilter([1.0], [1.0, -pole], signals[:-1], axis=0)
            out.append(response)
        return out

    def powers(self, count: int) -> list[FloatArray]:
        """Per kept mode the sequence 1, lambda, lambda^2, ... (count,)."""
        return [
            powers(v, count).real if v.imag == 0.0 else powers(v, count)
            for v in self.values[self.half]
        ]


def powers(pole: complex, count: int) -> np.ndarray:
    """1, pole, pole^2, ... (count,), complex; zero once far below rounding, as denormal numbers are
    slow."""
    out = np.zeros(count, dtype=complex)
    size = abs(pole)
    stop = count if size >= 1.0 else min(count, 2 + int(-115.0 / np.log(max(size, 1e-30))))
    out[:stop] = pole ** np.arange(stop)
    return out


def states(
    f: FloatArray, drive: FloatArray, x0: FloatArray, modes: Modes | None = None
) -> FloatArray:
    """x[k+1] = F x[k] + drive[k] from x[0] = x0: (N, n) for drive (N, n)."""
    n = len(f)
    count = len(drive)
    if n == 0 or count == 0:
        return np.zeros((count, n))
    modes = modes or Modes(f)
    if not modes.usable:
        x = np.empty((count, n))
        x[0] = x0
        for k in range(count - 1):
            x[k + 1] = f @ x[k] + drive[k]
        return x
    start = modes.inverse[modes.half] @ x0
    pushed = modes.inverse[modes.half] @ drive[:-1].T
    xi = np.empty((len(start), count), dtype=pushed.dtype)
    xi[:, 0] = start
    for i, value in enumerate(modes.values[modes.half]):
        if value.imag == 0.0:
            value, row, first = value.real, pushed[i].real, start[i].real
        else:
            row, first = pushed[i], start[i]
        xi[i, 1:] = lfilter([1.0], [1.0, -value], row, zi=np.array([value * first]))[0]
    back = modes.vectors[:, modes.half] * modes.weight
    if not np.iscomplexobj(xi):
        return np.asarray((back.real @ xi).T)
    return np.asarray((back.real @ xi.real - back.imag @ xi.imag).T)


def predict(
    system: Matrices,
    record: Record,
    x0: FloatArray,
    offset: FloatArray,
    noise: FloatArray,
    modes: Modes | None = None,
) -> Prediction:
    """One-step prediction from x[0] = x0 with the output offset (p,) taken off; `noise` is Lambda,
    used for holes."""
    if record.missing:
        return _with_holes(system, record, x0, offset, noise)
    z = np.hstack([record.u, record.y - offset])
    x = states(system.predictor, z @ system.predictor_input.T, x0, modes)
    e = record.y - offset - x @ system.c.T - record.u @ system.d.T
    return Prediction(x, e, None, None, 0.0)


def sensitivities(
    system: Matrices, record: Record, prediction: Prediction, modes: Modes | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(J, J_x0, J_offset): derivatives of y_hat, not of e; (N, p, q), (N, p, n), (N, p, p).

    The q columns follow `full_vector`: the rows of [F, G] (n times n + m + p), then C, then D.
    """
    modes = modes or Modes(system.predictor)
    if prediction.gains is not None or not modes.usable:
        return _recursive(system, record, prediction)
    n, m, p = system.sizes
    count, width = len(record), n + m + p
    level = prediction.x @ system.c.T + record.u @ system.d.T + prediction.e
    signals = np.hstack([prediction.x, record.u, level])
    basis = modal_signals(modes, signals)
    mix = modal_mix(modes, system.c)
    j = np.zeros((count, p, n * width + p * n + p * m))
    for o in range(p):
        for a in range(n):
            j[:, o, a * width : (a + 1) * width] = np.einsum("nib,i->nb", basis, mix[o, a])
    direct_part(j, prediction.x, record.u, n * width)
    jx, jc = start_sensitivities(system, modes, count)
    return j, jx, jc


def direct_part(j: FloatArray, x: FloatArray, u: FloatArray, first: int) -> None:
    """Write the columns of C and D into J (N, p, q), in place, from column `first` on."""
    p, n, m = j.shape[1], x.shape[1], u.shape[1]
    for o in range(p):
        j[:, o, first + o * n : first + (o + 1) * n] = x
        j[:, o, first + p * n + o * m : first + p * n + (o + 1) * m] = u


def modal_signals(modes: Modes, signals: FloatArray) -> FloatArray:
    """Filtered signals (N, r, q): r real rows, one per real mode and two (real, imaginary) per
    complex pair."""
    rows = []
    for response in modes.filtered(signals):
        rows.append(response.real)
        if np.iscomplexobj(response):
            rows.append(response.imag)
    return np.stack(rows, axis=1)


def modal_mix(modes: Modes, c: FloatArray) -> FloatArray:
    """Weights (p, n, r) that turn `modal_signals` of a push on state a into output o: Re of C v_i
    w_i'."""
    cv = c @ modes.vectors
    out = []
    for i, w in zip(modes.half, modes.weight):
        product = w * np.outer(cv[:, i], modes.inverse[i])
        out.append(product.real)
        if modes.values[i].imag != 0.0:
            out.append(-product.imag)
    return np.stack(out, axis=2)


def start_sensitivities(
    system: Matrices, modes: Modes, count: int
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of y_hat with respect to x0 (N, p, n) and to the output offset (N, p, p), without
    holes."""
    p = system.sizes[2]
    mix = modal_mix(modes, system.c)
    rows, sums = [], []
    for power in modes.powers(count):
        total = np.concatenate([np.zeros(1, dtype=power.dtype), np.cumsum(power)[:-1]])
        rows.append(power.real)
        sums.append(total.real)
        if np.iscomplexobj(power):
            rows.append(power.imag)
            sums.append(total.imag)
    jx = np.tensordot(np.array(rows), mix, axes=(0, 2))
    response = np.tensordot(np.array(sums), mix, axes=(0, 2))
    return jx, np.eye(p)[None] - response @ system.k


def full_vector(system: Matrices) -> FloatArray:
    """Rows of [F, G], then C, then D as one vector: the coordinates of `sensitivities`."""
    fg = np.hstack([system.predictor, system.predictor_input])
    return np.concatenate([fg.ravel(), system.c.ravel(), system.d.ravel()])


def from_full_vector(vector: FloatArray, sizes: tuple[int, int, int]) -> Matrices:
    """The inverse of `full_vector` for sizes (n, m, p)."""
    from greybox.model.matrices import from_predictor

    n, m, p = sizes
    first = n * (n + m + p)
    fg = vector[:first].reshape(n, n + m + p)
    c = vector[first : first + p * n].reshape(p, n)
    return from_predictor(fg[:, :n], fg[:, n:], c, vector[first + p * n :].reshape(p, m))


def _with_holes(
    system: Matrices, record: Record, x0: FloatArray, offset: FloatArray, noise: FloatArray
) -> Prediction:
    """Kalman filter with the gain of what was measured; the state is known (P = 0) at the start of
    the record."""
    a, b, c, d, k = system
    n, _, p = system.sizes
    q, s = k @ noise @ k.T, k @ noise
    count = len(record)
    x, e = np.zeros((count, n)), np.zeros((count, p))
    gains, whitener = np.empty((count, n, p)), np.empty((count, p, p))
    here, cov = np.asarray(x0, dtype=float), np.zeros((n, n))
    seen = np.isfinite(record.y)
    y = np.where(seen, record.y - offset, 0.0)
    log_det = 0.0
    base = np.linalg.inv(np.linalg.cholesky(noise))
    whole = float(np.linalg.slogdet(noise)[1])
    settled = True
    for i in range(count):
        x[i] = here
        full = seen[i].all()
        if settled and full:
            gains[i], whitener[i] = k, base
            e[i] = y[i] - c @ here - d @ record.u[i]
            log_det += whole
            here = a @ here + b @ record.u[i] + k @ e[i]
            continue
        v = np.flatnonzero(seen[i])
        gain, white = np.zeros((n, p)), np.zeros((p, p))
        if v.size:
            big = c[v] @ cov @ c[v].T + noise[np.ix_(v, v)]
            cross = a @ cov @ c[v].T + s[:, v]
            gain[:, v] = np.linalg.solve(big, cross.T).T
            white[np.ix_(v, v)] = np.linalg.inv(np.linalg.cholesky(big))
            e[i, v] = y[i, v] - c[v] @ here - d[v] @ record.u[i]
            log_det += float(np.linalg.slogdet(big)[1])
            cov = a @ cov @ a.T + q - gain[:, v] @ cross.T
        else:
            cov = a @ cov @ a.T + q
        cov = (cov + cov.T) / 2
        gains[i], whitener[i] = gain, white
        here = a @ here + b @ record.u[i] + gain @ e[i]
        settled = bool(np.abs(cov).max(initial=0.0) < 1e-12)
    return Prediction(x, e, whitener, gains, log_det)


def _recursive(
    system: Matrices, record: Record, prediction: Prediction
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same derivatives by a recursion over samples, for time-varying gains and for coinciding
    modes."""
    n, m, p = system.sizes
    a, _, c, d, k = system
    width, count = n + m + p, len(record)
    first = n * width
    q = first + p * n + p * m
    columns = q + n + p
    push = np.zeros((n, columns))
    push[:, q : q + n] = np.eye(n)
    out = np.zeros((count, p, columns))
    x, e, u = prediction.x, prediction.e, record.u
    seen = np.isfinite(record.y)
    rows = np.arange(n)
    starts = rows[:, None] * width + np.arange(width)
    for i in range(count):
        here = c @ push
        for o in range(p):
            here[o, first + o * n : first + (o + 1) * n] += x[i]
            here[o, first + p * n + o * m : first + p * n + (o + 1) * m] += u[i]
            here[o, q + n + o] += 1.0
        here[~seen[i]] = 0.0
        out[i] = here
        gain = k if prediction.gains is None else prediction.gains[i]
        push = a @ push - gain @ here
        # dA = dF + dK C + K dC and dB = dB~ + dK D + K dD, so that in the coordinates (F, B~, K, C,
        # D): dA x + dB u + dK e = dF x + dB~ u + dK (C x + D u + e) + K (dC x + dD u)
        level = c @ x[i] + d @ u[i] + e[i]
        push[rows[:, None], starts] += np.concatenate([x[i], u[i], level])
        for o in range(p):
            push[:, first + o * n : first + (o + 1) * n] += np.outer(k[:, o], x[i])
            push[:, first + p * n + o * m : first + p * n + (o + 1) * m] += np.outer(k[:, o], u[i])
    return out[:, :, :q], out[:, :, q : q + n], out[:, :, q + n :]
