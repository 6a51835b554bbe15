"""motor_lag_second at b = 0 is motor_lag to the last digit, wherever its own states stand, next to
all that shapes the lag or shows it late; the slope there is the true one, also without a lag."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from craft import CROOKED, flat, function, model_of, vector

DT = 0.01
BESIDE = {
    "alone": {},
    "each way": {"motor_lag_asymmetry__a": 0.3},
    "by speed": {"motor_lag_speed__s": 0.6},
    "late": {"command_delay__d": 0.013, "pose_delay__d": 0.012, "rotor_speed_delay__d": 0.004},
    "spinning": {"rotor_gyroscopic__J_r": 5e-5, "accelerometer_lever_arm__r_x": 0.02},
}


def pair(beside, tau):
    """(model with second order, its parameters at b = 0, those of the model without, that model)."""
    values = {"motor_lag__tau": tau, **BESIDE[beside]}
    names = [n.split("__")[0] for n in values]
    with_it = model_of(CROOKED, *names, "motor_lag_second", dt=DT)
    without = model_of(CROOKED, *names, dt=DT)
    return with_it, vector(with_it, **values), vector(without, **values), without


def states(with_it, without, seed):
    """(state with pulls anywhere, the same without), a window of commands."""
    rng = np.random.default_rng(seed)
    small = dict(zip(without.states.names, rng.normal(size=len(without.states)), strict=True))
    small |= {n: rng.uniform(0.3, 0.8) for n in small if n.startswith("rotor")}
    q = np.array([small[f"attitude.{a}"] for a in "wxyz"])
    small |= dict(zip((f"attitude.{a}" for a in "wxyz"), q / np.linalg.norm(q), strict=True))
    large = [small.get(n, rng.uniform(0.3, 0.8)) for n in with_it.states.names]
    window = rng.uniform(0.2, 0.9, size=(len(without.inputs), sum(without.window) + 1))
    return np.array(large), np.array(list(small.values())), window


@pytest.mark.parametrize("tau", [0.0, 0.03])
@pytest.mark.parametrize("beside", BESIDE)
def test_a_step_and_an_output_are_those_of_the_first_order(beside, tau):
    with_it, p, p0, without = pair(beside, tau)
    assert with_it.window == without.window
    there = [with_it.states[n] for n in without.states.names]
    for seed in range(3):
        x, x0, window = states(with_it, without, seed)
        rest = (np.zeros(6), DT)
        got = flat(function(with_it, "step")(x, window, p, *rest))[there]
        expected = flat(function(without, "step")(x0, window, p0, *rest))
        np.testing.assert_allclose(got, expected, rtol=1e-13, atol=1e-13)
        got = flat(function(with_it, "output")(x, window, p, *rest))
        expected = flat(function(without, "output")(x0, window, p0, *rest))
        np.testing.assert_allclose(got, expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("tau", [0.0, 0.004, 0.03])
def test_the_slope_there_is_the_true_one(tau):
    """Of the whole step, by the command that the rotors had before, which pulls them still."""
    with_it, p, _, without = pair("alone", tau)
    x, _, window = states(with_it, without, 1)
    at = [d.name for d in with_it.parameters].index("motor_lag_second.b")
    symbol = ca.SX.sym("p", p.size)
    end = with_it.step(0, ca.DM(x), ca.DM(window), symbol, ca.DM.zeros(6), ca.DM(DT))
    slope = ca.Function("slope", [symbol], [end, ca.jacobian(end, symbol[at])])
    now, exact = (flat(v) for v in slope(p))
    assert np.isfinite(exact).all()
    for size in (1e-3, 1e-4):
        moved = p.copy()
        moved[at] += size
        difference = (flat(slope(moved)[0]) - now) / size
        np.testing.assert_allclose(difference, exact, rtol=0.01, atol=20 * size)


def test_a_rotor_of_second_order_needs_a_lag_to_be_felt():
    assert model_of(CROOKED, "motor_lag_second", dt=DT).states == model_of(CROOKED, dt=DT).states


@pytest.mark.parametrize(("b", "beyond"), [(0.1, 0.0), (0.25, 0.0), (1.0, 0.163), (4.0, 0.444)])
def test_a_jump_of_the_command_is_overshot_by_its_damping_alone(b, beyond):
    """exp(-pi damping / sqrt(1 - damping^2)), damping = 1 / (2 sqrt(b)) (Ogata 2010, eq. 5-21)."""
    model = model_of(CROOKED, "motor_lag", "motor_lag_second", dt=DT)
    p = vector(model, motor_lag__tau=0.03, motor_lag_second__b=b)
    step, rows = function(model, "step"), [model.states[f"rotor.{i}"] for i in range(1, 5)]
    x = np.array([0.4 if n.startswith("rotor") else 0.0 for n in model.states.names])
    x[model.states["attitude.w"]] = 1.0
    highest = 0.0
    for _ in range(400):
        x = flat(step(x, np.full((4, 1), 0.6), p, np.zeros(6), 5e-4))
        highest = max(highest, (x[rows].max() - 0.4) / 0.2 - 1.0)
    assert max(highest, 0.0) == pytest.approx(beyond, abs=1e-3)
