"""Logs of gyro and accelerometer alone: what a velocity does that nobody measures must not be called a damping."""

from __future__ import annotations

import pytest

from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from scenarios.studies.discovery_cells import Cell, flown, nominal
from tests.discovery.small_world import shorten


def search(hidden: str, monkeypatch: pytest.MonkeyPatch) -> Discovery:
    shorten(monkeypatch)
    seed, plant, _, train, test = next(flown(Cell(hidden=(hidden,), columns="imu", seconds=8.0), [2]))
    return discover(nominal(plant, "off", seed), train, test)


def test_inflow_is_not_called_a_damping(monkeypatch: pytest.MonkeyPatch):
    found = search("axial_inflow", monkeypatch)
    assert found.effects() == []
    assert "force.z" in {u["channel"] for u in found.unnamed()}
    (withheld,) = (w for w in found.withheld if "rotational_damping" in w.effects)
    assert "without position, velocity or attitude" in withheld.reason


def test_a_damping_that_is_there_keeps_its_name(monkeypatch: pytest.MonkeyPatch):
    found = search("rotational_damping", monkeypatch)
    assert [e["name"] for e in found.effects()] == ["rotational_damping"]
    assert found.unnamed() == []
