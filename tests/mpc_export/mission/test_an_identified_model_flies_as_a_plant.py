"""The identified model as a plant: repeatable, with the noise that was identified and the
disturbances of real flights."""

import numpy as np
import pytest

from greybox.errors import ModelError
from mpc_export.mission.model_plant import BLOCK, ModelPlant, real_disturbances
from tests.mpc_export import cases


@pytest.fixture(scope="module")
def plant():
    return ModelPlant(cases.disturbed())


def flown(plant, seed, steps=20):
    plant.reset(seed, position=(0.5, 0.0, 1.0))
    u = plant._hover[1]
    seen = []
    for _ in range(steps):
        seen.append(list(plant.measure(u).values()))
        plant.step(u, plant.sample_time)
    return np.array(seen)


def test_a_seed_is_a_flight(plant):
    np.testing.assert_array_equal(flown(plant, 3), flown(plant, 3))
    assert np.abs(flown(plant, 3) - flown(plant, 4)).max() > 0


def test_it_begins_where_it_is_told_to_and_answers_alike_when_asked_twice(plant):
    plant.reset(1, position=(0.5, -0.2, 1.3))
    now = plant.states()
    assert (now["x"], now["y"], now["z"]) == (0.5, -0.2, 1.3)
    assert plant.measure() == plant.measure()


def test_sensor_noise_has_the_identified_size(plant):
    model = plant.model
    seen = []
    for seed in range(300):
        plant.reset(seed)
        seen.append(plant.measure()["p"])
    expected = model.sensor_noise[model.dynamics.innovations.names.index("p")]
    assert np.std(seen) == pytest.approx(expected, rel=0.15)


def test_parameters_differ_between_flights_by_their_covariance(plant):
    drawn = []
    for seed in range(200):
        plant.reset(seed)
        drawn.append(plant.truth()["parameters"]["mass"])
    sigma = np.sqrt(plant.model.covariance[0, 0])
    assert np.std(drawn) == pytest.approx(sigma, rel=0.2)
    assert np.mean(drawn) == pytest.approx(plant.model.values["mass"], abs=4 * sigma / np.sqrt(200))


def test_resampled_disturbances_have_the_size_and_the_pace_of_their_source():
    model = cases.disturbed()
    rng = np.random.default_rng(0)
    n, keep = 4000, np.exp(-model.sample_time / 0.3)
    source = np.zeros((n, 6))
    for k in range(1, n):
        source[k] = keep * source[k - 1] + np.sqrt(1 - keep**2) * rng.normal(size=6)
    plant = ModelPlant(model, [source * 1e-3])
    plant.reset(0)
    felt = []
    for _ in range(6000):
        felt.append(plant._x[plant._slow].copy())
        plant._next_disturbance()
    felt = np.array(felt)
    np.testing.assert_allclose(felt.std(axis=0), 1e-3, rtol=0.25)
    lag = round(0.1 / model.sample_time)
    alike = [np.corrcoef(felt[:-lag, i], felt[lag:, i])[0, 1] for i in range(6)]
    assert np.mean(alike) == pytest.approx(np.exp(-0.1 / 0.3), abs=0.1)
    jumps = np.abs(np.diff(felt, axis=0)).max()
    assert (
        jumps < 2 * np.abs(np.diff(source * 1e-3, axis=0)).max()
    )  # blocks go over into each other


def test_a_model_without_disturbances_cannot_be_asked_for_real_ones():
    with pytest.raises(ModelError, match="disturbance states"):
        real_disturbances(cases.physics(), [])
    with pytest.raises(ModelError, match=f"{4 * BLOCK:g} s"):
        real_disturbances(cases.disturbed(), [])
