"""A short catalogue and short flights: the whole search in seconds. The full catalogue is tested in
slow tests."""

from __future__ import annotations

import functools
from typing import Any

import pytest

import greybox.discovery.cause
from greybox.data import Dataset
from greybox.discovery.cause import offer
from greybox.discovery.evidence import Flights
from greybox.model.effects import CATALOGUE
from greybox.model.vehicle import Vehicle
from greybox.plants.effects import PlantEffect, RotationalDamping
from greybox.plants.presets import x250
from greybox.plants.quadrotor import Quadrotor
from greybox.residual.laws.axis import Axis
from greybox.residual.laws.terms import Term
from scenarios.studies import discovery_cells, discovery_grid

SHORT = ("gyro_bias", "rotational_damping", "center_of_mass_offset", "parasitic_drag")
DAMPING = RotationalDamping(d_p=4e-3, d_q=4e-3, d_r=4e-3)


def shorten(patch: pytest.MonkeyPatch, *more: str) -> None:
    """Leave a few effects in the catalogue, and `more`."""
    some = tuple(e for e in CATALOGUE if e.name in (*SHORT, *more))
    patch.setattr(greybox.discovery.cause, "CATALOGUE", some)


def law_of(channel: str, *picked: Term) -> Axis:
    """An axis with a law of these terms, their coefficients 0.5, 1, 1.5, ..."""
    return Axis(
        channel=channel,
        unit="N",
        rms=1.0,
        gain=100.0,
        lasts=1.0,
        needed=True,
        share=0.9,
        lawful=True,
        terms={t.text: 0.5 * (i + 1) for i, t in enumerate(picked)},
        depends_on=(),
        codes=tuple(t.code for t in picked),
        shapes=tuple(None if t.shape is None else (t.shape, 0.3) for t in picked),
    )


def plant(*effects: PlantEffect) -> Quadrotor:
    """The 250 mm quadrotor."""
    return x250(effects)


@functools.cache
def vehicle() -> Vehicle:
    """Its file, ten per cent off."""
    return discovery_grid.vehicle_of(plant())


@functools.cache
def flown(
    *effects: PlantEffect,
    seeds: tuple[int, ...] = (1, 2),
    name: str = "train",
    seconds: float = 4.0,
) -> Dataset:
    """Flights with hidden effects."""
    return discovery_cells.dataset([_log(effects, s, seconds) for s in seeds], name)


@functools.cache
def _log(effects: tuple[PlantEffect, ...], seed: int, seconds: float) -> dict[str, Any]:
    return discovery_cells.logs(plant(*effects), (seed,), seconds)[0]


def damped() -> Flights:
    """The short catalogue on flights of a plant with hidden damping, nothing fitted yet."""
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        data = flown(DAMPING)
        return Flights(causes=offer(vehicle(), data.channels, sample_time=0.01), data=data)
