"""However large an effect is, its evidence is a number: ln P(chi-square > x) against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.special
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from greybox.chi_square import log_tail


@given(st.floats(0.0, 1e8))
def test_one_and_two_degrees_have_closed_forms(x: float):
    one = -0.5 * x + np.log(scipy.special.erfcx(np.sqrt(0.5 * x)))
    assert log_tail(x, 1)[0] == pytest.approx(one, rel=1e-9, abs=1e-9)
    assert log_tail(x, 2)[0] == pytest.approx(-0.5 * x, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("dof", [1, 2, 3, 6, 12, 30])
def test_the_series_goes_on_where_scipy_ends(dof: int):
    x = np.array([550.0, 601.0, 900.0, 1200.0])
    assert log_tail(x, dof) == pytest.approx(scipy.stats.chi2.logsf(x, dof), abs=1e-5)
    far = log_tail(np.array([1300.0, 1e4, 1e6, 1e9]), dof)
    assert np.isfinite(far).all()
    assert (np.diff(far) < 0).all()
