"""A controller counts its samples whatever the clock of its caller does."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest

from mpc_export.tube.clock import LATE, Clock

STEP = 0.01


def counted(calls: Sequence[float]) -> tuple[list[int], list[str], float]:
    """Samples at every call, what was noted, and the time at the last."""
    said = list[str]()
    clock = Clock(step=STEP, note=lambda _time, what: said.append(what))
    return [clock.passed(t) for t in calls], said, clock.now


def test_early_and_late_calls_even_out():
    shaken = [k * STEP + (0.2 if k % 2 else -0.2) * STEP for k in range(1, 101)]
    samples, said, now = counted(shaken)
    assert samples == [1] * 100 and not said
    assert now == pytest.approx(shaken[-1])


def test_calls_that_did_not_come_count():
    samples, said, now = counted([0.0, STEP, 6 * STEP, 7 * STEP])
    assert samples == [1, 1, 5, 1] and said == ["calls did not come"]
    assert now == pytest.approx(7 * STEP)


@pytest.mark.parametrize("wrong", [-5.0, 1.0 + 2 * LATE, 1e9])
def test_a_clock_that_jumps_is_not_followed(wrong: float):
    samples, said, now = counted([1.0, wrong, wrong + STEP])
    assert samples == [1, 1, 1] and said == ["the clock jumps"]
    assert now == pytest.approx(1.0 + 2 * STEP)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_a_clock_that_says_no_number_goes_on_by_one_sample(wrong: float):
    samples, said, now = counted([1.0, wrong, 1.0 + 2 * STEP])
    assert samples == [1, 1, 1] and said == ["the clock jumps"]
    assert now == pytest.approx(1.0 + 2 * STEP)
