"""The rehearsed plant is the identified model, and its learned part errs by one draw of its own spread per flight."""

import numpy as np
import pytest

from scenarios.studies.mpc_plant import ModelPlant
from scenarios.studies.tube_rehearsal import RehearsedPlant
from tests.mpc_export import cases


@pytest.fixture(scope="module")
def plants():
    model = cases.hybrid()
    return ModelPlant(model), RehearsedPlant(model)


def test_without_its_error_it_is_the_model(plants):
    plain, rehearsed = plants
    for plant in plants:
        plant.reset(3)
    rehearsed._error = np.zeros_like(rehearsed._error)
    rehearsed._rng = np.random.default_rng()
    rehearsed._rng.bit_generator.state = plain._rng.bit_generator.state
    u = np.full(4, 0.7)
    for _ in range(5):
        for plant in plants:
            plant.step(u)
    np.testing.assert_allclose(rehearsed._x, plain._x, rtol=1e-12, atol=1e-12)


def test_its_error_is_the_spread_times_one_draw_that_stays(plants):
    plain, rehearsed = plants
    f, u = rehearsed.functions, np.full(4, 0.7)
    rehearsed.reset(4)
    error = rehearsed._error.copy()
    for _ in range(3):
        plain._x, plain._w, plain._p = rehearsed._x.copy(), rehearsed._w.copy(), rehearsed._p.copy()
        before = plain._x.copy()
        plain.step(u)
        rehearsed.step(u)
        moved = f["boxminus"](rehearsed._x, plain._x).full().ravel()
        features = f["gp_features_raw"](before, u, rehearsed._p)[0]
        spread = np.sqrt(f["gp_variance"](features, rehearsed._p).full().ravel())
        assert spread.min() > 0
        np.testing.assert_allclose(
            moved, f["B_d"](before, u, rehearsed._p).full() @ (spread * error), rtol=1e-6, atol=1e-12
        )
        np.testing.assert_array_equal(rehearsed._error, error)


def test_flights_differ_and_a_seed_repeats(plants):
    rehearsed = plants[1]
    drawn = []
    for seed in (1, 2, 1):
        rehearsed.reset(seed)
        drawn.append(rehearsed._error.copy())
    np.testing.assert_array_equal(drawn[0], drawn[2])
    assert not np.allclose(drawn[0], drawn[1])
