"""First-order Gauss-Markov noise, c+ = exp(-dt/T) c + w, of coloured noise, lines and disturbances.

(Gelb, ed. 1974, Applied Optimal Estimation, sec. 3.8; Bryson and Johansen 1965, IEEE Trans.
Automatic Control 10(1).)
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from greybox.symbolic import Expr


def kept(time: Expr, dt: Expr) -> Expr:
    """Factor exp(-dt/T) by which the noise falls in dt seconds."""
    return ca.exp(-dt / time)


def renewed(time: float, dt: float) -> float:
    """Share 1 - exp(-2 dt/T) of the stationary variance that is new in every sample of dt
    seconds."""
    return float(1 - np.exp(-2 * dt / time))


def rescaled(time: float, own: float, dt: float) -> float:
    """Factor of the level of w from samples of `own` seconds to those of `dt`, with the same
    stationary variance."""
    return float(np.sqrt(np.expm1(-2 * dt / time) / np.expm1(-2 * own / time)))


def described(level: float, values: Mapping[str, float], dt: float, name: str) -> dict[str, float]:
    """`sigma`, the stationary standard deviation, and `T` [s] of the part `name` whose driving
    noise has this level."""
    time = float(values[f"{name}.T"])
    return {"sigma": level / np.sqrt(renewed(time, dt)), "T": time}
