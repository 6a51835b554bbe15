"""A step that stays and a drift are found, with their place and size, in what has a memory; series
without a change seem to have one as seldom as is promised."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.statistics.lasting import FALSE, Cause, Change, beyond, lasting_change
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
@pytest.mark.parametrize("m", [24, pytest.param(60, marks=pytest.mark.slow)])
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


def moved(m: int, seed: int, jump: float = 0.0) -> FloatArray:
    """A motion (m, 3) that turns round; it is faster by `jump` from .6 of the series on."""
    z = np.column_stack([drawn(0.5, m, 10 * seed + i) for i in range(3)])
    angle, after = 0.6 * np.arange(m), jump * (np.arange(m) >= 0.6 * m)
    return z + after[:, None] * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])


def found_in(y: FloatArray) -> Change:
    found = lasting_change(y, 0.3)
    assert found is not None and found.at is not None
    return found


@pytest.mark.parametrize("m", [28, 60])
def test_a_step_that_nothing_else_explains_stays_one(m: int) -> None:
    step = 10.0 * (np.arange(m) >= 0.6 * m)
    for seed in range(20):
        y = drawn(0.3, m, seed) + step
        assert beyond(
            y, found_in(y), [Cause(z=moved(m, seed)), Cause(z=moved(m, seed + 50)[:, :1])]
        )


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("m", [28, 60])
def test_a_step_of_a_cause_that_jumps_is_that_of_the_cause(m: int, power: float) -> None:
    """Whatever function of it: a push goes with the speed, its root or its square."""
    seen = 0
    for seed in range(20):
        z = moved(m, seed, jump=8.0)
        y = 0.3 * drawn(0.3, m, seed) + 10.0 * (np.linalg.norm(z, axis=1) / 8.0) ** power
        found = lasting_change(y, 0.3)
        if found is not None:
            seen += 1
            assert not beyond(y, found, [Cause(z=moved(m, seed + 50)), Cause(z=z)])
    assert seen > 10


def test_a_cause_that_stands_still_explains_nothing() -> None:
    y = drawn(0.3, 40, 0) + 10.0 * (np.arange(40) >= 24)
    assert beyond(y, found_in(y), [Cause(z=np.zeros((40, 3)))])


def test_a_cause_that_hardly_moves_explains_nothing() -> None:
    """A load lets the craft sink by a little: that is no other way of flying."""
    after = np.arange(40) >= 24
    y, sunk = drawn(0.3, 40, 0) + 10.0 * after, 0.1 * after[:, None]
    assert not beyond(y, found_in(y), [Cause(z=sunk)])
    assert beyond(y, found_in(y), [Cause(z=sunk, least=1.0)])


@pytest.mark.parametrize("unit", [1e-200, 1e200])
def test_no_unit_is_too_large(unit: float) -> None:
    y = drawn(0.3, 40, 0) + 10.0 * (np.arange(40) >= 24)
    assert beyond(y * unit, replace(found_in(y), size=10.0 * unit), [Cause(z=moved(40, 1))])
