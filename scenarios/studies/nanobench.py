"""The NanoBench flights through greybox: fitted on nine, judged on five; or every type of
trajectory held out once.

    python -m scenarios.studies.nanobench [--leave-one-type-out] [--out DIR]
    python -m scenarios.studies.nanobench --fitted MODEL.json

What is fitted is decided from the flights, as by plain `greybox fit`. --fitted judges a model that
there is. Mean absolute errors come with their 95 % interval: flights are drawn, then blocks of two
seconds of these.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from greybox import automatic
from greybox.data import Dataset
from greybox.data.logs import read_logs
from greybox.examples import NANOBENCH_TEST, NANOBENCH_TRAIN, flight_paths, vehicle_path
from greybox.files import write_json
from greybox.model.identified import IdentifiedModel
from greybox.model.vehicle import read_vehicle
from greybox.validation.horizon_table import HorizonTable
from greybox.validation.validate import Validation, validate

ADAPT = 5.0
"""Seconds of a judged flight that its own values come from."""
AHEAD, DRAWS = (1, 10, 50, 100), 4000
"""Samples ahead whose errors get an interval, and how often flights are drawn for it."""


def judged(model: IdentifiedModel, data: Dataset) -> Validation:
    """As `greybox fit` judges."""
    return validate(model, data, adapt=ADAPT, measured_start=True)


def interval(table: HorizonTable, group: str, h: int) -> tuple[float, float]:
    """95 % interval of the mean absolute error h samples ahead (greybox.validation.bootstrap draws
    likewise)."""
    random = np.random.default_rng(0)
    flights = [
        (e[group].block_sums[:, h - 1], e[group].block_counts[:, h - 1])
        for e in table.flights.values()
    ]
    means = []
    for _ in range(DRAWS):
        total, count = 0.0, 0.0
        for k in random.integers(len(flights), size=len(flights)):
            sums, counts = flights[k]
            drawn = random.integers(len(sums), size=len(sums))
            total, count = total + sums[drawn].sum(), count + counts[drawn].sum()
        means.append(total / count)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def shown(table: HorizonTable) -> str:
    """Mean absolute errors with their intervals, a line per group."""
    lines = ["mean absolute error (95 % interval)"]
    for group, e in table.groups.items():
        cells = (
            f"{h * table.sample_time:g} s {e.mae[h - 1]:.4f} ({{:.4f}} to {{:.4f}})".format(
                *interval(table, group, h)
            )
            for h in AHEAD
            if h <= len(e.mae)
        )
        lines.append(f"  {group:10s} " + ", ".join(cells))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit, validate, print; with --out also write models and results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--leave-one-type-out", action="store_true", help="every type of trajectory held out once"
    )
    parser.add_argument("--out", metavar="DIR", help="folder for models and results")
    parser.add_argument("--fitted", metavar="MODEL.json", help="judge this model of the nine")
    options = parser.parse_args(arguments)
    vehicle = read_vehicle(vehicle_path("nanobench"))
    data = read_logs(flight_paths("nanobench"), vehicle)
    if options.fitted:
        model = IdentifiedModel.load(options.fitted)
        table = judged(model, data.select(NANOBENCH_TEST)).table
        print(shown(table) if table else "nothing could be predicted")
        return
    folds: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
        "test": (NANOBENCH_TRAIN, NANOBENCH_TEST)
    }
    if options.leave_one_type_out:
        kinds = sorted({n.split("_")[0] for n in data.names})
        folds = {
            k: (
                tuple(n for n in data.names if not n.startswith(k)),
                tuple(n for n in data.names if n.startswith(k)),
            )
            for k in kinds
        }
    total: dict[tuple[str, int], tuple[float, int]] = {}
    for name, (train, held_out) in folds.items():
        flights = data.select(train)
        result = automatic.fit(vehicle, flights)
        checked = judged(result.model, data.select(held_out))
        print(
            f"\n{name}: {', '.join(held_out)}\n{result.summary()}\n{checked.format()}", flush=True
        )
        if options.out:
            result.model.save(Path(options.out) / f"{name}.json")
            write_json(Path(options.out) / f"{name}-validate.json", checked.to_dict())
        if checked.table is None:
            continue
        print(shown(checked.table))
        for group, e in checked.table.groups.items():
            for h in (1, 10, 50):
                square, n = total.get((group, h), (0.0, 0))
                total[group, h] = (
                    square + float(e.rmse[h - 1]) ** 2 * int(e.n[h - 1]),
                    n + int(e.n[h - 1]),
                )
    print("\nRMSE of the norm over all held-out flights")
    for (group, h), (square, n) in total.items():
        print(f"  {group:10s} h = {h:2d}: {(square / n) ** 0.5:.4f}")


if __name__ == "__main__":
    main()
