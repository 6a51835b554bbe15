"""Delay and lag: the rotor after a step is what a reference with ten thousand small steps says, for
any fraction."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from craft import X250, blocks, flat, function, model_of, sensors, state, vector, vehicle_of

from greybox.model.model import PhysicsModel

DT = 0.01
POSE = sensors("position", "velocity", "attitude", "gyro", "accelerometer")
QUIET = np.zeros(6)


def record(n, seed=0):
    return np.random.default_rng(seed).uniform(0.3, 0.8, size=(n, 4))


def delayed(u, t, d):
    """The held record d seconds late; its first row has been held for ever."""
    k = int(np.floor((t - d) / DT + 1e-9))
    return u[max(k, 0)]


def lagged(u, seconds, d, tau, nu):
    """Rotor speed by brute force: Heun steps of one ten-thousandth of a second, aligned to every
    switch."""
    h = 1e-5
    nu = np.array(nu)
    for k in range(round(seconds / h)):
        goal = delayed(u, (k + 0.5) * h, d)
        first = (goal - nu) / tau
        second = (goal - (nu + h * first)) / tau
        nu = nu + 0.5 * h * (first + second)
    return nu


@pytest.mark.parametrize("d", [0.0, 0.0033, 0.01, 0.0247])
@pytest.mark.parametrize("tau", [0.004, 0.05])
def test_rotor_speed_after_six_samples_is_the_fine_grained_one(d, tau):
    model = model_of(X250, "command_delay", "motor_lag", sensors=POSE, dt=DT)
    p = vector(model, command_delay__d=d, motor_lag__tau=tau)
    u, past = record(6), model.window[0]
    padded = np.vstack([np.tile(u[:1], (past, 1)), u])
    step = function(model, "step")
    x = state(model, rotor=[0.7, 0.4, 0.5, 0.6])
    for k in range(6):
        x = flat(step(x, padded[k : k + past + 1].T, p, QUIET, DT))
    np.testing.assert_allclose(
        blocks(model, x)["rotor"], lagged(u, 6 * DT, d, tau, [0.7, 0.4, 0.5, 0.6]), atol=1e-6
    )


def impulse(model, p, window, rotor):
    """Vertical velocity gained in a step, per unit of thrust slope: the mean of nu over the step,
    when T is linear."""
    v = flat(function(model, "step")(state(model, rotor=rotor), window, p, QUIET, DT))
    return blocks(model, v)


@pytest.mark.parametrize("tau", [1e-5, 0.001, 0.01, 0.3])
@pytest.mark.parametrize("share", [0.0, 0.3])
def test_impulse_and_displacement_of_a_step_are_those_of_the_exact_rotor(tau, share):
    """With thrust linear in nu: dv = c1 sum(mean nu)/m - g dt and dz = the double integral, however
    short the lag."""
    frame = replace(X250, thrust=(0.0, 5.0, 0.0))
    model = model_of(frame, "command_delay", "motor_lag", sensors=POSE, dt=DT)
    p = vector(model, command_delay__d=share * DT, motor_lag__tau=tau)
    old, new, start = 0.4, 0.7, 0.5
    window = np.full((4, model.window[0] + 1), old)
    window[:, -1] = new
    after = impulse(model, p, window, [start] * 4)
    # Exact path on a grid that resolves the shortest lag.
    t = np.unique(
        np.concatenate([np.linspace(0, DT, 20001), share * DT + tau * np.linspace(0, 40, 20001)])
    )
    t = t[t <= DT]
    reached = old + (start - old) * np.exp(-share * DT / tau)
    nu = np.where(
        t < share * DT,
        old + (start - old) * np.exp(-t / tau),
        new + (reached - new) * np.exp(-np.maximum(t - share * DT, 0) / tau),
    )
    a = 4 * 5.0 * nu / 0.5 - frame.gravity
    assert after["velocity"][2] == pytest.approx(np.trapezoid(a, t), rel=2e-4)
    assert after["position"][2] == pytest.approx(np.trapezoid((DT - t) * a, t), rel=2e-4)
    assert after["rotor"] == pytest.approx([nu[-1]] * 4, abs=1e-9)


def test_the_slope_in_the_time_constant_is_there_at_the_null():
    """d(mean of nu)/d tau = -(goal - nu)/dt at tau = 0: a score test can see a lag that is not in
    the model."""
    frame = replace(X250, thrust=(0.0, 5.0, 0.0))
    model = model_of(frame, "motor_lag", sensors=POSE, dt=DT)
    p = ca.SX.sym("p", len(model.parameters))
    after = model.step(
        0, ca.DM(state(model, rotor=[0.4] * 4)), ca.DM([0.6] * 4), p, ca.DM.zeros(6), DT
    )
    tau = [d.name for d in model.parameters].index("motor_lag.tau")
    slope = ca.Function("s", [p], [ca.jacobian(after[model.states["velocity.z"]], p)[tau]])
    assert float(slope(vector(model, motor_lag__tau=0.0))) == pytest.approx(-4 * 5.0 / 0.5 * 0.2)
    early, late = (float(slope(vector(model, motor_lag__tau=v))) for v in (1e-9, 1e-4))
    assert early == pytest.approx(late, rel=1e-6)


def test_the_slope_in_the_delay_at_zero_is_the_one_sided_one():
    """dv/dd = -c1 sum(u_k - u_(k-1))/m: the older command rules for d seconds more."""
    frame = replace(X250, thrust=(0.0, 5.0, 0.0))
    model = model_of(frame, "command_delay", sensors=POSE, dt=DT)
    window = np.full((4, model.window[0] + 1), 0.5)
    window[:, -1] = 0.6
    p = ca.SX.sym("p", len(model.parameters))
    after = model.step(0, ca.DM(state(model)), ca.DM(window), p, ca.DM.zeros(6), DT)
    d = [q.name for q in model.parameters].index("command_delay.d")
    slope = ca.Function("s", [p], [ca.jacobian(after[model.states["velocity.z"]], p)[d]])
    assert float(slope(vector(model, command_delay__d=0.0))) == pytest.approx(-4 * 5.0 / 0.5 * 0.1)


def test_a_delay_of_whole_samples_is_a_shift_of_the_record():
    late, plain = (
        model_of(X250, "command_delay", sensors=POSE, dt=DT),
        model_of(X250, sensors=POSE, dt=DT),
    )
    window = record(late.window[0] + 1, seed=3).T
    x = state(plain, rate=[1.0, 2.0, 3.0])
    for m in (0, 1, 4, 10):
        shifted = flat(
            function(late, "step")(x, window, vector(late, command_delay__d=m * DT), QUIET, DT)
        )
        then = flat(function(plain, "step")(x, window[:, -1 - m], vector(plain), QUIET, DT))
        np.testing.assert_allclose(shifted, then, rtol=1e-12, atol=1e-14)


def test_without_a_lag_a_jump_of_the_command_turns_nothing_whether_the_model_could_lag_or_not():
    """Else a score test of the rotors' inertia, made in the model with every effect at its null,
    asks for another law than the refit without a lag has."""
    able, plain = (
        model_of(X250, *e, sensors=POSE, dt=DT)
        for e in (("motor_lag", "rotor_gyroscopic"), ("rotor_gyroscopic",))
    )
    low, high = [0.4, 0.5, 0.4, 0.5], [0.5, 0.4, 0.5, 0.4]
    spun = {"rotor_gyroscopic__J_r": 1e-5}
    a = function(able, "step")(
        state(able, rotor=low), high, vector(able, motor_lag__tau=0.0, **spun), QUIET, DT
    )
    b = function(plain, "step")(state(plain), high, vector(plain, **spun), QUIET, DT)
    np.testing.assert_allclose(
        blocks(able, a)["rate"], blocks(plain, b)["rate"], rtol=1e-12, atol=1e-14
    )
    lagging = function(able, "step")(
        state(able, rotor=low), high, vector(able, motor_lag__tau=0.02, **spun), QUIET, DT
    )
    assert blocks(able, lagging)["rate"][2] != pytest.approx(blocks(able, a)["rate"][2], abs=1e-3)


def linear_hold(*effects):
    vehicle = vehicle_of(X250)
    vehicle = replace(
        vehicle,
        actuator=replace(
            vehicle.actuator,
            hold="linear",
            thrust=vehicle_of(replace(X250, thrust=(0.0, 5.0, 0.0))).actuator.thrust,
        ),
    )
    return PhysicsModel(vehicle=vehicle, sensors=POSE, sample_time=DT).with_effect(*effects)


def test_a_record_that_runs_linearly_acts_with_its_mean_and_is_sampled_where_it_is():
    model = linear_hold()
    assert model.window == (0, 1)
    window = np.array([[0.5, 0.6]] * 4)
    after = blocks(
        model, flat(function(model, "step")(state(model), window, vector(model), QUIET, DT))
    )
    assert after["velocity"][2] == pytest.approx((4 * 5.0 * 0.55 / 0.5 - 9.80665) * DT)
    seen = flat(function(model, "output")(state(model), window, vector(model), QUIET, DT))
    assert seen[model.outputs["az"]] == pytest.approx(4 * 5.0 * 0.5 / 0.5), (
        "at t_k the command is u_k"
    )


def test_a_delayed_linear_record_is_interpolated():
    model = linear_hold("command_delay")
    past, future = model.window
    assert future == 1
    line = np.tile(
        0.4 + 0.01 * np.arange(past + 2), (4, 1)
    )  # grows by 0.01 per sample; at t_k it is 0.4 + 0.01 past
    for r in (0.0, 0.5, 2.0, 3.7):
        p = vector(model, command_delay__d=r * DT)
        seen = flat(function(model, "output")(state(model), line, p, QUIET, DT))[
            model.outputs["az"]
        ]
        assert seen == pytest.approx(4 * 5.0 * (0.4 + 0.01 * (past - r)) / 0.5)
        after = blocks(model, flat(function(model, "step")(state(model), line, p, QUIET, DT)))
        assert after["velocity"][2] == pytest.approx(
            (4 * 5.0 * (0.4 + 0.01 * (past - r + 0.5)) / 0.5 - 9.80665) * DT
        )
