"""Flights that show a ratio accuse neither of its numbers: the estimate's line names both, how far
each would be from what was stated of it, and how to tell."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from greybox.estimation.fit import fit
from greybox.estimation.result import Fit
from greybox.estimation.suspects import suspects
from tests.estimation.test_what_is_held_but_not_exact_widens_the_errors_of_others import (
    CHOICES,
    cart,
    record,
)


def fitted(mass: float, sigma: float) -> Fit:
    """A cart of 2 kg and a gain of 3 N/V, whose file states 4 % of the gain and another mass."""
    model = cart(sigma)
    gain, stated = model.parameters
    own = replace(model, parameters=(replace(gain, sigma=0.12), replace(stated, nominal=mass)))
    return fit(own, record(), fixed=["mass"], considered=["mass"], **CHOICES)


def line(found: Fit) -> str:
    return next(row for row in found.summary().splitlines() if row.startswith("gain "))


def test_a_mass_that_is_wrong_is_named_where_the_gain_stands() -> None:
    said = line(fitted(mass=2.4, sigma=0.024))
    assert "(3 was stated, 4.5" in said and "sigma away; or mass is 2.0" in said
    assert said.endswith("sigma away: weigh it)")


def test_what_was_stated_says_which_is_the_likelier() -> None:
    exact, vague = (line(fitted(mass=2.4, sigma=s)) for s in (0.0096, 0.096))

    def away(text: str) -> list[float]:
        return [float(part.split()[-1]) for part in text.split(" sigma away")[:-1]]

    assert away(exact)[1] > 5 * away(exact)[0]
    assert away(vague)[1] == pytest.approx(away(vague)[0], rel=0.05)


@pytest.mark.parametrize("sigmas", [1.1, 3.9, -3.5])
def test_an_estimate_that_is_as_stated_accuses_no_other_number(sigmas: float) -> None:
    """However much better the other one is known: nothing of what was stated is denied."""
    assert not asked({"gain": 1.5}, gain=(3.0 + 0.1 * sigmas, 3.0, 0.1))
    assert asked({"gain": 1.5}, gain=(3.5, 3.0, 0.1))


def test_as_stated_nothing_is_said() -> None:
    assert not line(fitted(mass=2.0, sigma=0.02)).endswith(")")


def asked(moves: dict[str, float], **found: tuple[float, float, float]) -> dict[str, str]:
    """Of a mass of 2 +- .02 kg that `moves` what was `found`: (value, stated, its error)."""
    model: Any = SimpleNamespace(
        dynamics=SimpleNamespace(parameters=[SimpleNamespace(name="mass", unit="kg")]),
        considered={"mass": (0.02, moves)},
        values={"mass": 2.0},
    )
    every: Any = {n: SimpleNamespace(value=v, prior=(m, s)) for n, (v, m, s) in found.items()}
    return suspects(model, every)


@pytest.mark.parametrize("moves", [{}, {"gain": 0.0}, {"gain": 0.1}])
def test_what_does_not_go_with_the_held_number_does_not_accuse_it(moves: dict[str, float]) -> None:
    assert not asked(moves, gain=(3.6, 3.0, 0.1))


def test_the_number_that_was_stated_best_is_asked() -> None:
    """An inertia that was guessed, and is wrong by a factor, says nothing of a mass."""
    moves = {"thrust": 4.0, "inertia": 0.5}
    assert not asked(moves, thrust=(8.0, 7.5, 1.5), inertia=(1.0, 0.4, 0.12))
    said = asked(moves, thrust=(8.0, 6.0, 0.4), inertia=(1.0, 0.9, 0.3))
    assert said == {
        "thrust": "6 was stated, 4.3 sigma away; or mass is 1.5 kg, 28.8 sigma away: weigh it"
    }


def test_what_falls_where_the_held_number_grows_points_the_other_way() -> None:
    (said,) = asked({"gain": -1.5}, gain=(3.0, 2.0, 0.2)).values()
    assert "mass is 3 kg" in said
