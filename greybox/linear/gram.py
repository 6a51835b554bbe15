"""Gradient, information and exact Hessian of the criterion from one Gram matrix of modal signals
(records without holes).

In the eigenvectors of F = A - KC every sensitivity of y_hat is a combination of a few signals per
mode lambda: z = [u, y] filtered once, the mode's own state filtered once more, and the start
lambda^k; a push from one mode to another splits into partial fractions of these. One Gram matrix of
n (m + p + 2) + m + 1 signals therefore holds all products of sensitivities. Its products with the
innovations, and with the innovations filtered backwards (the adjoint), hold all second derivatives
along straight lines in (F, G, C, D):

    d2 <eps, y_hat> [s, t] = <eps, dC(s) dx(t)> + <adjoint, dF(s) dx(t)> + the same with s and t
    exchanged.

The Hessian of N log det S, S = sum e e' / N, has the curvature of log det besides: -|J'eps +
eps'J|^2 / N at whitened innovations eps. At the true order both terms are small and Gauss-Newton is
enough; at wrong orders innovations are neither small nor white, and only the exact Hessian
converges fast.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from greybox.linear.predictor import Modes, Prediction, powers
from greybox.linear.records import Record
from greybox.model.matrices import Matrices
from greybox.symbolic import FloatArray

CLOSEST = 1e-4
"""Least distance between two modes, and of a mode from 1, at which partial fractions keep enough
digits."""
WORST = 1e3
"""Largest condition number of the eigenvectors."""


class Parts(NamedTuple):
    """Of one record, whitened: J'J (D, D) and J'e (D,) for D = d + n + p columns (free directions,
    x0, offset), the sums e_a J_b (p, p, D), and the second derivative of <e, y_hat> (d, d) along
    the free directions."""

    information: FloatArray
    gradient: FloatArray
    mixed: FloatArray
    second: FloatArray


def separable(modes: Modes) -> bool:
    """Are the modes far enough apart for partial fractions?"""
    if not modes.usable or modes.condition >= WORST:
        return False
    v = modes.values
    gap = np.abs(v[:, None] - v[None, :]) + np.eye(len(v))
    return bool(min(gap.min(initial=1.0), np.abs(1.0 - v).min(initial=1.0)) > CLOSEST)


class Gram:
    """What all records share at one point: the model and its free directions in modal coordinates.

    `tangent` (q, d) in the coordinates of `predictor.full_vector`; whitener Lambda whitener' = I.
    Modes are ordered: real ones and those with positive imaginary part first (h of them), then the
    conjugates of the latter.
    """

    def __init__(
        self, system: Matrices, modes: Modes, tangent: FloatArray, whitener: FloatArray
    ) -> None:
        n, m, p = system.sizes
        nz, d = m + p, tangent.shape[1]
        half = modes.half
        self.pairs = np.flatnonzero(modes.values[half].imag > 0.0)
        order = np.concatenate([half, half[self.pairs] + 1])
        v, w = modes.vectors[:, order], modes.inverse[order]
        self.system, self.whitener, self.inverse = system, whitener, w
        self.values, self.weight, self.h = modes.values[order], modes.weight, len(half)
        self.g = w @ system.predictor_input
        self.c = whitener @ system.c @ v
        rows = (w @ tangent[: n * (n + nz)].reshape(n, (n + nz) * d)).reshape(n, n + nz, d)
        self.df = np.matmul(v.T, rows[:, :n])
        dc = (whitener @ tangent[n * (n + nz) : n * (n + nz) + p * n].reshape(p, n * d)).reshape(
            p, n, d
        )
        self.dc = np.matmul(v.T, dc)
        self.dd = (whitener @ tangent[n * (n + nz) + p * n :].reshape(p, m * d)).reshape(p, m, d)
        # First-order perturbation of the modes: V moves along V turn, lambda along own, G and C in
        # modal coordinates too.
        diagonal = np.arange(n)
        self.own = self.df[diagonal, diagonal]
        self.turn = self.df / (self.values[None, :] - self.values[:, None] + np.eye(n))[:, :, None]
        self.turn[diagonal, diagonal] = 0.0
        self.moved_g = rows[:, n:] - np.matmul(self.g.T, self.turn)
        self.moved_c = dc_plus = self.dc + (self.c @ self.turn.reshape(n, n * d)).reshape(p, n, d)
        h = self.h
        c = (self.weight * self.c[:, :h]).T
        self.push = np.empty((h, nz + 1, p, d), dtype=complex)
        self.push[:, :nz] = c[:, None, :, None] * self.moved_g[:h, :, None, :]
        drive = (self.weight[:, None] * self.g[:h])[:, :, None, None]
        self.push[:, :nz] += drive * dc_plus[:, :h].transpose(1, 0, 2)[:, None]
        self.push[:, nz] = c[:, :, None] * self.own[:h, None, :]

    def parts(self, record: Record, prediction: Prediction) -> Parts:
        """The products of one record without holes."""
        h, pairs, n = self.h, self.pairs, len(self.values)
        p, d = len(self.c), self.own.shape[1]
        start = self.inverse @ prediction.x[0]
        basis, width = self._basis(record, prediction, start)
        gram = basis @ basis.T
        mix, turned = self._mix(width, start)
        total = mix.shape[2]
        flat = mix.reshape(width, p * total)
        information = mix.reshape(width * p, total).T @ (gram[:width, :width] @ flat).reshape(
            width * p, total
        )
        mixed = (gram[-p:, :width] @ flat).reshape(p, p, total)
        gradient = np.trace(mixed)

        # Products of innovations and adjoints with the modal signals, first with those of the first
        # h modes.
        size = self.g.shape[1] + 2
        tall = h * size
        left = gram[width:, :width]
        rows = np.concatenate([left[-p:], left[:h]]).astype(complex)
        rows[p + pairs] += 1j * left[h : h + len(pairs)]
        re = rows[:, :tall].reshape(p + h, h, size)
        im = np.zeros_like(re)
        im[:, pairs] = 1j * rows[:, tall : tall + len(pairs) * size].reshape(
            p + h, len(pairs), size
        )
        plus, minus = re + im, re - im
        inner = np.empty((p + n, n, size), dtype=complex)
        inner[: p + h, :h], inner[: p + h, h:] = plus, minus[:, pairs]
        inner[p + h :, :h], inner[p + h :, h:] = (
            minus[p + pairs].conj(),
            plus[p + pairs][:, pairs].conj(),
        )
        nz = size - 2
        of_x = (inner[:, :, :nz] * self.g).sum(axis=2) + inner[:, :, nz + 1] * start
        dx = np.matmul(inner[:, :h, :nz].transpose(1, 0, 2), self.moved_g[:h])
        dx += np.matmul(of_x, self.turn[:h])
        dx += inner[:, :h, nz + 1].T[:, :, None] * turned[:h, None]
        dx += inner[:, :h, nz].T[:, :, None] * self.own[:h, None]
        lead = np.concatenate([self.dc[:, :h], self.df[:, :h]]) * self.weight[:, None]
        second = (lead.transpose(1, 0, 2).reshape(-1, d).T @ dx.reshape(-1, d)).real
        return Parts(information, gradient, mixed, second + second.T)

    def _basis(
        self, record: Record, prediction: Prediction, start: np.ndarray
    ) -> tuple[FloatArray, int]:
        """Rows: z, own state, power of each of the h modes (real parts), of the pairs (imaginary
        parts), u, 1; then the adjoints (real, imaginary) and the innovations. Also the number of
        rows before the adjoints."""
        system, h, pairs = self.system, self.h, self.pairs
        _, m, p = system.sizes
        count, nz = len(record), m + p
        size, tall = nz + 2, (h + len(pairs)) * (nz + 2)
        width = tall + m + 1
        out = np.empty((width + h + len(pairs) + p, count))
        out[tall : tall + m] = record.u.T
        out[tall + m] = 1.0
        np.matmul(self.whitener, prediction.e.T, out=out[-p:])
        signals = np.empty((nz + 2, count))
        signals[:m] = record.u.T
        signals[m:nz] = (prediction.x @ system.c.T + record.u @ system.d.T + prediction.e).T
        back = self.c[:, :h].T @ out[-p:, ::-1]
        signals[nz + 1] = 0.0
        seen = 0
        for i in range(h):
            value, block = self.values[i], out[i * size : (i + 1) * size]
            power = powers(value, count)
            signals[nz] = back[i].real
            if value.imag == 0.0:
                late = _filtered(value, signals[: nz + 1])
                block[:nz], block[nz + 1] = late[:nz], power.real
                out[width + i] = late[nz, ::-1]
                block[nz] = _filtered(
                    value, self.g[i].real @ late[:nz] + start[i].real * power.real
                )
                continue
            other = out[(h + seen) * size : (h + seen + 1) * size]
            signals[nz + 1] = back[i].imag
            late = _filtered(value, signals)
            later = np.zeros_like(late)
            later[:, 1:] = late[:, :-1]
            # 1 / (q - lambda) = (q - Re lambda + i Im lambda) / (q^2 - 2 Re lambda q + |lambda|^2)
            np.multiply(later, -value.real, out=block)
            block += late
            np.multiply(later, value.imag, out=other)
            out[width + i] = (block[nz] - other[nz + 1])[::-1]
            out[width + h + seen] = (block[nz + 1] + other[nz])[::-1]
            block[nz + 1], other[nz + 1] = power.real, power.imag
            g = np.append(self.g[i], [0.0, start[i]])
            own = np.stack([g.real @ block - g.imag @ other, g.real @ other + g.imag @ block])
            late = _filtered(value, own)
            later = np.zeros_like(late)
            later[:, 1:] = late[:, :-1]
            re, im = late - value.real * later, value.imag * later
            block[nz], other[nz] = re[0] - im[1], re[1] + im[0]
            seen += 1
        return out, width

    def _mix(self, width: int, start: np.ndarray) -> tuple[FloatArray, np.ndarray]:
        """Coefficients of the whitened sensitivities on the basis (width, p, D); the turn of the
        start (n, d)."""
        h, pairs = self.h, self.pairs
        n, m, p = self.system.sizes
        nz, d = m + p, self.own.shape[1]
        size, tall = nz + 2, (h + len(pairs)) * (nz + 2)
        turned = -np.matmul(start, self.turn)
        gain = self.g[:, m:] / (1.0 - self.values)[:, None]
        block = np.zeros((h, size, p, d + n + p), dtype=complex)
        block[:, : nz + 1, :, :d] = self.push
        c = (self.weight * self.c[:, :h]).T[:, :, None]
        block[:, nz + 1, :, :d] = c * turned[:h, None]
        block[:, nz + 1, :, :d] += (self.weight * start[:h])[:, None, None] * self.moved_c[
            :, :h
        ].transpose(1, 0, 2)
        block[:, nz + 1, :, d : d + n] = c * self.inverse[:h, None]
        block[:, nz + 1, :, d + n :] = c * gain[:h, None]
        mix = np.zeros((width, p, d + n + p))
        mix[: h * size] = block.real.reshape(h * size, p, d + n + p)
        mix[h * size : tall] = -block[pairs].imag.reshape(len(pairs) * size, p, d + n + p)
        mix[tall : tall + m, :, :d] = self.dd.transpose(1, 0, 2)
        mix[tall + m, :, d + n :] = self.whitener - (self.c @ gain).real
        return mix, turned


def _filtered(pole: complex, signals: FloatArray) -> FloatArray:
    """From rest, each row through 1 / (q - pole) for a real pole, q / (q^2 - 2 Re pole q +
    |pole|^2) for a complex one."""
    if pole.imag == 0.0:
        return np.asarray(lfilter([0.0, 1.0], [1.0, -pole.real], signals))
    return np.asarray(lfilter([0.0, 1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], signals))
