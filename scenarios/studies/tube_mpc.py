"""Does a tube keep its promise? Controllers with the same solver and different models fly a course
in gusts.

One training flight identifies the models; then every controller flies the obstacle course
(mpc_export/mission) with the seeds that judge:

    nominal     what the data sheet says, noise levels from the training flight
    pem         physics with motor lag, rotor drag, centre of mass, fitted; no tightening
    hybrid      pem + Gaussian process, mean only; no tightening
    tube-20,    hybrid, planes and tilt tightened by the covariance of the closed loop for a risk of 20, 10, 5 % per flight;
    tube-10,    the number of standard deviations comes from rehearsals: flights against the identified model itself, with
    tube-5      its noise, parameter errors and learned errors drawn (mpc_export.mission.model_plant). No other flight
    boole-10,   the same at 10 %, standard deviations by Boole's inequality over touched samples, or by passages with the
    passage-10  closed loop's correlation (mpc_export/tube/risk.py); touched limits counted on training flights
    white-10,   tube-10 with the learned part's error fresh at every stage; with ellipsoids that hold bounded disturbances
    worst-case
    constant    hybrid, every limit moved by one constant, tuned on training flights of the plant to cross in 10 % of them
    cascade     the cascade controller that flew the training flight

The risk is that of crossing a plane (or a crash); flights that tilt too far are counted beside it.
Cost of a flight: its tracking cost with the controller's own weights, per second; a crash (farther
than `lost` from the path) costs CRASH. Everything is kept in OUT as it comes (flights.jsonl), and a
second run goes on where the first stopped.

    python -m scenarios.studies.tube_mpc --out OUT [--flights 200] [--first 0] [--only
    tube-10,hybrid] python -m scenarios.studies.tube_coverage --out OUT [--flights 20]
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.fit import fit
from greybox.files import append_json_line
from greybox.frames import numeric
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from greybox.model.vehicle import read_vehicle
from greybox.plants.controller import Setpoint
from greybox.plants.presets import controller_for
from greybox.plants.vehicle_file import write_vehicle
from greybox.residual.files import load_model, save_model
from greybox.residual.learn import learn
from greybox.residual.noise_levels import refit_noise
from mpc_export.feedback import Weights
from mpc_export.mission import JUDGING_SEEDS, OBSTACLE_COURSE
from mpc_export.mission.craft import vehicle
from mpc_export.mission.demo import EFFECTS, ERRORS, HELD, SIGMA, training_log
from mpc_export.mission.flight import CRASH, REACH, tracking_cost
from mpc_export.tube.controller import TubeController
from mpc_export.tube.problem import TubeProblem
from scenarios.studies.rows import read_rows, wilson

Array = NDArray[np.float64]
LEVELS = {"tube-20": 0.20, "tube-10": 0.10, "tube-5": 0.05}
OTHERS = ("boole-10", "passage-10", "white-10", "worst-case")
CONTROLLERS = ("nominal", "pem", "hybrid", *LEVELS, "constant", "cascade", *OTHERS)
TILT_PER_METRE = 2.0
"""Planes that are moved by a constant take this much off the tilt [rad/m]."""
WORST = 1.0
"""Size of the worst case's ellipsoids in standard deviations."""
DT = 0.01
TURN = 20
"""Controllers take turns: so many flights each."""
PROBLEM = TubeProblem(
    dt=0.02,
    horizon=20,
    planes=len(OBSTACLE_COURSE.planes),
    command_min=OBSTACLE_COURSE.command_min,
    command_max=OBSTACLE_COURSE.command_max,
    tilt_max=OBSTACLE_COURSE.tilt_max,
    ancillary=Weights(position=64.0),
)
"""The ancillary gain holds the place eight times as hard as the plan: after 0.4 s the tube is 7 mm
wide instead of 16."""


# ----------------------------------------------------------------------------------------- models


def training_flight(seconds: float = 60.0) -> Dataset:
    """The log as a data set."""
    columns = training_log(seconds)
    return dataset_from_arrays(columns.pop("t"), columns, name="training")


