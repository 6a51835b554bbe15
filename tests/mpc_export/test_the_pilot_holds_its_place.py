"""pilot_step: where it flies to, what a steady force leaves, what its commands keep, and that it is
the parts it names."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from greybox.errors import ModelError
from greybox.frames import numeric
from greybox.model.noise import with_disturbance
from mpc_export.feedback import NEAR
from mpc_export.functions import model_functions
from tests.mpc_export import cases
from tests.residual import hybrid_cases


@functools.cache
def made():
    return model_functions(cases.disturbed(), with_=("pilot", "target"))


def flown(goal, samples, push=(0.0, 0.0, 0.0), start=(0.0, 0.0, 0.0)):
    """(States of the vehicle (n, n_x), commands (n, n_u)) of a flight under a steady force in body
    axes."""
    f = made()
    own = [f.states[f"disturbance.force.{a}"] for a in "xyz"]
    truth, u, p = f.pilot.x.copy(), f.pilot.u.copy(), f.parameter_values
    truth[[f.states[f"position.{a}"] for a in "xyz"]] = start
    x, states, commands = truth.copy(), [], []
    for _ in range(samples):
        truth[own] = push
        y = f["h"](truth, u, p).full().ravel()
        x, after = (
            v.full().ravel()
            for v in f["pilot_step"](x, u, p, y, np.ones(len(f.innovations)), goal)[:2]
        )
        truth = f["f_d"](truth, u, p).full().ravel()
        u = after
        states.append(truth)
        commands.append(u)
    return np.array(states), np.array(commands)


def test_it_flies_to_the_goal_and_keeps_the_limits_of_commands():
    f = made()
    states, commands = flown(np.array([2.0, -1.0, 1.5, 0.8]), 500)
    end = states[-1]
    np.testing.assert_allclose(
        end[[f.states[f"position.{a}"] for a in "xyz"]], [2.0, -1.0, 1.5], atol=2e-3
    )
    heading = numeric("euler", end[[f.states[f"attitude.{a}"] for a in "wxyz"]])[0][2]
    assert heading == pytest.approx(0.8, abs=2e-3)
    assert commands.min() >= 0.0 and commands.max() <= 1.0
    speed = np.linalg.norm(states[:, [f.states[f"velocity.{a}"] for a in "xyz"]], axis=1)
    assert speed.max() < 3.0, "places farther away than NEAR count as that far"
    assert NEAR["position"] < 2.0


def test_a_steady_force_leaves_millimetres_whatever_the_heading():
    f = made()
    push, place = 0.4 * f.sampled.values["mass"], [f.states[f"position.{a}"] for a in "xyz"]
    left = []
    for heading in (0.0, 2.0):
        goal = np.array([0.0, 0.0, 1.0, heading])
        states, _ = flown(goal, 600, push=(push, 0.0, -push), start=(0.0, 0.0, 1.0))
        left.append(np.linalg.norm(states[-1, place] - goal[:3]))
    assert max(left) < 1e-3
    assert left[0] == pytest.approx(left[1], rel=0.01)


@pytest.mark.parametrize("c_v", [0.6, 1.0])
def test_an_empty_battery_leaves_millimetres(c_v):
    craft = hybrid_cases.craft(("motor_lag", "battery_sag"))
    dynamics = with_disturbance(craft, ("force", "torque"), time=2.0)
    model = replace(
        cases.identified(dynamics, **{"motor_lag.tau": 0.04, "battery_sag.c_V": c_v}),
        reference_inputs=np.array([0.7, 0.7, 0.7, 0.7, 3.8]),
    )
    f = model_functions(model, with_=("pilot",))
    goal, place = np.array([0.0, 0.0, 1.0, 0.0]), [f.states[f"position.{a}"] for a in "xyz"]
    for volts in (3.8, 3.2):
        p = np.array([volts])
        truth, u = f.pilot.x.copy(), f.pilot.u.copy()
        truth[place] = goal[:3]
        x = truth.copy()
        for _ in range(600):
            y = f["h"](truth, u, p).full().ravel()
            x, after = (
                v.full().ravel()
                for v in f["pilot_step"](x, u, p, y, np.ones(len(f.innovations)), goal)[:2]
            )
            truth, u = f["f_d"](truth, u, p).full().ravel(), after
        assert np.linalg.norm(truth[place] - goal[:3]) < 4e-3
    assert u.mean() > f.pilot.u.mean() + 0.03


def test_without_measurements_it_is_the_filter_and_the_target_that_it_is_made_of():
    f, rng = made(), np.random.default_rng(3)
    place = cases.point(f, rng)
    r, there = np.array([0.1, 0.0, 1.0, 0.2]), np.zeros(len(f.innovations))
    x, u, p, y = place["x"], place["u"], place["p"], place["y"]
    after, command, e, y_hat = f["pilot_step"](x, u, p, y, there, r)
    filtered = f["follow_step"](x, u, p, y, there)
    for one, other in zip((after, e, y_hat), filtered):
        np.testing.assert_array_equal(one.full(), other.full())
    assert ((command.full() >= 0.0) & (command.full() <= 1.0)).all()
    # at its own steady state it gives the target's command
    force = np.array([0.02, -0.01, 0.03, 0.0, 0.0, 0.0]) * f.sampled.values["mass"]
    begin, at = (
        f.pilot.x.copy(),
        [i for i, n in enumerate(f.states.names) if n.startswith("disturbance.")],
    )
    begin[at] = force
    steady, held, _ = f["target_step"](begin, f.pilot.u, p, np.zeros(4))
    moved = f["boxminus"](steady, f.pilot.x).full().ravel()
    rest = np.setdiff1d(
        np.arange(len(moved)), [f.error_states[f"d_{f.states.names[i]}"] for i in at]
    )
    np.testing.assert_allclose(moved[rest], (f.pilot.moved @ force)[rest], atol=1e-5)
    np.testing.assert_allclose(held.full().ravel() - f.pilot.u, f.pilot.held @ force, atol=1e-5)


def test_what_the_pilot_is_made_with_does_not_come_along():
    assert "target_step" not in model_functions(cases.physics(), with_=("pilot",)).functions


def test_what_does_not_fly_has_no_pilot():
    with pytest.raises(ModelError, match="needs a model with position"):
        model_functions(cases.linear(), with_=("pilot",))
