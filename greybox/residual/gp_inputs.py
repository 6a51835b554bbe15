"""What every Gaussian process is asked at: one input, or rows of them, and the one form of both."""

from __future__ import annotations

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError
from greybox.symbolic import Expr, FloatArray


def standardised(z: Expr, mean: FloatArray, scale: FloatArray) -> Expr:
    """z (n_in, in any shape of CasADi's or numbers) as the column (z - mean)/scale. Raises
    `ModelError` for a wrong length."""
    if not isinstance(z, (ca.SX, ca.MX, ca.DM)):
        z = ca.DM(np.asarray(z, dtype=np.float64))
    n_in = len(mean)
    if z.numel() != n_in:
        raise ModelError(
            "the GP's input has the wrong length", expected=f"{n_in} values", got=str(z.numel())
        )
    return (ca.reshape(z, n_in, 1) - mean) / scale


def rows_of(z: npt.ArrayLike, n_in: int) -> FloatArray:
    """Inputs (N, n_in) as numbers. Raises `ModelError` for another shape."""
    rows = np.ascontiguousarray(z, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != n_in:
        raise ModelError(
            "the GP's inputs have the wrong shape", expected=f"(N, {n_in})", got=str(rows.shape)
        )
    return rows
