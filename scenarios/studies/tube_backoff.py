"""What does it cost to hold the back-offs fixed within an iteration, and the learned error for
white noise?

Along one training flight, plans that touch a tightened plane are computed again on a short horizon
from the same estimate:

    one         one iteration from the plan before, as in flight
    zero-order  to convergence, back-offs renewed in every iteration but not differentiated (zoRO)
    full        by IPOPT with the covariance recursion as part of the problem

and for the whole horizon the back-offs are compared with those of a white learned error and of the
worst case.

    python -m scenarios.studies.tube_backoff --out OUT [--horizon 6] [--deviations 1.5]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.errors import GreyboxError
from greybox.files import write_json
from greybox.model.identified import IdentifiedModel
from mpc_export.mission import TRAINING_SEEDS
from mpc_export.tube.controller import TubeController
from mpc_export.tube.stages import block
from scenarios.studies.tube_flights import PROBLEM, controller, flight
from scenarios.studies.tube_ipopt import IpoptSolver, Setting
from scenarios.studies.tube_mpc import models

Array = NDArray[np.float64]
SEED = TRAINING_SEEDS[30]
APART = 0.15
"""Plans that touch a tightened limit within the short horizon are computed again, at least this far
apart [s]."""
OPTIONS: dict[str, Setting] = {
    "ipopt.hessian_approximation": "limited-memory",
    "ipopt.tol": 1e-6,
    "ipopt.max_iter": 400,
    "ipopt.acceptable_tol": 1e-5,
}


def follow(follower: TubeController, flown: TubeController) -> None:
    """Give a controller of another horizon the estimate, command before and steady state of the one
    that flies."""
    follower.estimator.x, follower.estimator.p = flown.estimate.copy(), flown.p.copy()
    follower.u, follower.past = flown.past[0].copy(), [v.copy() for v in flown.past]
    follower.steady = flown.steady[0].copy(), flown.steady[1].copy()


def room(pilot: TubeController, horizon: int) -> float:
    """Least distance of the plan to a tightened plane within the first stages [m]; below zero where
    slack is used."""
    data = pilot.solver.data
    place = data["x"][1 : horizon + 1, block(pilot.functions, "position")]
    planes = data["plane"][1 : horizon + 1]
    left = (
        planes[..., 3]
        - np.einsum("kpi,ki->kp", planes[..., :3], place)
        - data["backoff"][1 : horizon + 1, :-1]
    )
    there = (planes[..., :3] != 0).any(axis=-1)
    return float(np.where(there, left, np.inf).min())


def compare(model: IdentifiedModel, horizon: int, deviations: float) -> list[dict[str, Any]]:
    """One row per plan: commands, cost and seconds of the three ways."""
    pilot = controller(model, deviations=deviations)
    short = TubeController(
        model=model,
        problem=replace(PROBLEM, horizon=horizon),
        reference=pilot.reference,
        planes=pilot.planes,
        kappa=pilot.kappa,
        kappa_u=pilot.kappa_u,
        integrate=False,
    )
    full = IpoptSolver(short.solver, backoff="full", options=OPTIONS)
    rows: list[dict[str, Any]] = []
    last = pilot.plan

    def at(_k: int, _p: Any, flown: TubeController) -> None:
        nonlocal last
        before, last = last, flown.plan
        if before is None or last is None or room(flown, horizon) > 1e-4:
            return
        if rows and last.time < rows[-1]["time"] + APART:
            return
        follow(short, flown)
        data = short.solver.data
        data["x"][:], data["u"][:] = before.x[: horizon + 1], before.u[:horizon]
        data["iterations_max"][()] = data["tube_updates_max"][()] = 1
        short._decide(last.time)
        one = data["u"].copy()
        data["iterations_max"][()], data["tube_updates_max"][()] = 100, 100
        converged = short.solver.solve()
        row: dict[str, Any] = {
            "time": last.time,
            "kkt": converged.kkt,
            "seconds": converged.seconds,
            "one": float(np.abs(one[0] - data["u"][0]).max()),
            "slack": float(data["slack"].max()),
            "room": room(short, horizon),
        }
        began = time.perf_counter()
        try:
            found = full.solve()
            row |= {
                "full": float(np.abs(found.u[0] - data["u"][0]).max()),
                "full_place": float(np.linalg.norm(found.x[-1, :3] - data["x"][-1, :3])),
                "full_seconds": time.perf_counter() - began,
            }
        except GreyboxError as error:
            row |= {"failed": str(error)}
        rows.append(row)
        print({k: f"{v:.3g}" if isinstance(v, float) else v for k, v in row.items()}, flush=True)

    flight(pilot, SEED, at=at)
    return rows


def backoffs(model: IdentifiedModel, deviations: float) -> dict[str, Array]:
    """(N, planes + 1) Mean back-offs along a flight: consider states, white learned error, worst
    case."""
    kinds: dict[str, dict[str, Any]] = {
        "consider": {},
        "white": {"white": True},
        "worst case": {"worst": True},
    }
    found = {}
    for name, choice in kinds.items():
        pilot = controller(model, deviations=deviations, **choice)
        rows: list[Array] = []

        def at(_k: int, _p: Any, flown: TubeController, rows: list[Array] = rows) -> None:
            rows.append(flown.solver.data["backoff"][1:].copy())

        flight(pilot, SEED, at=at)
        seen = np.array(rows)
        there = seen > 1e-9
        found[name] = np.where(there, seen, 0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--horizon", type=int, default=6)
    parser.add_argument("--deviations", type=float, default=1.5)
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    hybrid = models(options.out)["hybrid"]
    wide = backoffs(hybrid, options.deviations)
    for name, value in wide.items():
        print(
            f"{name:10s} mean back-off of the wall at stages 1, 5, 10, 20: "
            f"{np.round(1e3 * value[[0, 4, 9, 19], 0], 2)} mm"
        )
    rows = compare(hybrid, options.horizon, options.deviations)
    write_json(
        options.out / "backoff.json",
        {
            "schema": "greybox.study/1",
            "rows": rows,
            "backoffs": {k: v.tolist() for k, v in wide.items()},
        },
    )


if __name__ == "__main__":
    main()
