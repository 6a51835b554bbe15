"""Logs of gyro and accelerometer alone: what a velocity does that nobody measures must not be called a damping."""

from __future__ import annotations

import pytest

from greybox.data import Dataset, Flight, Segment
from greybox.discovery.candidates import candidates
from greybox.discovery.name import next_addition
from greybox.discovery.nested import Nest
from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from scenarios.studies.discovery_cells import Cell, flown, nominal
from tests.discovery.small_world import shorten


def search(hidden: str, monkeypatch: pytest.MonkeyPatch, *more: str) -> Discovery:
    shorten(monkeypatch, *more)
    seed, plant, _, train, test = next(flown(Cell(hidden=(hidden,), columns="imu", seconds=8.0), [2]))
    return discover(nominal(plant, "off", seed), train, test)


def test_inflow_is_not_called_a_damping(monkeypatch: pytest.MonkeyPatch):
    found = search("axial_inflow", monkeypatch)
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
    assert 0 < effect["p_value"] < 1e-6
    for axis, true in (("k_x", 3.554e-5), ("k_y", 4.443e-5)):
        assert effect["parameters"][axis]["value"] == pytest.approx(true, abs=4 * effect["parameters"][axis]["std"])
    assert found.unnamed() == []


def test_how_small_a_drag_may_be_is_not_said_where_nothing_shows_it(monkeypatch: pytest.MonkeyPatch):
    found = search("rotational_damping", monkeypatch, "rotor_drag")
    assert [e["name"] for e in found.effects()] == ["rotational_damping"]
    assert {"rotor_drag", "parasitic_drag"} & {*found.minimum_detectable, *found.unjudged} == set()
    assert any("rotor_drag" in w and "velocity" in w for w in found.warnings)


def test_starts_that_only_a_drag_may_guess_are_no_evidence_for_it(monkeypatch: pytest.MonkeyPatch):
    shorten(monkeypatch, "rotor_drag")
    seed, plant, _, train, _ = next(flown(Cell(hidden=(), columns="imu", seconds=12.0), [2]))
    pieces = [f.segments[0].rows(k, k + 100) for f in train for k in range(0, 1200, 100)]
    alone = [Segment(t=s.t, channels=s.channels, flight=f"f{i}") for i, s in enumerate(pieces)]
    short = Dataset(flights=tuple(Flight(name=s.flight, segments=(s,)) for s in alone))
    nest = Nest(candidates=candidates(nominal(plant, "off", seed), short.channels, sample_time=0.01), data=short)
    null = nest.refit(())
    assert next_addition(nest, null, nest.screen(null), 0.05) is None
    # The drag is likelier by what the starts of 24 flights may take up of the noise, which they pay for.
    with_drag = nest.unled(("rotor_drag",), null)
    assert with_drag.fit.loglik - null.fit.loglik > 10
    assert with_drag.evidence - null.evidence < 5


def test_a_damping_that_is_there_keeps_its_name(monkeypatch: pytest.MonkeyPatch):
    found = search("rotational_damping", monkeypatch)
    assert [e["name"] for e in found.effects()] == ["rotational_damping"]
    assert found.unnamed() == []
