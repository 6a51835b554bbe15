"""Rotation algebra against definitions that do not use it: the matrix exponential, scipy's
rotations, kinematics."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from greybox.frames import (
    euler_zyx,
    numeric,
    quat_derivative,
    quat_exp,
    quat_log,
    quat_multiply,
    rotation_matrix,
)

quickly = settings(deadline=None, max_examples=150, derandomize=True)
quaternions = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .filter(lambda q: np.linalg.norm(q) > 1e-2)
    .map(lambda q: np.array(q) / np.linalg.norm(q))
)
vectors = st.tuples(*[st.floats(-10, 10)] * 3).map(np.array)
turns = (
    st.tuples(*[st.floats(-1, 1)] * 3)
    .filter(lambda v: np.linalg.norm(v) > 1e-9)
    .flatmap(
        lambda v: st.floats(0, np.pi - 1e-6).map(lambda a: a * np.array(v) / np.linalg.norm(v))
    )
)


def number(value):
    return np.squeeze(np.asarray(ca.DM(value).full()))


def matrix(q):
    return ca.DM(rotation_matrix(ca.DM(q))).full()


def cross(v):
    """[v]x, with [v]x w = v x w."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


@quickly
@given(quaternions)
def test_a_rotation_matrix_is_orthonormal_and_right_handed(q):
    r = matrix(q)
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(r) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(r, matrix(-q), atol=0)
    np.testing.assert_allclose(r, Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), atol=1e-14)


@quickly
@given(quaternions, quaternions)
def test_the_quaternion_product_is_the_matrix_product(a, b):
    np.testing.assert_allclose(
        matrix(number(quat_multiply(ca.DM(a), ca.DM(b)))), matrix(a) @ matrix(b), atol=1e-14
    )


@quickly
@given(vectors)
def test_the_exponential_is_the_matrix_exponential(v):
    r = expm(cross(v))
    np.testing.assert_allclose(matrix(number(quat_exp(ca.DM(v)))), r, atol=1e-12)


@quickly
@given(turns)
def test_log_inverts_exp_inside_the_ball_of_radius_pi(v):
    np.testing.assert_allclose(number(quat_log(quat_exp(ca.DM(v)))), v, atol=1e-9)


@quickly
@given(quaternions)
def test_exp_inverts_log_up_to_the_sign_of_the_quaternion(q):
    again = number(quat_exp(quat_log(ca.DM(q))))
    np.testing.assert_allclose(again * np.sign(again @ q), q, atol=1e-12)
    if abs(q[0]) > 1e-9:  # at half a turn both signs of the axis are right
        np.testing.assert_allclose(
            number(quat_log(ca.DM(-q))), number(quat_log(ca.DM(q))), atol=1e-12
        )
    assert np.linalg.norm(number(quat_log(ca.DM(q)))) <= np.pi + 1e-12


@quickly
@given(st.floats(-3.14, 3.14), st.floats(-1.5, 1.5), st.floats(-3.14, 3.14))
def test_euler_angles_come_back(phi, theta, psi):
    q = numeric("from_euler", [phi, theta, psi])
    np.testing.assert_allclose(numeric("euler", q)[0], [phi, theta, psi], atol=1e-10)


@quickly
@given(st.floats(-3.14, 3.14), st.floats(-1.5, 1.5), st.floats(-3.14, 3.14))
def test_euler_angles_are_yaw_then_pitch_then_roll(phi, theta, psi):
    q = numeric("from_euler", [phi, theta, psi])[0]
    np.testing.assert_allclose(
        matrix(q), Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix(), atol=1e-12
    )


@pytest.mark.parametrize("theta", [np.pi / 2, -np.pi / 2])
def test_euler_angles_stay_finite_where_roll_and_yaw_are_one(theta):
    q = numeric("from_euler", [0.3, theta, 0.0])[0]
    angles = numeric("euler", q * (1 + 1e-12))[0]
    assert np.isfinite(angles).all()
    assert angles[1] == pytest.approx(theta, abs=1e-6)


@quickly
@given(quaternions, vectors)
def test_the_derivative_is_that_of_turning_by_omega_dt_in_body_axes(q, omega):
    h = 1e-6
    ahead, behind = (
        number(quat_multiply(ca.DM(q), quat_exp(ca.DM(s * h * omega)))) for s in (1, -1)
    )
    np.testing.assert_allclose(
        number(quat_derivative(ca.DM(q), ca.DM(omega))), (ahead - behind) / (2 * h), atol=1e-8
    )


@quickly
@given(quaternions, vectors)
def test_a_rotation_matrix_obeys_poisson(q, omega):
    """dR/dt = R [omega]x, with dR/dt by the chain rule through dq/dt."""
    s = ca.SX.sym("q", 4)
    rate = ca.Function(
        "r", [s], [ca.jtimes(ca.vec(rotation_matrix(s)), s, quat_derivative(s, ca.DM(omega)))]
    )(q)
    np.testing.assert_allclose(ca.reshape(rate, 3, 3).full(), matrix(q) @ cross(omega), atol=1e-12)


def test_exp_log_and_difference_are_smooth_at_the_identity():
    v = ca.SX.sym("v", 3)
    slope = ca.Function(
        "s", [v], [ca.jacobian(quat_exp(v), v), ca.jacobian(quat_log(quat_exp(v)), v)]
    )
    at_zero, round_trip = (m.full() for m in slope(np.zeros(3)))
    np.testing.assert_allclose(at_zero, np.vstack([np.zeros(3), 0.5 * np.eye(3)]), atol=1e-15)
    np.testing.assert_allclose(round_trip, np.eye(3), atol=1e-12)


def test_many_rotations_at_once_are_those_one_by_one():
    rng = np.random.default_rng(0)
    q = rng.normal(size=(7, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    v = rng.normal(size=(7, 3))
    world = numeric("rotate", q, v)
    np.testing.assert_allclose(
        world, [matrix(a) @ b for a, b in zip(q, v, strict=True)], atol=1e-14
    )
    np.testing.assert_allclose(numeric("rotate_inverse", q, world), v, atol=1e-14)
    small = 0.1 * v
    np.testing.assert_allclose(
        numeric("difference", q, numeric("multiply", q, numeric("exp", small))), small, atol=1e-12
    )
    np.testing.assert_allclose(numeric("log", numeric("exp", small)), small, atol=1e-12)
    np.testing.assert_allclose(
        numeric("euler", q), [number(euler_zyx(ca.DM(a))) for a in q], atol=1e-15
    )
