"""discover on simulated flights: a hidden effect gets its name, clean flights none, bad data an early no."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib import resources
from typing import Any

import jsonschema
import numpy as np
import pytest

from greybox.data import Dataset, dataset_from_arrays
from greybox.discovery import workflow
from greybox.discovery.result import Discovery
from greybox.discovery.sensor_noise import Suspected
from greybox.discovery.workflow import discover
from greybox.errors import DataError, GreyboxError
from greybox.files import to_plain
from greybox.model.effects import CATALOGUE
from scenarios.plants.effects import MotorLag, RotorDrag
from scenarios.studies import discovery_grid
from tests.discovery.small_world import DAMPING, SHORT, flown, shorten, vehicle


def valid(found: Discovery) -> dict[str, Any]:
    """discovery.json as it would be written, checked against its schema."""
    content: dict[str, Any] = to_plain(found.to_dict())
    schema = json.loads(resources.files("greybox.schemas").joinpath("discovery.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(content, schema)
    return content


@pytest.fixture(scope="module")
def short() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        yield


@pytest.fixture(scope="module")
def damped(short: None) -> tuple[Discovery, list[Discovery], list[str]]:
    """The search on flights with hidden damping; what was saved and said on the way."""
    saved: list[Discovery] = []
    said: list[str] = []
    found = discover(
        vehicle(), flown(DAMPING), flown(DAMPING, seeds=(11,), name="test"), save=saved.append,
        progress=lambda text, share: said.append(text),
    )  # fmt: skip
    return found, saved, said


def test_the_hidden_effect_is_named_and_nothing_else(damped: tuple[Discovery, list[Discovery], list[str]]):
    content = valid(damped[0])
    assert content["verdict"] == "named"
    assert [e["name"] for e in content["effects"]] == ["rotational_damping"]
    effect = content["effects"][0]
    assert effect["stage"] == "wrench"
    assert effect["p_value"] <= 0.05
    assert effect["delta_bic"] > 10
    assert content["unnamed"] == []


def test_its_parameters_are_within_their_error_bars(damped: tuple[Discovery, list[Discovery], list[str]]):
    for p in damped[0].effects()[0]["parameters"].values():
        assert abs(p["value"] - 4e-3) < 4 * p["std"]
        assert p["unit"] == "N m s"


def test_every_flight_gives_the_named_effect_the_same_numbers(damped: tuple[Discovery, list[Discovery], list[str]]):
    content = damped[0].to_dict()
    rows = {r["parameter"]: r for r in content["stability"]}
    shared = content["effects"][0]["parameters"]
    assert set(rows) == {f"rotational_damping.{n}" for n in shared}
    for name, p in shared.items():
        row = rows[f"rotational_damping.{name}"]
        assert row["p_value"] > 1e-3
        values = [v["value"] for v in row["flights"].values()]
        assert len(values) == 2
        assert min(values) <= p["value"] <= max(values)
    assert not any("differs between" in w for w in content["warnings"])


def test_the_gap_of_the_rate_closes_on_flights_that_were_not_searched(
    damped: tuple[Discovery, list[Discovery], list[str]],
):
    content = valid(damped[0])
    assert content["gap_on"] == "test"
    row = next(r for r in content["gap"] if r["group"] == "rotation" and r["horizon_s"] == 1.0)
    assert row["after"] < row["before"]
    assert row["closed"] > 0.5


def test_locations_shrink_and_steps_tell_the_story(damped: tuple[Discovery, list[Discovery], list[str]]):
    content = valid(damped[0])
    torque = [r for r in content["locations"] if r["channel"].startswith("torque")]
    assert len(torque) == 3
    assert content["deficiency"]["before"] > 10
    assert content["deficiency"]["after"] < content["deficiency"]["before"]
    assert [s["added"] for s in content["steps"]] == [["rotational_damping"], []]
    assert {s["name"] for s in content["steps"][0]["scores"]} <= set(SHORT)
    assert all(s["p_family"] > 0.05 for s in content["steps"][1]["scores"])
    before = np.array([c["before"] for c in content["spectrum"]["channels"]])
    after = np.array([c["after"] for c in content["spectrum"]["channels"]])
    assert before.shape == after.shape
    assert after.mean() == pytest.approx(1.0, rel=0.5)


def test_every_step_is_saved_as_it_is_found(damped: tuple[Discovery, list[Discovery], list[str]]):
    found, saved, said = damped
    assert [len(s.additions) for s in saved] == [0, 1]
    for s in saved:
        content = valid(s)
        assert "stopped" in content["warnings"][0]
        assert s.model.values["mass"] == found.model.values["mass"]
    assert [e["name"] for e in saved[-1].effects()] == ["rotational_damping"]
    assert any("added rotational_damping" in text for text in said)


def test_what_would_have_been_seen_covers_the_candidates_that_are_left(
    damped: tuple[Discovery, list[Discovery], list[str]],
):
    sizes = damped[0].minimum_detectable
    assert "rotational_damping" not in sizes
    assert set(sizes) <= set(SHORT)
    assert set(sizes["gyro_bias"]) == {"b_x", "b_y", "b_z"}
    assert 0 < sizes["gyro_bias"]["b_x"] < 0.1


def test_clean_flights_miss_nothing_and_the_answer_repeats(short: None):
    a, b = (discover(vehicle(), flown(), seed=3) for _ in range(2))
    content = valid(a)
    assert content["verdict"] == "nothing_missing"
    assert content["effects"] == content["ambiguous"] == content["unnamed"] == []
    assert "nothing is missing" in a.summary()
    assert any("training flights" in w for w in content["warnings"])
    assert all(r["closed"] is None or r["closed"] == 0 for r in content["gap"])
    varies = ("seconds", "versions")
    assert {k: v for k, v in a.to_dict().items() if k not in varies} == {
        k: v for k, v in b.to_dict().items() if k not in varies
    }


def test_a_noise_fit_that_goes_astray_leaves_the_names_alone(short: None, monkeypatch: pytest.MonkeyPatch):
    # Found on real flights: the fit with the sensors' own noise diverged, and every name was lost.
    suspected = Suspected(parts=(), gains={}, noise={})
    monkeypatch.setattr(workflow, "coloured_sensors", lambda lean, data: suspected)
    monkeypatch.setattr(workflow, "dressed", lambda nest, at, noise: (nest, nest.refit(())))
    found = discover(vehicle(), flown(DAMPING))
    assert [e["name"] for e in found.effects()] == ["rotational_damping"]
    assert any("astray" in w for w in found.warnings)


def test_known_effects_are_not_offered_again(short: None):
    from greybox.discovery.candidates import candidates

    data = flown(DAMPING)
    with_known = vehicle_with("[effects.rotational_damping]\nd_p = 4e-3\nd_q = 4e-3\nd_r = 4e-3\n")
    offered = candidates(with_known, data.channels)
    assert "rotational_damping" not in offered.names
    assert "rotational_damping" not in offered.unjudged
    assert "rotational_damping" in candidates(vehicle(), data.channels).names


def vehicle_with(text: str) -> Any:
    """The vehicle with more lines in its file."""
    import tempfile
    from pathlib import Path

    from greybox.model.vehicle import read_vehicle
    from scenarios.plants.vehicle_file import write_vehicle
    from tests.discovery.small_world import plant

    with tempfile.TemporaryDirectory() as folder:
        path = write_vehicle(Path(folder) / "v.toml", plant(), sigma=discovery_grid.SIGMA, errors=discovery_grid.ERRORS)
        path.write_text(path.read_text() + "\n" + text)
        return read_vehicle(path)


def swapped() -> Dataset:
    """Flights whose commands of two motors are exchanged."""
    out = None
    for flight in flown():
        segment = flight.segments[0]
        columns = dict(segment.channels)
        columns["u1"], columns["u2"] = columns["u2"], columns["u1"]
        one = dataset_from_arrays(segment.t, columns, name=flight.name)
        out = one if out is None else out + one
    assert out is not None
    return out


def test_swapped_motors_are_bad_data_and_not_physics():
    found = discover(vehicle(), swapped())
    content = valid(found)
    assert content["verdict"] == "bad_data"
    assert content["faults"]
    assert content["effects"] == []
    assert "fault" in found.summary()
    with pytest.raises(GreyboxError, match="faults"):
        _ = found.model


def test_a_fault_in_a_test_flight_blocks_as_well():
    found = discover(vehicle(), flown(seeds=(5,), name="good"), swapped())
    assert found.verdict == "bad_data"
    assert all(f.startswith("train") for f in found.faults)


@pytest.mark.slow
def test_two_effects_of_the_whole_catalogue_are_named_in_one_search():
    hidden = (MotorLag(tau=0.04), RotorDrag(k_x=2e-5, k_y=2.5e-5))
    found = discover(vehicle(), flown(*hidden, seconds=16.0), flown(*hidden, seeds=(11,), name="test", seconds=16.0))
    content = valid(found)
    assert content["verdict"] == "named"
    assert {e["name"] for e in content["effects"]} == {"motor_lag", "rotor_drag"}
    assert len(found.last_scores) + len(found.unjudged) >= len(CATALOGUE) - 3
    half = [r["closed"] for r in content["gap"] if r["horizon_s"] == 0.5 and r["closed"] is not None]
    assert min(half) > 0.85


def test_flights_that_are_too_short_are_refused_before_anything_is_said(short: None):
    said: list[str] = []
    stub = flown(DAMPING, seconds=0.5)
    with pytest.raises(DataError, match=r"no training flight is long enough to search in; expected 0.6 s .* got 0.5 s"):
        discover(vehicle(), stub, progress=lambda text, share: said.append(text), save=lambda found: said.append("saved"))
    assert not said
