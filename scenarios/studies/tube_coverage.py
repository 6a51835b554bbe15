"""Is the tube as wide as the flights are? Coverage of its sets along flights, stage by stage, and
what makes it wide.

From every `EVERY`-th plan of a flight, so that branches of one flight do not overlap, a copy of the
plant flies on with the planned commands and the ancillary gain on the filter's estimate, without a
new plan. Per group of states (position, velocity, attitude, rate) and stage: the share of true
states inside the 68 and 95 % ellipsoids (chi-square, 3 degrees of freedom), with its standard error
from one flight to the next; per state: the stated 95 % half width over the 95 % quantile of |true -
planned|. Judging seeds that no controller of the study starts with. Then the parts of the stated
variance, at hover: the filter's error, its innovations, the learned part, the parameters, what the
nonlinear loop adds. What was found so far is kept after every tenth flight.

    python -m scenarios.studies.tube_coverage --out OUT [--flights 110] [--deviations 1.5]
    [--rehearsed]
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
from mpc_export.mission import JUDGING_SEEDS
from mpc_export.mission.model_plant import RehearsedPlant
from mpc_export.tube.controller import TubeController
from scenarios.studies.tube_flights import DT, PROBLEM, TRUE, controller, flight
from scenarios.studies.tube_mpc import models

Array = NDArray[np.float64]
GROUPS = {"position": 0, "velocity": 3, "attitude": 6, "rate": 9}
LEVELS = (0.68, 0.95)
EVERY = PROBLEM.horizon
FIRST = 80
"""Where this study's judging seeds begin."""
SHOWN = (1, 2, 3, 5, 10, 15, 20)
KEPT = 10


def branches(pilot: TubeController, seed: int, plant: Any = None) -> tuple[Array, Array]:
    """(true - planned (n, N, n_d), stated covariances (n, N, n_d, n_d)) of the branches of a
    flight.

    plant: default the course's vehicle.
    """
    away: list[Array] = []
    stated: list[Array] = []
    count = 0

    def at(_: int, plant: Any, flown: TubeController) -> None:
        nonlocal count
        count += 1
        if count % EVERY == 0:
            stated.append(flown.solver.data["covariance"][1:].copy())
            away.append(
                branch(
                    plant.copied() if isinstance(plant, RehearsedPlant) else copy.deepcopy(plant),
                    flown,
                )
            )

    flight(pilot, seed, at=at, plant=plant)
    return np.array(away), np.array(stated)


def branch(plant: Any, flown: TubeController) -> Array:
    """True state - plan in error coordinates (N, n_d), the plant flying on with the plan and the
    ancillary gain."""
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
            estimate, _ = flown.estimator.filtered(estimate, u, plant.measure(u))
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
    """(N, 12) Stated 95 % half widths (of the mean variance) over the empirical 95 % quantiles of
    |true - planned|."""
    half = norm.ppf(0.975) * np.sqrt(np.mean(np.diagonal(stated, axis1=2, axis2=3), axis=0))[:, :12]
    return np.asarray(half / np.quantile(np.abs(away[..., :12]), 0.95, axis=0))


def parts(pilot: TubeController, stages: int) -> dict[str, Array]:
    """(stages + 1, 12) Variances at hover of the filter's error, its innovations, the learned part,
    the parameters, and what the nonlinear loop adds."""
    model, made = pilot.functions, pilot.solver.stages
    x, u = made.steady
    n = model.sizes
    z, c, b = (
        np.zeros((n["n_d"],) * 2),
        np.zeros((n["n_d"], n["n_g"])),
        np.zeros((n["n_d"], n["n_theta"])),
    )
    names = ("filter", "innovations", "learned part", "parameters", "second order")
    rows: dict[str, list[Array]] = {k: [] for k in names}
    for k in range(stages + 1):
        matrices = (made.estimate, z, c @ c.T, b @ model.covariance @ b.T, made.bent[k])
        for name, matrix in zip(rows, matrices, strict=True):
            rows[name].append(np.diag(matrix)[:12].copy())
        _, z, c, b = (
            v.full() for v in made.functions["tube_spread"](x, u, model.parameter_values, z, c, b)
        )
    return {k: np.array(v) for k, v in rows.items()}


