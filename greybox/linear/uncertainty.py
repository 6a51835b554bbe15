"""Uncertainty of what does not depend on state coordinates: poles, zeros, frequency response,
steady gain.

The covariance of the entries of (A, B, C, D, K) lives on the tangent space that the fit used, so
that it has rank d and says nothing about directions that only change coordinates. Any quantity that
is the same in all coordinates has a gradient without components along those directions, so that its
variance g' P g is the same whichever coordinates the covariance is expressed in (delta method;
Ljung 1999, section 9.6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sla

from greybox.model.matrices import Matrices
from greybox.statistics.distributions import chi_square_quantile
from greybox.symbolic import BoolArray, FloatArray

STRONG = 25.0
"""Strength of a mode from which the standard error of its pole is believed: about 5 standard errors
of the residue."""
CROWDED = 0.1
"""Largest share of the distance to the next pole that a standard error may have to be believed."""


@dataclass(frozen=True, kw_only=True)
class ComplexEstimate:
    """Complex numbers `value` (k,) with covariances of their (real, imaginary) parts `covariance`
    (k, 2, 2)."""

    value: np.ndarray
    covariance: FloatArray

    def ellipse(self, i: int, *, level: float = 0.95, points: int = 65) -> np.ndarray:
        """Boundary (points,) of the confidence ellipse of number i in the complex plane (a segment
        for a real one)."""
        values, vectors = np.linalg.eigh(self.covariance[i])
        inside = values[0] <= 1e-12 * max(float(values[1]), 1e-300)
        radius = np.sqrt(_chi2(level, 1 if inside else 2))
        angle = np.linspace(0, 2 * np.pi, points)
        xy = vectors @ (
            np.sqrt(np.maximum(values, 0))[:, None]
            * radius
            * np.array([np.cos(angle), np.sin(angle)])
        )
        return np.asarray(self.value[i] + xy[0] + 1j * xy[1])


@dataclass(frozen=True, kw_only=True)
class Uncertainty:
    """A system with a factor S (q, d) of the covariance S S' of `vector(system)` = [A, B, K rows;
    C; D] entries."""

    system: Matrices
    factor: FloatArray

    def transformed(self, t: FloatArray) -> Uncertainty:
        """The same knowledge in the coordinates x' = T x, T (n, n)."""
        n, m, p = self.system.sizes
        inverse = np.linalg.inv(t)
        columns = []
        for s in self.factor.T:
            da, db, dc, dd, dk = _split(s, (n, m, p))
            columns.append(_join(t @ da @ inverse, t @ db, dc @ inverse, dd, t @ dk))
        return Uncertainty(system=self.system.transformed(t), factor=np.array(columns).T)

    def of(self, gradient: FloatArray) -> FloatArray:
        """Covariance (k, k) of k real quantities with `gradient` (k, q) in the entries."""
        spread = gradient @ self.factor
        return np.asarray(spread @ spread.T)

    def poles(self) -> ComplexEstimate:
        """Eigenvalues of A with covariances: d lambda = w' dA v / w' v (Golub and Van Loan 2013,
        section 7.2.2)."""
        return self._eigenvalues(self.system.a, "a")

    def pole_strengths(self) -> FloatArray:
        """Wald statistic per degree of freedom (n,) of the hypothesis that a mode is not there, in
        the order of `poles`.

        The mode of a pole enters by its residue R = C v w' [B, K]; strength is r' cov(r)^+ r over
        the rank of cov(r), r the entries of R (real and imaginary for a complex pole). About 1 is
        noise.
        """
        n, m, p = self.system.sizes
        values, left, right = sla.eig(self.system.a, left=True, right=True)
        scale = np.einsum("ai,ai->i", left.conj(), right)
        drive = np.hstack([self.system.b, self.system.k])
        parts = [_split(s, (n, m, p)) for s in self.factor.T]
        out = []
        for i in np.argsort(np.round(values, 12)):
            others = np.delete(np.arange(n), i)
            gaps = values[i] - values[others]
            gaps = np.where(np.abs(gaps) < 1e-12, 1e-12, gaps)
            rest = (right[:, others] / (scale[others] * gaps)) @ left[:, others].conj().T
            mode = np.outer(right[:, i], left[:, i].conj()) / scale[i]
            rows = []
            for da, db, dc, _, dk in parts:
                turned = rest @ da @ mode + mode @ da @ rest
                change = dc @ mode @ drive + self.system.c @ (
                    turned @ drive + mode @ np.hstack([db, dk])
                )
                rows.append(change.ravel())
            residue, spread = (self.system.c @ mode @ drive).ravel(), np.array(rows).T
            if values[i].imag == 0.0:
                residue, spread, freedom = residue.real, spread.real, m + 2 * p - 1
            else:
                residue = np.concatenate([residue.real, residue.imag])
                spread, freedom = np.vstack([spread.real, spread.imag]), 2 * (m + 2 * p - 1)
            u, s, _ = np.linalg.svd(spread, full_matrices=False)
            keep = s[:freedom] > 1e-9 * max(float(s.max(initial=0.0)), 1e-300)
            out.append(
                float((((u[:, :freedom].T @ residue)[keep] / s[:freedom][keep]) ** 2).sum())
                / max(keep.sum(), 1)
            )
        return np.array(out)

    def well_determined(self) -> BoolArray:
        """Whether the standard error of each pole (order of `poles`) can be believed: booleans
        (n,).

        A weak mode (strength below `STRONG`) or one whose neighbour is nearer than ten of its
        standard errors has a likelihood that is no parabola: its interval is too short.
        `pole_profile` has intervals for those.
        """
        poles = self.poles()
        distance = np.abs(poles.value[:, None] - poles.value[None])
        np.fill_diagonal(distance, np.inf)
        std = np.sqrt(np.trace(poles.covariance, axis1=1, axis2=2))
        crowded = std > CROWDED * distance.min(axis=1, initial=np.inf)
        return np.asarray((self.pole_strengths() >= STRONG) & ~crowded)

    def predictor_poles(self) -> ComplexEstimate:
        """Eigenvalues of A - KC, the zeros of the noise model."""
        return self._eigenvalues(self.system.predictor, "f")

    def zeros(self, output: int | None = None, input: int | None = None) -> ComplexEstimate:
        """Finite invariant zeros of the square system, or of one (output, input) channel.

        Zeros beyond 1e3 in size are those at infinity and are left out. A system that is not square
        has none.
        """
        n, m, p = self.system.sizes
        rows = slice(None) if output is None else slice(output, output + 1)
        columns = slice(None) if input is None else slice(input, input + 1)
        a, b, c, d = (
            self.system.a,
            self.system.b[:, columns],
            self.system.c[rows],
            self.system.d[rows, columns],
        )
        if b.shape[1] != c.shape[0]:
            return ComplexEstimate(value=np.zeros(0, dtype=complex), covariance=np.zeros((0, 2, 2)))
        size = n + c.shape[0]
        left = np.block([[a, b], [c, d]])
        right = np.zeros((size, size))
        right[:n, :n] = np.eye(n)
        values, lv, rv = sla.eig(left, right, left=True, right=True)
        keep = np.flatnonzero(np.isfinite(values) & (np.abs(values) < 1e3))
        keep = keep[np.argsort(np.round(values[keep], 12))]
        out, covariance = [], []
        for i in keep:
            w, v = lv[:, i].conj(), rv[:, i]
            scale = w[:n] @ v[:n]
            spread = []
            for s in self.factor.T:
                da, db, dc, dd, _ = _split(s, (n, m, p))
                change = np.block([[da, db[:, columns]], [dc[rows], dd[rows, columns]]])
                spread.append(w @ change @ v / scale)
            out.append(values[i])
            covariance.append(_two_by_two(np.array(spread)))
        return ComplexEstimate(
            value=np.array(out, dtype=complex), covariance=np.array(covariance).reshape(-1, 2, 2)
        )

    def response(self, frequencies: FloatArray, dt: float) -> tuple[np.ndarray, FloatArray]:
        """Frequency response G (k, p, m) at `frequencies` [Hz] and covariances (k, p, m, 2, 2) of
        (real, imaginary)."""
        n, m, p = self.system.sizes
        a, b, c, d, _ = self.system
        parts = [_split(s, (n, m, p)) for s in self.factor.T]
        count = len(parts)
        da = np.array([v[0] for v in parts]).reshape(count, n, n)
        db = np.array([v[1] for v in parts]).reshape(count, n, m)
        dc = np.array([v[2] for v in parts]).reshape(count, p, n)
        dd = np.array([v[3] for v in parts]).reshape(count, p, m)
        gains, covariances = [], []
        for frequency in np.atleast_1d(frequencies):
            z = np.exp(2j * np.pi * frequency * dt)
            pencil = z * np.eye(n) - a
            xb = np.linalg.solve(pencil, b)
            cx = np.linalg.solve(pencil.T, c.T).T
            gains.append(c @ xb + d)
            change = dc @ xb + cx @ da @ xb + cx @ db + dd
            covariances.append([[_two_by_two(change[:, i, j]) for j in range(m)] for i in range(p)])
        return np.array(gains), np.array(covariances).reshape(-1, p, m, 2, 2)

    def bode(self, frequencies: FloatArray, dt: float) -> dict[str, FloatArray]:
        """Magnitude and phase [rad] with standard errors, each (k, p, m): magnitude, phase,
        magnitude_std, phase_std.

        `log_magnitude_std` is the standard error of ln |G|, for bands that stay positive.
        """
        g, cov = self.response(frequencies, dt)
        size = np.maximum(np.abs(g), 1e-300)
        along = np.stack([g.real, g.imag], axis=-1) / size[..., None]
        across = np.stack([-g.imag, g.real], axis=-1) / size[..., None]
        var_size = np.einsum("...i,...ij,...j->...", along, cov, along)
        var_phase = np.einsum("...i,...ij,...j->...", across, cov, across) / size**2
        return {
            "magnitude": np.abs(g),
            "phase": np.unwrap(np.angle(g), axis=0),
            "magnitude_std": np.sqrt(np.maximum(var_size, 0)),
            "phase_std": np.sqrt(np.maximum(var_phase, 0)),
            "log_magnitude_std": np.sqrt(np.maximum(var_size, 0)) / size,
        }

    def _eigenvalues(self, matrix: FloatArray, what: str) -> ComplexEstimate:
        n, m, p = self.system.sizes
        values, left, right = sla.eig(matrix, left=True, right=True)
        order = np.argsort(np.round(values, 12))
        out = []
        for i in order:
            w, v = left[:, i].conj(), right[:, i]
            scale = w @ v
            spread = []
            for s in self.factor.T:
                da, _, dc, _, dk = _split(s, (n, m, p))
                change = da if what == "a" else da - dk @ self.system.c - self.system.k @ dc
                spread.append(w @ change @ v / scale)
            out.append(_two_by_two(np.array(spread)))
        return ComplexEstimate(value=values[order], covariance=np.array(out).reshape(-1, 2, 2))


