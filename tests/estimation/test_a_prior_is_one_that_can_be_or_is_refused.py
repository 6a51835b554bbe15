"""A prior that is given is named like its parameter and has a positive sigma; anything else is said
in one line, and nothing is swallowed. What is held is held where its prior says."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from greybox import build_model, fit
from greybox.errors import GreyboxError, ModelError, UnknownNameError
from greybox.estimation.considered import demand_considerable
from greybox.estimation.options import FitOptions
from greybox.estimation.prior import Prior
from greybox.estimation.problem import Problem, make_problem
from tests.simulated import flights, vehicle

TAU = "motor_lag.tau"


@pytest.fixture(scope="module")
def data():
    return flights(1)


@pytest.fixture(scope="module")
def model(data):
    return build_model(vehicle(), data.channels, ["motor_lag"], sample_time=0.01)


def unknown(problem: Problem, name: str):
    return next(u for u in problem.unknowns if u.name == name)


@pytest.mark.parametrize("option", ["priors", "flight_priors"])
@pytest.mark.parametrize(
    "prior",
    [0.03, "0.03", (0.03,), (0.03, 0.0), (0.03, -1e-4), (0.03, math.nan), (math.nan, 0.1), None],
)
def test_what_is_no_prior_is_refused_in_one_line(option: str, prior: Any) -> None:
    with pytest.raises(ModelError, match=f"^{option} of {TAU}: .*") as caught:
        FitOptions.of(None, {option: {TAU: prior}})  # type: ignore[misc]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("option", ["values", "priors", "flight_priors", "noise"])
def test_what_is_no_mapping_is_refused(option: str) -> None:
    with pytest.raises(GreyboxError, match=f"^{option} takes names"):
        FitOptions.of(None, {option: [TAU]})  # type: ignore[misc]


@pytest.mark.parametrize("option", ["priors", "flight_priors"])
def test_a_misspelled_name_is_said_with_the_one_that_was_meant(option, model, data) -> None:
    with pytest.raises(UnknownNameError, match=f"motor_lag.tua.*did you mean {TAU}"):
        make_problem(model, data, **{option: {"motor_lag.tua": (0.03, 0.01)}})


@pytest.mark.parametrize("option", ["priors", "flight_priors"])
def test_a_fit_that_decides_itself_says_it_before_it_begins(option, data) -> None:
    with pytest.raises(UnknownNameError, match=f"motor_lag.tua.*did you mean {TAU}"):
        fit(vehicle(), data, **{option: {"motor_lag.tua": (0.03, 0.01)}})


def test_a_prior_of_every_flight_needs_a_value_of_every_flight(model, data) -> None:
    with pytest.raises(ModelError, match=rf"{TAU}: it has one value.*per_flight=\['{TAU}'\]"):
        make_problem(model, data, flight_priors={TAU: (0.03, 0.01)})
    make_problem(model, data, flight_priors={TAU: (0.03, 0.01)}, per_flight=[TAU])


@pytest.mark.parametrize("prior", [(0.03, 0.01), Prior(0.03, 0.01), [0.03, np.float64(0.01)]])
def test_a_prior_replaces_what_is_declared(prior, model, data) -> None:
    u = unknown(make_problem(model, data, priors={TAU: prior}), TAU)
    assert (u.mean, u.sigma) == (0.03, 0.01)


def test_an_infinite_sigma_is_no_prior(model, data) -> None:
    u = unknown(make_problem(model, data, priors={"inertia.xx": (2e-5, math.inf)}), "inertia.xx")
    assert u.sigma == math.inf


def test_what_is_held_is_held_where_its_prior_says(model, data) -> None:
    at = [d.name for d in model.parameters].index("mass")
    held = make_problem(model, data, fixed=["mass"], priors={"mass": (0.04, 0.001)})
    assert held.base[at] == 0.04
    said = make_problem(
        model, data, fixed=["mass"], priors={"mass": (0.04, 0.001)}, values={"mass": 0.041}
    )
    assert said.base[at] == 0.041


def test_a_prior_that_is_given_can_be_considered(model, data) -> None:
    given = {"mass": (0.04, 0.001)}
    options = FitOptions(fixed=("mass",), considered=("mass",), priors=given)
    demand_considerable(model, options)
    with pytest.raises(ModelError, match="mass is considered but has no stated error"):
        demand_considerable(model, options.but(priors={"mass": (0.04, math.inf)}))