def models(out: Path, report: Callable[[str], None] = print) -> dict[str, IdentifiedModel]:
    """nominal, pem and hybrid, from their files in `out` or identified anew."""
    names = ("nominal", "pem", "hybrid")
    if not all((out / f"{n}.json").exists() for n in names):
        data = training_flight()
        card = read_vehicle(
            write_vehicle(out / "vehicle.toml", vehicle(), sigma=SIGMA, errors=ERRORS)
        )
        noise = ("force", "torque")
        report("identifying from one flight of 60 s")
        plain = fit(
            build_model(card, data.channels, ()),
            data,
            initialisation="nominal",
            disturbance=noise,
            free=(),
        )
        save_model(plain.model, out / "nominal.json")
        physics = build_model(card, data.channels, EFFECTS)
        fitted = fit(physics, data, initialisation="nominal", disturbance=noise, fixed=HELD)
        save_model(fitted.model, out / "pem.json")
        report("learning what is left")
        hybrid = refit_noise(learn(fitted.model, data, points=50, seed=0).model, data, each=True)
        # the filter's own levels are the tube's: what is calibrated for horizons is so on the
        # flight that was learned from
        save_model(replace(hybrid, horizon_noise=None), out / "hybrid.json")
    return {n: load_model(out / f"{n}.json") for n in names}


# ---------------------------------------------------------------------------------------- flights


class Route:
    """The course's reference and planes at multiples of DT, computed once."""

    def __init__(self) -> None:
        self.times: Array = np.asarray(
            DT * np.arange(round((OBSTACLE_COURSE.duration + 1.0) / DT)), dtype=float
        )
        self.whole = OBSTACLE_COURSE.sample(self.times)
        self.limits = np.zeros((self.times.size, len(OBSTACLE_COURSE.planes), 4))
        self.limits[..., 3] = 1.0
        for j, plane in enumerate(OBSTACLE_COURSE.planes):
            there = plane.exists(self.whole.position, REACH)
            self.limits[there, j, :3], self.limits[there, j, 3] = plane.normal, plane.offset

    def _rows(self, time_: Array) -> Any:
        return np.minimum(np.rint(np.asarray(time_) / DT).astype(int), self.times.size - 1)

    def sample(self, time_: Array) -> Any:
        """The reference at these times (n,)."""
        rows = self._rows(time_)
        return type(self.whole)(**{k: v[rows] for k, v in vars(self.whole).items()})

    def planes(self, time_: Array, moved: float = 0.0) -> Array:
        """Planes of the course that exist near the reference at these times, `moved` [m] toward the
        path."""
        out = self.limits[self._rows(time_)].copy()
        out[(out[..., :3] != 0).any(axis=-1), 3] -= moved
        return out


@cache
def route() -> Route:
    """The one path of the course."""
    return Route()


def controller(
    model: IdentifiedModel,
    *,
    deviations: float = 0.0,
    moved: float = 0.0,
    white: bool = False,
    worst: bool = False,
) -> TubeController:
    """The tube controller on the course; `deviations` tighten planes and tilt, one of them at most
    the commands."""
    problem = replace(PROBLEM, kind="worst case") if worst else PROBLEM
    return TubeController(
        model=model,
        problem=replace(problem, tilt_max=problem.tilt_max - TILT_PER_METRE * moved),
        reference=route(),
        planes=lambda t: route().planes(t, moved),
        kappa=(deviations,) * (len(OBSTACLE_COURSE.planes) + 1),
        kappa_u=min(deviations, 1.0),
        integrate=False,
        white=white,
    )


class Cascade:
    """The cascade controller behind the tube controller's interface."""

    def __init__(self) -> None:
        self.inner = controller_for(vehicle())
        self.plan = None
        self.events: list[Any] = []
        self.start()

    def start(self) -> None:
        """Forget everything."""
        self.inner.reset()
        self.u = np.full(4, float(np.mean(vehicle().airframe.hover_speed)))

    def sample(self, time_: float, seen: dict[str, float]) -> Array:
        """The command from the next sample on."""
        path = route().sample(np.array([time_ + DT]))
        goal = Setpoint(
            position=tuple(path.position[0]),
            velocity=tuple(path.velocity[0]),
            acceleration=tuple(path.acceleration[0]),
            yaw=float(path.yaw[0]),
            yaw_rate=float(path.yaw_rate[0]),
        )
        self.u = np.array(self.inner(seen, goal, DT, (0.0, 0.0, 0.0, 0.0)))
        return self.u


