"""The peers of the league table: terms are those of the catalogue, and toys are named."""

from __future__ import annotations

import json

import numpy as np
import pytest

from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.vehicle import read_vehicle
from greybox.plants import effects as hidden
from greybox.plants.flight_log import fly, write_log
from greybox.plants.noise import SensorNoise
from greybox.plants.presets import X250, controller_for
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle
from scenarios.studies import league
from scenarios.studies.league_terms import CORE, read_columns, regression

QUIET = SensorNoise(gyro=1e-4, accelerometer=1e-3, attitude=1e-5, position=1e-5, velocity=1e-4)
LAG = hidden.MotorLag(tau=0.04)


def folder_of(path, *effects, flights=("train1", "train2", "test1")):
    """Flights of a 250 mm craft with these effects, and a file that knows its lag alone."""
    path.mkdir(exist_ok=True)
    plant = Quadrotor(X250, [LAG, *effects], sensors=QUIET)
    write_vehicle(path / "vehicle.toml", plant, known=["motor_lag"])
    for seed, name in enumerate(flights):
        log = fly(
            plant, controller_for(plant), RandomWaypoints(), rich_excitation(), 6.0, seed=seed
        )
        write_log(path / f"{name}.csv", log, drop=("omega",))
    return path


@pytest.mark.parametrize(
    ("effect", "size"),
    [
        (hidden.RotorDrag(k_x=4e-5, k_y=6e-5), (4e-5, 6e-5)),
        (hidden.AxialInflow(k_z=5e-5), (5e-5,)),
        (hidden.RotationalDamping(d_p=4e-3, d_q=3e-3, d_r=4e-3), (4e-3, 3e-3, 4e-3)),
        (hidden.RotorAsymmetry(delta=(0.04, -0.02, 0.0, -0.02)), (0.04, -0.02, 0.0)),
        (hidden.ThrustCurve(f=0.2), (0.2,)),
        (hidden.RotorGyroscopic(J_r=4e-6), (4e-6,)),
        (hidden.ProductsOfInertia(Jxy=2e-4, Jxz=-1e-4, Jyz=1e-4), (2e-4, -1e-4, 1e-4)),
        (hidden.BladeFlapping(k_flap=1e-6), (1e-6,)),
        (hidden.ConstantForce(f_x=0.2, f_y=-0.1), (0.2, -0.1, 0.0)),
    ],
)
def test_the_coefficient_of_a_term_is_the_parameter_of_its_effect(effect, size, tmp_path):
    folder = folder_of(tmp_path, effect, flights=("train1",))
    found = regression(read_vehicle(folder / "vehicle.toml"), read_columns(folder / "train1.csv"))
    height = np.array([1.0, 1.0, 1.0, 20.0, 20.0, 20.0])  # angular accelerations are rougher
    y = (found.y / height).reshape(-1)
    x = (found.terms[effect.name] / height[:, None]).reshape(len(y), -1)
    value = np.linalg.lstsq(x, y, rcond=None)[0]
    assert value == pytest.approx(size, rel=0.25, abs=0.1 * max(map(abs, size)))
    assert CORE in found.terms


def toy(seed=0, size=0.5):
    """400 rows in which the two columns of `a` matter."""
    random = np.random.default_rng(seed)
    owner = ["a", "a", "b", "c|d", "e"]

    def part():
        x = random.standard_normal((400, len(owner)))
        return size * (x[:, 0] - x[:, 1]) + 0.5 * random.standard_normal(400), x

    parts = [part(), part()]
    whole = tuple(np.concatenate(p) for p in zip(*parts))
    return league.Problem(parts=parts, train=whole, test=part(), owner=owner)


@pytest.mark.parametrize("peer", list(league.PEERS))
def test_a_peer_names_what_a_toy_shows_and_nothing_else(peer):
    if "SINDy" in peer:
        pytest.importorskip("pysindy", reason="pysindy comes with the extra judge")
    assert league.PEERS[peer](toy(), 0) == {"a"}


def test_a_split_f_test_of_noise_names_nothing():
    assert sum(bool(league.split_f(toy(seed, 0.0), 0)) for seed in range(20)) <= 2


def test_a_term_of_several_effects_is_a_set():
    found = league.said({"a", "b|c"})
    assert found.named == {"a"} and found.sets == [[frozenset("b"), frozenset("c")]]


def test_a_folder_is_compared_and_counted(tmp_path):
    pytest.importorskip("pysindy", reason="pysindy comes with the extra judge")
    folder = folder_of(tmp_path / "drag", hidden.RotorDrag(k_x=8e-5, k_y=8e-5))
    truth = {"cell": "single:rotor_drag", "seed": 1, "hidden": ["rotor_drag"], "sensors": "ideal"}
    (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8")
    rows = league.compared(folder)
    assert [r["peer"] for r in rows] == list(league.PEERS)
    assert all("rotor_drag" in r["named"] for r in rows)
    said = league.table([{**r, "judged": "right"} for r in rows])
    assert "| SINDy | 0 of 0 | 1 of 1 (100.0 %, 2.5 to 100.0) | 0 of 1" in said
