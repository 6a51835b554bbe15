"""Golden vectors: points of flight, on the edge of the training domain and far outside, with the
results of CasADi.

Every function of a bundle gets the same points; C, the rebuild and any consumer must give the same
results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from greybox.symbolic import FloatArray
from mpc_export.calibration import COLUMNS, GAIN, LEVEL
from mpc_export.functions import ModelFunctions

SPREADS = (0.3, 1.0, 1.0, 1.0, 3.0, 10.0)
"""How far out the points after the reference are, again and again; 1 is typical flight."""
FARTHEST = 1 + SPREADS.index(max(SPREADS))
"""The first point that is as far out as any."""
DOUBLINGS = 12
"""So often the way out is doubled at most, until the learned part knows nothing there."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Golden:
    """Arguments and results of one function: name -> (points, numbers), column by column within a
    matrix."""

    name: str
    arguments: Mapping[str, FloatArray]
    results: Mapping[str, FloatArray]

    def csv(self) -> str:
        """One row per point; columns `in.x.0`, ..., `out.x_next.0`, ..."""
        parts = [
            (f"{kind}.{n}", v)
            for kind, d in (("in", self.arguments), ("out", self.results))
            for n, v in d.items()
        ]
        head = [f"{n}.{i}" for n, v in parts for i in range(v.shape[1])]
        rows = np.hstack([v for _, v in parts])
        return "\n".join([",".join(head), *(",".join(map(repr, r)) for r in rows.tolist())]) + "\n"


def golden_vectors(functions: ModelFunctions, points: int, seed: int = 0) -> list[Golden]:
    """Every function at `points` points: the reference, then random ones, ever farther out."""
    rng = np.random.default_rng(seed)
    spreads = [0.0, *np.resize(SPREADS, max(points - 1, 0))]
    places = [_point(functions, rng, float(s)) for s in spreads[:points]]
    told = [
        _out_of_sight(functions, place) if spread == max(SPREADS) else place
        for place, spread in zip(places, spreads, strict=False)
    ]
    out = []
    for name, function in functions.functions.items():
        # A distance is one minus what the data explain: its scale is one only where that is seen.
        here = told if "distance" in function.name_out() else places
        given = [_arguments(function, place) for place in here]
        got = [
            [v.full().ravel(order="F") for v in function.call([ca.DM(v) for v in row.values()])]
            for row in given
        ]
        names = function.name_in()
        out.append(
            Golden(
                name=name,
                arguments={
                    n: np.array([np.ravel(row[n], order="F") for row in given]) for n in names
                },
                results={
                    n: np.array([row[i] for row in got]) for i, n in enumerate(function.name_out())
                },
            )
        )
    return out


