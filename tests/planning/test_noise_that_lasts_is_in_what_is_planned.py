"""A plan from a fitted model expects the noise of that model's flights, the part that lasts too:
its white rest alone promises errors that no flight gives."""

from __future__ import annotations

from dataclasses import replace

import pytest

from greybox.data import Dataset
from greybox.estimation.fit import fit
from greybox.estimation.result import Fit
from greybox.model.model import build_model
from greybox.planning.information import errors, information
from greybox.planning.own_plan import plan_own
from greybox.planning.planning_case import planning_case, precision_of
from tests import gusty, simulated


@pytest.fixture(scope="module")
def flight() -> Dataset:
    return simulated.flights(1)


@pytest.fixture(scope="module")
def fitted(flight: Dataset) -> Fit:
    model = build_model(simulated.vehicle(), flight.channels, sample_time=0.01)
    return fit(model, flight, disturbance=("force", "torque"))


def test_along_the_flight_of_a_fit_a_plan_expects_the_errors_of_the_fit(
    flight: Dataset, fitted: Fit
) -> None:
    wish = planning_case(model=fitted.model)
    # The flight is the fit's own: what it told is not known before.
    bare = replace(wish, precision=precision_of(wish.declared, wish.free, None))
    expected = errors(bare, information(bare, flight))
    for n in wish.free:
        assert expected[n][0] == pytest.approx(fitted[n].std_fisher, rel=0.1), n


def test_a_sensor_that_is_not_logged_takes_its_noise_along(fitted: Fit) -> None:
    noisy = fit(
        fitted.model.core,
        simulated.flights(1),
        noise_parts=("coloured.attitude",),
        estimate_noise=False,
    )
    names = {
        seen: {d.name for d in planning_case(model=noisy.model, sensors=seen).dynamics.parameters}
        for seen in (("attitude", "gyro"), ("position", "gyro"))
    }
    (more,) = names["attitude", "gyro"] - names["position", "gyro"]
    assert more == "coloured.attitude.T"


def test_a_model_of_ones_own_is_planned_for_in_its_gusts() -> None:
    """`b` pushes all the time, gusts of T = 2 s hardly shorter. The best a record of length t tells
    of the mean of such is sigma (2 T / (t + 2 T))^(1/2)."""
    held = fit(
        gusty.model(),
        gusty.rides(2),
        noise=gusty.LEVELS,
        estimate_noise=False,
        initialisation="nominal",
        fixed=["disturbance.v.T"],
    )
    found = plan_own(held.model, {"f": (-1.0, 1.0)}, seconds=8.0, piece=4.0, free=["b"])
    told = gusty.SIGMA * (2 * gusty.TIME / (8.0 + 2 * gusty.TIME)) ** 0.5
    assert found.errors["b"][1] == pytest.approx(told, rel=0.05)