def errors(away: Array, stated: Array, flights: int) -> dict[str, dict[float, Array]]:
    """Standard errors of `shares` (N,), and last of their mean over stages, from one flight to the
    next."""
    found: dict[str, dict[float, Array]] = {g: {} for g in GROUPS}
    parts_ = [
        shares(*v)
        for v in zip(np.array_split(away, flights), np.array_split(stated, flights), strict=True)
    ]
    for group, level in ((g, v) for g in GROUPS for v in LEVELS):
        each = np.array([p[group][level] for p in parts_])
        each = np.column_stack([each, each.mean(axis=1)])
        found[group][level] = (
            each.std(axis=0, ddof=1) / np.sqrt(flights)
            if flights > 1
            else np.full(each.shape[1], np.nan)
        )
    return found


def told(
    away: Array, stated: Array, terms: dict[str, Array], flights: int, deviations: float, out: Path
) -> None:
    """Print what was found and keep it."""
    found, doubt, ratio = shares(away, stated), errors(away, stated, flights), widths(away, stated)
    print(
        f"{len(away)} branches of {flights} flights; stages {SHOWN}, then all stages together "
        "(standard error)"
    )
    at = np.array(SHOWN) - 1
    for name, levels in found.items():
        for level, share in levels.items():
            own = doubt[name][level]
            print(
                f"{name:9s} {level:.0%} inside: {np.round(share[at], 3)}  mean {share.mean():.3f} "
                f"({own[-1]:.4f}, of a stage at most {own[:-1].max():.4f})"
            )
        rows = ratio[:, GROUPS[name] : GROUPS[name] + 3]
        print(
            f"{name:9s} half width / quantile: {np.round(rows.mean(axis=1)[at], 2)}  "
            f"{rows.min():.2f} to {rows.max():.2f}"
        )
    for stage in (1, 5, 20):
        sizes = {k: 1e3 * np.sqrt(v[stage, [0, 2]]) for k, v in terms.items()}
        print(
            f"stage {stage:2d}, standard deviations of x, z [mm]: "
            + ", ".join(f"{k} {np.round(v, 2)}" for k, v in sizes.items())
        )
    write_json(
        out / "coverage.json",
        {
            "schema": "greybox.study/1",
            "branches": len(away),
            "flights": flights,
            "deviations": deviations,
            "inside": {
                g: {f"{v:g}": s.tolist() for v, s in levels.items()} for g, levels in found.items()
            },
            "standard_error": {
                g: {f"{v:g}": s.tolist() for v, s in levels.items()} for g, levels in doubt.items()
            },
            "half_width_over_quantile": ratio.tolist(),
            "variances": {k: v.tolist() for k, v in terms.items()},
        },
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--flights", type=int, default=110)
    parser.add_argument(
        "--deviations",
        type=float,
        default=1.5,
        help="standard deviations that limits are tightened by",
    )
    parser.add_argument(
        "--rehearsed", action="store_true", help="fly the identified model instead of the plant"
    )
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    hybrid = models(options.out)["hybrid"]
    pilot, plant = (
        controller(hybrid, deviations=options.deviations),
        RehearsedPlant(hybrid) if options.rehearsed else None,
    )
    terms = parts(pilot, PROBLEM.horizon)
    found: list[tuple[Array, Array]] = []
    for seed in JUDGING_SEEDS[FIRST : FIRST + options.flights]:
        found.append(branches(pilot, seed, plant))
        if len(found) % KEPT == 0 or len(found) == options.flights:
            away, stated = (np.concatenate(v) for v in zip(*found, strict=True))
            told(away, stated, terms, len(found), options.deviations, options.out)


if __name__ == "__main__":
    main()
