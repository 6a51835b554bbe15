"""The model as a plant flies with its learned part; rehearsed, that part errs by one draw of its
own spread per flight."""

import numpy as np
import pytest

from mpc_export.mission.model_plant import RehearsedPlant
from tests.mpc_export import cases

U = np.full(4, 0.7)


@pytest.fixture(scope="module")
def plant():
    return RehearsedPlant(cases.hybrid())


def still(plant, seed):
    """At hover of this seed, moving, without noise."""
    plant.reset(seed)
    plant._w = np.zeros_like(plant._w)
    plant._x[plant.functions.states["velocity.x"]] = 1.5
    return plant._x.copy(), plant._error.copy()


def test_without_its_error_a_step_is_that_of_the_exported_model(plant):
    before, _ = still(plant, 3)
    plant._error = np.zeros_like(plant._error)
    plant.step(U)
    f = plant.functions
    np.testing.assert_allclose(
        plant._x, f["f_d"](before, U, plant._p).full().ravel(), rtol=1e-9, atol=1e-12
    )
    physics = plant._step(before, U, plant._p, np.zeros_like(plant._w))[0].ravel()
    assert np.abs(plant._x - physics).max() > 1e-6  # the learned part does something


def test_its_error_is_the_spread_times_one_draw(plant):
    before, error = still(plant, 4)
    plant.step(U)
    f = plant.functions
    moved = f["boxminus"](plant._x, f["f_d"](before, U, plant._p)).full().ravel()
    features = f["gp_features_raw"](before, U, plant._p)[0]
    spread = np.sqrt(f["gp_variance"](features, plant._p).full().ravel())
    assert spread.min() > 0
    expected = f["B_d"](before, U, plant._p).full() @ (spread * error)
    np.testing.assert_allclose(moved, expected, rtol=0.02, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_array_equal(plant._error, error)


def test_flights_differ_and_a_seed_repeats(plant):
    drawn = [still(plant, seed)[1] for seed in (1, 2, 1)]
    np.testing.assert_array_equal(drawn[0], drawn[2])
    assert not np.allclose(drawn[0], drawn[1])


def test_a_copy_flies_on_as_the_original_would_have_done(plant):
    plant.reset(5)
    plant.step(plant._u)
    other = plant.copied()
    ends = []
    for one in (plant, other):
        for _ in range(5):
            one.step(one._u)
        ends.append(one.measure())
    assert ends[0] == ends[1]
