"""Elements of a filter: many samples in one are the same samples one by one, with exact
derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from greybox.estimation.elements import Element, System

ALL = np.ones(4, dtype=bool)
SOME = np.array([True, False, True, False])
NONE = np.zeros(4, dtype=bool)
N, NE, NW, NS = 6, 4, 3, 5


def parts(seed: int) -> list[np.ndarray]:
    """A, G, C, D, q, r; noise reaches state and sensor alike."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(N, N))
    a *= 1.02 / np.abs(np.linalg.eigvals(a)).max()
    shapes = ((N, NW), (NE, N), (NE, NW))
    return [
        a,
        *(rng.normal(size=s) for s in shapes),
        np.exp(rng.normal(size=NW)),
        np.exp(rng.normal(size=NE)),
    ]


def directions(seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(100 + seed)
    return [rng.normal(size=(NS, *v.shape)) for v in parts(seed)]


def system(seed: int, along: int | None = None, by: float = 0.0) -> System:
    """With slopes; moved `by` along one of the directions without."""
    a, g, c, d, q, r = (
        v + (0 if along is None else by * w[along])
        for v, w in zip(parts(seed), directions(seed), strict=True)
    )
    slopes = None if along is not None else tuple(directions(seed))
    return System(a=a, g=g, c=c, d=d, q=q, r=r, weak=np.full(N, np.inf), slopes=slopes)  # type: ignore[arg-type]


def by_hand(s: System, p: np.ndarray, channels: list[np.ndarray]) -> np.ndarray:
    """The Kalman recursion as textbooks have it."""
    for m in channels:
        p_next = s.a @ p @ s.a.T + (s.g * s.q) @ s.g.T
        if m.any():
            c, d = s.c[m], s.d[m]
            innovation = c @ p @ c.T + (d * s.q) @ d.T + np.diag(s.r[m])
            cross = s.a @ p @ c.T + (s.g * s.q) @ d.T
            p_next = p_next - cross @ np.linalg.solve(innovation, cross.T)
        p = p_next
    return p


def start(seed: int) -> np.ndarray:
    root = np.random.default_rng(200 + seed).normal(size=(N, N))
    return root @ root.T


@pytest.mark.parametrize("seed", range(4))
def test_one_sample_after_the_other_is_the_kalman_recursion(seed):
    s, p = system(seed), start(seed)
    channels = [ALL, SOME, NONE, ALL, SOME]
    expected = by_hand(s, p, channels)
    for m in channels:
        p, _ = s.element(m).moved(p)
    np.testing.assert_allclose(p, expected, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_many_samples_in_one_element_are_these_samples(seed):
    s, p = system(seed), start(seed)
    whole: Element = s.element(SOME)
    for _ in range(4):
        whole = whole.then(whole)
    whole = whole.then(s.element(ALL)).then(s.element(NONE))
    zero = np.zeros((NS, N, N))
    got, slope = whole.moved(p, zero)
    one_by_one, slopes = p, zero
    for m in [SOME] * 16 + [ALL, NONE]:
        one_by_one, slopes = s.element(m).moved(one_by_one, slopes)
    np.testing.assert_allclose(got, one_by_one, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(slope, slopes, rtol=1e-7, atol=1e-8 * np.abs(slopes).max())


@pytest.mark.parametrize("seed", range(3))
def test_slopes_are_central_differences(seed):
    channels, h = [ALL, SOME, NONE, SOME, ALL], 1e-6
    s, p = system(seed), start(seed)
    whole = s.element(channels[0])
    for m in channels[1:]:
        whole = whole.then(s.element(m))
    slope = whole.moved(p, np.zeros((NS, N, N)))[1]
    assert slope is not None
    for j in range(NS):
        ahead, behind = (by_hand(system(seed, j, sign * h), p, channels) for sign in (1, -1))
        numeric = (ahead - behind) / (2 * h)
        np.testing.assert_allclose(slope[j], numeric, rtol=1e-6, atol=1e-7 * np.abs(numeric).max())


@pytest.mark.parametrize("seed", range(3))
def test_the_same_samples_for_ever_end_in_the_stationary_solution(seed):
    a, g, c, d, q, r = parts(seed)
    expected = solve_discrete_are(
        a.T, c.T, (g * q) @ g.T, np.diag(r) + (d * q) @ d.T, s=(g * q) @ d.T
    )
    got = system(seed).element(ALL).settled()
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


def test_without_noise_the_covariance_falls_like_one_over_k_and_stays_positive():
    """A constant seen k times: P = (1/p0 + k/r)^-1, exactly."""
    one, none = np.eye(1), np.zeros((1, 1))
    s = System(
        a=one, g=one, c=one, d=none, q=np.zeros(1), r=np.array([0.25]), weak=np.array([np.inf])
    )
    e = s.element(np.array([True]))
    for k in range(1, 24):
        e = e.then(e)
        assert e.moved(100 * one)[0][0, 0] == pytest.approx(1 / (0.01 + 2**k / 0.25), rel=1e-9)
