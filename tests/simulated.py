"""A simulated closed-loop flight and its vehicle file, made once per test session and shared by the
estimation tests."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

from greybox.data import Dataset, dataset_from_arrays
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.plants.flight_log import fly
from greybox.plants.presets import controller_for
from greybox.plants.vehicle_file import write_vehicle
from scenarios.studies.recovery import plant

SIGMA = {"inertia": 0.2, "thrust.c2": 0.2, "torque.c2": 0.3}
ERRORS = {"inertia": 1.1, "thrust.c2": 0.9, "torque.c2": 1.1}


@functools.cache
def truth() -> dict[str, float]:
    """True parameters of the plant by catalogue name."""
    return {k: float(v) for k, v in plant().truth()["parameters"].items()}


@functools.cache
def vehicle(**sigma: float) -> Vehicle:
    """The plant's vehicle file, ten per cent off, with further relative sigmas."""
    with tempfile.TemporaryDirectory() as folder:
        return read_vehicle(
            write_vehicle(Path(folder) / "v.toml", plant(), sigma={**SIGMA, **sigma}, errors=ERRORS)
        )


@functools.cache
def flights(count: int = 2, seconds: float = 8.0, first_seed: int = 40) -> Dataset:
    """`count` flights of the plant at 100 Hz, named run0, run1, ..."""
    sets = [_flown(f"run{i}", seconds, first_seed + i) for i in range(count)]
    return sum(sets[1:], start=sets[0])


@functools.cache
def _flown(name: str, seconds: float, seed: int) -> Dataset:
    true_plant = plant()
    log = fly(
        true_plant,
        controller_for(true_plant),
        RandomWaypoints(),
        rich_excitation(),
        seconds,
        seed=seed,
        warm_up=1.0,
    )
    t = log.pop("t")
    return dataset_from_arrays(
        t, {k: v for k, v in log.items() if not k.startswith("omega")}, name=name
    )
