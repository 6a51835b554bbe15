"""A model at a longer sample time than it was identified at: what decays in it goes on decaying."""

from __future__ import annotations

import numpy as np
import pytest

from mpc_export.functions import model_functions
from tests.mpc_export import cases
from tests.residual import hybrid_cases

STIFF = 240.0
"""Decay of the yaw rate [1/s]: a Runge-Kutta step of 10 ms still holds it, one of 20 ms does not."""


def damped(rate: float):
    model = cases.identified(hybrid_cases.craft(("motor_lag", "rotational_damping")))
    changes = {"motor_lag.tau": 0.04, "rotational_damping.d_r": rate * model.values["inertia.zz"]}
    return model.with_values(changes)


def yaw(functions, rate: float) -> float:
    """The yaw rate after a sample that began with `rate` about hover [rad/s]."""
    x, u = (np.array(v) for v in functions.reference)
    at = functions.states.names.index("rate.z")
    calm = functions["f_d"](x, u, functions.parameter_values).full().ravel()[at]
    x[at] += rate
    return float(functions["f_d"](x, u, functions.parameter_values).full().ravel()[at] - calm)


@pytest.mark.parametrize(
    ("decay", "parts"), [(20.0, 1), (60.0, 1), (100.0, 2), (139.0, 2), (STIFF, 2)]
)
def test_a_step_has_as_many_parts_as_leave_what_short_ones_do(decay, parts):
    own = model_functions(damped(decay))
    longer = model_functions(damped(decay), dt=2 * own.dt)
    assert own.sampled.dynamics.parts == 1
    assert longer.sampled.dynamics.parts == parts
    assert yaw(longer, 0.1) == pytest.approx(yaw(own, yaw(own, 0.1)), abs=0.002)


def test_two_parts_are_two_steps():
    own = model_functions(damped(STIFF))
    longer = model_functions(damped(STIFF), dt=2 * own.dt)
    x = own.reference[0].copy()
    x[[own.states.names.index(f"rate.{a}") for a in "xyz"]] = [1.0, -2.0, 3.0]
    u, p = own.reference[1] + [0.02, -0.03, 0.05, 0.0], own.parameter_values
    twice = own["f_d"](own["f_d"](x, u, p), u, p)
    np.testing.assert_allclose(longer["f_d"](x, u, p), twice, rtol=1e-12, atol=1e-12)
