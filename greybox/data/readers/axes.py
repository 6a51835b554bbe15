"""Vectors and rotations as logs hold them, in the axes of our channels: of the world for a velocity,
of the body for what an IMU measures."""

from __future__ import annotations

import numpy as np

from greybox.data.raw import FloatArray
from greybox.data.readers.recording import Source
from greybox.frames import GRAVITY

_WORLD = ("ENU", "NED")
_OTHER_AXES = {"velocity": ("FLU", "FRD"), "rate": _WORLD, "specific_force": _WORLD}
"""Frames whose axes are those of the world where a group's are the body's, or the other way."""


def needs_attitude(source: Source) -> str:
    """What of a source takes the attitude, in words; empty where nothing does."""
    if source.frame in _OTHER_AXES.get(source.group, ()):
        return f"{source.group} in {'world' if source.frame in _WORLD else 'body'} axes"
    return "" if source.gravity else f"{source.group} without gravity"


def in_own_axes(values: FloatArray, quaternions: FloatArray, source: Source) -> FloatArray:
    """Vectors (N, 3) of a source, FLU or ENU, in the axes of its group; quaternions (N, 4) turn
    body to world. Gravity that was taken out of a specific force is put back."""
    # CasADi, which the rotations are written in, is loaded on first use.
    from greybox.frames import numeric

    up = np.tile([0.0, 0.0, 0.0 if source.gravity else GRAVITY], (len(values), 1))
    if source.frame not in _OTHER_AXES.get(source.group, ()):
        return values + numeric("rotate_inverse", quaternions, up)
    turn = "rotate_inverse" if source.frame in _WORLD else "rotate"
    return numeric(turn, quaternions, values + up)


def from_matrix(matrices: FloatArray) -> FloatArray:
    """Quaternions (N, 4) of rotation matrices row by row (N, 9). Their length is one only where
    the matrix is a rotation's; missing where one of its cells is."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = matrices.T
    one = np.ones_like(xx)
    # Four times the outer product of the quaternion with itself; its longest row is the surest.
    rows = np.array(
        [
            [one + xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, one + xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, one - xx + yy - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, one - xx - yy + zz],
        ]
    ).transpose(2, 0, 1)
    squares = np.nan_to_num(np.einsum("nii->ni", rows))
    best, samples = squares.argmax(axis=1), np.arange(len(rows))
    with np.errstate(invalid="ignore", divide="ignore"):
        out = rows[samples, best] / (2.0 * np.sqrt(squares[samples, best]))[:, None]
    out[np.isnan(matrices).any(axis=1)] = np.nan  # lost, even where a cell is there
    return np.asarray(np.where(out[:, :1] < 0.0, -out, out))