def uncertainty(
    system: Matrices, information: FloatArray, tangent: FloatArray, scores: FloatArray | None = None
) -> tuple[Uncertainty, int]:
    """From H = J'J (d, d) along `tangent` (q, d; coordinates of `predictor.full_vector`). Also the
    rank of H.

    The covariance is H^-1 (Fisher), or with the covariance M of the `scores` (d, d) the sandwich
    H^-1 M H^-1. Directions that the data do not see (relative eigenvalue below 1e-12) get no
    covariance; the rank tells how many are left, and a caller must say so where it is below d.
    """
    n, m, p = system.sizes
    scale = np.sqrt(
        np.maximum(
            np.diag(information), 1e-14 * max(float(np.diag(information).max(initial=0.0)), 1e-300)
        )
    )
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    keep = (
        values > 1e-12 * max(float(values[-1]), 1e-300) if len(values) else np.zeros(0, dtype=bool)
    )
    root = (vectors[:, keep] / np.sqrt(values[keep])) / scale[:, None]
    if scores is not None:
        share, turn = np.linalg.eigh(root.T @ scores @ root)
        root = root @ turn * np.sqrt(np.maximum(share, 0.0))
    predictor = tangent @ root
    columns = []
    width, first = n + m + p, n * (n + m + p)
    for s in predictor.T:
        rows = s[:first].reshape(n, width)
        df, db, dk = rows[:, :n], rows[:, n : n + m], rows[:, n + m :]
        dc, dd = s[first : first + p * n].reshape(p, n), s[first + p * n :].reshape(p, m)
        columns.append(
            _join(
                df + dk @ system.c + system.k @ dc, db + dk @ system.d + system.k @ dd, dc, dd, dk
            )
        )
    return Uncertainty(
        system=system, factor=np.array(columns).T.reshape(tangent.shape[0], -1)
    ), int(keep.sum())


