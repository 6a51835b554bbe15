"""A step that stays and a drift are found, with their place and size, in what has a memory; series
without a change seem to have one as seldom as is promised."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.statistics.lasting import FALSE, lasting_change
from greybox.symbolic import FloatArray


def drawn(memory: float, m: int, seed: int) -> FloatArray:
    rng, y = np.random.default_rng(seed), np.zeros(m)
    y[0] = rng.standard_normal()
    for i in range(1, m):
        y[i] = memory * y[i - 1] + np.sqrt(1 - memory**2) * rng.standard_normal()
    return y


@pytest.mark.parametrize("size", [8.0, -8.0])
@pytest.mark.parametrize("memory", [0.0, 0.5, 0.9])
def test_a_step_is_found_where_it_is(memory: float, size: float) -> None:
    y = drawn(memory, 40, 1) + size * (np.arange(40) >= 25)
    found = lasting_change(y, memory, tests=8)
    assert found is not None and found.at is not None and abs(found.at - 25) <= 1
    assert found.size == pytest.approx(size, abs=3.0)
    assert found.p * 8 <= FALSE


def test_a_drift_is_no_step() -> None:
    found = lasting_change(drawn(0.2, 50, 2) + np.linspace(0.0, -10.0, 50), 0.2)
    assert found is not None and found.at is None
    assert found.size == pytest.approx(-10.0, abs=2.0)


def test_what_comes_and_goes_is_no_change() -> None:
    y = drawn(0.5, 40, 3) + 8.0 * ((np.arange(40) >= 14) & (np.arange(40) < 20))
    assert lasting_change(y, 0.5) is None


@pytest.mark.parametrize(("memory", "known"), [(0.1, 0.1), (0.6, 0.6), (0.9, 0.9), (0.98, 0.98)])
@pytest.mark.parametrize("m", [24, 60])
def test_gusts_seem_to_change_as_seldom_as_is_promised(memory: float, known: float, m: int) -> None:
    seen = sum(lasting_change(drawn(memory, m, s), known) is not None for s in range(500))
    assert seen <= 500 * FALSE + 3 * np.sqrt(500 * FALSE)


def test_gusts_that_last_longer_than_is_known_are_seldom_a_change() -> None:
    """The memory is then told from the series."""
    seen = sum(lasting_change(drawn(0.9, 60, s), 0.2) is not None for s in range(400))
    assert seen < 0.1 * 400


@pytest.mark.parametrize("y", [np.zeros(30), np.arange(8.0)])
def test_nothing_and_too_little_say_nothing(y: FloatArray) -> None:
    assert lasting_change(y, 0.0) is None
