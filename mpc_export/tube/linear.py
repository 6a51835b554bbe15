"""The linear tube MPC as one C library, for parts too small for the tube MPC: the model as it is near
hover, its QP condensed before the flight.

In error coordinates about hover at the present heading and the path's place, d+ = A d + B w with
w = u - u_hover, whatever the heading is: errors of place and speed stand in body axes. So the
responses G_k of the error states to the commands, the Hessian of the tracking cost

    H = sum_k G_k' Q G_k + G_N' P G_N + changes and commands,

the steady state that holds against a disturbance, and the tube (covariances of the closed loop
along hover) are numbers of the library. With another battery voltage hover's command is another,
and so are all in proportion: a step plans with commands times the ratio of the hover command that
it was made for to that of now. A step computes the response to hover's command, the
gradient, the limits, and the QP by an active-set method (qp_active.c). Attitude is linear: planes
are as they are, the tilt is held where the plan before tilts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.errors import ModelError
from greybox.frames import numeric
from greybox.symbolic import FloatArray
from mpc_export.c_code import CSource, Real
from mpc_export.tube.controller import TubeController
from mpc_export.tube.solver import braced, included
from mpc_export.tube.stages import block
from mpc_export.tube.told import SAMPLES
from mpc_export.tube.trusted import TRUSTED, trusted

QP_ITERATIONS = 22
"""Systems of active limits at most: what is found then, clipped to its limits, is the plan."""
QP_TOLERANCE = 1e-5
"""By how much limits of the QP may be missed, in its coordinates, in float as in double."""
GROWTH = 2.0
"""By how much errors of the open loop may grow within a plan."""
MEMORY = """  qp_solver solver;
  tube_qp qp;
  tube_real kappa[NL], kappa_u, before[N][NU], tilt[N + 1][2];
  tube_real w[TUBE_W], ratio;
"""
"""What plans keep in the library's memory, besides the integers of the model's functions."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearTube:
    """Numbers of the library: transition A (n_d, n_d); responses G_k (k = 1..N, each n_k, k n_u);
    hessian (N n_u, N n_u); terminal P G_N (n_k, N n_u); steady (n_k + n_u, n_f), what holds against
    a disturbance; tracking (n_k,), the diagonal of Q; spreads of place (N + 1, 3, 3), tilt
    (N + 1, 2, 2) and, standard deviations, commands (N, n_u); level (2,), hover's own tilt as a
    turn about the body's x and y [rad]; trusted (3,): tilt [rad], speed [m/s] and rate [rad/s] away
    from hover, one alone, up to which the prediction misses by no more than TRUSTED."""

    transition: FloatArray
    responses: tuple[FloatArray, ...]
    hessian: FloatArray
    terminal: FloatArray
    steady: FloatArray
    tracking: FloatArray
    place: FloatArray
    tilt: FloatArray
    command: FloatArray
    level: FloatArray
    trusted: FloatArray


def words(pilot: TubeController, name: str) -> dict[str, str]:
    """Words of the templates that the linear tube has of its own, for a library of that name."""
    own = pilot.estimator.told.own
    return {
        "n_values": repr(SAMPLES),
        "values": _nested([one.values for one in own] or [[0.0] * SAMPLES], "double"),
        "ratios": _nested([one.ratio for one in own] or [[1.0] * SAMPLES], "double"),
        "memory": f"{MEMORY}  {name}_tube_model_int iw[TUBE_IW];\n",
        "trusted": repr(TRUSTED),
        "qp_iterations": repr(QP_ITERATIONS),
        "qp_tolerance": repr(QP_TOLERANCE),
    }