def flight(
    pilot: Any, seed: int, at: Callable[[int, Any, Any], None] | None = None, plant: Any = None
) -> dict[str, Any]:
    """One flight over the course: margins, tracking error, cost, times. `at(k, plant, pilot)` is
    called after every plan.

    plant: default the course's vehicle.
    """
    plant = vehicle() if plant is None else plant
    start = OBSTACLE_COURSE.start
    plant.reset(seed, position=start[:3])
    pilot.start()
    u = np.array(pilot.u)
    steps = round(OBSTACLE_COURSE.duration / DT)
    states, commands, seconds, crashed = [], [], [], False
    reference = route().sample(route().times[:steps])
    last = None
    for k in range(steps):
        after = pilot.sample(DT * k, plant.measure(u))
        now = plant.states()
        states.append([now[n] for n in TRUE])
        commands.append(u)
        if np.linalg.norm(states[-1][:3] - reference.position[k]) > OBSTACLE_COURSE.lost:
            crashed = True
            break
        plant.step(u, DT)
        u = np.array(after)
        if pilot.plan is not None and pilot.plan is not last:
            last = pilot.plan
            seconds.append(last.outcome.seconds)
            if at is not None:
                at(k, plant, pilot)
    path, given = np.array(states), np.array(commands)
    margins = {n: float(m.min()) for n, m in OBSTACLE_COURSE.margins(path[:, :3]).items()}
    tilt = np.arccos(
        np.clip(
            numeric("rotate", path[:, 6:10], np.tile([0.0, 0.0, 1.0], (len(path), 1)))[:, 2], -1, 1
        )
    )
    error = np.linalg.norm(path[:, :3] - reference.position[: len(path)], axis=1)
    out = {
        "seed": seed,
        "crashed": crashed,
        "margins": margins,
        "tilt": float(tilt.max()),
        "rmse": float(np.sqrt(np.mean(error**2))),
        "cost": CRASH if crashed else tracking_cost(path, given, reference, PROBLEM.weights),
        "events": len(pilot.events),
    }
    if seconds:
        out |= {
            "median_ms": 1e3 * float(np.median(seconds)),
            "p99_ms": 1e3 * float(np.quantile(seconds, 0.99)),
        }
    return out


TRUE = ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "p", "q", "r")


def crossed(record: dict[str, Any]) -> bool:
    """Whether the flight crossed a plane or crashed."""
    return bool(record["crashed"] or min(record["margins"].values()) < 0)


def tilted(record: dict[str, Any]) -> bool:
    """Whether the flight tilted too far or crashed."""
    return bool(record["crashed"] or record["tilt"] > OBSTACLE_COURSE.tilt_max)


# ------------------------------------------------------------------------------------ controllers


def pilots(
    out: Path, report: Callable[[str], None] = print
) -> Iterator[tuple[str, Callable[[], Any]]]:
    """(name, factory) of every controller; what a factory needs is tuned when it is called."""
    # imported here: what is tuned is flown with this module's controllers
    from scenarios.studies.tube_tuning import Tuning

    made = models(out, report)
    hybrid = made["hybrid"]
    tuning = Tuning(out, hybrid, report)
    for name in ("nominal", "pem", "hybrid"):
        yield name, partial(controller, made[name])
    for name, level in LEVELS.items():
        yield name, lambda level=level: controller(hybrid, deviations=tuning.deviations(level))  # type: ignore[misc]
    yield "constant", lambda: controller(hybrid, moved=tuning.moved(0.10))
    yield "cascade", Cascade
    yield "boole-10", lambda: controller(hybrid, deviations=tuning.by_boole(0.10))
    yield "passage-10", lambda: controller(hybrid, deviations=tuning.by_passages(0.10))
    yield "white-10", lambda: controller(hybrid, deviations=tuning.deviations(0.10), white=True)
    yield "worst-case", partial(controller, hybrid, deviations=WORST, worst=True)


