"""What runs to a bound goes, a fit that fails falls back to less, and each step down is said."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import greybox as gb
from greybox.automatic.decide import Decided
from greybox.automatic.fit import fit_decided, prepare
from greybox.errors import DataError, UnknownNameError
from greybox.estimation.fit import Fit
from greybox.estimation.options import FitOptions
from greybox.estimation.recipe import Recipe
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from tests.automatic.craft import flight, flights, flown, vehicle

SHORT = {"seconds": 4.0}


def falls(result: Fit) -> list[Any]:
    return [d for d in result.provenance.decisions if d.about == "fallback"]


def test_a_parameter_at_its_bound_goes_and_it_is_said():
    columns = dict(flown(**SHORT)[0])
    # Commands that the log stamps two samples late: the craft answers before it is asked, which no
    # delay explains.
    columns |= {f"u{i}": np.roll(columns[f"u{i}"], 2) for i in range(1, 5)}
    result = gb.fit(vehicle(), flight(columns, "run0"))
    (said,) = falls(result)
    assert "command_delay" in said.choice
    assert "bound" in said.reason
    assert "command_delay.d" not in result.parameters
    assert result.model.values.get("command_delay.d", 0.0) == 0.0
    assert result.converged


def test_a_fit_that_does_not_converge_falls_back_and_says_as_what():
    hurried = LevenbergMarquardt(max_iterations=1)
    options = FitOptions(predictor="multi-step", solver=hurried, noise={"noise.sensor.p": 1.0})
    recipe = Recipe(effects=("motor_lag", "gyro_bias"), options=options)
    decided = Decided(recipe=recipe, decisions=(), candidate=None)
    result = fit_decided(vehicle(), prepare(vehicle(), flights(**SHORT)), decided)
    assert [d.choice for d in falls(result)] == ["likelihood one step ahead"]
    assert "NOT converged" in falls(result)[0].reason
    assert result.provenance.recipe.options.predictor == "innovation"
    assert not result.converged, (
        "the base set has nothing below it: kept, and never called converged"
    )


def test_what_was_said_stays_where_a_fit_fails():
    hurried = LevenbergMarquardt(max_iterations=1)
    result = gb.fit(
        vehicle(),
        flights(**SHORT),
        predictor="multi-step",
        solver=hurried,
        noise={"noise.sensor.p": 1.0},
    )
    assert falls(result) == []
    assert result.provenance.recipe.options.predictor == "multi-step"
    assert not result.converged


@pytest.mark.parametrize(
    "wrong",
    [{"predictor": "inovation"}, {"criterion": "gauss"}, {"solver": "newton"}, {"fixd": ()}],
)
def test_a_mistyped_choice_is_said_before_anything_is_fitted(wrong):
    said: list[str] = []
    with pytest.raises(UnknownNameError):
        gb.fit(vehicle(), flights(), say=said.append, **wrong)
    assert said == []


def test_a_flight_to_fit_cannot_be_one_to_judge():
    with pytest.raises(DataError, match="run0 is both train and test"):
        gb.fit(vehicle(), flights(), test=flights().select(["run0"]))
