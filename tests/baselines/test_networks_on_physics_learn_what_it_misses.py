"""A network on physics: open loop it is the fitted model without its disturbance states, plus what it
has learned of a step; it gains on a flight that it has not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.baselines.filter_predictor import FilterPredictor
from greybox.data import Dataset, Flight
from greybox.errors import DataError
from greybox.model.noise import with_disturbance
from greybox.validation.open_loop import predict_from
from tests import simulated
from tests.residual.hybrid_cases import craft, craft_model

pytest.importorskip("torch")
from greybox.baselines import residual_network as rn

SETTINGS = rn.ResidualSettings(window=1, ahead=10, epochs=15, learning_rate=3e-3)


@pytest.fixture(scope="module")
def data():
    return simulated.flights(3, 4.0)


@pytest.fixture(scope="module")
def physics():
    """The craft of the flights without its drag."""
    model = craft_model(
        with_disturbance(craft(("motor_lag", "command_delay")), ("force", "torque"))
    )
    return rn.PhysicsAlone(FilterPredictor(model=model))


@pytest.fixture(scope="module")
def parts(physics, data):
    return [rn.known(physics.base, data.select(n)) for n in (("run0", "run1"), ("run2",))]


def squared(told, flight, k, steps):
    at = k[:, None] + 1 + np.arange(steps)
    return {g: np.mean((told[g] - flight.references[g][at]) ** 2) for g in rn.TAUGHT}


def test_on_a_flight_not_seen_it_is_nearer_than_physics_alone(physics, parts):
    model = rn.train_residual(physics, *parts, settings=SETTINGS)
    (flight,) = parts[1]
    k = flight.origins(1, 50, 5)
    alone = squared(physics.rolled(flight.run, k, 50), flight, k, 50)
    with_network = squared(model.rolled(flight.run, k, 50), flight, k, 50)
    assert with_network["velocity"] < 0.7 * alone["velocity"]
    again = rn.train_residual(physics, *parts, settings=SETTINGS)
    assert again.error == model.error


def test_without_a_network_it_is_the_model_without_disturbances(physics, data, parts):
    filtered = physics.base.filter.run(data.select(("run2",)).segments[0])
    forgotten = filtered.states.copy()
    forgotten[:, physics.pushes] = 0.0
    k = np.array([60, 100])
    wanted = predict_from(
        physics.base.filter.engine,
        physics.reader,
        replace(filtered, states=forgotten),
        k,
        steps=20,
    )
    told = physics.rolled(parts[1][0].run, k, 20)
    for g in wanted:
        np.testing.assert_allclose(told[g], wanted[g], atol=1e-9)


def test_what_is_added_moves_body_velocity_and_rates_from_the_next_sample_on(physics, parts):
    run, k = parts[1][0].run, np.array([80])
    alone = physics.rolled(run, k, 3)
    push = np.array([0.0, 0.0, 2.0, 0.0, 3.0, 0.0])
    moved = physics.rolled(run, k, 3, lambda w: np.tile(push, (len(w), 1)))
    dt = physics.base.dt
    assert np.array_equal(moved["rate"][:, 0], alone["rate"][:, 0])
    np.testing.assert_allclose((moved["rate"] - alone["rate"])[0, 1], [0, 3.0 * dt, 0], atol=1e-9)
    gained = np.linalg.norm((moved["velocity"] - alone["velocity"])[0, 1])
    assert gained == pytest.approx(2.0 * dt, rel=1e-6)


def test_flights_without_velocity_are_one_line(physics, data):
    (segment,) = data.select(("run2",)).segments
    poor = Flight(name="run2", segments=(segment.without(("vx", "vy", "vz")),))
    with pytest.raises(DataError, match="learns from velocity and rates"):
        rn.known(physics.base, Dataset(flights=(poor,)))
