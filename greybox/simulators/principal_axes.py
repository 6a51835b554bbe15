"""Principal axes of an inertia, as physics engines take it."""

from __future__ import annotations

import numpy as np

from greybox.symbolic import FloatArray


def principal_axes(inertia: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(moments (3,), largest first, attitude (w, x, y, z) of their axes in the body's) of an
    inertia (3, 3) about the centre of mass."""
    moments, turn = np.linalg.eigh(inertia)
    moments, turn = moments[::-1], turn[:, ::-1].copy()
    if np.linalg.det(turn) < 0:
        turn[:, 0] = -turn[:, 0]
    return moments, _quaternion(turn)


def _quaternion(turn: FloatArray) -> FloatArray:
    """(w, x, y, z) of a rotation matrix (Shepperd 1978)."""
    diagonal = np.array([np.trace(turn), *np.diag(turn)])
    k = int(np.argmax(diagonal))
    if k == 0:
        q = np.array(
            [
                1 + diagonal[0],
                turn[2, 1] - turn[1, 2],
                turn[0, 2] - turn[2, 0],
                turn[1, 0] - turn[0, 1],
            ]
        )
    else:
        i = k - 1
        j, m = (i + 1) % 3, (i + 2) % 3
        q = np.zeros(4)
        q[0] = turn[m, j] - turn[j, m]
        q[1 + i] = 1 + turn[i, i] - turn[j, j] - turn[m, m]
        q[1 + j] = turn[i, j] + turn[j, i]
        q[1 + m] = turn[i, m] + turn[m, i]
    return np.asarray(q / np.linalg.norm(q))
