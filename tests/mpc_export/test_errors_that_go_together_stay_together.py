"""A parameter that was held although it is not exact, and those that followed it, go together into
plans and plants: what flights know well, such as thrust over mass, stays well known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mpc_export.adaptation import with_flight_spread
from mpc_export.functions import model_functions
from mpc_export.noise import parameter_covariance
from tests.mpc_export import cases

SIGMA = 0.1
"""Stated error of the mass, as a share; the thrust follows it."""


@pytest.fixture(scope="module")
def model():
    plain = cases.physics()
    mass, thrust = plain.values["mass"], plain.values["thrust.c2"]
    own = (1e-3 * thrust) ** 2
    moves = thrust / mass
    return replace(
        plain,
        covariance_names=("thrust.c2",),
        covariance=np.array([[own + (moves * SIGMA * mass) ** 2]]),
        considered={"mass": (SIGMA * mass, {"thrust.c2": moves})},
    )


def test_lift_over_weight_is_known_as_well_as_the_flights_know_it(model):
    functions = model_functions(model, with_=("covariance",))
    assert functions.covariance_names == ("thrust.c2", "mass")
    x, u = functions.reference
    slope = functions["P_theta"](x, u, functions.parameter_values).full()
    spread = np.sqrt(np.diag(slope @ functions.covariance @ slope.T))
    at = functions.error_states.names.index("d_velocity.z")
    by_thrust = abs(slope[at, 0]) * 1e-3 * model.values["thrust.c2"]
    assert spread[at] == pytest.approx(by_thrust, rel=0.05)


def test_what_is_learned_in_flight_is_no_error_of_the_others(model):
    aware = with_flight_spread(model, {"mass": 0.05 * model.values["mass"]})
    names, covariance = parameter_covariance(aware)
    assert names == ("thrust.c2",)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(1e-3 * model.values["thrust.c2"])
    assert model.covariance[0, 0] > 1e3 * covariance[0, 0], "the model itself stays"