# ------------------------------------------------------------------------------------------ table


def summary(records: Sequence[dict[str, Any]]) -> str:
    """Per controller: flights that crossed a plane, with the exact one-sided test of the level;
    error, cost, times."""
    lines = [
        f"{'controller':10s} {'flights':>7s} {'crossed':>7s} {'95 %':>13s} {'p(rate<=level)':>15s} "
        f"{'tilted':>7s} "
        f"{'crashed':>8s} {'RMSE [m]':>9s} {'cost':>8s} {'ms':>10s}"
    ]
    for name in CONTROLLERS:
        mine = [r for r in records if r["controller"] == name]
        if not mine:
            continue
        hits, n = sum(map(crossed, mine)), len(mine)
        level = LEVELS.get(name, 0.10 if name.endswith("-10") else None)
        test = f"{binomtest(hits, n, level, alternative='greater').pvalue:.3f}" if level else ""
        low, high = wilson(hits, n)
        whole = [r for r in mine if not r["crashed"]]
        middle, late = (
            np.median([r[k] for r in mine if k in r] or [math.nan]) for k in ("median_ms", "p99_ms")
        )
        lines.append(
            f"{name:10s} {n:7d} {hits / n:7.3f} {low:6.3f}-{high:.3f} {test:>15s} "
            f"{sum(map(tilted, mine)):7d} "
            f"{n - len(whole):8d} {np.mean([r['rmse'] for r in whole] or [math.nan]):9.4f} "
            f"{np.mean([r['cost'] for r in mine]):8.4f} {f'{middle:.1f}/{late:.1f}':>10s}"
        )
    return "\n".join(lines)


def paired(records: Sequence[dict[str, Any]], one: str, other: str) -> tuple[float, float, int]:
    """Mean of cost(one) - cost(other) over the seeds that both flew, its standard error, and how
    many these are."""
    costs = {
        name: {r["seed"]: r["cost"] for r in records if r["controller"] == name}
        for name in (one, other)
    }
    gaps = [costs[one][s] - costs[other][s] for s in costs[one].keys() & costs[other].keys()]
    if len(gaps) < 2:
        return math.nan, math.nan, len(gaps)
    return float(np.mean(gaps)), float(np.std(gaps, ddof=1) / math.sqrt(len(gaps))), len(gaps)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--flights", type=int, default=200, help="judging flights per controller")
    parser.add_argument(
        "--first", type=int, default=0, help="how many judging seeds to leave out at the beginning"
    )
    parser.add_argument("--only", help="controllers, separated by commas")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    log = options.out / "flights.jsonl"
    records = read_rows(log)
    done = {(r["controller"], r["seed"]) for r in records}
    wanted = options.only.split(",") if options.only else CONTROLLERS
    made = dict(pilots(options.out))
    seeds = JUDGING_SEEDS[options.first : options.first + options.flights]
    flown: dict[str, Any] = {}
    for i in range(0, len(seeds), TURN):
        for name in (n for n in wanted if n in made):
            todo = [s for s in seeds[i : i + TURN] if (name, s) not in done]
            if not todo:
                continue
            pilot, began = (
                flown.get(name) or flown.setdefault(name, made[name]()),
                time.perf_counter(),
            )
            for seed in todo:
                record = {
                    "controller": name,
                    "kappa": max(getattr(pilot, "kappa", ()), default=0.0),
                    **flight(pilot, seed),
                }
                records.append(record)
                append_json_line(log, record)
            each = (time.perf_counter() - began) / len(todo)
            print(
                f"  {name}: {i + len(seeds[i : i + TURN])} of {len(seeds)}, {each:.1f} s each",
                flush=True,
            )
    print(summary(records))
    for name in LEVELS:
        gap, error, n = paired(records, name, "constant")
        if n > 1:
            print(f"cost of {name} - constant, paired: {gap:+.5f} +- {error:.5f} ({n} flights)")


if __name__ == "__main__":
    main()
