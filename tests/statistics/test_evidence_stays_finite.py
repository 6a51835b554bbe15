"""However large an effect is, its evidence is a number: ln P(chi-square > x) against closed
forms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.special
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from greybox.statistics.chi_square import log_tail


@given(st.floats(0.0, 1e8))
def test_one_and_two_degrees_have_closed_forms(x: float):
    one = -0.5 * x + np.log(scipy.special.erfcx(np.sqrt(0.5 * x)))
    assert log_tail(x, 1)[0] == pytest.approx(one, rel=1e-9, abs=1e-9)
    assert log_tail(x, 2)[0] == pytest.approx(-0.5 * x, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("dof", [1, 2, 3, 6, 30, 300, 1200])
def test_the_series_goes_on_where_scipy_ends(dof: int):
    x = np.concatenate([np.linspace(1.0, 6000.0, 6000), [1e5, 1e7, 1e9]])
    known = scipy.stats.chi2.logsf(x, dof)
    there = known > -700
    assert log_tail(x, dof)[there] == pytest.approx(known[there], rel=1e-7, abs=1e-9)
    assert np.isfinite(log_tail(x, dof)).all()
    steps = np.diff(log_tail(x, dof))
    assert (steps <= 0).all()
    assert (steps[x[1:] > 2 * dof] < 0).all()
    assert log_tail(np.inf, dof)[0] == -np.inf
