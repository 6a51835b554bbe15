"""Logs of gyro and accelerometer alone: what a velocity does that nobody measures must not be called a damping."""

from __future__ import annotations

import pytest

from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from scenarios.studies.discovery_cells import Cell, flown, nominal
from tests.discovery.small_world import shorten


def search(hidden: str, monkeypatch: pytest.MonkeyPatch, *more: str, without: str = "") -> Discovery:
    shorten(monkeypatch, *more, without=without)
    seed, plant, _, train, test = next(flown(Cell(hidden=(hidden,), columns="imu", seconds=8.0), [2]))
    return discover(nominal(plant, "off", seed), train, test)


def test_inflow_is_not_called_a_damping(monkeypatch: pytest.MonkeyPatch):
    # A drag along z with a damping does almost what inflow does: without it there is no word for the force.
    found = search("axial_inflow", monkeypatch, without="parasitic_drag")
    assert found.effects() == []
    assert "force.z" in {u["channel"] for u in found.unnamed()}
    (withheld,) = (w for w in found.withheld if "rotational_damping" in w.effects)
    assert "without position, velocity or attitude" in withheld.reason


def test_inflow_is_called_inflow_where_the_catalogue_has_it(monkeypatch: pytest.MonkeyPatch):
    found = search("axial_inflow", monkeypatch, "axial_inflow")
    assert [e["name"] for e in found.effects()] == ["axial_inflow"]
    assert found.unnamed() == []


def test_a_drag_is_found_by_the_velocity_that_only_it_shows(monkeypatch: pytest.MonkeyPatch):
    found = search("rotor_drag", monkeypatch, "rotor_drag")
    (effect,) = found.effects()
    assert effect["name"] == "rotor_drag"
    assert effect["p_value"] < 1e-6
    for axis, true in (("k_x", 3.554e-5), ("k_y", 4.443e-5)):
        assert effect["parameters"][axis]["value"] == pytest.approx(true, abs=4 * effect["parameters"][axis]["std"])
    assert found.unnamed() == []


def test_how_small_a_drag_may_be_is_not_said_where_nothing_shows_it(monkeypatch: pytest.MonkeyPatch):
    found = search("rotational_damping", monkeypatch, "rotor_drag")
    assert [e["name"] for e in found.effects()] == ["rotational_damping"]
    assert {"rotor_drag", "parasitic_drag"} & {*found.minimum_detectable, *found.unjudged} == set()
    assert any("rotor_drag" in w and "velocity" in w for w in found.warnings)


def test_a_damping_that_is_there_keeps_its_name(monkeypatch: pytest.MonkeyPatch):
    found = search("rotational_damping", monkeypatch)
    assert [e["name"] for e in found.effects()] == ["rotational_damping"]
    assert found.unnamed() == []
