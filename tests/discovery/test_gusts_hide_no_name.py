"""In gusts, which last and follow no signal, the search carries them along: names are found, and nothing is invented."""

from __future__ import annotations

import functools

import pytest

from greybox.data import Dataset
from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from scenarios.plants.effects import AccelerometerBias, PlantEffect
from scenarios.plants.presets import x250
from scenarios.studies.discovery_cells import GUSTS, gusts
from scenarios.studies.discovery_grid import flights
from tests.discovery.small_world import shorten, vehicle

BIAS = AccelerometerBias(b_x=0.1, b_y=-0.08, b_z=0.1)


def windy(seeds: tuple[int, ...], name: str, *effects: PlantEffect) -> Dataset:
    """Flights of 8 s in gusts."""
    return flights(x250(effects, process=gusts(x250())), seeds, 8.0, name)


@functools.cache
def searched(*effects: PlantEffect) -> Discovery:
    """What a short catalogue finds in them."""
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch, "accelerometer_bias", "accelerometer_scale")
        return discover(vehicle(), windy((1, 2), "train", *effects), windy((11,), "test", *effects))


def test_a_name_is_found_through_gusts_with_honest_errors() -> None:
    found = searched(BIAS)
    assert [e["name"] for e in found.effects()] == ["accelerometer_bias"]
    for key, truth in BIAS.parameters().items():
        estimate = found.fit.parameters[key]
        assert abs(estimate.value - truth) < 4 * estimate.std
    for lasts in found.settings["carried"].values():
        assert lasts == pytest.approx(GUSTS.seconds, rel=0.5)


def test_gusts_alone_have_no_name_and_their_axes_are_flagged() -> None:
    found = searched()
    assert found.verdict == "unnamed"
    assert not found.additions
    assert {u["channel"] for u in found.unnamed()} >= {"force.x", "force.y", "torque.x", "torque.y"}
    assert "carried" not in found.settings
