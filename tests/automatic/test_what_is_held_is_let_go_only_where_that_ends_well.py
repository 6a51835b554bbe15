"""What is held for a ratio is estimated where the flights tell it, and stays held where that fails
or was said."""

from __future__ import annotations

import importlib
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from greybox.automatic.setting import Given
from greybox.errors import FitError
from greybox.estimation.fit import fit
from greybox.estimation.options import FitOptions
from greybox.estimation.recipe import Decision, Recipe
from greybox.estimation.result import Fit
from greybox.validation.sanity import Insane, Sanity
from tests.estimation.test_what_is_held_but_not_exact_widens_the_errors_of_others import (
    cart,
    record,
)

automatic = importlib.import_module(
    "greybox.automatic.fit"
)  # the package has a function of that name
OPTIONS = FitOptions(
    fixed=("mass",), considered=("mass",), predictor="simulation", use_compiler=False
)
HELD = Decision(
    about="mass", choice="held at 2 kg", reason="only its ratio shows", option="--fixed"
)
MODEL, FLIGHTS = cart(sigma=0.4, drag=2.0), record()


@pytest.fixture(scope="module")
def found() -> Fit:
    return fit(MODEL, FLIGHTS, OPTIONS)


def done(
    monkeypatch: pytest.MonkeyPatch, found: Fit, said: Given, answer: Any = None
) -> tuple[Fit, list[str]]:
    lines: list[str] = []

    def again(vehicle: object, data: object, recipe: Recipe, progress: object) -> Fit:
        if isinstance(answer, Exception):
            raise answer
        freed = fit(MODEL, FLIGHTS, recipe.options)
        return freed if answer is None else answer(freed)

    monkeypatch.setattr(automatic, "fit_recipe", again)
    vehicle: Any = None
    recipe = Recipe(options=OPTIONS)
    return automatic._with_what_flights_tell(
        vehicle, FLIGHTS, found, recipe, [HELD], said, lines.append
    ), lines


def test_it_is_estimated_and_the_decision_says_so(monkeypatch, found):
    result, lines = done(monkeypatch, found, Given())
    assert "mass" in result.parameters and "mass" not in found.parameters
    assert [d.choice for d in result.provenance.decisions] == ["estimated"]
    assert "kg, stated to 0.4" in result.provenance.decisions[0].reason
    assert result.provenance.recipe.options.fixed == ()
    assert len(lines) == 1


def test_it_stays_held_where_the_other_fit_fails(monkeypatch, found):
    result, lines = done(monkeypatch, found, Given(), FitError("no minimum"))
    assert "mass" not in result.parameters
    assert result.provenance.decisions == (HELD,)
    assert "held after all" in lines[-1]


def at_bound(freed: Fit, name: str) -> Fit:
    """The fit with one parameter, there or not, at a bound that is not its null."""
    stuck = replace(freed["gain"], name=name, value=0.01, std=float("nan"), at_bound=True)
    table = {**freed.parameters, name: stuck}
    return replace(freed, estimates=replace(freed.estimates, parameters=table))


def test_a_noise_that_is_not_there_takes_nothing_back(monkeypatch, found):
    """A fit that is 650 nats better was thrown away, as there was no gust of torque."""
    freed = partial(at_bound, name="disturbance.torque.T")
    result, lines = done(monkeypatch, found, Given(), freed)
    assert "mass" in result.parameters and len(lines) == 1
    assert result.provenance.recipe.options.fixed == ()


@pytest.mark.parametrize("name", ["mass", "gain"])
def test_physics_at_a_bound_does_and_what_can_be_done_is_said(monkeypatch, found, name):
    result, lines = done(monkeypatch, found, Given(), partial(at_bound, name=name))
    assert "mass" not in result.parameters and result.provenance.decisions == (HELD,)
    why = f"that fit ends with {name} at a bound"
    assert f"held after all, as {why}" in lines[-1]
    (warning,) = [w for w in result.diagnostics.warnings if w.startswith("mass ")]
    assert why in warning and "--fixed none" in warning and "leave it out" not in warning


@pytest.mark.parametrize(
    "said", [{"fixed": ("mass",)}, {"considered": ("mass",)}, {"free": ("gain",)}]
)
def test_it_stays_held_where_somebody_said_so(monkeypatch, found, said):
    result, lines = done(monkeypatch, found, Given(choices=said), AssertionError("asked again"))
    assert "mass" not in result.parameters and not lines


def test_holding_something_else_decides_nothing_about_it(monkeypatch, found):
    assert "mass" in done(monkeypatch, found, Given(choices={"fixed": ("other",)}))[0].parameters


def test_it_is_held_and_said_where_flights_deny_what_was_stated(monkeypatch, found):
    denial = Insane(
        severity="doubtful",
        kind="overruled",
        parameters=("mass",),
        statement="mass was weighed (2 +- 0.4 kg) but the flights want 9 kg, 17 sigma away",
        likely="",
        attempt="",
    )
    monkeypatch.setattr(automatic, "sanity_of", lambda _fit: Sanity(findings=(denial,)))
    result, lines = done(monkeypatch, found, Given())
    assert "mass" not in result.parameters and result.provenance.decisions == (HELD,)
    (warning,) = [w for w in result.diagnostics.warnings if w.startswith("mass ")]
    assert "the flights want 9 kg" in warning and "it is held: measure it again" in warning
    assert warning in lines[-1]
