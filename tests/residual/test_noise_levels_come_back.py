"""Noise levels that a fit drove away come back one by one; a group's common factor cannot bring
them."""

import numpy as np
import pytest

from greybox.residual.noise_levels import refit_noise
from tests.residual import hybrid_cases


@pytest.fixture(scope="module")
def data():
    # white torque of 0.05 per root hertz: 0.354 over a sample of 20 ms
    return hybrid_cases.swings(2, 2, hidden=0.0, period=5.0)


@pytest.mark.parametrize("start", [(0.02, 0.3), (0.354, 0.01), (0.354, 0.3)])
def test_levels_are_found_from_wherever_a_fit_left_them(data, start):
    found = refit_noise(hybrid_cases.pendulum_model(start), data, each=True).process_noise
    assert found[0] == pytest.approx(0.354, rel=0.02)
    # There is no correlated torque: what the starts are off by is none either.
    assert found[1] < 0.02


@pytest.mark.slow
def test_levels_are_right_on_average():
    """One level scatters by 4 % (the likelihood of 1600 samples): five per cent are three errors of
    the mean of six."""
    found = [
        refit_noise(
            hybrid_cases.pendulum_model((0.354, 0.3)),
            hybrid_cases.swings(2, seed, hidden=0.0, period=5.0),
            each=True,
        ).process_noise
        for seed in range(1, 7)
    ]
    assert np.mean(found, axis=0)[0] == pytest.approx(0.354, rel=0.05)
    assert np.max(found, axis=0)[1] < 0.02


def test_a_level_that_was_driven_to_nothing_stays_there_without(data):
    assert refit_noise(hybrid_cases.pendulum_model((0.02, 0.3)), data).process_noise[0] < 0.11


def test_a_factor_is_the_same_from_below_and_from_above(data):
    low, high = (
        refit_noise(hybrid_cases.pendulum_model((start, 1e-6)), data).process_noise[0]
        for start in (0.2, 0.8)
    )
    assert low == pytest.approx(high, rel=1e-3)
    assert low == pytest.approx(0.354, rel=0.05)
