"""Is the tube as wide as the flights are? Coverage of its sets along flights, stage by stage, and what makes it wide.

From every `EVERY`-th plan of a flight a copy of the plant flies on with the planned commands and the ancillary gain on the
filter's estimate, without a new plan. Per group of states (position, velocity, attitude, rate) and stage: the share of true
states inside the 68 and 95 % ellipsoids (chi-square, 3 degrees of freedom); per state: the stated 95 % half width over the
95 % quantile of |true - planned|. Training seeds only. Then the parts of the stated variance, at hover: the filter's error,
its innovations, the learned part, the parameters.

    python -m scenarios.studies.tube_coverage --out OUT [--flights 20] [--deviations 1.5]
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

from greybox.files import write_json
from mpc_export.tube.controller import TubeController
from scenarios.courses import TRAINING_SEEDS
from scenarios.studies.tube_mpc import DT, PROBLEM, TRUE, controller, flight, models

Array = NDArray[np.float64]
GROUPS = {"position": 0, "velocity": 3, "attitude": 6, "rate": 9}
LEVELS = (0.68, 0.95)
EVERY = 10
FIRST = 40
"""First training seed of this study: the ones before were tuned on."""
SHOWN = (1, 2, 3, 5, 10, 15, 20)


def branches(pilot: TubeController, seeds: Sequence[int], every: int = EVERY) -> tuple[Array, Array]:
    """(true - planned (n, N, n_d), stated covariances (n, N, n_d, n_d)) of all branches of flights with these seeds."""
    away: list[Array] = []
    stated: list[Array] = []
    count = 0

    def at(_: int, plant: Any, flown: TubeController) -> None:
        nonlocal count
        count += 1
        if count % every == 0:
            stated.append(flown.solver.data["covariance"][1:].copy())
            away.append(branch(copy.deepcopy(plant), flown))

    for seed in seeds:
        flight(pilot, seed, at=at)
    return np.array(away), np.array(stated)


def branch(plant: Any, flown: TubeController) -> Array:
    """True state - plan in error coordinates (N, n_d), the plant flying on with the plan and the ancillary gain."""
    plan, functions = flown.plan, flown.functions
    assert plan is not None
    estimate, u = flown.estimate.copy(), plan.u[0].copy()
    gain, own = flown.solver.stages.gain, flown.filter.own_states
    out = []
    for k in range(PROBLEM.horizon):
        if k:
            state = plan.x[k].copy()
            state[:own] = estimate[:own]
            u = plan.u[k] + gain @ functions["boxminus"](state, plan.x[k]).full().ravel()
            u = np.clip(u, PROBLEM.command_min, PROBLEM.command_max)
        for _ in range(flown.every):
            estimate, _ = flown.filtered(estimate, u, plant.measure(u))
            plant.step(u, DT)
        now = plant.states()
        true = plan.x[k + 1].copy()
        true[: len(TRUE)] = [now[n] for n in TRUE]
        out.append(functions["boxminus"](true, plan.x[k + 1]).full().ravel())
    return np.array(out)


def shares(away: Array, stated: Array) -> dict[str, dict[float, Array]]:
    """Per group and level: share of true states inside the set of this level, (N,) by stage."""
    found: dict[str, dict[float, Array]] = {}
    for name, at in GROUPS.items():
        e, s = away[..., at : at + 3], stated[..., at : at + 3, at : at + 3]
        distance = np.einsum("...i,...i->...", e, np.linalg.solve(s, e[..., None])[..., 0])
        found[name] = {level: np.mean(distance <= chi2.ppf(level, 3), axis=0) for level in LEVELS}
    return found


def widths(away: Array, stated: Array) -> Array:
    """(N, 12) Stated 95 % half widths (of the mean variance) over the empirical 95 % quantiles of |true - planned|."""
    half = norm.ppf(0.975) * np.sqrt(np.mean(np.diagonal(stated, axis1=2, axis2=3), axis=0))[:, :12]
    return np.asarray(half / np.quantile(np.abs(away[..., :12]), 0.95, axis=0))


def parts(pilot: TubeController, stages: int) -> dict[str, Array]:
    """(stages + 1, 12) Variances at hover of the filter's error, its innovations, the learned part, the parameters."""
    model, made = pilot.functions, pilot.solver.stages
    x, u = made.steady
    n = model.sizes
    z, c, b = np.zeros((n["n_d"],) * 2), np.zeros((n["n_d"], n["n_g"])), np.zeros((n["n_d"], n["n_theta"]))
    rows: dict[str, list[Array]] = {k: [] for k in ("filter", "innovations", "learned part", "parameters")}
    for _ in range(stages + 1):
        matrices = (made.estimate, z, c @ c.T, b @ model.covariance @ b.T)
        for name, matrix in zip(rows, matrices, strict=True):
            rows[name].append(np.diag(matrix)[:12].copy())
        _, z, c, b = (v.full() for v in made.functions["tube_spread"](x, u, model.parameter_values, z, c, b))
    return {k: np.array(v) for k, v in rows.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument(
        "--deviations", type=float, default=1.5, help="standard deviations that limits are tightened by"
    )
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    pilot = controller(models(options.out)["hybrid"], deviations=options.deviations)
    away, stated = branches(pilot, TRAINING_SEEDS[FIRST : FIRST + options.flights])
    found, ratio, terms = shares(away, stated), widths(away, stated), parts(pilot, PROBLEM.horizon)
    print(f"{len(away)} branches of {options.flights} flights; stages {SHOWN}, then all stages together")
    at = np.array(SHOWN) - 1
    for name, levels in found.items():
        for level, share in levels.items():
            print(f"{name:9s} {level:.0%} inside: {np.round(share[at], 3)}  mean {share.mean():.3f}")
        rows = ratio[:, GROUPS[name] : GROUPS[name] + 3]
        print(f"{name:9s} half width / quantile: {np.round(rows.mean(axis=1)[at], 2)}  largest {rows.max():.2f}")
    for stage in (1, 5, 20):
        sizes = {k: 1e3 * np.sqrt(v[stage, [0, 2]]) for k, v in terms.items()}
        print(
            f"stage {stage:2d}, standard deviations of x, z [mm]: "
            + ", ".join(f"{k} {np.round(v, 2)}" for k, v in sizes.items())
        )
    write_json(options.out / "coverage.json", {
        "schema": "greybox.study/1", "branches": len(away), "deviations": options.deviations,
        "inside": {g: {f"{v:g}": s.tolist() for v, s in levels.items()} for g, levels in found.items()},
        "half_width_over_quantile": ratio.tolist(), "variances": {k: v.tolist() for k, v in terms.items()},
    })  # fmt: skip


if __name__ == "__main__":
    main()