def _out_of_sight(functions: ModelFunctions, place: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """The place with x and z farther out, each where most is unexplained; as it was where none is
    (features that are bounded)."""
    known, posterior = functions.functions, functions.posterior
    if posterior is None or "gp_distance" not in known:
        return place
    out, middle = dict(place), posterior.input_mean
    for times in 2.0 ** np.arange(DOUBLINGS):
        z = middle + times * (place["z"] - middle)
        if float(known["gp_distance"](z, place["p"])) > 0.5:
            out["z"] = z
            break
    if "out_of_domain" not in known or not functions.sizes["n_x"]:
        return out
    reference = functions.reference[0]
    away = np.asarray(known["boxminus"](place["x"], reference)).ravel()
    held = np.array([s.startswith(("rotor", "history")) for s in functions.states.names])
    for times in 2.0 ** np.arange(DOUBLINGS):
        moved = np.asarray(known["boxplus"](reference, times * away)).ravel()
        x = np.where(held, place["x"], moved)
        if float(known["out_of_domain"](x, place["u"], place["p"])[2]) > 0.5:
            out["x"] = x
            break
    return out


def _arguments(function: ca.Function, place: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """What this function takes at a place; f and its Jacobian take the model's own states only."""
    out = {}
    for i, n in enumerate(function.name_in()):
        value = place["x" if n in ("x1", "x") else n]
        rows, columns = function.size1_in(i), function.size2_in(i)
        out[n] = value[:rows] if columns == 1 else value.reshape(rows, columns)
    return out


def _point(
    functions: ModelFunctions, rng: np.random.Generator, spread: float
) -> dict[str, FloatArray]:
    """One value for every argument that a function may take; `spread` 1 is typical flight."""
    n, scale, boxplus = functions.sizes, functions.scales[0], _boxplus(functions)
    move, size = rng.standard_normal(n["n_d"]), _error_sizes(functions)
    x = _state(functions, rng, spread, 0.3 * spread * size * move)
    lower, upper = (np.nan_to_num(v, posinf=1.0, neginf=-1.0) for v in functions.bounds)
    share = np.clip(0.5 + min(spread, 1.0) * (rng.random(n["n_u"]) - 0.5), 0.0, 1.0)
    u = functions.reference[1] if spread == 0 else lower + share * (upper - lower)
    p = functions.parameter_values * (1 + 0.02 * min(spread, 1.0) * rng.standard_normal(n["n_p"]))
    z = np.zeros(0)
    if functions.posterior is not None:
        center, width = functions.posterior.input_mean, functions.posterior.input_scale
        z = center + spread * width * rng.standard_normal(n["n_z"])
    y = np.asarray(functions.functions["h"](x, u, p)).ravel()
    deviation = np.sqrt(np.maximum(np.diag(functions.noise.covariance), 1e-12 * size**2))
    mix = np.eye(n["n_d"]) + 0.2 * rng.standard_normal((n["n_d"], n["n_d"])) / np.sqrt(n["n_d"])
    root = deviation[:, None] * mix * (1 + spread)
    theta = np.sqrt(np.maximum(np.diag(functions.covariance), 1e-30))
    target = rng.standard_normal(n["n_r"]) * min(spread, 1.0)
    felt, command = _felt(functions, rng, deviation), functions.scales[1]
    return {
        "x": x,
        "u": u,
        "p": p,
        "z": z,
        "x2": np.asarray(boxplus(x, 0.1 * size * rng.standard_normal(n["n_d"]))).ravel(),
        "d": 0.1 * size * move,
        "y": y + 0.05 * np.maximum(np.abs(y), 0.1) * rng.standard_normal(n["n_y"]),
        "there": (rng.random(n["n_e"]) < (1.0 if spread == 0 else 0.8)).astype(float),
        "S": root @ root.T,
        "K": 0.1 * command[:, None] / size[None, :] * rng.standard_normal((n["n_u"], n["n_d"])),
        "c": deviation[:, None] * rng.standard_normal((n["n_d"], n["n_g"])),
        "b": deviation[:, None] * rng.standard_normal((n["n_d"], n["n_theta"])) / theta,
        "V": felt @ functions.adapted.covariance @ felt.T * min(1.0, 0.2 + spread),
        "memory": np.array([30.0 * spread]),
        **_calibration(functions, rng, x, 0.1 * size * move, spread),
        "lam": rng.standard_normal(n["n_x"]) / scale,
        "r": target,
    }


def _boxplus(functions: ModelFunctions) -> Callable[[FloatArray, FloatArray], npt.ArrayLike]:
    """x moved by an error state; what has no states stays."""
    if not functions.sizes["n_x"]:
        return lambda x, d: x
    known: Callable[[FloatArray, FloatArray], npt.ArrayLike] = functions.functions["boxplus"]
    return known


def _error_sizes(functions: ModelFunctions) -> FloatArray:
    """Typical errors (n_d,). Raw and error states differ in the attitude alone, whose typical error
    is a third of a radian."""
    scale = functions.scales[0]
    typical = {s.name.removeprefix("d_"): scale[i] for i, s in enumerate(functions.states)}
    return np.array(
        [
            0.3 if "attitude" in s else typical[s.removeprefix("d_")]
            for s in functions.error_states.names
        ]
    )


def _state(
    functions: ModelFunctions, rng: np.random.Generator, spread: float, away: FloatArray
) -> FloatArray:
    """State (n_x,) that is `away` (n_d,) from the reference; rotors and histories inside their
    range."""
    scale = functions.scales[0]
    x = np.asarray(_boxplus(functions)(functions.reference[0], away)).ravel()
    inside = np.array(
        [s.startswith(("rotor", "history")) for s in functions.states.names], dtype=bool
    )
    level = np.clip(0.5 + 0.3 * spread * (rng.random(x.size) - 0.5), 0.02, 0.98) * scale
    return np.where(inside & (spread > 0), level, x)


def _felt(functions: ModelFunctions, rng: np.random.Generator, deviation: FloatArray) -> FloatArray:
    """(n_a, n_a): what the covariance of the adapted parameters is mixed with, states that feel
    them by about their `deviation`."""
    own, n_a = functions.adapted, functions.sizes["n_a"]
    felt = np.eye(n_a)
    if n_a:
        between = np.sqrt(np.diag(own.covariance))[: len(own.rows)]
        states = n_a - len(own.rows)
        slopes = rng.standard_normal((states, len(own.rows))) / np.maximum(between, 1e-30)
        felt[len(own.rows) :, : len(own.rows)] = deviation[:states, None] * slopes
    return felt


def _calibration(
    functions: ModelFunctions,
    rng: np.random.Generator,
    x: FloatArray,
    away: FloatArray,
    spread: float,
) -> dict[str, FloatArray]:
    """Arguments of forecast_step and calibrate_step: forecasts and the next state about x, at
    samples due or not."""
    own, boxplus = functions.calibration, _boxplus(functions)
    under_way = [np.asarray(boxplus(x, k / COLUMNS * away)).ravel() for k in range(1, COLUMNS + 1)]
    shape = own.sigma.shape
    return {
        "x_next": under_way[0],
        "F": np.array(under_way).T.reshape(x.size, COLUMNS),
        "clock": np.array(
            [own.every * rng.integers(0, 2 * COLUMNS) + rng.integers(0, 2)], dtype=float
        ),
        "theta": 0.2 * spread * rng.standard_normal((shape[0], own.remembered)),
        "E": own.sigma * (0.5 + spread) * rng.standard_normal(shape),
        "sigma": own.sigma,
        "seen": (rng.random(shape) < 0.8).astype(float),
        "level": np.array([LEVEL]),
        "gain": np.array([GAIN]),
    }
