"""A row that the logger lost took its command with it: the sample after it is trusted more, and exactly so."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.data import dataset_from_arrays
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.fit import fit
from greybox.estimation.gain import LOST, lost_command, stationary
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import make_problem
from greybox.estimation.record import UNSURE, make_records
from greybox.model.model import build_model
from greybox.model.vehicle import read_vehicle
from scenarios.excitation.injection import rich_excitation
from scenarios.excitation.waypoints import RandomWaypoints
from scenarios.plants.flight_log import fly
from scenarios.plants.presets import controller_for, x250
from scenarios.plants.vehicle_file import write_vehicle

SIGMA = {"inertia": 0.2, "thrust.c2": 0.2, "torque.c2": 0.3}


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """(vehicle, whole log, the same with three rows in a hundred lost and their commands held)."""
    plant = x250()
    log = fly(plant, controller_for(plant), RandomWaypoints(), rich_excitation(), 6.0, seed=4, warm_up=1.0)
    log = {k: v for k, v in log.items() if not k.startswith("omega")}
    t = log.pop("t")
    gone = np.random.default_rng(0).random(t.size) < 0.03
    gone[:2] = gone[-2:] = False
    gone[1:] &= ~gone[:-1]
    holed = {k: np.where(gone, np.nan, v) for k, v in log.items()}
    for i in range(1, 5):
        holed[f"u{i}"] = np.where(gone, np.concatenate([[0.0], log[f"u{i}"][:-1]]), log[f"u{i}"])
    vehicle = read_vehicle(write_vehicle(tmp_path_factory.mktemp("v") / "v.toml", plant, sigma=SIGMA))
    return vehicle, dataset_from_arrays(t, log), dataset_from_arrays(t, holed), gone


def problem_of(vehicle, data):
    model = build_model(vehicle, data.channels, (), sample_time=0.01)
    return make_problem(model, data, predictor=Innovation(), criterion=Gaussian(), use_compiler=False)


def test_only_rows_after_a_lost_one_are_marked(flight):
    vehicle, whole, holed, gone = flight
    (record,) = problem_of(vehicle, holed).records
    marked = (record.patterns == UNSURE).any(axis=1)[record.pattern]
    assert np.array_equal(np.flatnonzero(marked), np.flatnonzero(gone) + 1)
    (record,) = problem_of(vehicle, whole).records
    assert not (record.patterns == UNSURE).any()


def test_a_slow_sensor_is_not_a_lost_row(flight):
    vehicle, whole, _, _ = flight
    segment = whole.segments[0]
    slow = {k: v.copy() for k, v in segment.channels.items()}
    for name in slow:
        if name[0] != "u":
            slow[name][1::2] = np.nan
        else:
            slow[name][1::2] = slow[name][::2]
    problem = problem_of(vehicle, dataset_from_arrays(segment.t, slow))
    assert not any(
        (r.patterns == UNSURE).any() for r in make_records(problem.engine, dataset_from_arrays(segment.t, slow))
    )


def test_the_gain_is_that_of_a_filter_with_the_noise_of_the_lost_command():
    rng = np.random.default_rng(1)
    a, g, c, d = np.eye(2) * 0.9, rng.normal(size=(2, 1)), rng.normal(size=(3, 2)), rng.normal(size=(3, 1))
    q, r, lost = np.array([0.3]), np.array([0.1, 0.2, 0.4]), np.diag([2.0, 3.0])
    usual = stationary((a, g, c, d), q, r, np.full(2, 1e9), lost=lost)
    p = usual.P + lost
    s = c @ p @ c.T + (d * q) @ d.T + np.diag(r)
    k = (a @ p @ c.T + (g * q) @ d.T) @ np.linalg.inv(s)
    gain, covariance, _, _ = usual.gain(np.array([UNSURE, UNSURE, UNSURE]))
    assert gain == pytest.approx(k, rel=1e-10)
    assert covariance == pytest.approx(s, rel=1e-10)
    assert usual.gain(np.ones(3))[1] == pytest.approx(usual.S)


def test_a_lost_command_moves_what_commands_move(flight):
    vehicle, whole, _, _ = flight
    problem = problem_of(vehicle, whole)
    x, window = problem.state["reference"]
    spread = np.sqrt(np.diag(lost_command(problem.dynamics, x, window, problem.dt)))
    at = {n: i for i, n in enumerate(problem.dynamics.error_states.names)}
    # Four independent commands, LOST of the mean command u each: rate = dt lever 2 c2 u LOST u sqrt(4) / J.
    u = problem.means["u1"]
    expected = problem.dt * 0.088 * 2 * 4.2 * u * LOST * u * 2 / 2.1e-3
    assert spread[at["d_rate.x"]] == pytest.approx(expected, rel=0.05)
    assert spread[at["d_velocity.x"]] < 0.05 * spread[at["d_velocity.z"]]


def test_the_gradient_stays_exact(flight):
    vehicle, _, holed, _ = flight
    problem = problem_of(vehicle, holed.split_by_time(at=1.5)[0])
    assert any((r.patterns == UNSURE).any() for r in problem.records)
    theta = problem.start
    value = problem.evaluate(theta)
    for i, u in enumerate(problem.unknowns):
        if u.name not in (
            "inertia.xx",
            "thrust.c2",
            "noise.process.torque.y",
            "noise.process.force.z",
            "noise.sensor.q",
        ):
            continue
        step = np.zeros(problem.n)
        step[i] = 1e-5 * u.scale
        slope = (problem.evaluate(theta + step, 0).cost - problem.evaluate(theta - step, 0).cost) / (2 * step[i])
        assert abs(slope - value.gradient[i]) < 1e-4 * max(abs(slope), 1.0 / u.scale), u.name


def test_lost_rows_do_not_pass_for_torque_noise(flight):
    vehicle, whole, holed, _ = flight
    model = build_model(vehicle, whole.channels, (), sample_time=0.01)
    level = {
        name: fit(model, data, initialisation="noise").noise["noise.process.torque.x"][0]
        for name, data in (("whole", whole), ("holed", holed))
    }
    assert level["holed"] == pytest.approx(level["whole"], rel=0.25)
