"""The stationary gain: against scipy, against pencil and paper, against a recursion, and its
derivative by differences."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from greybox.errors import FitError
from greybox.estimation.gain import Linearisation, Riccati, solve_riccati, stationary
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.symbolic import Layout, Signal

FAR = 1e8
"""Variance of a pseudo-measurement that says nothing."""


def random_system(seed, n=6, ne=4, nw=3):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    a *= 1.02 / np.abs(np.linalg.eigvals(a)).max()  # slightly unstable: the filter must hold it
    g, c, d = rng.normal(size=(n, nw)), rng.normal(size=(ne, n)), rng.normal(size=(ne, nw))
    return a, g, c, d, np.exp(rng.normal(size=nw)), np.exp(rng.normal(size=ne))


@pytest.mark.parametrize("seed", range(6))
def test_covariance_is_that_of_scipy_with_the_cross_term(seed):
    a, g, c, d, q, r = random_system(seed)
    weak = np.full(len(a), FAR)
    # Force noise that reaches the sensor too: S = G Q D'.
    expected = solve_discrete_are(
        a.T, c.T, (g * q) @ g.T, np.diag(r) + (d * q) @ d.T, s=(g * q) @ d.T
    )
    got = solve_riccati(a, g, c, d, q, r, weak)
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())
    without = solve_discrete_are(a.T, c.T, (g * q) @ g.T, np.diag(r) + (d * q) @ d.T)
    assert np.abs(without - expected).max() > 1e-2 * np.abs(expected).max(), (
        "the cross term matters here"
    )


@pytest.mark.parametrize("seed", range(3))
def test_covariance_with_the_pseudo_sensor_is_that_of_scipy_with_the_sensor_written_out(seed):
    a, g, c, d, q, r = random_system(seed)
    n = len(a)
    weak = np.exp(np.random.default_rng(seed).normal(size=n))
    c2, d2 = np.vstack([c, np.eye(n)]), np.vstack([d, np.zeros((n, d.shape[1]))])
    r2 = np.concatenate([r, weak])
    expected = solve_discrete_are(
        a.T, c2.T, (g * q) @ g.T, np.diag(r2) + (d2 * q) @ d2.T, s=(g * q) @ d2.T
    )
    np.testing.assert_allclose(
        solve_riccati(a, g, c, d, q, r, weak), expected, rtol=1e-9, atol=1e-11
    )


def test_gain_and_innovation_covariance_are_the_fixed_point_of_the_kalman_recursion():
    a, g, c, d, q, r = random_system(11)
    solution = stationary((a, g, c, d), q, r, np.full(len(a), FAR))
    p = np.eye(len(a))
    for _ in range(500):
        s = c @ p @ c.T + (d * q) @ d.T + np.diag(r)
        k = np.linalg.solve(s, (a @ p @ c.T + (g * q) @ d.T).T).T
        closed, through = a - k @ c, g - k @ d  # Joseph's form, which keeps P positive
        p = closed @ p @ closed.T + (through * q) @ through.T + (k * r) @ k.T
    np.testing.assert_allclose(solution.P, p, rtol=1e-6, atol=1e-7)
    got, s2, _, _ = solution.gain(np.ones(len(c)))
    np.testing.assert_allclose(got, k, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(s2, s, rtol=1e-6, atol=1e-7)
    assert np.abs(np.linalg.eigvals(a - got @ c)).max() < 1


def test_a_random_walk_seen_in_noise_has_the_golden_solution():
    """P = P + q - P^2/(P + r) gives P^2 = q (P + r); with q = r = 1 P is the golden ratio (1 + sqrt
    5)/2."""
    one = np.eye(1)
    for q, r in ((1.0, 1.0), (0.04, 2.5)):
        p = (q + np.sqrt(q * q + 4 * q * r)) / 2
        got = stationary((one, one, one, 0 * one), np.array([q]), np.array([r]), np.array([1e12]))
        assert got.P[0, 0] == pytest.approx(p, rel=1e-9)
        assert got.gain(np.ones(1))[0][0, 0] == pytest.approx(p / (p + r), rel=1e-9)
        assert got.S[0, 0] == pytest.approx(p + r, rel=1e-9)


def test_noise_that_is_measured_perfectly_need_not_be_estimated():
    """x+ = a x + w, y = x + w + v with small v: K = (a P + q)/(P + q + r), worked out from the
    scalar quadratic."""
    a, q, r = 0.9, 2.0, 0.5
    # P = a^2 P + q - (a P + q)^2/(P + q + r)  <=>  P^2 + P (q + r - a^2 (q + r) - q + 2 a q) - q r = 0
    b = (q + r) * (1 - a * a) - q + 2 * a * q
    p = (-b + np.sqrt(b * b + 4 * q * r)) / 2
    one = np.eye(1)
    got = stationary((a * one, one, one, one), np.array([q]), np.array([r]), np.array([1e12]))
    assert got.P[0, 0] == pytest.approx(p, rel=1e-9)
    assert got.gain(np.ones(1))[0][0, 0] == pytest.approx((a * p + q) / (p + q + r), rel=1e-9)


def test_what_no_sensor_sees_stays_finite_and_leaves_the_rest_alone():
    """Two states that do not know of each other, one a random walk without a sensor."""
    a, g, c, d = np.eye(2), np.eye(2), np.array([[1.0, 0.0]]), np.zeros((1, 2))
    seen = stationary(
        (np.eye(1), np.eye(1), np.eye(1), np.zeros((1, 1))),
        np.ones(1),
        np.ones(1),
        np.array([1e10]),
    )
    both = stationary((a, g, c, d), np.ones(2), np.ones(1), np.full(2, 1e10))
    assert np.isfinite(both.P).all()
    assert both.P[1, 1] > 1e4
    k = both.gain(np.ones(1))[0]
    assert k[0, 0] == pytest.approx(seen.gain(np.ones(1))[0][0, 0], rel=1e-9)
    assert abs(k[1, 0]) < 1e-9


def test_numbers_that_are_not_finite_are_an_error_of_the_fit():
    a, g, c, d, q, r = random_system(0)
    a[0, 1] = np.nan
    with pytest.raises(FitError, match="Riccati"):
        solve_riccati(a, g, c, d, q, r, np.full(len(a), FAR))


def perturbed(system, direction, t):
    return tuple(m + t * dm for m, dm in zip(system, direction, strict=True))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_derivatives_of_everything_are_central_differences(seed):
    """Two parameters that move the matrices, then one process and one sensor noise level."""
    rng = np.random.default_rng(100 + seed)
    a, g, c, d, q, r = random_system(seed)
    weak = np.exp(2 + rng.normal(size=len(a)))
    directions = [tuple(rng.normal(size=m.shape) for m in (a, g, c, d)) for _ in range(2)]
    slopes = tuple(np.array([direction[i] for direction in directions]) for i in range(4))
    dq, dr = np.zeros((4, q.size)), np.zeros((4, r.size))
    dq[2], dr[3] = rng.normal(size=q.size), rng.normal(size=r.size)
    solution = stationary((a, g, c, d), q, r, weak, slopes, dq, dr)
    there = np.array([1, 0, 1, 1])
    exact = {"P": solution.dP, "N": solution.dN, "S": solution.dS}
    _, _, exact["K"], exact["partial S"] = solution.gain(there)
    h = 1e-6
    for j in range(4):
        ends = []
        for sign in (1, -1):
            t = sign * h
            moved = perturbed((a, g, c, d), directions[j], t) if j < 2 else (a, g, c, d)
            at = stationary(moved, q + t * dq[j], r + t * dr[j], weak)
            k, s, _, _ = at.gain(there)
            ends.append({"P": at.P, "N": at.N, "S": at.S, "K": k, "partial S": s})
        for name, value in exact.items():
            numeric = (ends[0][name] - ends[1][name]) / (2 * h)
            np.testing.assert_allclose(
                value[j], numeric, rtol=1e-5, atol=1e-6 * np.abs(numeric).max(), err_msg=name
            )


@pytest.mark.parametrize("there", [(1, 1, 1, 1), (1, 0, 1, 0), (0, 0, 0, 1)])
def test_the_gain_of_a_pattern_is_that_of_a_filter_with_only_these_sensors(there):
    a, g, c, d, q, r = random_system(5)
    solution = stationary((a, g, c, d), q, r, np.full(len(a), FAR))
    k, s, _, _ = solution.gain(np.array(there))
    m = np.array(there, dtype=bool)
    cov = c[m] @ solution.P @ c[m].T + (d[m] * q) @ d[m].T + np.diag(r[m])
    cross = a @ solution.P @ c[m].T + (g * q) @ d[m].T
    np.testing.assert_allclose(k[:, m], np.linalg.solve(cov, cross.T).T, rtol=1e-10)
    np.testing.assert_allclose(s[np.ix_(m, m)], cov, rtol=1e-10)
    assert np.abs(k[:, ~m]).max(initial=0.0) == 0.0
    np.testing.assert_array_equal(s[np.ix_(~m, ~m)], np.eye(int((~m).sum())))


def test_a_pattern_without_any_sensor_corrects_nothing():
    solution = Riccati(P=np.eye(2), N=np.ones((2, 2)), S=np.eye(2))
    k, s, _, _ = solution.gain(np.zeros(2))
    assert np.abs(k).max() == 0.0
    np.testing.assert_array_equal(s, np.eye(2))


def pendulum():
    """A pendulum with friction: the user's own model, not a vehicle."""
    return StateSpaceModel(
        name="pendulum",
        states=Layout([Signal(name="angle", unit="rad"), Signal(name="speed", unit="rad/s")]),
        inputs=Layout([Signal(name="torque", unit="N m")]),
        outputs=Layout([Signal(name="angle", unit="rad")]),
        parameters=(
            Parameter(name="stiffness", unit="1/s^2", nominal=9.0),
            Parameter(name="friction", unit="1/s", nominal=0.4),
        ),
        dynamics=lambda t, x, u, p: [
            x[1],
            -p["stiffness"] * ca.sin(x[0]) - p["friction"] * x[1] + u[0],
        ],
        measurement=lambda t, x, u, p: [x[0]],
        noise_states=("speed",),
    )


