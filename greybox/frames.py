"""Quaternion and rotation algebra in CasADi. Nothing else in greybox defines a rotation.

Conventions: world frame ENU (z up), body frame FLU (x forward, y left, z up). A unit quaternion q =
(w, x, y, z) maps body vectors to world vectors, v_world = R(q) v_body. Euler angles are ZYX (yaw
psi, pitch theta, roll phi), for reports and GP inputs only. The attitude error delta_theta is in
body axes: q = q_hat * exp(delta_theta / 2).

Source of the formulas: J. Sola, "Quaternion kinematics for the error-state Kalman filter",
arXiv:1711.02508 (Hamilton convention, local error).
"""

from __future__ import annotations

import functools

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.symbolic import Expr, FloatArray, evaluate

GRAVITY = 9.80665
"""Standard gravity [m/s^2], used where the vehicle file says nothing else."""


def quat_multiply(a: Expr, b: Expr) -> Expr:
    """Hamilton product a * b of quaternions (w, x, y, z)."""
    return ca.vertcat(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def quat_conjugate(q: Expr) -> Expr:
    """Conjugate (w, -x, -y, -z): the inverse of a unit quaternion."""
    return ca.vertcat(q[0], -q[1], -q[2], -q[3])


def quat_normalize(q: Expr) -> Expr:
    """q / |q|."""
    return q / ca.sqrt(ca.sumsqr(q))


def rotation_matrix(q: Expr) -> Expr:
    """R(q), 3 x 3, body to world, for a unit quaternion (w, x, y, z)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def quat_exp(rotation_vector: Expr) -> Expr:
    """Unit quaternion of a rotation vector [rad]; smooth at zero (sinc by a guarded division)."""
    half = 0.5 * rotation_vector
    # 1e-30 keeps sqrt differentiable at zero and is below double precision everywhere else.
    angle = ca.sqrt(ca.sumsqr(half) + 1e-30)
    return ca.vertcat(ca.cos(angle), ca.sin(angle) / angle * half)


def quat_log(q: Expr) -> Expr:
    """Rotation vector [rad] of a unit quaternion, in the ball of radius pi (q and -q give the
    same); smooth at identity."""
    sign = ca.if_else(q[0] < 0, -1.0, 1.0)
    w, v = sign * q[0], sign * q[1:4]
    n = ca.sqrt(ca.sumsqr(v) + 1e-30)
    return 2.0 * ca.atan2(n, w) / n * v


def quat_derivative(q: Expr, omega: Expr) -> Expr:
    """dq/dt = q * (0, omega) / 2 for the body rate omega [rad/s]."""
    return 0.5 * quat_multiply(q, ca.vertcat(0, omega))


def quat_difference(q_hat: Expr, q: Expr) -> Expr:
    """delta_theta [rad], body axes, with q = q_hat * exp(delta_theta / 2)."""
    return quat_log(quat_multiply(quat_conjugate(q_hat), q))


def euler_zyx(q: Expr) -> Expr:
    """(phi, theta, psi) = (roll, pitch, yaw) [rad] of a unit quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return ca.vertcat(
        ca.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        ca.asin(ca.fmax(-1.0, ca.fmin(1.0, 2 * (w * y - z * x)))),
        ca.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def quat_from_euler(phi: Expr, theta: Expr, psi: Expr) -> Expr:
    """Unit quaternion of ZYX Euler angles [rad]."""
    qz = ca.vertcat(ca.cos(psi / 2), 0, 0, ca.sin(psi / 2))
    qy = ca.vertcat(ca.cos(theta / 2), 0, ca.sin(theta / 2), 0)
    qx = ca.vertcat(ca.cos(phi / 2), ca.sin(phi / 2), 0, 0)
    return quat_multiply(quat_multiply(qz, qy), qx)


@functools.cache
def _function(name: str) -> ca.Function:
    q, p, v = ca.SX.sym("q", 4), ca.SX.sym("p", 4), ca.SX.sym("v", 3)
    bodies = {
        "rotate": ([q, v], rotation_matrix(q) @ v),
        "rotate_inverse": ([q, v], rotation_matrix(q).T @ v),
        "difference": ([q, p], quat_difference(q, p)),
        "matrix": ([q], ca.vec(rotation_matrix(q).T)),
        "multiply": ([q, p], quat_multiply(q, p)),
        "exp": ([v], quat_exp(v)),
        "log": ([q], quat_log(q)),
        "euler": ([q], euler_zyx(q)),
        "from_euler": ([v], quat_from_euler(v[0], v[1], v[2])),
    }
    inputs, output = bodies[name]
    return ca.Function(name, inputs, [output])


def numeric(name: str, *arrays: npt.ArrayLike) -> FloatArray:
    """Evaluate a rotation formula over many samples, time first: arrays (N, 3) or (N, 4) in, (N, 3)
    or (N, 4) out.

    Names: rotate(q, v), rotate_inverse(q, v), difference(q_hat, q), multiply(a, b), exp(v), log(q),
    euler(q) -> (phi, theta, psi), from_euler((phi, theta, psi)), matrix(q) -> R row by row (N, 9).
    """
    return evaluate(
        _function(name), *(np.atleast_2d(np.asarray(a, dtype=np.float64)) for a in arrays)
    )
