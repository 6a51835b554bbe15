"""Rotors that are all weaker than an exact vehicle file says (thin air, warm motors) are no
payload: every model has the thrust level."""

from __future__ import annotations

import pytest

from greybox.discovery.workflow import discover
from greybox.plants.effects import ThrustLevel
from scenarios.studies import discovery_grid
from tests.discovery import small_world
from tests.discovery.small_world import plant, shorten


def test_nothing_is_named_for_thrust_that_is_missing(monkeypatch: pytest.MonkeyPatch):
    shorten(monkeypatch, "thrust_level", "payload_mass")
    thin = ThrustLevel(s=-0.03)
    exact = discovery_grid.vehicle_of(plant(), sigma={}, errors={})
    test = small_world.flown(thin, seeds=(11,), name="test")
    found = discover(exact, small_world.flown(thin), test)
    assert found.effects() == []
    level = {b["name"]: b["parameters"] for b in found.to_dict()["base"]}["thrust_level"]["s"]
    assert abs(level["value"] + 0.03) < 4 * level["std"]
    assert "thrust_level (s = -0.0" in found.summary()