def test_linearisation_gives_the_matrices_of_a_model_and_their_slopes():
    model, dt = pendulum(), 0.02
    x, u, p = np.array([0.3, -0.2]), np.array([[0.1]]), np.array([9.0, 0.4])
    (a, g, c, d), slopes = Linearisation(model, ("friction",))(x, u, p, dt)
    rate = np.array([[0, 1], [-9.0 * np.cos(0.3), -0.4]])
    np.testing.assert_allclose(a, np.eye(2) + rate * dt + rate @ rate * dt**2 / 2, atol=1e-4)
    np.testing.assert_allclose(g, [[dt**2 / 2], [dt]], rtol=1e-2)
    np.testing.assert_array_equal(c, [[1, 0]])
    np.testing.assert_array_equal(d, [[0]])
    h = 1e-5
    ahead, behind = (
        Linearisation(model, ()).values(x, u, p + np.array([0, s * h]), dt) for s in (1, -1)
    )
    for slope, hi, lo in zip(slopes, ahead, behind, strict=True):
        np.testing.assert_allclose(slope[0], (hi - lo) / (2 * h), atol=1e-9)


def test_innovations_of_a_simulated_system_have_the_promised_covariance():
    """The claim behind the likelihood: cov(e) = S and e is white, with noise common to state and
    sensor."""
    rng = np.random.default_rng(8)
    a, g, c, d = (
        np.array([[0.95, 0.1], [0.0, 0.9]]),
        np.array([[0.0], [0.3]]),
        np.array([[1.0, 0.0], [0.0, 0.5]]),
        np.array([[0.0], [0.7]]),
    )
    q, r = np.array([1.0]), np.array([0.04, 0.09])
    solution = stationary((a, g, c, d), q, r, np.full(2, 1e10))
    k, s, _, _ = solution.gain(np.ones(2))
    n = 40000
    w, v = rng.normal(size=(n, 1)), rng.normal(size=(n, 2)) * np.sqrt(r)
    x, hat, e = np.zeros(2), np.zeros(2), np.zeros((n, 2))
    for t in range(n):
        e[t] = c @ x + d @ w[t] + v[t] - c @ hat
        x, hat = a @ x + g @ w[t], a @ hat + k @ e[t]
    whitened = np.linalg.solve(np.linalg.cholesky(s), e[200:].T)
    m = whitened.shape[1]
    np.testing.assert_allclose(whitened @ whitened.T / m, np.eye(2), atol=5 * np.sqrt(2 / m))
    np.testing.assert_allclose(whitened[:, 1:] @ whitened[:, :-1].T / m, 0, atol=5 / np.sqrt(m))
