"""Covariance of a predicted state over many samples at once, and its exact derivative.

What m samples with the same or different channels do to the covariance P of the predicted state is
one map

    P' = H + A P (I + G P)^-1 A'

whatever m is: A is the transition, G the information on the first state that the samples bring, H
the covariance at the end of a state known exactly at the start. One sample is an `Element` (A, G,
H), two elements one after the other are one again, so that 2^k samples take k compositions
(Anderson and Moore 1979, Optimal Filtering, sec. 6.7, doubling; Sarkka and Garcia-Fernandez 2021,
IEEE Trans. Automatic Control 66(1), the associative composition for any sequence).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.symbolic import BoolArray, FloatArray


def stack_times(stack: FloatArray, right: FloatArray) -> FloatArray:
    """`stack` (n_s, n, m) times one matrix (m, k). Matrix by matrix, which stays in the cache: a
    third quicker than one tall product; so is a matrix that lies row by row."""
    return stack @ np.ascontiguousarray(right)


def _turned(stack: FloatArray) -> FloatArray:
    return stack.transpose(0, 2, 1)


def _both(stack: FloatArray) -> FloatArray:
    return stack + _turned(stack)


def _around(left: FloatArray, stack: FloatArray, right: FloatArray) -> FloatArray:
    """left stack right for every matrix of the stack."""
    return np.ascontiguousarray(left) @ stack_times(stack, right)


@dataclass(frozen=True, kw_only=True)
class System:
    """Linear system of a filter, states divided by `unit` (n_d), with the slopes of all its parts
    in n_s unknowns.

    a, g, c, d as in `greybox.estimation.gain`; q (n_w), r (n_e) variances; weak (n_d) those of the
    pseudo-measurement of every state, infinite for none. da, dg, dc, dd (n_s, ...), dq (n_s, n_w),
    dr (n_s, n_e); None without slopes.
    """

    a: FloatArray
    g: FloatArray
    c: FloatArray
    d: FloatArray
    q: FloatArray
    r: FloatArray
    weak: FloatArray
    slopes: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray] | None = (
        None
    )

    def scaled(self, unit: FloatArray) -> System:
        """The same system with the states in units of `unit`."""
        left, right = 1.0 / unit[:, None], unit[None, :]
        slopes = None
        if self.slopes is not None:
            da, dg, dc, dd, dq, dr = self.slopes
            slopes = left * da * right, left * dg, dc * right, dd, dq, dr
        return System(
            a=left * self.a * right,
            g=left * self.g,
            c=self.c * right,
            d=self.d,
            q=self.q,
            r=self.r,
            weak=self.weak / unit**2,
            slopes=slopes,
        )

    def element(self, there: BoolArray) -> Element:
        """One sample at which the channels `there` (n_e) are measured."""
        m = np.asarray(there, dtype=bool)
        a, g, q = self.a, self.g, self.q
        gq = g * q
        h, info, moved = gq @ g.T, np.diag(1.0 / self.weak), a
        slopes = None
        if self.slopes is not None:
            da, dg, _, _, dq, _ = self.slopes
            dh = _both(stack_times(dg, gq.T)) + (g * dq[:, None, :]) @ g.T
            slopes = da, np.zeros_like(da), dh
        if m.any():
            c, d, r = self.c[m], self.d[m], self.r[m]
            dq_ = d * q
            inverse = np.linalg.inv(np.diag(r) + dq_ @ d.T)
            cross = gq @ d.T
            through, seen = cross @ inverse, inverse @ c
            moved = a - through @ c
            h = h - through @ cross.T
            info = info + c.T @ seen
            if self.slopes is not None and slopes is not None:
                da, dg, dc, dd, dq, dr = self.slopes
                dc, dd, dr = dc[:, m], dd[:, m], dr[:, m]
                d_r = _both(stack_times(dd, dq_.T)) + (d * dq[:, None, :]) @ d.T
                d_r[:, np.arange(m.sum()), np.arange(m.sum())] += dr
                d_cross = stack_times(dg, (d * q).T) + (g * dq[:, None, :]) @ d.T + gq @ _turned(dd)
                inner = d_cross - through @ d_r  # times `inverse`: the slope of `through`
                d_moved = da - stack_times(inner, seen) - through @ dc
                side = stack_times(inner, through.T)
                d_info = _both(c.T @ (inverse @ dc)) - _around(seen.T, d_r, seen)
                slopes = d_moved, d_info, slopes[2] - side - through @ _turned(d_cross)
        return Element(A=moved, G=_even(info), H=_even(h), slopes=slopes)


def _even(m: FloatArray) -> FloatArray:
    return 0.5 * (m + m.T)


@dataclass(frozen=True, kw_only=True)
class Element:
    """What some samples do to the covariance of the predicted state: A, G, H (n_d, n_d) and their
    slopes."""

    A: FloatArray
    G: FloatArray
    H: FloatArray
    slopes: tuple[FloatArray, FloatArray, FloatArray] | None = None

    def then(self, after: Element) -> Element:
        """These samples, then those of `after`."""
        a1, g1, h1, a2, g2, h2 = self.A, self.G, self.H, after.A, after.G, after.H
        m = np.linalg.inv(np.eye(len(a1)) + h1 @ g2)
        u, v = m @ a1, a2 @ m
        w, z = g2 @ u, v @ h1
        slopes = None
        if self.slopes is not None and after.slopes is not None:
            # G and H are symmetric: of every symmetric slope half is made, and mirrored.
            (da1, dg1, dh1), (da2, dg2, dh2) = self.slopes, after.slopes
            dh_w, z_dg = stack_times(dh1, w), z @ dg2
            da = stack_times(da2 - z_dg, u) + v @ (da1 - dh_w)
            dg = dg1 + _both(_turned(da1 - 0.5 * dh_w) @ w + 0.5 * _around(u.T, dg2, u))
            dh = dh2 + _both(stack_times(da2 - 0.5 * z_dg, z.T) + 0.5 * _around(v, dh1, v.T))
            slopes = da, dg, dh
        return Element(A=a2 @ u, G=_even(g1 + a1.T @ w), H=_even(h2 + z @ a2.T), slopes=slopes)

    def moved(
        self, p: FloatArray, dp: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray | None]:
        """(P, dP) after these samples from the covariance `p` with slopes `dp` (n_s, n_d, n_d)
        before them."""
        inverse = np.linalg.inv(np.eye(len(p)) + p @ self.G)
        x = _even(inverse @ p)  # the covariance once the samples are known
        ax = self.A @ x
        after = _even(self.H + ax @ self.A.T)
        if dp is None or self.slopes is None:
            return after, None
        da, dg, dh = self.slopes
        f = self.A @ inverse
        half = stack_times(da - 0.5 * (ax @ dg), ax.T) + stack_times(0.5 * (f @ dp), f.T)
        slope = dh + _both(half)
        return after, slope

    def closed(self, p: FloatArray) -> FloatArray:
        """Transition of the filter's error over these samples, (n_d, n_d), from the covariance `p`
        before them."""
        return self.A @ np.linalg.inv(np.eye(len(p)) + p @ self.G)

    def settled(self, tolerance: float = 1e-14, most: int = 60) -> FloatArray | None:
        """P that these samples, over and over, end in; None where there is none."""
        e, plain = Element(A=self.A, G=self.G, H=self.H), None
        for _ in range(most):
            try:
                e = e.then(e)
            except np.linalg.LinAlgError:
                return None
            if not np.isfinite(e.H).all():
                return None
            if plain is not None and np.abs(e.H - plain).max() <= tolerance * np.abs(e.H).max():
                return e.H
            plain = e.H
        return None
