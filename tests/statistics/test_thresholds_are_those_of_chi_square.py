"""Thresholds of chi-square are those of the tables, and the steps of evidence are the odds that
they claim."""

from __future__ import annotations

import math

import pytest

from greybox.statistics.blocks import BLOCK_SECONDS, block_samples
from greybox.statistics.distributions import chi_square_quantile, chi_square_tail
from greybox.statistics.evidence import CLEAR, CLEAR_LOG_RATIO


def test_textbook_thresholds():
    # Abramowitz and Stegun 1964, table 26.8, six digits.
    table = {(1, 0.05): 3.84146, (1, 0.01): 6.63490, (3, 0.01): 11.3449, (10, 0.05): 18.3070}
    for (dof, tail), threshold in table.items():
        assert chi_square_quantile(1 - tail, dof) == pytest.approx(threshold, rel=3e-6)
        assert chi_square_tail(threshold, dof) == pytest.approx(tail, rel=3e-5)


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
