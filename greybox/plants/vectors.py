"""Vector and quaternion algebra on components that are floats (one plant) or arrays of shape (B,)
(B plants at once).

A vector is a tuple of three components, a quaternion a tuple (w, x, y, z) that maps body to world,
a rotation matrix the tuple of its nine elements row by row. Writing physics on components lets the
same lines run on Python floats, which is fast for one flight, and on arrays, which is fast for
hundreds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Number = Any
"""A float, or an array of shape (B,) for a batch of B plants."""
Command = Sequence[Number] | NDArray[np.float64]
"""Rotor commands: n of one plant, or shape (B, n) for a batch."""
Vector = tuple[Number, Number, Number]
"""Three components."""
Quaternion = tuple[Number, Number, Number, Number]
"""w, x, y, z; body to world."""
Matrix = tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]
"""Nine elements of a 3 x 3 matrix, row by row."""

ZERO: Vector = (0.0, 0.0, 0.0)


def add(a: Vector, b: Vector) -> Vector:
    """a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def subtract(a: Vector, b: Vector) -> Vector:
    """a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def cross(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def norm(a: Vector) -> Number:
    """Euclidean length of a; zero at zero."""
    return (a[0] * a[0] + a[1] * a[1] + a[2] * a[2]) ** 0.5


def rotation(q: Quaternion) -> Matrix:
    """Rotation matrix R(q) of a unit quaternion; R maps body vectors to world."""
    w, x, y, z = q
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


def apply(m: Matrix, v: Vector) -> Vector:
    """m v; with m = R(q), from body to world."""
    x, y, z = v
    return (
        m[0] * x + m[1] * y + m[2] * z,
        m[3] * x + m[4] * y + m[5] * z,
        m[6] * x + m[7] * y + m[8] * z,
    )


def apply_transposed(m: Matrix, v: Vector) -> Vector:
    """m^T v; with m = R(q), from world to body."""
    x, y, z = v
    return (
        m[0] * x + m[3] * y + m[6] * z,
        m[1] * x + m[4] * y + m[7] * z,
        m[2] * x + m[5] * y + m[8] * z,
    )


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product a * b."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def quaternion_of(theta: Vector) -> Quaternion:
    """Unit quaternion exp(theta/2) of the rotation vector theta [rad]; exact, also at zero."""
    angle = norm(theta)
    if isinstance(angle, float):
        half = 0.5 * angle
        scale = 0.5 * (math.sin(half) / half if half > 1e-9 else 1.0)
        return (math.cos(half), scale * theta[0], scale * theta[1], scale * theta[2])
    scale = 0.5 * np.sinc(angle / (2.0 * np.pi))
    return (np.cos(0.5 * angle), scale * theta[0], scale * theta[1], scale * theta[2])


def normalised(q: Quaternion) -> Quaternion:
    """q scaled to unit length."""
    w, x, y, z = q
    scale = (w * w + x * x + y * y + z * z) ** -0.5
    return (w * scale, x * scale, y * scale, z * scale)


def exponential(x: Number) -> Number:
    """e^x of a float or an array."""
    return math.exp(x) if isinstance(x, float) else np.exp(x)


def clip(x: Number, low: Number, high: Number) -> Number:
    """X limited to [low, high]."""
    if isinstance(x, float) and isinstance(low, float) and isinstance(high, float):
        return low if x < low else high if x > high else x
    return np.minimum(np.maximum(x, low), high)


def where(condition: bool | NDArray[np.bool_], a: Number, b: Number) -> Number:
    """A where the condition holds, else b."""
    if isinstance(condition, bool):
        return a if condition else b
    return np.where(condition, a, b)


def inverse_symmetric(
    xx: Number, yy: Number, zz: Number, xy: Number, xz: Number, yz: Number
) -> Matrix:
    """Inverse of a symmetric 3 x 3 matrix given by its elements."""
    a = yy * zz - yz * yz
    b = xz * yz - xy * zz
    c = xy * yz - xz * yy
    d = xx * zz - xz * xz
    e = xy * xz - xx * yz
    f = xx * yy - xy * xy
    det = xx * a + xy * b + xz * c
    return (a / det, b / det, c / det, b / det, d / det, e / det, c / det, e / det, f / det)
