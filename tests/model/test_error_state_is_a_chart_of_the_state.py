"""boxplus and boxminus invert each other, and the error-state Jacobians are what finite differences
say."""

from __future__ import annotations

import casadi as ca
import numpy as np
from craft import CROOKED, flat, model_of, state, vector
from hypothesis import given, settings
from hypothesis import strategies as st

from greybox.estimation.reference_point import chart_jacobians
from greybox.model.noise import with_disturbance

MODEL = model_of(CROOKED, "motor_lag", "rotor_drag")
SYMBOLS = {
    n: ca.SX.sym(n, len(layout))
    for n, layout in (("x", MODEL.states), ("z", MODEL.states), ("d", MODEL.error_states))
}
PLUS = ca.Function(
    "plus", [SYMBOLS["x"], SYMBOLS["d"]], [MODEL.boxplus(SYMBOLS["x"], SYMBOLS["d"])]
)
MINUS = ca.Function(
    "minus", [SYMBOLS["z"], SYMBOLS["x"]], [MODEL.boxminus(SYMBOLS["z"], SYMBOLS["x"])]
)

numbers = st.floats(-3, 3, allow_nan=False)
quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


def states():
    return st.builds(
        lambda p, v, q, w: state(
            MODEL, position=p, velocity=v, attitude=np.array(q) / np.linalg.norm(q), rate=w
        ),
        *[st.tuples(numbers, numbers, numbers)] * 2,
        quaternions,
        st.tuples(numbers, numbers, numbers),
    )


errors = st.lists(st.floats(-1.5, 1.5, allow_nan=False), min_size=16, max_size=16).map(np.array)


@settings(deadline=None, max_examples=100, derandomize=True)
@given(states(), errors)
def test_boxminus_undoes_boxplus(x, d):
    moved = PLUS(x, d)
    np.testing.assert_allclose(flat(MINUS(moved, x)), d, atol=1e-12)
    at = MODEL.states["attitude.w"]
    assert abs(np.linalg.norm(flat(moved)[at : at + 4]) - 1) < 1e-14


@settings(deadline=None, max_examples=100, derandomize=True)
@given(states(), states())
def test_boxplus_of_the_difference_arrives(x, z):
    arrived = flat(PLUS(x, MINUS(z, x)))
    at = MODEL.states["attitude.w"]
    if arrived[at : at + 4] @ z[at : at + 4] < 0:  # q and -q are one attitude
        arrived[at : at + 4] *= -1
    np.testing.assert_allclose(arrived, z, atol=1e-7)


def test_error_state_jacobian_of_a_step_is_the_finite_difference():
    rng = np.random.default_rng(2)
    x = state(
        MODEL,
        position=[1, 2, 3],
        velocity=[1, -2, 0.5],
        attitude=np.array([0.7, 0.1, -0.5, 0.5]),
        rate=[1, 2, -1],
    )
    x[6:10] /= np.linalg.norm(x[6:10])
    p, u, dt = (
        vector(MODEL, rotor_drag__k_x=3e-5, rotor_drag__k_y=2e-5),
        rng.uniform(0.4, 0.7, size=4),
        0.01,
    )
    symbol = SYMBOLS["x"]
    after = MODEL.step(0, symbol, ca.DM(u), ca.DM(p), ca.DM.zeros(6), dt)
    into, out = chart_jacobians(MODEL, symbol, after)
    exact = ca.Function("a", [symbol], [out @ ca.jacobian(after, symbol) @ into])(x).full()
    step = ca.Function("s", [symbol], [after])
    h = 1e-5
    numeric = np.zeros_like(exact)
    for j, e in enumerate(np.eye(len(MODEL.error_states))):
        ahead, behind = (step(PLUS(x, s * h * e)) for s in (1, -1))
        centre = step(x)
        numeric[:, j] = (flat(MINUS(ahead, centre)) - flat(MINUS(behind, centre))) / (2 * h)
    np.testing.assert_allclose(exact, numeric, atol=1e-7)


def test_the_linearisation_depends_on_neither_position_nor_heading():
    """The reason for errors in body axes: one stationary gain serves a whole flight."""
    p, u, dt = ca.DM(vector(MODEL, rotor_drag__k_x=3e-5)), ca.DM([0.5, 0.52, 0.54, 0.5]), 0.01
    symbol = SYMBOLS["x"]
    after = MODEL.step(0, symbol, u, p, ca.DM.zeros(6), dt)
    y = ca.SX.sym("y", len(MODEL.outputs))
    e = MODEL.innovation(y, MODEL.output(0, symbol, u, p, ca.DM.zeros(6), dt), symbol)
    into, out = chart_jacobians(MODEL, symbol, after)
    at = ca.Function("a", [symbol], [out @ ca.jacobian(after, symbol) @ into])
    seen = ca.Function("c", [symbol, y], [ca.jacobian(e, symbol) @ into])
    measured = ca.Function("h", [symbol], [MODEL.output(0, symbol, u, p, ca.DM.zeros(6), dt)])

    def state_at(yaw, position):
        # Heading yaw, pitched by 0.3 rad, moving forward at 2 m/s in body terms.
        q = np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
        pitched = np.array([np.cos(0.15), 0, np.sin(0.15), 0])
        w, z = q[0], q[3]
        attitude = [w * pitched[0], -z * pitched[2], w * pitched[2], z * pitched[0]]
        velocity = [2 * np.cos(yaw), 2 * np.sin(yaw), 0.1]
        return state(
            MODEL, position=position, velocity=velocity, attitude=attitude, rate=[0.5, -0.3, 0.2]
        )

    here, there = state_at(0.0, [0, 0, 0]), state_at(2.1, [5, -3, 9])
    # The inner stages of Runge-Kutta see quaternions that are unit to second order in dt only.
    np.testing.assert_allclose(at(there).full(), at(here).full(), atol=1e-8)
    np.testing.assert_allclose(
        seen(there, measured(there)).full(), seen(here, measured(here)).full(), atol=1e-9
    )


def test_a_disturbed_model_has_the_chart_of_its_parts():
    disturbed = with_disturbance(MODEL, ("force",))
    rng = np.random.default_rng(5)
    x = np.concatenate([state(MODEL), rng.normal(size=3)])
    d = 0.3 * rng.normal(size=len(disturbed.error_states))
    moved = disturbed.boxplus(ca.DM(x), ca.DM(d))
    np.testing.assert_allclose(flat(disturbed.boxminus(moved, ca.DM(x))), d, atol=1e-13)
    np.testing.assert_allclose(flat(moved)[-3:], x[-3:] + d[-3:])
