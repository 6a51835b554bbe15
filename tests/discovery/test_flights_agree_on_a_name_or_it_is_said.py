"""Stability across flights: equal values pass at the stated level, different ones are found."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.discovery.stability import cochran


def test_cochrans_q_is_uniform_when_the_flights_agree():
    rng = np.random.default_rng(0)
    errors = np.array([0.1, 0.2, 0.05, 0.1])
    p = np.array([cochran(list(3 + errors * rng.standard_normal(4)), list(errors))[0] for _ in range(2000)])
    assert np.quantile(p, [0.1, 0.5, 0.9]) == pytest.approx([0.1, 0.5, 0.9], abs=0.035)


def test_the_spread_beyond_the_errors_is_that_of_the_flights():
    rng = np.random.default_rng(1)
    errors = np.full(400, 0.1)
    values = 2 + 0.3 * rng.standard_normal(400) + errors * rng.standard_normal(400)
    p, spread = cochran(list(values), list(errors))
    assert p < 1e-12
    assert spread == pytest.approx(0.3, rel=0.1)


def test_no_spread_is_claimed_where_errors_explain_all():
    assert cochran([1.0, 1.01], [0.1, 0.1])[1] == 0.0
