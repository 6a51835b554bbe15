"""In gusts, which last and follow no signal, the search carries them along: names are found, and nothing is invented."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

import greybox.discovery.candidates
from greybox.data import Dataset
from greybox.discovery.gap import foresee
from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from greybox.model.effects import CATALOGUE
from greybox.model.identified import IdentifiedModel
from greybox.model.noise import disturbances
from greybox.report.discover_report import discover_report
from scenarios.plants.effects import AccelerometerBias, PlantEffect
from scenarios.plants.presets import x250
from scenarios.studies.discovery_cells import GUSTS, gusts
from scenarios.studies.discovery_grid import flights
from tests.discovery.small_world import vehicle

BIAS = AccelerometerBias(b_x=0.1, b_y=-0.08, b_z=0.1)
OFFERED = ("accelerometer_bias", "rotational_damping")


def windy(seeds: tuple[int, ...], name: str, *effects: PlantEffect) -> Dataset:
    """Flights of 6 s in gusts."""
    return flights(x250(effects, process=gusts(x250())), seeds, 6.0, name)


@functools.cache
def searched(*hidden: PlantEffect) -> Discovery:
    """What two effects on offer explain in gusts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(greybox.discovery.candidates, "CATALOGUE", tuple(e for e in CATALOGUE if e.name in OFFERED))
        return discover(vehicle(), windy((1, 2), "train", *hidden), windy((11,), "test", *hidden))


def test_gusts_alone_have_no_name_and_their_axes_are_flagged() -> None:
    found = searched()
    assert found.verdict == "unnamed"
    assert not found.additions
    assert {"force.x", "force.y", "torque.x", "torque.y"} <= {u["channel"] for u in found.unnamed()}
    assert "carried" not in found.settings


def test_a_name_is_found_through_gusts_with_honest_errors() -> None:
    found = searched(BIAS)
    assert [e["name"] for e in found.effects()] == ["accelerometer_bias"]
    assert found.fit is not None
    for key, truth in BIAS.parameters().items():
        estimate = found.fit.parameters[key]
        assert abs(estimate.value - truth) < 4 * estimate.std
    assert found.before is not None
    assert found.leftover is not None
    assert found.before.fit is not found.leftover.fit


def test_how_long_a_gust_lasts_is_found_and_said() -> None:
    found = searched(BIAS)
    lasts = found.settings["carried"]
    assert set(lasts) == {"force", "torque"}
    for seconds in lasts.values():
        assert GUSTS.seconds / 2 < seconds < GUSTS.seconds * 2
    assert "carried along: what is left of force lasts" in found.summary()


def test_the_model_that_is_handed_out_knows_the_gust_of_the_moment(tmp_path: Path) -> None:
    found = searched(BIAS)
    assert disturbances(found.model.dynamics)
    found.model.save(tmp_path / "model.json")
    loaded = IdentifiedModel.load(tmp_path / "model.json")
    data = windy((11,), "test", BIAS)
    ours, theirs = foresee(found.model, data), foresee(loaded, data)
    assert theirs.loglik == pytest.approx(ours.loglik, rel=1e-9)
    rows = found.to_dict()["held_out_errors"]
    assert [(r["added"], r["carried"]) for r in rows] == [([], False), ([], True), (["accelerometer_bias"], True)]
    assert "From the states alone to all names, half a second ahead: position" in discover_report(found.to_dict())
    ahead = [next(e["rmse"] for e in r["errors"] if (e["group"], e["horizon_s"]) == ("velocity", 0.1)) for r in rows]
    assert np.all(np.diff(ahead) < 0)
