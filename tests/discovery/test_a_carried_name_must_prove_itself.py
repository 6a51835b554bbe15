"""Where what is left is carried along, a name must whiten innovations or prove itself on flights that were not searched."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from greybox.discovery.carried import memories, whitens
from greybox.discovery.veto import HeldOut
from tests.discovery.test_names_that_leave_more_than_they_explain_are_taken_back import Fitted, seen


def innovations(*poles: float, n: int = 4000, seed: int = 0) -> Any:
    """A fit whose innovation components are first-order noise with these poles, one record."""
    rng = np.random.default_rng(seed)
    e = np.stack([lfilter([1.0], [1.0, -a], rng.standard_normal(n)) for a in poles], axis=1)
    names = [f"c{i}" for i in range(len(poles))]
    dynamics = SimpleNamespace(innovations=SimpleNamespace(names=names))
    return SimpleNamespace(model=SimpleNamespace(dynamics=dynamics), innovations={"flight": [e]})


@pytest.mark.parametrize(
    ("before", "after", "cured"),
    [
        ((0.5, 0.0), (0.0, 0.0), True),
        ((0.5, 0.5), (0.0, 0.5), True),
        ((0.5, 0.0), (0.5, 0.0), False),
        ((0.5, 0.0), (0.0, 0.5), False),  # moved elsewhere
        ((0.0, 0.0), (0.0, 0.0), True),
    ],
)
def test_innovations_are_whitened_where_some_are_cured_and_none_is_hurt(
    before: tuple[float, float], after: tuple[float, float], cured: bool
) -> None:
    assert whitens(innovations(*before), innovations(*after, seed=1)) is cured


def test_what_is_hardly_coloured_any_more_is_not_cured() -> None:
    # 0.05 squared is less of the variance than counts as coloured, and plain in so many samples.
    assert not whitens(innovations(0.5, 0.5), innovations(0.05, 0.5, n=20000, seed=1))


def test_what_is_too_short_to_be_tested_is_not_white() -> None:
    assert not whitens(innovations(0.9, n=60), innovations(0.9, n=60, seed=1))


def verdict(level: float, gain: float, spread: float, effect: str = "rotor_drag", *, nearer: bool = True) -> bool:
    """Whether the name stays that changes the mean square ahead from 4 to `level` and the log likelihood by `gain`."""
    held, fits = HeldOut(None), (Fitted(()), Fitted((effect,), bic=80.0))  # type: ignore[arg-type]
    held.foresight = lambda f: seen(4.0, 0) if f is fits[0] else seen(level, gain, seed=1, spread=spread)  # type: ignore[method-assign, assignment, return-value]
    return held.withheld(*fits, supported=True, nearer=nearer) is None  # type: ignore[arg-type]


def test_flights_that_were_not_searched_must_speak_for_it() -> None:
    assert verdict(3.0, 8.0, 1.0)  # the sum of twelve blocks of +-1 is uncertain by 3.6
    assert not verdict(3.0, 6.0, 1.0)
    assert not verdict(3.0, 0.0, 0.0)


def test_errors_ahead_must_fall_clearly_unless_it_whitens() -> None:
    assert not verdict(3.8, 8.0, 1.0)
    assert verdict(3.8, 8.0, 1.0, nearer=False)
    assert not verdict(4.4, 8.0, 1.0, nearer=False)


@pytest.mark.parametrize("effect", ["constant_force", "steady_wind"])
def test_a_constant_proves_nothing(effect: str) -> None:
    assert not verdict(3.0, 8.0, 1.0, effect)


def test_how_long_it_lasts_is_said_only_of_what_is_left_and_known() -> None:
    estimates = {
        "disturbance.force.T": SimpleNamespace(value=0.3, std=0.1),
        "disturbance.torque.T": SimpleNamespace(value=1.0, std=0.1),
        "rotor_drag.k_x": SimpleNamespace(value=1.0, std=0.1),
    }
    left: Any = SimpleNamespace(unnamed=(SimpleNamespace(channel="force.x"),))
    assert memories(SimpleNamespace(parameters=estimates), left) == {"force": 0.3}  # type: ignore[arg-type]
    estimates["disturbance.force.T"].std = float("nan")
    assert memories(SimpleNamespace(parameters=estimates), left) == {}  # type: ignore[arg-type]
