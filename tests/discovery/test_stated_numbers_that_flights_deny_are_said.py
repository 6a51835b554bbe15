"""What a vehicle file states with a sigma is no effect that is missing: flights may move it, and
what they deny of it is said before all names."""

from __future__ import annotations

from dataclasses import replace

import pytest

from greybox.discovery.cause import offer
from greybox.discovery.workflow import discover
from greybox.model.vehicle import Vehicle
from greybox.model.vehicle_parts import Quantity
from greybox.plants.effects import CenterOfMassOffset
from tests.discovery import small_world
from tests.discovery.small_world import shorten, vehicle

OFF_CENTRE = CenterOfMassOffset(c_x=0.01, c_y=0.0, c_z=0.0)
AXES = [f"center_of_mass.{a}" for a in "xyz"]


def stating(sigma: float) -> Vehicle:
    """The vehicle with a centre of mass that is known so well [m]."""
    return replace(vehicle(), center_of_mass=(Quantity(value=0.0, sigma=sigma),) * 3)


def test_an_effect_that_moves_a_stated_number_under_its_name_is_not_offered():
    data = small_world.flown(OFF_CENTRE)
    causes = offer(stating(0.001), data.channels, sample_time=0.01)
    assert "center_of_mass_offset" not in causes.offered
    assert set(AXES) <= set(causes.core)
    assert causes.unjudged["center_of_mass_offset"] == f"the vehicle file states {', '.join(AXES)}"
    exact = offer(stating(0.0), data.channels, sample_time=0.01)
    assert "center_of_mass_offset" in exact.offered
    assert not set(AXES) & set(exact.core)


def test_what_flights_deny_stands_before_all_names(monkeypatch: pytest.MonkeyPatch):
    shorten(monkeypatch)
    test = small_world.flown(OFF_CENTRE, seeds=(11,), name="test")
    found = discover(stating(0.001), small_world.flown(OFF_CENTRE), test)
    (denied,) = found.denied
    assert denied.startswith("center_of_mass.x was stated (0 +- 0.001 m) but the flights want 0.0")
    assert found.line.startswith(f"AGAINST THE FILE: {denied}. ")
    assert found.to_dict()["denied"] == [denied]
    assert not found.effects()


def test_nothing_is_denied_of_a_number_that_is_right(monkeypatch: pytest.MonkeyPatch):
    shorten(monkeypatch)
    test = small_world.flown(seeds=(11,), name="test")
    found = discover(stating(0.001), small_world.flown(), test)
    assert found.denied == ()
    assert found.line.startswith("NOTHING MISSING")