def rescaled(known: Uncertainty, input_scale: FloatArray, output_scale: FloatArray) -> Uncertainty:
    """From unit-scale signals u / su, y / sy to the units of the channels."""
    n, m, p = known.system.sizes
    su, sy = input_scale, output_scale
    columns = []
    for s in known.factor.T:
        da, db, dc, dd, dk = _split(s, (n, m, p))
        columns.append(_join(da, db / su, dc * sy[:, None], dd * sy[:, None] / su, dk / sy))
    return Uncertainty(
        system=known.system.scaled(1 / su, 1 / sy),
        factor=np.array(columns).T.reshape(known.factor.shape[0], -1),
    )


def _split(s: FloatArray, sizes: tuple[int, int, int]) -> tuple[FloatArray, ...]:
    n, m, p = sizes
    width, first = n + m + p, n * (n + m + p)
    rows = s[:first].reshape(n, width)
    return (
        rows[:, :n],
        rows[:, n : n + m],
        s[first : first + p * n].reshape(p, n),
        s[first + p * n :].reshape(p, m),
        rows[:, n + m :],
    )


def _join(
    da: FloatArray, db: FloatArray, dc: FloatArray, dd: FloatArray, dk: FloatArray
) -> FloatArray:
    return np.concatenate([np.hstack([da, db, dk]).ravel(), dc.ravel(), dd.ravel()])


def _two_by_two(spread: np.ndarray) -> FloatArray:
    both = np.array([spread.real, spread.imag])
    return np.asarray(both @ both.T)


def _chi2(level: float, freedom: int) -> float:

    return float(chi_square_quantile(level, freedom))
