"""The NanoBench flights through greybox: fitted on nine, judged on five; or every type of
trajectory held out once.

    python -m scenarios.studies.nanobench [--by-hand] [--leave-one-type-out] [--out DIR]
    python -m scenarios.studies.nanobench --fitted MODEL.json

What is fitted is decided from the flights, as by plain `greybox fit`; --by-hand takes the recipe
below instead, which the figures of docs/studies/hybrid.md were made with. --fitted judges a model
that there is. Mean absolute errors come with their 95 % interval: flights are drawn, then
blocks of two seconds of these.

Why by hand so: attitude and position come from another clock than gyro, accelerometer and commands,
and drift against them by some 10 ms; sensor levels are therefore held at what the vehicle file
says, the disagreement is noise on the attitude kinematics, and the parameters come from errors up
to half a second ahead. Mass and thrust scale only as a ratio, and yaw is hardly excited, so that
mass and the rotors' drag torque stay at their published values.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from greybox import automatic
from greybox.data import Dataset
from greybox.data.logs import read_logs
from greybox.estimation.fit import Fit, fit
from greybox.estimation.record import sample_time
from greybox.examples import NANOBENCH_TEST, NANOBENCH_TRAIN, flight_paths, vehicle_path
from greybox.files import write_json
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.validation.horizon_table import HorizonTable
from greybox.validation.validate import Validation, validate

EFFECTS = (
    "motor_lag",
    "command_delay",
    "battery_sag",
    "rotor_drag",
    "blade_flapping",
    "rotational_damping",
    "rotor_asymmetry",
    "accelerometer_bias",
    "gyro_bias",
    "mocap_misalignment",
    "pose_delay",
)
PER_FLIGHT = (
    "thrust.c2",
    "rotor_asymmetry.delta_1",
    "rotor_asymmetry.delta_2",
    "rotor_asymmetry.delta_3",
    "mocap_misalignment.theta_x",
    "mocap_misalignment.theta_y",
    "mocap_misalignment.theta_z",
    "pose_delay.d",
)
ADAPT = 5.0
"""Seconds of a judged flight that its own values come from."""
AHEAD, DRAWS = (1, 10, 50, 100), 4000
"""Samples ahead whose errors get an interval, and how often flights are drawn for it."""
FIXED = ("mass", "battery_sag.c_V", "torque.c2")


def fit_by_hand(vehicle: Vehicle, data: Dataset) -> Fit:
    """The fit by the recipe."""
    model = build_model(
        vehicle,
        data.channels,
        EFFECTS,
        sample_time=sample_time(data),
        noncausal=data.noncausal,
        kinematic_noise=True,
    )
    return fit(
        model,
        data,
        predictor="multi-step",
        initialisation="innovation",
        estimate_noise="process",
        disturbance=("force", "torque"),
        per_flight=PER_FLIGHT,
        fixed=FIXED,
        values={"battery_sag.c_V": 1.0},
    )


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
        "--by-hand", action="store_true", help="by the recipe of this file, nothing decided"
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
        result = (
            fit_by_hand(vehicle, flights) if options.by_hand else automatic.fit(vehicle, flights)
        )
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
