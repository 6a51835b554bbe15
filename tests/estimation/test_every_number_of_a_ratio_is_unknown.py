"""Where only a ratio of parameters is seen, none of them has an error bar: not the one either that
would be known poorly if the others were given."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.estimation.covariance import covariance

RATIO = np.array([1.0, 1.0, 1.0, 0.0])
"""A common factor on the first three; the fourth has nothing to do with it."""


def information(sizes: tuple[float, ...]) -> np.ndarray:
    """Of four parameters (4, 4), in which the change `RATIO` is not seen; the first three are known
    alone to `sizes`."""
    rng = np.random.default_rng(3)
    known = 1.0 / np.array([*sizes, 1.0])
    slopes = rng.standard_normal((40, 4)) * known
    slopes -= np.outer(slopes @ RATIO, RATIO * known**2) / (RATIO @ known**2)
    return slopes.T @ slopes


@pytest.mark.parametrize("poor", [1e-3, 1e-2, 0.1, 1.0, 10.0])
def test_also_of_the_one_that_is_poorly_known(poor: float) -> None:
    found = covariance(information((1e-3, 2e-3, poor)), None, np.zeros(4), np.zeros(4, bool))
    assert np.isinf(np.diag(found.fisher)).tolist() == [True, True, True, False]


@pytest.mark.parametrize("weak", [1e-8, 1e-4, 1.0])
def test_a_direction_that_is_seen_leaves_errors_finite(weak: float) -> None:
    seen = information((1e-3, 2e-3, 0.1)) + weak * 1e6 * np.outer(RATIO, RATIO)
    found = covariance(seen, None, np.zeros(4), np.zeros(4, bool))
    assert np.isfinite(found.fisher).all()
