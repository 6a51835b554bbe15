"""The tube's covariance is that of a simulated loop of plant, identified filter and ancillary
gain."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mpc_export.feedback import Weights
from mpc_export.functions import model_functions
from mpc_export.tube.controller import TubeController
from mpc_export.tube.correlation import correlation, error_transition, innovations
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.second_order import _surplus
from mpc_export.tube.solver import TubeSolver
from mpc_export.tube.stages import _weights, stages
from tests.mpc_export import cases


class Origin:
    """Stay at the origin."""

    def sample(self, time):
        zero = np.zeros((len(time), 3))
        return SimpleNamespace(position=zero, velocity=zero, acceleration=zero, yaw=zero[:, 0])


@pytest.fixture(scope="module")
def solver():
    # at the model's own sample time, where filter and tube see the same steps
    model = cases.disturbed()
    functions = model_functions(model, with_=("covariance", "target"))
    return TubeSolver(functions, TubeProblem(dt=functions.dt, horizon=12, planes=1))


def hover(solver, parameters=True):
    solver.reset()
    d = solver.data
    d["kappa"][:] = 1.0
    d["plane"][:, 0] = [1.0, 0.0, 0.0, 1.0]
    assert solver.solve().status == 0
    return d


def test_covariance_is_that_of_an_ensemble(solver):
    d = hover(solver)
    model, made = solver.model, solver.stages
    x, u = made.steady
    _, a, b, _ = (v.full() for v in model["f_d_jac"](x, u, model.parameter_values))
    k, n = model.noise.gain, 20_000
    rng = np.random.default_rng(3)
    # innovations are white and of covariance S; the estimate moves by K times them, and the error
    # stays of covariance P
    s = np.linalg.cholesky(model.noise.innovation)
    away = np.zeros((n, a.shape[0]))
    closed = a + b @ made.gain
    root = np.linalg.cholesky(made.estimate + 1e-18 * np.eye(len(a)))
    theta = np.linalg.cholesky(model.covariance) @ rng.standard_normal((len(model.covariance), n))
    slope = model["P_theta"](x, u, model.parameter_values).full()
    bias = np.zeros_like(away)
    for stage in range(solver.problem.horizon + 1):
        error = rng.standard_normal((n, len(a))) @ root.T
        spread = (away + bias + error).std(axis=0)
        stated = np.sqrt(np.diag(d["covariance"][stage] - d["bent"][stage]))
        np.testing.assert_allclose(spread, stated, rtol=0.04, atol=1e-8)
        away = away @ closed.T + rng.standard_normal((n, len(s))) @ s.T @ k.T
        bias = bias @ closed.T + (slope @ theta).T


def test_backoff_is_kappa_standard_deviations_along_the_normal(solver):
    d = hover(solver)
    at = solver.model.error_states.names.index("d_position.x")
    np.testing.assert_allclose(d["backoff"][1:, 0], np.sqrt(d["covariance"][1:, at, at]), rtol=1e-9)
    assert d["backoff"][0, 0] == 0.0


def spread(made, model, steps):
    """Covariances of the tube at hover, and the part of them that errors of the parameters make."""
    x, u = made.steady
    n = model.sizes
    z, c, b = (
        np.zeros((n["n_d"],) * 2),
        np.zeros((n["n_d"], n["n_g"])),
        np.zeros((n["n_d"], n["n_theta"])),
    )
    totals = []
    for _ in range(steps + 1):
        total, z, c, b_next = (
            v.full() for v in made.functions["tube_spread"](x, u, model.parameter_values, z, c, b)
        )
        totals.append(total)
        last, b = b, b_next
    return np.array(totals), last @ model.covariance @ last.T


def test_recursion_in_c_and_in_casadi_are_one(solver):
    totals, _ = spread(solver.stages, solver.model, 12)
    d = hover(solver)
    np.testing.assert_allclose(d["covariance"], totals + d["bent"], rtol=1e-9, atol=1e-15)


def test_the_tube_grows_without_feedback_and_less_with_it(solver):
    model = solver.model
    free, _ = spread(stages(model, TubeProblem(dt=model.dt, feedback=False)), model, 60)
    held, _ = spread(solver.stages, model, 60)
    at = model.error_states.names.index("d_position.x")
    assert np.all(np.diff(free[:, at, at]) > 0)
    assert free[-1, at, at] > 1.5 * held[-1, at, at]


def test_worst_case_ellipsoids_hold_every_sequence_of_bounded_disturbances(solver):
    model = solver.model
    made = stages(model, TubeProblem(dt=model.dt, kind="worst case"))
    x, u = made.steady
    _, a, b, _ = (v.full() for v in model["f_d_jac"](x, u, model.parameter_values))
    closed = a + b @ made.gain
    values, vectors = np.linalg.eigh(made.fresh)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    # the disturbances that push farthest along a direction at the end, each on its own ellipsoid
    totals, by_parameters = spread(made, model, 12)
    inner = totals[-1] - made.estimate - by_parameters
    rng = np.random.default_rng(0)
    for _ in range(20):
        direction = rng.standard_normal(len(a))
        reach, turn = 0.0, direction
        for _ in range(12):
            reach += np.linalg.norm(root.T @ turn)
            turn = closed.T @ turn
        assert reach <= np.sqrt(direction @ inner @ direction) * (1 + 1e-9)


def test_gain_is_the_riccati_solution_with_disturbances_as_states(solver):
    model, made = solver.model, solver.stages
    x, u = made.steady
    _, a, b, _ = (v.full() for v in model["f_d_jac"](x, u, model.parameter_values))
    rows = list(made.keep)
    q, r = _weights(model, solver.problem.weights)
    # value iteration over all states, which needs no stabilisability
    p, gain = np.zeros_like(q), np.zeros_like(made.gain)
    for _ in range(4000):
        gain = -np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a)
        p = q + a.T @ p @ (a + b @ gain)
    np.testing.assert_allclose(made.gain, gain, rtol=1e-5, atol=1e-6 * np.abs(gain).max())
    np.testing.assert_allclose(
        made.terminal, p[np.ix_(rows, rows)], rtol=1e-5, atol=1e-6 * np.abs(p).max()
    )


@pytest.mark.slow
def test_the_filters_error_is_that_of_the_filter_that_runs():
    # plans twice as long as the filter's samples: the tube starts at the error of the quick filter
    model = cases.disturbed()
    problem = TubeProblem(dt=2 * model.sample_time, horizon=2)
    pilot = TubeController(model=model, problem=problem, reference=Origin(), integrate=False)
    stated, slow = pilot.solver.stages.estimate, pilot.functions.noise.covariance
    own = model_functions(model).noise.covariance
    for name in ("d_position.x", "d_velocity.z", "d_attitude.y", "d_disturbance.force.x"):
        at, there = (
            pilot.functions.error_states.names.index(name),
            pilot.filter.error_states.names.index(name),
        )
        assert stated[at, at] == own[there, there] > 0
        assert stated[at, at] < 0.9 * slow[at, at]
    # and its innovations are those of both samples of a stage
    both = innovations(pilot.filter, 2, len(stated))
    np.testing.assert_allclose(pilot.solver.stages.fresh, both, rtol=1e-9, atol=1e-12 * both.max())


def test_a_stiffer_ancillary_gain_makes_the_tube_narrower_and_the_plan_stays(solver):
    model = solver.model
    stiff = stages(model, TubeProblem(dt=model.dt, ancillary=Weights(position=64.0)))
    at = model.error_states.names.index("d_position.x")
    wide, narrow = (spread(made, model, 60)[0][-1, at, at] for made in (solver.stages, stiff))
    assert narrow < 0.5 * wide
    np.testing.assert_array_equal(stiff.terminal, solver.stages.terminal)


@pytest.mark.parametrize("ahead", [1.0, 3.0])
def test_innovations_of_a_quicker_filter_add_up_to_what_it_does_not_know(ahead):
    # estimate and its error together move as the state does: A P A' + Q = W + P, at the filter's
    # own sample time; also where errors ahead are larger than the filter's noise says
    model = cases.disturbed()
    model = replace(model, horizon_noise=ahead * model.process_noise)
    filter_ = model_functions(model, with_=("filter",))
    noise = filter_.noise
    x, u = filter_.reference
    _, a, _, _ = (v.full() for v in filter_["f_d_jac"](x, u, filter_.parameter_values))
    once, twice = (innovations(filter_, steps, len(a)) for steps in (1, 2))
    np.testing.assert_allclose(
        once, a @ noise.covariance @ a.T + noise.process - noise.covariance, atol=2e-9
    )
    np.testing.assert_allclose(twice, a @ once @ a.T + once, rtol=1e-12)


def test_the_second_order_is_what_a_nonlinear_loop_adds(solver):
    # rough air that does not turn the vehicle about its vertical: what it turns there comes of
    # turns about the other two
    model, problem = (
        solver.model,
        TubeProblem(dt=solver.model.dt, horizon=25, ancillary=Weights(position=64.0)),
    )
    names = model.error_states.names
    level = np.diag(
        [0.0 if n in ("d_attitude.z", "d_rate.z", "d_disturbance.torque.z") else 8.0 for n in names]
    )
    rough = level @ solver.stages.fresh @ level
    made = stages(model, problem, fresh=rough)
    x0, u0 = made.steady
    totals, _ = spread(made, model, problem.horizon)
    rng, n = np.random.default_rng(11), 120
    values, vectors = np.linalg.eigh(rough)
    away = np.zeros((n, len(rough)))
    for i in range(n):
        x = x0
        for _ in range(problem.horizon):
            u = np.clip(u0 + made.gain @ away[i], problem.command_min, problem.command_max)
            pushed = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(rough)))
            x = model["boxplus"](model["f_d"](x, u, model.parameter_values), pushed).full().ravel()
            away[i] = model["boxminus"](x, x0).full().ravel()
    at = names.index("d_attitude.z")
    flown = np.sqrt(np.mean(away[:, at] ** 2))
    linear = totals[-1] - made.estimate
    assert linear[at, at] < (0.7 * flown) ** 2  # none to first order, a rounding below nought
    assert np.sqrt((linear + made.bent[-1])[at, at]) == pytest.approx(flown, rel=0.2)
    assert np.all(np.linalg.eigvalsh(made.bent[-1]) > -1e-12)
    # in calm air there is nothing to add
    calm = stages(model, problem, fresh=1e-4 * solver.stages.fresh)
    assert np.all(
        np.diag(calm.bent[-1]) <= 1e-3 * np.diag(spread(calm, model, problem.horizon)[0][-1])
    )


@pytest.mark.parametrize("still", [0.0, 1e-14])
def test_a_direction_that_the_linear_loop_hardly_moves_spoils_no_other(still):
    linear = np.random.default_rng(3).standard_normal((3, 1000))
    linear[2] *= still
    bent = linear.copy()
    bent[2] = 1e-2 * bent[0] * bent[1]
    added = _surplus(bent, linear)
    assert added[2, 2] == pytest.approx(np.mean(bent[2] ** 2), rel=0.05)
    np.testing.assert_allclose(np.diag(added)[:2], 0.0, atol=0.05)


def test_stages_hang_together_as_in_an_ensemble(solver):
    model, made, length = solver.model, solver.stages, 8
    filter_ = model_functions(cases.disturbed(), with_=("filter",))
    transition = error_transition(filter_, 1, len(made.estimate))
    normal = np.zeros(len(made.estimate))
    normal[model.error_states.names.index("d_position.x")] = 1.0
    stated = correlation(model, made, transition, normal, length)
    x, u = made.steady
    _, a, b, _ = (v.full() for v in model["f_d_jac"](x, u, model.parameter_values))
    _, c, _, _ = (v.full() for v in filter_["h_jac"](x, u, model.parameter_values))
    closed, gain, n = a + b @ made.gain, model.noise.gain, 20_000
    rng = np.random.default_rng(5)
    # innovations first: the error that makes them is drawn with them, S = C P C' + (what else they
    # hold)
    p, s = made.estimate, model.noise.innovation
    rest = np.linalg.cholesky(s - c @ p @ c.T + 1e-18 * np.eye(len(s)))
    process = p - (a - gain @ c) @ p @ (a - gain @ c).T
    values, vectors = np.linalg.eigh(process - gain @ rest @ rest.T @ gain.T)
    own = vectors * np.sqrt(np.maximum(values, 0.0))
    values, vectors = np.linalg.eigh(p)
    e = rng.standard_normal((n, len(p))) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    h, bias = np.zeros_like(e), np.zeros_like(e)
    theta = np.linalg.cholesky(model.covariance) @ rng.standard_normal((len(model.covariance), n))
    slope = model["P_theta"](x, u, model.parameter_values).full()
    seen = []
    for stage in range(length + 1):
        if stage:
            seen.append((e + h + bias) @ normal)
        v = rng.standard_normal((n, len(s))) @ rest.T
        h = h @ closed.T + (e @ c.T + v) @ gain.T
        e = e @ (a - gain @ c).T - v @ gain.T + rng.standard_normal((n, len(p))) @ own.T
        bias = bias @ closed.T + (slope @ theta).T
    np.testing.assert_allclose(stated, np.corrcoef(seen), atol=0.03)
