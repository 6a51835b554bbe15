"""What a late pose shows was pushed by the same gusts as the states that came after it."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from greybox.model.noise import Disturbance, with_parts
from tests.model.craft import CROOKED, flat, model_of, state
from tests.mpc_export import cases

DT = 0.01
EFFECTS = ("motor_lag", "pose_delay")
POSE = ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz")
PUSH = np.array([0.8, -0.5, 0.3, 0.02, -0.03, 0.01])
"""Force [N] and torque [N m]: a quarter of the weight of the craft or less."""


def functions_of(model):
    """(step, output) as functions of (x, window, p, w)."""
    x, p, w = (ca.SX.sym("v", len(n)) for n in (model.states, model.parameters, model.noises))
    window = ca.SX.sym("U", len(model.inputs), sum(model.window) + 1)
    return [
        ca.Function(
            "f", [x, window, p, w], [ca.densify(getattr(model, which)(0, x, window, p, w, DT))]
        )
        for which in ("step", "output")
    ]


def values_of(model, delay: float, tau: float = 0.02) -> list[float]:
    """Nominal values with this delay of the pose, this lag, and gusts that last for ever."""
    changes = {
        "motor_lag.tau": tau,
        "pose_delay.d": delay,
        "disturbance.force.T": 1e9,
        "disturbance.torque.T": 1e9,
    }
    return [changes.get(d.name, d.nominal) for d in model.parameters]


def flown(model, values, x, steps: int, seed: int = 0):
    """(states, windows) of some steps with commands that jump from sample to sample."""
    step, _ = functions_of(model)
    random = np.random.default_rng(seed)
    past = model.window[0]
    u = CROOKED.hover_speed + random.uniform(-0.02, 0.02, (past + steps + 1, 4))
    states, windows, quiet = [x], [], np.zeros(len(model.noises))
    for k in range(steps + 1):
        windows.append(u[k : k + past + 1].T)
        states.append(flat(step(states[-1], windows[-1], values, quiet)))
    return states, windows


def start_of(model, push=()) -> np.ndarray:
    hover = [CROOKED.hover_speed] * 4
    return state(
        model, velocity=[1.0, -0.5, 0.2], rate=[0.6, -0.4, 0.3], rotor=hover, disturbance=push
    )


@pytest.mark.parametrize(("steps", "tau"), [(1, 0.02), (1, 0.05), (2, 0.03)])
def test_the_pose_of_some_samples_ago_is_the_one_that_was_there(steps, tau):
    model = with_parts(
        model_of(CROOKED, *EFFECTS), [Disturbance(group="force"), Disturbance(group="torque")]
    )
    late, now = values_of(model, steps * DT, tau), values_of(model, 0.0, tau)
    states, windows = flown(model, late, start_of(model, PUSH), 8)
    _, output = functions_of(model)
    quiet = np.zeros(len(model.noises))
    names = list(model.outputs.names)
    rows = [names.index(c) for c in POSE]
    k = 8
    seen = flat(output(states[k], windows[k], late, quiet))[rows]
    true = flat(output(states[k - steps], windows[k - steps], now, quiet))[rows]
    moved = flat(output(states[k], windows[k], now, quiet))[rows]
    calm = states[k].copy()
    calm[-len(PUSH) :] = 0.0
    without = flat(output(calm, windows[k], late, quiet))[rows]
    of_push = np.abs(without - seen)
    assert of_push[3:6].max() > 5e-3  # what forgetting the gust would cost [m/s]
    assert np.abs(seen - true).max() < 0.1 * np.abs(moved - true).max()
    assert np.abs(seen - true)[3:6].max() < 0.25 * of_push[3:6].max()


def test_the_noise_of_the_coming_step_moves_no_pose_of_the_past():
    model = model_of(CROOKED, *EFFECTS)
    values = values_of(model, 2 * DT)
    states, windows = flown(model, values, start_of(model), 8)
    _, output = functions_of(model)
    rows = [list(model.outputs.names).index(c) for c in POSE]
    quiet, noisy = (
        flat(output(states[8], windows[8], values, w))[rows] for w in (np.zeros(6), PUSH)
    )
    assert np.array_equal(quiet, noisy)


def test_what_lasts_is_a_gust_and_noise_together():
    """`lasting` and `w` push alike now: the accelerometer sees their sum."""
    model = model_of(CROOKED, *EFFECTS)
    values = values_of(model, 2 * DT)
    states, windows = flown(model, values, start_of(model), 4)
    both = model.output(
        0, states[4], windows[4], ca.DM(values), ca.DM(0.3 * PUSH), DT, ca.DM(0.7 * PUSH)
    )
    one = model.output(0, states[4], windows[4], ca.DM(values), ca.DM(PUSH), DT)
    rows = [list(model.outputs.names).index(c) for c in ("p", "q", "r", "ax", "ay", "az")]
    assert flat(both)[rows] == pytest.approx(flat(one)[rows], abs=1e-12)


def test_a_learned_push_on_disturbance_states_shows_itself_in_the_outputs():
    dynamics = cases.hybrid().dynamics
    x, p, w = (
        ca.SX.sym("v", len(n)) for n in (dynamics.states, dynamics.parameters, dynamics.noises)
    )
    window = ca.SX.sym("U", len(dynamics.inputs), sum(dynamics.window) + 1)
    y = dynamics.output(0, x, window, p, w, DT)
    inner = dynamics.inner.output(0, x, window, p, w, DT)
    assert y.numel() == len(dynamics.outputs)
    different = ca.Function("d", [x, window, p, w], [y - inner])
    at = flat(different(0.1, CROOKED.hover_speed, [d.nominal for d in dynamics.parameters], 0))
    names = list(dynamics.outputs.names)
    assert np.abs(at[[names.index(c) for c in ("ax", "ay", "az")]]).max() > 0