def linear_tube(pilot: TubeController) -> LinearTube:
    """The numbers for a pilot's model and problem. Raises `ModelError` for a model whose errors grow
    within the plan by more than GROWTH."""
    f, made, problem = pilot.functions, pilot.solver.stages, pilot.problem
    keep, n = list(made.keep), problem.horizon
    x, u = made.steady
    a, b = (v.full() for v in f["f_d_jac"](x, u, f.parameter_values)[1:3])
    growth = float(np.abs(np.linalg.eigvals(a)).max()) ** n
    if growth > GROWTH:
        raise ModelError(
            "the linear tube is for a model that hovers calmly",
            got=f"errors that grow {growth:.1f} times within the plan at hover",
            fix="use the target tube, or learn a smoother part",
        )
    responses = []
    for k in range(1, n + 1):
        moved = [np.linalg.matrix_power(a, k - 1 - j) @ b for j in range(k)]
        responses.append(np.hstack(moved)[keep])
    tracking, terminal = _tracking(pilot)[keep], made.terminal @ responses[-1]
    total, commands = _spread(pilot)
    place, tilt = (block(f, v, error=True) for v in ("position", "attitude"))
    return LinearTube(
        transition=a,
        responses=tuple(responses),
        hessian=_hessian(pilot, tracking, responses, terminal),
        terminal=terminal,
        steady=_steady(pilot, a, b),
        tracking=tracking,
        place=total[:, place][:, :, place],
        tilt=total[:, tilt[:2]][:, :, tilt[:2]],
        command=commands,
        level=_level(x[block(f, "attitude")]),
        trusted=trusted(pilot, a, total),
    )


def _tracking(pilot: TubeController) -> FloatArray:
    """Squares of the weights (n_d,) of the error states."""
    f, w = pilot.functions, pilot.problem.weights
    weight = {"position": w.position, "velocity": w.velocity, "rate": w.rate}
    tracking = np.zeros(len(f.error_states))
    for name, v in weight.items():
        tracking[block(f, name, error=True)] = v**2
    tracking[block(f, "attitude", error=True)[2]] = w.yaw**2
    return tracking


def _hessian(
    pilot: TubeController,
    tracking: FloatArray,
    responses: list[FloatArray],
    terminal: FloatArray,
) -> FloatArray:
    """Of the cost in the commands, see the top of the file."""
    n, nu, w = pilot.problem.horizon, len(pilot.functions.inputs), pilot.problem.weights
    change = np.eye(n) - np.eye(n, k=-1)
    found = np.kron(w.command**2 * np.eye(n) + w.change**2 * change.T @ change, np.eye(nu))
    for g in responses[:-1]:
        size = g.shape[1]
        found[:size, :size] += g.T @ (tracking[:, None] * g)
    found += responses[-1].T @ terminal
    return np.asarray(0.5 * (found + found.T))


def _level(q: FloatArray) -> FloatArray:
    """Tilt (2,) of attitude q as a turn about the body's x and y [rad]."""
    up = numeric("matrix", q)[0, 6:]
    sine = float(np.hypot(up[0], up[1]))
    return np.asarray(np.array([up[1], -up[0]]) * (np.arctan2(sine, up[2]) / sine if sine else 1.0))


def _steady(pilot: TubeController, a: FloatArray, b: FloatArray) -> FloatArray:
    """(error states kept, commands) per unit of each disturbance: at rest in place, heading 0."""
    f, keep = pilot.functions, list(pilot.solver.stages.keep)
    pushed = block(f, "disturbance", error=True)
    place = [*block(f, "position", error=True), block(f, "attitude", error=True)[2]]
    still = (a - np.eye(len(a)))[keep]
    held = np.zeros((len(place), len(keep) + b.shape[1]))
    held[range(len(place)), [keep.index(i) for i in place]] = 1.0
    left = np.vstack([np.hstack([still[:, keep], b[keep]]), held])
    right = np.vstack([-still[:, pushed], np.zeros((len(place), len(pushed)))])
    return np.asarray(np.linalg.lstsq(left, right, rcond=None)[0])


def _spread(pilot: TubeController) -> tuple[FloatArray, FloatArray]:
    """Covariances (N + 1, n_d, n_d) along hover, and standard deviations of the commands."""
    solver = pilot.solver
    solver.reset()
    solver.data["kappa_u"][()] = 1.0
    outcome = solver.solve()
    if outcome.status:
        raise ModelError(
            "the linear tube needs a plan at hover, and there is none",
            got=f"status {outcome.status}, QP {outcome.qp_status}",
            fix="limits of the commands that hover keeps",
        )
    total, commands = solver.data["covariance"].copy(), solver.data["backoff_u"].copy()
    pilot.start()
    return total, commands


