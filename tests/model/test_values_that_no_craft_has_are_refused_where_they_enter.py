"""A value that somebody gives for a parameter is let in only where its declaration, and a body, can
have it; the error says what was expected, what came and what to do."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

from greybox.errors import GreyboxError, ModelError, UnknownNameError
from greybox.model.given_values import demand_given
from greybox.model.model import PhysicsModel
from greybox.model.noise import with_disturbance
from greybox.model.vehicle import Vehicle
from greybox.model.vehicle_template import template_text
from tests.residual.hybrid_cases import craft_model


def dynamics():
    vehicle = Vehicle.from_dict(tomllib.loads(template_text("x")))
    return with_disturbance(
        PhysicsModel(vehicle=vehicle).with_effect("motor_lag", "products_of_inertia"), ("force",)
    )


MODEL = dynamics()
NOMINAL = {d.name: d.nominal for d in MODEL.parameters}
DECLARED = {d.name: d for d in MODEL.parameters}
WAYS = {
    "given": lambda changes: demand_given(MODEL, changes),
    "changed": lambda changes: craft_model(MODEL).with_values(changes),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("name", "value", "what"),
    [
        ("mass", -1.0, "outside its bounds; expected .* kg; got -1. Usual fix"),
        ("mass", 0.0, "outside its bounds"),
        ("mass", 1e3, "outside its bounds"),
        ("mass", float("nan"), "not finite"),
        ("mass", float("inf"), "not finite"),
        ("mass", "1.2", "not a number; expected .*; got '1.2'"),
        ("mass", None, "not a number"),
        ("mass", [1.0, 2.0], "not a number"),
        ("inertia.xx", -1e-3, "outside its bounds"),
        ("motor_lag.tau", -0.01, "outside its bounds; expected 0 to 0.5 s"),
        ("disturbance.force.T", -1.0, "outside its bounds"),
    ],
)
def test_what_no_parameter_can_be_is_one_clear_error(way, name, value, what):
    with pytest.raises(ModelError, match=f"value of {name}: {what}"):
        WAYS[way]({name: value})


@pytest.mark.parametrize("way", WAYS)
def test_moments_and_products_that_no_body_has_are_refused(way):
    xx, yy = NOMINAL["inertia.xx"], NOMINAL["inertia.yy"]
    # 5 % is the rounding of tables.
    WAYS[way]({"inertia.zz": 1.04 * (xx + yy)})
    with pytest.raises(ModelError, match=r"values of inertia\.zz: no body has this inertia"):
        WAYS[way]({"inertia.zz": 1.06 * (xx + yy)})
    with pytest.raises(GreyboxError, match=r"products_of_inertia\.Jxy"):
        WAYS[way]({"products_of_inertia.Jxy": 1.01 * np.sqrt(xx * yy)})


@pytest.mark.parametrize("way", WAYS)
def test_values_within_bounds_and_their_rounding_pass(way):
    longest = DECLARED["motor_lag.tau"].upper
    WAYS[way]({"mass": np.float64(1.3 * NOMINAL["mass"]), "motor_lag.tau": 1.004 * longest})
    WAYS[way](NOMINAL)
    with pytest.raises(UnknownNameError, match="did you mean mass"):
        WAYS[way]({"mas": 1.0})


def test_a_disturbance_of_a_model_may_last_for_ever_and_one_to_search_may_not():
    changed = craft_model(MODEL).with_values({"disturbance.force.T": 1e6})
    assert changed.values["disturbance.force.T"] == 1e6
    with pytest.raises(ModelError, match="outside its bounds"):
        demand_given(MODEL, {"disturbance.force.T": 1e6})
