"""A filter that hardly corrects carries a wrong start on: a rotor that was not settled turns the
craft right round within seconds, from where no slope leads back."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.data import Segment
from greybox.estimation.engine import engine_for
from greybox.examples import vehicle_path
from greybox.model.effects import effect_by_name
from greybox.model.model import PhysicsModel, sensors_for
from greybox.model.parameter import ParameterValues
from greybox.model.vehicle import read_vehicle
from greybox.validation.adapt import adapt_to_flight
from tests.validation.test_validate_judges_causally import COLUMNS, DT, dataset, make_model

UNSETTLED = np.array([-0.12, 0.05, 0.1, -0.06])


@pytest.fixture(scope="module")
def made():
    """A model whose filter hardly corrects, a flight of it, and its start, with rotors unsettled."""
    vehicle = read_vehicle(vehicle_path("nanobench"))
    dynamics = PhysicsModel(
        vehicle=vehicle,
        sensors=sensors_for(COLUMNS, vehicle),
        effects=(effect_by_name("accelerometer_bias"), effect_by_name("motor_lag")),
    )
    values = {d.name: d.nominal for d in dynamics.parameters}
    hover = {f"u{i}": 0.849 for i in range(1, 5)}
    model = make_model(
        dynamics=dynamics,
        values=ParameterValues({**values, "motor_lag.tau": 0.05}),
        process_noise=np.full(6, 1e-7),
        weak=np.full(len(dynamics.error_states), 100.0),
        reference_state=dynamics.reference(hover),
    )
    n, rng = 500, np.random.default_rng(0)
    t = DT * np.arange(n)
    u = 0.849 + 0.01 * np.sin(t[:, None] * rng.uniform(2, 9, 4) + rng.uniform(0, 6, 4))
    start = np.array(dynamics.reference(hover), dtype=float)
    start[[i for i, s in enumerate(dynamics.states.names) if "rotor" in s]] += UNSETTLED
    engine = engine_for(dynamics, ())
    y, _ = engine.rollout(
        starts=start[None],
        rows=np.array([0]),
        horizon=n,
        inputs=engine.padded_inputs(u),
        p=model.parameter_vector(None),
        dt=DT,
        want_states=True,
    )
    sigma = np.array([1e-3] * 3 + [1.5e-3] * 4 + [2e-2] * 3 + [5e-2] * 3)
    measured = y[0] + sigma * rng.standard_normal(y[0].shape)
    measured[:, 3:7] /= np.linalg.norm(measured[:, 3:7], axis=1, keepdims=True)
    channels = dict(zip(COLUMNS, measured.T, strict=True))
    channels |= {f"u{i + 1}": u[:, i] for i in range(4)}
    (flight,) = dataset(Segment(t=t, channels=channels, flight="f"))
    return model, flight, start


def test_windows_that_grow_find_the_rotors_that_one_window_does_not(made):
    model, flight, start = made
    dynamics = model.dynamics
    found = adapt_to_flight(model, flight, 4.0)
    assert found.warnings == ()
    rotors = [i for i, s in enumerate(dynamics.states.names) if "rotor" in s]
    np.testing.assert_allclose(found.x0[rotors], start[rotors], atol=0.02)


@pytest.mark.parametrize("seconds", [0.02, 0.1])
def test_a_window_too_short_to_grow_ends_with_a_warning(made, seconds):
    model, flight, _ = made
    found = adapt_to_flight(model, flight, seconds, max_iterations=1)
    assert found.warnings
    assert "NOT converged" in found.warnings[0]
