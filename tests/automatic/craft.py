"""Short simulated flights with little in their logs, so that an automatic fit takes seconds:
commands and gyro alone."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from greybox.data import Dataset, dataset_from_arrays
from greybox.data.raw import RawLog
from greybox.excitation.hover import Hover
from greybox.excitation.injection import rich_excitation
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.plants import effects as plant_effects
from greybox.plants.flight_log import fly
from greybox.plants.presets import controller_for, nano
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle

RATES = ("p", "q", "r")
POSE = ("qw", "qx", "qy", "qz", "x", "y", "z")
IMU = (*RATES, "ax", "ay", "az")


@functools.cache
def plant(damping: float = 0.0) -> Quadrotor:
    """A nano quadrotor with motor lag, a delay and the air's damping of rotation [N m s]."""
    effects = [plant_effects.MotorLag(tau=0.05), plant_effects.CommandDelay(d=0.012)]
    if damping:
        effects.append(plant_effects.RotationalDamping(d_p=damping, d_q=damping, d_r=damping / 2))
    return nano(effects)


@functools.cache
def vehicle(**sigma: float) -> Vehicle:
    """Its vehicle file: inertia and thrust within a fifth, the rest exact unless `sigma` says
    otherwise."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_vehicle(
            Path(folder) / "v.toml", plant(), sigma={"inertia": 0.2, "thrust.c2": 0.2, **sigma}
        )
        return read_vehicle(path)


def flown(
    seeds: tuple[int, ...] = (1, 2), seconds: float = 8.0, damping: float = 0.0
) -> tuple[Mapping[str, np.ndarray], ...]:
    """All columns of flights at 100 Hz, one per seed."""
    return tuple(_flown(s, seconds, damping) for s in seeds)


@functools.cache
def _flown(seed: int, seconds: float, damping: float) -> Mapping[str, np.ndarray]:
    true = plant(damping)
    return fly(
        true, controller_for(true), Hover(), rich_excitation(), seconds, seed=seed, warm_up=0.5
    )


def flight(
    columns: Mapping[str, np.ndarray], name: str, sensors: tuple[str, ...] = RATES
) -> Dataset:
    """One flight with its commands and some sensors."""
    kept = {n: v for n, v in columns.items() if n in sensors or n in ("u1", "u2", "u3", "u4")}
    return dataset_from_arrays(columns["t"], kept, name=name)


def flights(sensors: tuple[str, ...] = RATES, **choices: object) -> Dataset:
    """`flown` as a data set, named run0, run1, ..."""
    parts = [flight(c, f"run{i}", sensors) for i, c in enumerate(flown(**choices))]  # type: ignore[arg-type]
    return Dataset(flights=tuple(p.flights[0] for p in parts))


def raw(columns: Mapping[str, np.ndarray], name: str = "run0") -> RawLog:
    """The log as a reader hands it on."""
    n = len(columns["t"])
    channels = {k: np.array(v, dtype=float) for k, v in columns.items() if k != "t"}
    rows = np.arange(1, n + 1, dtype=np.int64)
    return RawLog(
        t=np.array(columns["t"]),
        channels=channels,
        extra={},
        rows=rows,
        flight=name,
        source=name,
        sha256="",
    )


def with_channel(log: RawLog, **changed: np.ndarray) -> RawLog:
    """A log with other values in some channels."""
    return replace(log, channels={**log.channels, **changed})
