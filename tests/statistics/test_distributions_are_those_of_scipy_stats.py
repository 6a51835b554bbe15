"""Quantiles and tails are those of scipy.stats, which no command needs to import for them."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from greybox.statistics import distributions as own

LEVELS = st.floats(1e-6, 1 - 1e-6)
DEGREES = st.integers(1, 400)


@given(LEVELS, DEGREES, DEGREES)
def test_quantiles(level: float, a: int, b: int) -> None:
    pairs = [
        (own.normal_quantile(level), scipy.stats.norm.ppf(level)),
        (own.student_quantile(level, a), scipy.stats.t.ppf(level, a)),
        (own.chi_square_quantile(level, a), scipy.stats.chi2.ppf(level, a)),
        (own.fisher_quantile(level, a, b), scipy.stats.f.ppf(level, a, b)),
        (own.beta_quantile(level, a, b), scipy.stats.beta.ppf(level, a, b)),
        (own.kolmogorov_quantile(level), scipy.stats.kstwobign.ppf(level)),
    ]
    for mine, theirs in pairs:
        assert mine == pytest.approx(theirs, rel=1e-6, abs=1e-9)


@given(st.floats(0.0, 1000.0), DEGREES, DEGREES)
def test_tails(statistic: float, a: int, b: int) -> None:
    assert own.chi_square_tail(statistic, a) == pytest.approx(scipy.stats.chi2.sf(statistic, a))
    assert own.fisher_tail(statistic, a, b) == pytest.approx(scipy.stats.f.sf(statistic, a, b))


def test_arrays_come_back_as_arrays() -> None:
    found = own.chi_square_quantile(0.95, np.array([1.0, 2.0]))
    assert found == pytest.approx([3.841459, 5.991465])


def test_a_fit_and_its_report_do_without_scipy_stats() -> None:
    code = (
        "import sys, greybox.automatic.front_door, greybox.report.fit_report, "
        "greybox.validation.validate, greybox.commands.fit; sys.exit('scipy.stats' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