def settled(pilot: TubeController, model: CSource) -> str:
    """Sizes and numbers as C."""
    made, f = linear_tube(pilot), pilot.functions
    sizes, real, keep = pilot.solver.sizes, model.real, list(pilot.solver.stages.keep)
    boxminus = model.functions[0]
    lines = [f"typedef {real} tube_real;", *(f"#define {k} {v}" for k, v in sizes.items())]
    for k in ("arg", "res", "iw", "w"):
        lines.append(f"#define TUBE_{k.upper()} {max(1, getattr(boxminus, f'sz_{k}'))}")
    for name in ("position", "velocity", "attitude", "rate"):
        first = keep.index(block(f, name, error=True)[0])
        lines.append(f"#define TUBE_K_{name.upper()} {first}")
    lines += [f"#define TUBE_{k} {_nested(v, real)}" for k, v in _tables(pilot, made).items()]
    weights = pilot.problem.weights
    for name, v in (("COMMAND", weights.command), ("CHANGE", weights.change)):
        lines.append(f"#define TUBE_ON_{name} {braced([float(v**2)], real)[1:-1]}")
    return "\n".join(lines) + "\n"


def _tables(pilot: TubeController, made: LinearTube) -> dict[str, npt.ArrayLike]:
    """Arrays of the library by name."""
    f, stages, nu = pilot.functions, pilot.solver.stages, len(pilot.functions.inputs)
    keep, root = list(stages.keep), inverse_root(made.hessian)
    rates = root - np.pad(root, ((0, 0), (nu, 0)))[:, :-nu]
    felt = [keep.index(i) for v in ("position", "attitude") for i in block(f, v, error=True)]
    responses = np.concatenate(
        [g.reshape(len(g), -1, nu).transpose(1, 0, 2).ravel() for g in made.responses]
    )
    return {
        "TRANSITION": made.transition.ravel(),
        "RESPONSES": responses,
        "INVERSE_ROOT": root,
        "SIZES": np.linalg.norm(np.hstack([root, rates]), axis=0),
        "FELT": _felt(made.responses, root, felt),
        "TERMINAL": made.terminal,
        "STEADY": made.steady if made.steady.size else np.zeros((len(made.steady), 1)),
        "GAIN": stages.gain,
        "TRACKING": made.tracking,
        "PLACE_SPREAD": made.place,
        "TILT_SPREAD": made.tilt,
        "COMMAND_SPREAD": made.command,
        "LEVEL": made.level,
        "TRUSTED": made.trusted,
        "FREE": stages.free or (0,),
        "KEEP": keep,
        "PUSHED": block(f, "disturbance", error=True) or (0,),
    }


def inverse_root(hessian: FloatArray) -> FloatArray:
    """T = U^-1 (n, n) of U U' = hessian, U and so T without a number below the diagonal: T a of a
    limit that feels the first commands alone has numbers for those alone."""
    upper = np.linalg.cholesky(hessian[::-1, ::-1])[::-1, ::-1]
    return np.asarray(np.linalg.inv(upper))


def _felt(responses: tuple[FloatArray, ...], root: FloatArray, rows: list[int]) -> FloatArray:
    """T times the responses' rows, (N, rows, N n_u)."""
    felt = np.zeros((len(responses), len(rows), len(root)))
    for k, g in enumerate(responses):
        size = g.shape[1]
        felt[k, :, :size] = g[rows] @ root[:size, :size].T
    return felt


def _nested(values: npt.ArrayLike, real: Real) -> str:
    values = np.asarray(values)
    if values.ndim <= 1:
        return braced(values.tolist(), real)
    return f"{{{', '.join(_nested(v, real) for v in values)}}}"


def driver() -> tuple[str, str]:
    """What of libraries is included, and C of the QP without a plan."""
    text = "".join(included(name) for name in ("numbers.h", "linear_sizes.h", "qp_active.c"))
    libraries = ("float", "math", "stddef", "string")
    text = text.replace("#include <float.h>\n", "")
    return "".join(f"#include <{name}.h>\n" for name in libraries), text
