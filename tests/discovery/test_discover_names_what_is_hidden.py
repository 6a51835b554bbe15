"""discover on simulated flights: a hidden effect is certified, clean flights miss nothing, bad data
are an early no."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib import resources
from typing import Any

import jsonschema
import numpy as np
import pytest

import greybox.discovery.workflow
from greybox.data import Dataset, dataset_from_arrays
from greybox.discovery.further import further
from greybox.discovery.result import Discovery
from greybox.discovery.rules import EFFORT, Effort
from greybox.discovery.search import Search
from greybox.discovery.workflow import discover
from greybox.errors import DataError, GreyboxError
from greybox.estimation.fit import fit
from greybox.files import to_plain
from greybox.model.model import build_model
from greybox.model.noise import sensor_parts
from greybox.plants.effects import PayloadMass, PlantEffect, ThrustLevel
from greybox.validation.judges import Judges
from greybox.validation.then import Then
from tests.discovery import small_world
from tests.discovery.small_world import DAMPING, SHORT, shorten, vehicle
from tests.discovery.test_noise_that_is_not_felt_is_not_kept import coloured


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
def damped(short: None) -> tuple[Discovery, list[Discovery]]:
    """The search on flights with hidden damping, and what was saved on the way."""
    saved: list[Discovery] = []
    test = small_world.flown(DAMPING, seeds=(11,), name="test")
    return discover(vehicle(), small_world.flown(DAMPING), test, save=saved.append), saved


def test_one_flight_without_a_test_judges_itself_by_halves(short: None):
    found = discover(vehicle(), small_world.flown(DAMPING, seeds=(1,), seconds=6.0))
    assert found.base == ("gyro_bias",)  # a number of each half's own
    assert [e["name"] for e in found.effects()] == ["rotational_damping"]
    assert any("by halves" in w for w in found.warnings)


def test_the_hidden_effect_is_certified_and_nothing_else(damped: tuple[Discovery, list[Discovery]]):
    content = valid(damped[0])
    assert content["verdict"] == "named"
    (effect,) = content["effects"]
    assert (effect["name"], effect["status"], effect["stage"]) == (
        "rotational_damping",
        "certified",
        "wrench",
    )
    assert effect["log10_e"] >= content["bar_log10_e"] == pytest.approx(1.9, abs=0.1)
    assert effect["worth"]["share"] > 0.1
    for p in effect["parameters"].values():
        assert abs(p["value"] - 4e-3) < 4 * p["std"]
    assert content["unnamed"] == []
    assert content["line"].startswith("MISSING: rotational_damping")
    assert content["line"] == damped[0].summary().splitlines()[0]


def test_the_gap_closes_on_flights_that_were_not_searched(
    damped: tuple[Discovery, list[Discovery]],
):
    content = valid(damped[0])
    assert content["gap_on"] == "test"
    row = next(r for r in content["gap"] if r["group"] == "rotation" and r["horizon_s"] == 1.0)
    assert row["closed"] > 0.5


def test_every_step_is_saved_as_stopped(damped: tuple[Discovery, list[Discovery]]):
    found, saved = damped
    assert len(saved) >= 2
    for s in saved:
        assert valid(s)["verdict"] == "stopped"
        assert s.effects() == []
        assert s.model_verdict is not None and s.model_verdict.refused
    assert "rotational_damping" in saved[-1].model.effects
    assert [len(s.steps) for s in saved] == [0, 1, 2]
    assert [s.line.partition("; ")[2] for s in saved] == [
        f"taken up so far, not certified: {name}; not done: further steps, certificates, what is "
        "left, the gap"
        for name in ("nothing", "rotational_damping")
    ] + [
        "so far, what laws may still change: rotational_damping certified; not done: what is left, "
        "the gap"
    ]
    assert found.verdict == "named"


def test_sizes_that_would_be_certified_are_those_of_what_is_absent(
    damped: tuple[Discovery, list[Discovery]],
):
    sizes = damped[0].minimum_detectable
    assert set(sizes) <= set(SHORT) - {"rotational_damping"}
    assert all(v > 0 for row in sizes.values() for v in row.values())


def test_clean_flights_miss_nothing(short: None):
    found = discover(vehicle(), small_world.flown(), small_world.flown(seeds=(11,), name="test"))
    content = valid(found)
    assert content["verdict"] == "nothing_missing"
    assert content["effects"] == content["ambiguous"] == content["unnamed"] == []
    assert content["line"].startswith("NOTHING MISSING")


@pytest.mark.slow
def test_without_test_flights_halves_judge_each_other(short: None):
    assert [e["name"] for e in discover(vehicle(), small_world.flown(DAMPING)).effects()] == [
        "rotational_damping"
    ]
    alone = small_world.flown(DAMPING, seeds=(1,), seconds=8.0)
    assert [e["name"] for e in discover(vehicle(), alone).effects()] == ["rotational_damping"]


@pytest.mark.slow
def test_more_effort_keeps_every_verdict(short: None):
    more = Effort(tried=2 * EFFORT.tried, iterations=90, behind=60.0)
    for hidden in ((), (DAMPING,)):
        train, test = (
            small_world.flown(*hidden),
            small_world.flown(*hidden, seeds=(11,), name="test"),
        )
        few, many = (discover(vehicle(), train, test, effort=e) for e in (EFFORT, more))
        assert few.verdict == many.verdict
        assert [(n.name, n.status) for n in few.names] == [(n.name, n.status) for n in many.names]


@pytest.mark.slow
def test_what_changed_since_a_model_was_identified_has_a_name(short: None):
    before = discover(
        vehicle(), small_world.flown(), small_world.flown(seeds=(11,), name="test")
    ).model
    train, test = small_world.flown(DAMPING), small_world.flown(DAMPING, seeds=(11,), name="test")
    found = discover(vehicle(), train, test, since=before)
    assert [e["name"] for e in found.effects()] == ["rotational_damping"]


@pytest.mark.slow
def test_a_load_is_told_from_rotors_that_are_weaker_by_as_much():
    """Both make thrust over mass smaller; torque over inertia is smaller for weak rotors alone."""
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch, "payload_mass", "thrust_level")

        def flights(*hidden: PlantEffect) -> tuple[Dataset, Dataset]:
            return small_world.flown(*hidden), small_world.flown(*hidden, seeds=(11,), name="test")

        before = discover(vehicle(), *flights()).model
        found = discover(vehicle(), *flights(PayloadMass(mu=0.15)), since=before)
        (name,) = found.effects()
        assert (name["name"], name["status"]) == ("payload_mass", "certified")
        size = found.numbers_of("payload_mass")["mu"]
        assert 0.0 < size["std"] < 0.05
        assert abs(size["value"] - 0.15) < 2.5 * size["std"]
        weak = discover(vehicle(), *flights(ThrustLevel(s=-0.13)), since=before)
        assert [e["name"] for e in weak.effects()] == []
        now, was = (
            (1.0 + m.values["thrust_level.s"]) * m.values["thrust.c2"] for m in (weak.model, before)
        )
        assert now / was == pytest.approx(0.87, abs=0.01)


def test_what_is_no_change_is_said_first_and_costs_no_swap_and_no_certificate(
    short: None, monkeypatch: pytest.MonkeyPatch
):
    then = fit(build_model(vehicle(), small_world.flown().channels), small_world.flown()).model
    monkeypatch.setattr(Then, "unchanged", lambda _then, _new, added, _span: f"AS THEN: {added}")
    monkeypatch.setattr(greybox.discovery.workflow, "certificates", None)
    monkeypatch.setattr(Then, "beats", lambda *_: True)
    monkeypatch.setattr(Search, "_rivals", None)
    train, test = small_world.flown(DAMPING), small_world.flown(DAMPING, seeds=(11,), name="test")
    found = discover(vehicle(), train, test, since=then)
    assert valid(found)["line"] == found.line == "AS THEN: ['rotational_damping']"
    assert found.names == ()
    assert "rotational_damping" not in found.model.effects
    errors = Then.on(then, Judges(flights=test, adapt=found.settings["adapt"]))
    assert errors is not None
    half = next(r for r in found.gap if (r.group, r.horizon_s) == ("rate", 0.5))
    squares = np.concatenate(errors.errors.own["rate", 0.5])
    assert half.before == pytest.approx(np.sqrt(squares.mean())), "of the model of then"


def test_further_flights_multiply_the_evidence(damped: tuple[Discovery, list[Discovery]]):
    found, content = damped[0], valid(damped[0])
    more = further(content, found.model, small_world.flown(DAMPING, seeds=(21,), name="more"))
    (before,), (after,) = content["effects"], more["effects"]
    assert after["log10_e"] == pytest.approx(before["log10_e"] + after["further"])
    assert after["further"] > 1.0
    assert more["tested_on"] == ["test0", "more0"]
    assert after["further"] > 0.3 * before["log10_e"], "as much as a flight told before, nearly"
    with pytest.raises(DataError, match="took part"):
        further(content, found.model, small_world.flown(DAMPING, seeds=(11,), name="test"))
    with pytest.raises(DataError, match="copy0 took part"):
        further(content, found.model, small_world.flown(DAMPING, seeds=(1,), name="copy"))


@pytest.mark.slow
def test_flights_of_a_craft_that_changed_are_no_evidence_for_a_name(
    damped: tuple[Discovery, list[Discovery]],
):
    found, content = damped[0], valid(damped[0])
    loaded = small_world.flown(DAMPING, PayloadMass(mu=0.2), seeds=(21,), name="loaded")
    same = small_world.flown(DAMPING, seeds=(22,), name="same")
    after = further(content, found.model, loaded + same)
    ((before,), (now,)) = content["effects"], after["effects"]
    assert now["log10_e"] <= before["log10_e"]
    assert "ANOTHER CRAFT OR AIR" in after["line"].split(";")[0]
    assert "loaded0: NOT USABLE" in after["line"]
    assert "same0" not in after["line"]
    assert after["warnings"][-1] in after["line"]
    assert further(content, found.model, same)["effects"][0]["further"] > 1.0


@pytest.mark.slow
def test_further_flights_without_it_take_a_name_back(damped: tuple[Discovery, list[Discovery]]):
    found, content = damped[0], valid(damped[0])
    clean = small_world.flown(seeds=(31, 32, 33, 34, 35, 36), name="clean", seconds=8.0)
    against = further(content, found.model, clean)
    assert against["effects"] == []
    assert against["verdict"] == "nothing_missing"


@pytest.mark.slow
def test_a_search_that_has_not_ended_has_no_names_to_go_on_with(
    damped: tuple[Discovery, list[Discovery]],
):
    found = damped[1][-1]
    more = small_world.flown(DAMPING, seeds=(21,), name="more")
    with pytest.raises(DataError, match=r"stopped before its end.*go on with it first"):
        further(valid(found), found.model, more)


@pytest.mark.slow
def test_further_flights_of_coloured_sensors_multiply_the_evidence_too(short: None):
    rng = np.random.default_rng(3)

    def lasting(*seeds: int, name: str) -> Dataset:
        data = small_world.flown(DAMPING, seeds=seeds, name=name)
        return Dataset(flights=tuple(coloured(f, rng) for f in data))

    found = discover(vehicle(), lasting(1, 2, name="train"), lasting(11, name="test"))
    assert "coloured.gyro" in {p.name for p in sensor_parts(found.model.dynamics)}
    content = valid(found)
    (before,) = content["effects"]
    content["line"] = f"NOT USABLE: a reason. {content['line']}"
    more = further(content, found.model, lasting(21, name="more"))
    again = further(more, found.model, lasting(22, name="again"))
    for later in (more, again):  # what the search had said of its model holds
        assert later["line"].startswith("MISSING: rotational_damping (log10 e ")
        assert later["line"].endswith(f"). Before: {content['line']}")
    (after,) = more["effects"]
    assert after["status"] == "certified"
    assert after["further"] > 1.0
    assert after["log10_e"] == pytest.approx(before["log10_e"] + after["further"])


def test_flights_that_are_too_short_are_refused():
    data = small_world.flown(seconds=4.0)
    (flight, *_) = data.flights
    few = {n: v[:30] for n, v in flight.segments[0].channels.items()}
    with pytest.raises(DataError, match="long enough"):
        discover(vehicle(), dataset_from_arrays(flight.segments[0].t[:30], few, name="short"))


def test_bad_data_stop_the_search_before_it_begins():
    channels = dict(small_world.flown().flights[0].segments[0].channels)
    channels["u1"], channels["u2"] = channels["u2"], channels["u1"]
    data = dataset_from_arrays(
        small_world.flown().flights[0].segments[0].t, channels, name="swapped"
    )
    found = discover(vehicle(), data)
    content = valid(found)
    assert content["verdict"] == "bad_data"
    assert content["faults"]
    with pytest.raises(GreyboxError, match="blocking"):
        _ = found.model
