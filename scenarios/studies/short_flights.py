"""Do the 95 % intervals of short flights hold the truth, and does a fit say where they do not?

One flight of the craft of `scenarios.studies.recovery` per seed, cut to each length and fitted
twice: with its noise levels estimated, and with those held that a flight of 20 s told. Said: fits
whose first lines doubt every standard error.

    python -m scenarios.studies.short_flights --runs 40 --seconds 0.6 1 2 4 8
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from greybox import build_model, dataset_from_arrays, fit, read_vehicle
from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.estimation.fit import noise_of
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.plants.flight_log import fly, member
from greybox.plants.presets import controller_for
from greybox.plants.vehicle_file import write_vehicle
from scenarios.studies.recovery import EFFECTS, plant

LONG = 20.0
NORMAL = 1.959964


@dataclass(frozen=True, kw_only=True)
class Row:
    """Fits of one length [s]: `shares` (fits,) of the intervals that hold the truth, how many said
    that their errors are too small, and how many were refused or did not converge."""

    seconds: float
    held: bool
    shares: tuple[float, ...]
    said: int
    failed: int

    @property
    def coverage(self) -> float:
        """Share of all intervals that hold the truth."""
        return float(np.mean(self.shares)) if self.shares else float("nan")

    @property
    def error(self) -> float:
        """Standard error of `coverage`; the intervals of one flight are not independent, flights
        are."""
        return (
            float(np.std(self.shares, ddof=1) / np.sqrt(len(self.shares)))
            if len(self.shares) > 1
            else float("nan")
        )

    def format(self) -> str:
        """One line of the table."""
        levels = "held" if self.held else "estimated"
        return (
            f"| {self.seconds:g} | {levels} | {100 * self.coverage:.1f} +- {100 * self.error:.1f} "
            f"| {self.said} of {len(self.shares)} | {self.failed} |"
        )


def flights(runs: int, seconds: float, first_seed: int) -> list[Dataset]:
    """One flight per seed."""
    true_plant = plant()
    seeds = list(range(first_seed, first_seed + runs))
    log = fly(
        true_plant,
        controller_for(true_plant),
        RandomWaypoints(),
        rich_excitation(),
        seconds,
        seed=seeds,
        warm_up=1.0,
    )
    out = []
    for i in range(runs):
        one = {k: v for k, v in member(log, i).items() if not k.startswith("omega")}
        out.append(dataset_from_arrays(one.pop("t"), one, name="run"))
    return out


def cut(data: Dataset, seconds: float) -> Dataset:
    """Its first seconds."""
    (segment,) = data.flights[0].segments
    rows = round(seconds / segment.dt)
    return dataset_from_arrays(
        segment.t[:rows], {k: v[:rows] for k, v in segment.channels.items()}, name="run"
    )


def study(runs: int, lengths: Sequence[float], first_seed: int = 3000) -> Iterator[Row]:
    """A row for every length, with levels estimated and held. Deterministic."""
    with tempfile.TemporaryDirectory() as folder:
        vehicle = read_vehicle(
            write_vehicle(
                Path(folder) / "vehicle.toml",
                plant(),
                sigma={"inertia": 0.2, "thrust.c2": 0.2, "torque.c2": 0.3},
                errors={"inertia": 1.1, "thrust.c2": 0.9, "torque.c2": 1.1},
            )
        )
    truth = {k: float(np.asarray(v)) for k, v in plant().truth()["parameters"].items()}
    (long,) = flights(1, LONG, first_seed - 1)
    model = build_model(vehicle, long.channels, EFFECTS)
    levels = noise_of(fit(model, long, initialisation="nominal").model)
    flown = flights(runs, max(lengths), first_seed)
    for seconds in lengths:
        for held in (False, True):
            choices: dict[str, Any] = {"noise": levels, "estimate_noise": False} if held else {}
            shares, said, failed = [], 0, 0
            for data in flown:
                try:
                    found = fit(model, cut(data, seconds), initialisation="nominal", **choices)
                except GreyboxError:
                    failed += 1
                    continue
                if not found.converged:
                    failed += 1
                    continue
                told = [
                    (n, e) for n, e in found.parameters.items() if n in truth and not e.at_bound
                ]
                shares.append(
                    float(np.mean([abs(e.value - truth[n]) <= NORMAL * e.std for n, e in told]))
                )
                said += "standard errors are too small" in "\n".join(
                    found.summary().splitlines()[:3]
                )
            yield Row(seconds=seconds, held=held, shares=tuple(shares), said=said, failed=failed)


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seconds", type=float, nargs="+", default=[0.6, 1.0, 2.0, 4.0, 8.0])
    arguments = parser.parse_args(argv)
    print(
        "| flight [s] | noise levels | intervals that hold the truth [%] | said too small | failed "
        "|"
    )
    print("|---|---|---|---|---|")
    for row in study(arguments.runs, arguments.seconds):
        print(row.format(), flush=True)


if __name__ == "__main__":
    main()
