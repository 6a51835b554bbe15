"""A drawn craft is a folder as a stranger would send it, with the truth beside it."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest

import greybox as gb
from greybox.model.effects import CATALOGUE
from scenarios.foreign import draw as drawing
from scenarios.foreign.draw import HIDDEN, draw, flights_of, write
from scenarios.foreign.stranger import INERTIA_ERROR, LARGEST_DEVIATION, MASS_ERROR, THRUST_ERROR
from scenarios.foreign.survey import survey
from tests.foreign_plants import ALL, FOREIGN, make

SEEDS = range(1, 61)


@pytest.fixture(scope="module")
def drawn():
    return [draw(seed) for seed in SEEDS]


def test_masses_span_25_g_to_3_kg_and_every_choice_occurs(drawn):
    masses = np.array([d.craft.airframe.mass for d in drawn])
    assert masses.min() < 0.05 and masses.max() > 1.5
    assert np.all((masses >= 0.025) & (masses <= 3.0))
    assert {d.simulator for d in drawn} == set(ALL) - set(drawing.ON_REQUEST)
    for choice in ("gusts", "rotor_speeds"):
        assert {getattr(d, choice) for d in drawn} == {True, False}
    assert {d.realism is None for d in drawn} == {True, False}
    assert {d.knowledge.sigmas for d in drawn} == {True, False}
    assert {d.knowledge.noise for d in drawn} == {True, False}


def test_nominal_numbers_are_wrong_by_as_much_as_is_said(drawn):
    for name, error in (("mass", MASS_ERROR), ("thrust", THRUST_ERROR)):
        off = np.array([getattr(d.knowledge, name) - 1.0 for d in drawn])
        assert np.abs(off).max() <= LARGEST_DEVIATION * error
        assert 0.6 * error < off.std() < 1.2 * error
    off = np.array([d.knowledge.inertia for d in drawn]) - 1.0
    assert np.abs(off).max() <= LARGEST_DEVIATION * INERTIA_ERROR
    assert 0.15 < off.std() < 0.35


def test_the_simulator_can_be_chosen_and_leaves_the_craft_as_it_was():
    ours, theirs = draw(5, "rotorpy"), draw(5, "mujoco")
    assert ours.craft == theirs.craft and ours.knowledge == theirs.knowledge
    curved, straight = draw(5, "drone_models").craft.airframe, ours.craft.airframe
    assert curved.thrust != straight.thrust
    assert replace(curved, thrust=straight.thrust, torque=straight.torque) == straight
    with pytest.raises(ValueError, match="no such choice: gazebo"):
        draw(5, "gazebo")


def test_a_fitted_rotor_law_is_hidden_only_when_asked_for_and_only_where_there_is_one():
    assert draw(5, "drone_models").fitted is None
    assert draw(5, "drone_models", ("rotor_law",)).fitted is not None
    with pytest.raises(ValueError, match="only drone_models can hide rotor_law"):
        draw(5, "mujoco", ("rotor_law",))


def test_what_is_hidden_changes_only_itself():
    plain, delayed = draw(9, "plants"), draw(9, "plants", ("delay",))
    assert delayed.craft.delay > 0.0
    assert replace(delayed.craft, delay=0.0) == plain.craft
    everything = draw(9, "plants", HIDDEN)
    assert everything.craft.delay == delayed.craft.delay
    assert sum(everything.craft.uneven) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("simulator", ALL)
def test_the_truth_has_the_names_of_the_catalogue(simulator):
    make(simulator)
    truth = drawing.truth_of(draw(4, simulator, HIDDEN))
    known = {effect.name for effect in CATALOGUE} | {
        "mass",
        "inertia",
        "thrust",
        "torque",
        "center_of_mass",
    }
    for table in ("parameters", "near"):
        assert {name.split(".")[0] for name in truth[table]} <= known
    assert not set(truth["parameters"]) & set(truth["near"])
    assert set(truth["file"]) <= set(truth["parameters"])
    assert {"motor_lag.tau", "command_delay.d", "battery_sag.c_V"} <= {
        *truth["parameters"],
        *truth["near"],
    }


def seed_with(sigmas):
    return next(s for s in SEEDS if draw(s).knowledge.sigmas == sigmas)


@pytest.mark.parametrize(
    "simulator",
    [s if s == "mujoco" else pytest.param(s, marks=pytest.mark.slow) for s in drawing.SIMULATORS],
)
def test_the_folder_reads_back_and_its_flights_have_no_blocking_findings(simulator, tmp_path):
    make(simulator)
    drawn = draw(seed_with(True), simulator)
    logs = write(drawn, tmp_path, duration=8.0)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        *(
            "test1.csv",
            "test2.csv",
            "train1.csv",
            "train2.csv",
            "train3.csv",
            "truth.json",
            "vehicle.toml",
        ),
    ]
    vehicle = gb.read_vehicle(tmp_path / "vehicle.toml")
    assert vehicle.mass.value == pytest.approx(
        drawn.knowledge.mass * drawn.craft.airframe.mass, rel=1e-4
    )
    data = gb.read_logs(sorted(tmp_path.glob("*.csv")), vehicle)
    assert len(data.flights) == 5
    found = [f for f in gb.check(data, vehicle).findings if f.severity == "blocking"]
    assert found == []
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["simulator"] == simulator
    assert survey(logs).flies and survey(logs).moves
    assert not any(
        line.startswith("true")
        for line in (tmp_path / "train1.csv").read_text().splitlines()[0].split(",")
    )


def test_a_file_without_sigmas_has_bare_numbers_and_the_schema_that_believes_them_in_part():
    drawn = draw(seed_with(False))
    text = drawing.vehicle_text(drawn.craft.airframe, drawn.knowledge, drawn.sensors)
    file = tomllib.loads(text)
    assert file["schema"] == "greybox.vehicle/2"
    assert text.count("sigma") == 1
    assert file["mass"]["sigma"] == pytest.approx(0.03 * file["mass"]["value"], rel=1e-5)


def test_a_draw_repeats_itself():
    drawn = replace(draw(3, "plants"), gusts=True)
    first, again = (flights_of(drawn, duration=1.0)["train1"] for _ in range(2))
    assert all(np.array_equal(first[name], again[name], equal_nan=True) for name in first)


def test_real_sensors_round_quaternions_lose_rows_and_come_late():
    seed = next(s for s in SEEDS if draw(s).realism is not None and draw(s).realism.lost > 0.005)
    drawn = draw(seed, "plants")
    log = flights_of(drawn, duration=4.0)["train1"]
    kept = drawing.logged(drawn, log, 0)
    assert len(kept["t"]) < len(log["t"])
    assert np.array_equal(kept["qw"], np.round(kept["qw"], 5))
    ideal = drawing.logged(replace(drawn, realism=None), log, 0)
    assert ideal is log


def test_the_command_writes_a_folder_and_says_what_it_drew(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(drawing, "write", lambda drawn, out: out.mkdir())
    assert (
        drawing.main(["--seed", "7", "--simulator", "plants", "--out", str(tmp_path / "craft")])
        == 0
    )
    assert "plants" in capsys.readouterr().out
    assert (
        drawing.main(["--seed", "1007", "--simulator", "plants", "--out", str(tmp_path / "judge")])
        == 0
    )
    assert capsys.readouterr().out.startswith("seed 1007:")


def test_a_simulator_that_is_not_installed_is_named_with_its_extra(tmp_path, capsys, monkeypatch):
    def missing(drawn, out):
        raise drawing.MissingSimulator("rotorpy")

    monkeypatch.setattr(drawing, "write", missing)
    assert (
        drawing.main(["--seed", "7", "--simulator", FOREIGN[0], "--out", str(tmp_path / "craft")])
        == 2
    )
    assert "greybox-sysid[judge]" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_every_development_craft_flies_within_bounds_and_really_moves(seed):
    drawn = draw(seed)
    make(drawn.simulator)
    found = survey(flights_of(drawn))
    assert found.flies and found.moves, found
