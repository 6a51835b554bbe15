"""A model at a longer sample time than it was identified at: what decays in it goes on decaying."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.model.dynamics import StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.parameter import Parameter, ParameterValues
from greybox.symbolic import Layout, Signal
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


def own_model(decay: float, substeps: int) -> IdentifiedModel:
    """A model of the user's own with one mode, at 10 ms a sample."""
    names = Layout([Signal(name="v", unit="m/s")])
    dynamics = StateSpaceModel(
        name="own",
        states=names,
        inputs=Layout([Signal(name="u", unit="m/s")]),
        outputs=names,
        parameters=(Parameter(name="decay", unit="1/s", nominal=decay, scale=decay),),
        dynamics=lambda t, x, u, p: [p["decay"] * (u[0] - x[0])],
        measurement=lambda t, x, u, p: [x[0]],
        substeps=substeps,
    )
    return IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues({"decay": decay}),
        process_noise=np.array([1.0]),
        sensor_noise=np.array([0.1]),
        weak=np.full(1, 1e4),
        reference_state=np.zeros(1),
        reference_inputs=np.zeros(1),
        sample_time=0.01,
    )


@pytest.mark.parametrize(
    ("decay", "substeps", "times", "steps"),
    [(20.0, 1, 3, 1), (240.0, 1, 3, 3), (240.0, 2, 3, 4), (600.0, 4, 3, 8), (20.0, 4, 0.5, 1)],
)
def test_a_model_of_the_users_own_does_too(decay, substeps, times, steps):
    model = own_model(decay, substeps)
    own, longer = model_functions(model), model_functions(model, dt=times * 0.01)
    assert longer.sampled.dynamics.substeps == steps
    x, p = np.array([1.0]), own.parameter_values
    for _ in range(max(1, round(times))):
        x = own["f_d"](x, [0.0], p).full().ravel()
    left = longer["f_d"]([1.0], [0.0], p).full().item()
    assert left == pytest.approx(x.item() ** min(times, 1.0), abs=0.02)
