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
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.fit import fit
from greybox.files import append_json_line
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from greybox.model.vehicle import read_vehicle
from greybox.plants.vehicle_file import write_vehicle
from greybox.residual.files import load_model, save_model
from greybox.residual.learn import learn
from greybox.residual.noise_levels import refit_noise
from mpc_export.mission import JUDGING_SEEDS
from mpc_export.mission.craft import vehicle
from mpc_export.mission.demo import EFFECTS, ERRORS, HELD, SIGMA, training_log
from scenarios.studies.rows import read_rows, wilson
from scenarios.studies.tube_flights import Cascade, controller, crossed, flight, tilted
from scenarios.studies.tube_tuning import Tuning

Array = NDArray[np.float64]
LEVELS = {"tube-20": 0.20, "tube-10": 0.10, "tube-5": 0.05}
OTHERS = ("boole-10", "passage-10", "white-10", "worst-case")
CONTROLLERS = ("nominal", "pem", "hybrid", *LEVELS, "constant", "cascade", *OTHERS)
WORST = 1.0
"""Size of the worst case's ellipsoids in standard deviations."""
TURN = 20
"""Controllers take turns: so many flights each."""


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


# ------------------------------------------------------------------------------------ controllers


def pilots(
    out: Path, report: Callable[[str], None] = print
) -> Iterator[tuple[str, Callable[[], Any]]]:
    """(name, factory) of every controller; what a factory needs is tuned when it is called."""
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
        f"{'crashed':>8s} {'RMSE [m]':>9s} {'cost':>8s} {'lap [s]':>8s} {'ms: half, 99 %, all':>20s}"
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
        most = max((r["most_ms"] for r in mine if "most_ms" in r), default=math.nan)
        lap = np.mean([r["lap"] for r in whole if "lap" in r] or [math.nan])
        lines.append(
            f"{name:10s} {n:7d} {hits / n:7.3f} {low:6.3f}-{high:.3f} {test:>15s} "
            f"{sum(map(tilted, mine)):7d} "
            f"{n - len(whole):8d} {np.mean([r['rmse'] for r in whole] or [math.nan]):9.4f} "
            f"{np.mean([r['cost'] for r in mine]):8.4f} {lap:8.3f} "
            f"{f'{middle:.1f}/{late:.1f}/{most:.1f}':>20s}"
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
