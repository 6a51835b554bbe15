"""The tail of chi-square is scipy's where scipy has one, and the steps of evidence are the odds
that they claim."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats

from greybox.statistics.blocks import BLOCK_SECONDS, block_samples
from greybox.statistics.chi_square import log_tail
from greybox.statistics.evidence import CLEAR, CLEAR_LOG_RATIO


@pytest.mark.parametrize("dof", [1, 3, 6, 20, 100])
@pytest.mark.parametrize("level", [0.95, 0.99, 1 - 1e-6])
def test_at_scipys_threshold_the_tail_is_what_the_level_leaves(dof: int, level: float):
    threshold = scipy.stats.chi2.ppf(level, dof)
    assert log_tail(threshold, dof)[0] == pytest.approx(math.log(1 - level), rel=1e-8)


def test_textbook_thresholds():
    # Abramowitz and Stegun 1964, table 26.8, six digits.
    table = {(1, 0.05): 3.84146, (1, 0.01): 6.63490, (3, 0.01): 11.3449, (10, 0.05): 18.3070}
    for (dof, tail), threshold in table.items():
        assert log_tail(threshold, dof)[0] == pytest.approx(math.log(tail), abs=3e-5)


def test_many_statistics_at_once():
    x = np.array([0.0, 1.0, 5e3])
    assert log_tail(x, 2) == pytest.approx(-0.5 * x)


def test_a_clear_difference_of_bic_is_very_strong_evidence():
    # Kass and Raftery 1995, section 3.2: twice the log of the odds above 10, odds above 150 to 1
    # (exp(5) = 148).
    assert abs(CLEAR - 2 * math.log(150)) < 0.05
    assert math.exp(CLEAR_LOG_RATIO) == pytest.approx(150, abs=2)


@pytest.mark.parametrize(
    ("dt", "samples"),
    [(0.01, 50), (0.002, 250), (0.3, 2), (0.7, 1), (2.0, 1)],
)
def test_a_block_has_half_a_second_and_at_least_one_sample(dt: float, samples: int):
    assert block_samples(dt) == samples == max(1, round(BLOCK_SECONDS / dt))


def test_blocks_of_another_length():
    assert block_samples(0.01, 0.2) == 20
