"""Where the likelihood bends a model, its effects are fitted by errors ahead: those that the flights
need stay, and flights that judge say what these are worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import greybox.automatic.held_ahead
from greybox.automatic.held_ahead import HeldAhead, Terms, _at_bound, held_ahead, is_bent
from greybox.errors import FitError
from greybox.estimation.fit import fit
from greybox.estimation.result import Fit
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.model.known import Known
from greybox.model.model import PhysicsModel, build_model
from greybox.validation.judges import Judges
from tests.automatic.craft import RATES, flights, vehicle

DAMPING, SPAN, LEAST = 4e-5, (0.1, 1.0), 0.25
ASKED = ("motor_lag", "rotational_damping", "gyro_scale", "products_of_inertia")
TAU = "motor_lag.tau"


@pytest.fixture(scope="module")
def train():
    return flights(RATES, damping=DAMPING)


@pytest.fixture(scope="module")
def judges() -> Judges:
    return Judges(flights=flights(RATES, seeds=(3, 4), seconds=16.0, damping=DAMPING), adapt=0.0)


def model(train, *effects: str) -> PhysicsModel:
    there = (*effects, "command_delay", "gyro_bias")
    return build_model(vehicle(), train.channels, there, sample_time=train.flights[0].dt)


@pytest.fixture(scope="module")
def said() -> list[str]:
    return []


@pytest.fixture(scope="module")
def race(train, judges, said) -> HeldAhead:
    there, most = model(train, *ASKED), len(ASKED)
    held = ("rotor_drag.k_x",)  # on offer, and in no structure on the way
    return held_ahead(
        there, ASKED, train, judges, SPAN, most, terms=Terms(fixed=held), say=said.append
    )


def test_what_flights_need_stays_and_what_they_do_without_goes(race):
    assert [n for n in ASKED if race.held(n)] == ["motor_lag", "rotational_damping"]
    assert set(race.worth) == set(ASKED)
    lag = race.fit[TAU]
    assert abs(lag.value - 0.05) < 3 * lag.std
    assert {"command_delay", "gyro_bias"} <= set(race.fit.model.effects)


def test_it_says_what_they_are_worth_to_flights_that_judge(race):
    damping = race.worth["rotational_damping"]
    assert damping is not None
    assert damping.matters and not damping.harms
    assert damping.group == "rate"
    assert damping.log_e > np.log(len(ASKED) / 0.05)


def test_nobody_asks_for_a_fit_without_what_flights_clearly_need_before_the_others_are_gone(
    race, said
):
    assert [t for t in said if "motor_lag" in t] == ["errors ahead without motor_lag"]
    last = said.index("the effects fitted by errors ahead, without gyro_scale, products_of_inertia")
    assert said.index("errors ahead without motor_lag") > last


@pytest.mark.slow
def test_no_more_stay_than_may(train, judges):
    one = held_ahead(model(train, *ASKED), ASKED, train, judges, SPAN, 1)
    assert one is not None
    assert [n for n in ASKED if one.held(n)] == ["motor_lag"]
    assert one.crowded_out == {"rotational_damping"}
    assert one.worth["rotational_damping"] is not None and one.worth["gyro_scale"] is None


@pytest.mark.parametrize(
    ("bound", "goes"),
    [
        ({}, False),
        ({"d_p": 0.0}, False),
        ({"d_p": 0.0, "d_q": 0.0, "d_r": 0.0}, True),
        ({"d_r": 0.01}, True),
    ],
)
def test_what_ran_to_a_bound_is_nothing_or_stands_for_something_else(race, bound, goes):
    """A damping that is nothing about one axis is still one."""
    parts = {f"rotational_damping.{n}": v for n, v in bound.items()}
    there = {
        n: replace(e, value=parts[n], at_bound=True) if n in parts else e
        for n, e in race.fit.parameters.items()
    }
    held = replace(race.fit, estimates=replace(race.fit.estimates, parameters=there))
    assert _at_bound(held, "rotational_damping") == goes
    assert _at_bound(held, "ground_effect"), "of which nothing is estimated"


def told(train, **choices) -> Fit:
    lacking = model(train, "motor_lag", "rotational_damping")
    return fit(lacking, train, disturbance=("torque",), **choices)


def elsewhere(train) -> Fit:
    none = LevenbergMarquardt(max_iterations=0)
    return told(train, values={TAU: 0.2}, initialisation="nominal", solver=none)


def test_a_model_that_its_likelihood_does_not_bend_is_not_said_to_be(train, judges):
    found = told(train)
    assert found.converged
    assert not is_bent(found, train, judges, SPAN, LEAST)


def test_one_whose_numbers_errors_ahead_would_have_elsewhere_is(train, judges):
    """A lag four times as long foretells worse, whatever the likelihood says for it."""
    found = elsewhere(train)
    assert found[TAU].value == pytest.approx(0.2)
    assert is_bent(found, train, judges, SPAN, LEAST)


def test_where_flights_that_judge_tell_nothing_nobody_says_so(train, judges):
    found = elsewhere(train)
    short = Judges(flights=flights(RATES, seeds=(3,), seconds=1.2, damping=DAMPING), adapt=0.0)
    assert not is_bent(found, train, short, SPAN, LEAST)
    assert is_bent(found, train, replace(judges, _known={}), SPAN, LEAST)


def test_where_nothing_can_be_fitted_by_errors_ahead_that_is_told(train, judges, monkeypatch):
    def fails(*_: object, **_said: object) -> Fit:
        raise FitError("no samples")

    told_so: list[str] = []
    found = told(train)
    monkeypatch.setattr(greybox.automatic.held_ahead, "fit", fails)
    assert not is_bent(found, train, judges, SPAN, LEAST, unable=told_so.append)
    monkeypatch.setattr(greybox.automatic.held_ahead, "fit_prepared", fails)
    there = model(train, *ASKED)
    assert held_ahead(there, ASKED, train, judges, SPAN, 4, unable=told_so.append) is None
    assert len(told_so) == 2
    assert all("on the likelihood alone" in t and "no samples" in t for t in told_so)


def test_what_is_known_of_the_craft_goes_before_its_file(train, judges, monkeypatch):
    known = Known(prior={TAU: (0.06, 1e-5)}, held={"mass": 0.03})
    terms = Terms(known=known)
    race = held_ahead(model(train, "motor_lag"), ["motor_lag"], train, judges, SPAN, 4, terms=terms)
    assert race is not None
    assert race.fit[TAU].value == pytest.approx(0.06, abs=1e-4), "flights alone say 0.05"
    assert race.fit.model.values["mass"] == 0.03
    found, asked = told(train), list[Fit]()

    def kept(*given) -> Fit:
        asked.append(fit(*given))
        return asked[-1]

    monkeypatch.setattr(greybox.automatic.held_ahead, "fit", kept)
    is_bent(found, train, judges, SPAN, LEAST, known=known)
    assert asked[0].model.values["mass"] == 0.03
    assert asked[0][TAU].value == pytest.approx(0.06, abs=1e-4)
