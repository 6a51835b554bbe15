"""A fit to errors further ahead foretells, but is no measurement where the likelihood of the same
flights says something else: its errors hold the difference, and it is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.automatic.foretell import Score
from greybox.automatic.sets import BASE
from greybox.automatic.trials import Candidate
from greybox.automatic.two_horizons import with_one_step
from greybox.estimation.fit import fit
from greybox.estimation.result import Estimate
from greybox.estimation.status import Code
from greybox.model.model import build_model
from tests.automatic.craft import RATES, flights, vehicle

TAU = "motor_lag.tau"
FAR, NEAR = Score(blocks=np.ones(4)), Score(blocks=np.full(4, 9.0))


@pytest.fixture(scope="module")
def agreed() -> Candidate:
    """The two fits of a model to flights that lack nothing."""
    data = flights(RATES)
    effects = ("motor_lag", "command_delay", "gyro_bias")
    model = build_model(vehicle(), data.channels, effects, sample_time=data.flights[0].dt)
    near = fit(model, data, disturbance=("torque",))
    far = fit(model, data, disturbance=("torque",), predictor="multi-step")
    return Candidate(
        steps=(BASE,), likelihood=near, likelihood_score=NEAR, ahead=far, ahead_score=FAR
    )


@pytest.fixture(scope="module")
def tried(agreed: Candidate) -> Candidate:
    """The same, where the likelihood says another lag."""
    near = agreed.likelihood
    return with_lag(
        agreed, replace(near[TAU], value=agreed.fit[TAU].value + 5 * agreed.fit[TAU].std)
    )


def with_lag(candidate: Candidate, lag: Estimate) -> Candidate:
    """The candidate whose likelihood has this lag."""
    near = candidate.likelihood
    estimates = replace(near.estimates, parameters={**near.parameters, TAU: lag})
    return replace(candidate, likelihood=replace(near, estimates=estimates))


def test_where_both_agree_errors_hardly_grow_and_nothing_is_said(agreed):
    held = with_one_step(agreed.fit, agreed)
    for name, e in agreed.fit.parameters.items():
        assert not e.std > 0 or e.std <= held[name].std < 1.5 * e.std, name
    assert held.warnings == agreed.fit.warnings


def test_the_errors_hold_what_the_likelihood_says_beyond_chance(tried):
    far = tried.fit
    held = with_one_step(far, tried)
    assert held[TAU].std == pytest.approx(5 * far[TAU].std)  # its own, and 25 less 1 for chance
    assert held[TAU].value == far[TAU].value


def test_what_chance_moves_widens_nothing(agreed):
    lag = replace(agreed.likelihood[TAU], value=agreed.fit[TAU].value + 0.99 * agreed.fit[TAU].std)
    held = with_one_step(agreed.fit, with_lag(agreed, lag))
    assert held[TAU].std == agreed.fit[TAU].std


def test_a_likelihood_that_did_not_end_says_nothing(tried):
    status = replace(tried.likelihood.status, code=Code.MAX_ITERATIONS)
    diagnostics = replace(tried.likelihood.diagnostics, status=status)
    unfinished = replace(tried, likelihood=replace(tried.likelihood, diagnostics=diagnostics))
    assert with_one_step(tried.fit, unfinished) is tried.fit


def test_it_is_said_which_are_no_measurement(tried):
    said = with_one_step(tried.fit, tried).warnings[0]
    assert said.startswith(f"{TAU} is no measurement: the same flights, told by the likelihood")


def test_a_fit_by_the_likelihood_stays_as_it_is(tried):
    assert with_one_step(tried.likelihood, tried) is tried.likelihood
    assert with_one_step(tried.fit, None) is tried.fit
    chosen = replace(tried, ahead_score=NEAR)
    assert with_one_step(tried.likelihood, chosen) is tried.likelihood
