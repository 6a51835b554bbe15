"""A risk per flight becomes standard deviations by Boole's inequality: the parts add up to the whole."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from greybox.errors import ModelError
from mpc_export.tube.risk import kappa


@given(st.floats(1e-6, 0.5), st.integers(1, 5000))
def test_parts_add_up(level, pairs):
    each = norm.sf(kappa(level, pairs))
    assert pairs * each == pytest.approx(level, rel=1e-6)


@pytest.mark.parametrize(("level", "pairs"), [(0.0, 3), (1.0, 3), (0.1, 0), (0.1, float("nan"))])
def test_nonsense_is_refused(level, pairs):
    with pytest.raises(ModelError):
        kappa(level, pairs)
