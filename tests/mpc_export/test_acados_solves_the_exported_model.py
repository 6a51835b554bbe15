"""acados, from a bundle alone, solves an optimal control problem of the exported model as IPOPT
does."""

from __future__ import annotations

import os
import sys
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from mpc_export.acados import (
    acados_model,
    explicit_difference,
    first_order,
    lay_out,
    limit_slopes,
    robust_solve,
    session,
)
from mpc_export.exported import load, of
from mpc_export.functions import model_functions
from mpc_export.hover import hover, residual, solve
from tests.mpc_export import cases, consumers

SPEED = 0.11
"""Largest forward speed of the problem with a limit [m/s]."""


@pytest.mark.parametrize("kind", ["physics", "hybrid"])
@consumers.needs("acados")
def test_acados_finds_the_solution_that_ipopt_finds(kind):
    got = consumers.run(kind, "acados_hover.py", "--acados", consumers.ACADOS, "--optimise=-O0")
    assert got["status"] == 0
    assert got["difference"] < 1e-4
    # And IPOPT's with the functions before they were exported, which the script knows nothing of.
    runtime = ("mass",) if kind == "physics" else ()
    own = of(
        model_functions(
            {"physics": cases.physics, "hybrid": cases.hybrid}[kind](), runtime_parameters=runtime
        ),
        "m",
    )
    _, expected = solve(own, hover(own, 20))
    assert np.abs(np.array(got["inputs"]) - expected).max() < 1e-4
    assert np.any(expected > own.upper - 1e-6), "the case should reach a bound"


@consumers.needs("acados")
def test_explicit_and_implicit_dynamics_are_f(tmp_path, monkeypatch):
    model = load(consumers.bundle("physics"))
    monkeypatch.chdir(tmp_path)
    with session(consumers.ACADOS) as home:
        from acados_template import AcadosSim, AcadosSimSolver

        sim = AcadosSim()
        sim.model = acados_model(model, dynamics="continuous")
        sim.acados_include_path, sim.acados_lib_path = str(home / "include"), str(home / "lib")
        sim.code_export_directory = str(tmp_path / "generated")
        sim.parameter_values = model.parameter_values
        options = sim.solver_options
        options.T, options.integrator_type, options.num_stages, options.num_steps = (
            model.dt,
            "ERK",
            4,
            1,
        )
        solver = AcadosSimSolver(sim, json_file=str(tmp_path / "sim.json"), verbose=False)
        x = model.reference_state[: model.own_states] + 0.01
        u = model.reference_inputs + 0.05
        solver.set("x", x)
        solver.set("u", u)
        assert solver.solve() == 0
        got = solver.get("x")
    f, p, h = model["f"], model.parameter_values, model.dt
    k1 = f(x, u, p)
    k2 = f(x + h / 2 * k1, u, p)
    k3 = f(x + h / 2 * k2, u, p)
    k4 = f(x + h * k3, u, p)
    np.testing.assert_allclose(
        got, (x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)).full().ravel(), rtol=1e-12, atol=1e-12
    )
    dynamics = sim.model
    gap = ca.Function(
        "gap", [dynamics.x, dynamics.xdot, dynamics.u, dynamics.p], [dynamics.f_impl_expr]
    )
    assert float(ca.norm_inf(gap(x, k1, u, p))) == 0.0


def limited(model, home, folder):
    """(solver, limits) of the hover problem whose forward speed is limited."""
    from acados_template import AcadosOcp, AcadosOcpSolver

    x = ca.MX.sym("x", len(model.states))
    limits = ca.Function("limits", [x], [x[model.states.index("velocity.x")]])
    task, ocp = hover(model, 20), AcadosOcp()
    ocp.model = acados_model(model)
    ocp.acados_include_path, ocp.acados_lib_path = str(home / "include"), str(home / "lib")
    ocp.code_export_directory, ocp.dims.N = str(folder / "generated"), task.steps
    ocp.model.cost_y_expr = residual(model, ocp.model.x, ocp.model.u)
    ocp.model.cost_y_expr_e = residual(model, ocp.model.x)
    ocp.cost.cost_type = ocp.cost.cost_type_e = "NONLINEAR_LS"
    ocp.cost.W = np.diag(np.concatenate([task.state_weights, task.input_weights]))
    ocp.cost.W_e = np.diag(task.final * task.state_weights)
    ocp.cost.yref, ocp.cost.yref_e = np.zeros(len(ocp.cost.W)), np.zeros(len(ocp.cost.W_e))
    ocp.model.con_h_expr, ocp.model.con_h_expr_e = limits(ocp.model.x), limits(ocp.model.x)
    ocp.constraints.lh = ocp.constraints.lh_e = np.array([-1e3])
    ocp.constraints.uh = ocp.constraints.uh_e = np.array([SPEED])
    ocp.constraints.idxbu = np.arange(len(model.inputs))
    ocp.constraints.lbu, ocp.constraints.ubu = model.lower, model.upper
    start = np.array(
        model.with_history(model.reference_state[: model.own_states], model.reference_inputs)
    ).ravel()
    start[model.states.index("position.x")] += 1.0
    ocp.constraints.x0, ocp.parameter_values = start, model.parameter_values
    options = ocp.solver_options
    options.tf, options.integrator_type, options.hessian_approx = (
        task.steps * model.dt,
        "DISCRETE",
        "GAUSS_NEWTON",
    )
    options.nlp_solver_type, options.nlp_solver_max_iter, options.tol = "SQP", 100, 1e-8
    options.qp_solver, options.qp_solver_iter_max = "PARTIAL_CONDENSING_HPIPM", 200
    options.ext_fun_compile_flags = "-O0"
    solver = AcadosOcpSolver(ocp, json_file=str(folder / "ocp.json"), verbose=False)
    for k in range(task.steps + 1):
        solver.set(k, "x", start)
        if k < task.steps:
            solver.set(k, "u", model.reference_inputs)
    return solver, limits


@pytest.mark.slow
@consumers.needs("acados")
def test_zero_order_robust_plans_keep_a_limit_that_plain_ones_cross(tmp_path, monkeypatch):
    functions = model_functions(cases.hybrid(), with_=("covariance", "pilot"))
    model, gain, kappa = of(functions, "robust"), functions.pilot.gain, 2.0
    monkeypatch.chdir(tmp_path)
    beyond = {}
    with session(consumers.ACADOS) as home:
        solver, limits = limited(model, home, tmp_path)
        n, nothing = int(solver.N), np.zeros((len(model.error_states),) * 2)
        for name, wide in (("plain", 0.0), ("robust", kappa)):
            status, off = robust_solve(
                solver, model, limits, SPEED, kappa=wide, covariance=nothing, gain=gain
            )
            assert status == 0, off
            xs = np.array([solver.get(k, "x") for k in range(n + 1)])
            us = np.array([solver.get(k, "u") for k in range(n)])
            speeds = np.array([float(limits(x)) for x in xs])
            np.testing.assert_array_less(speeds[1:], SPEED - off[1:, 0] + 1e-6)
            worst = int(np.argmax(speeds + off[:, 0]))
            assert speeds[worst] + off[worst, 0] == pytest.approx(SPEED, abs=1e-4), (
                "the limit should bind"
            )
            beyond[name] = share_beyond(model, limits, xs[: worst + 1], us, gain)
        added = [
            model["covariance_step"](x, u, model.parameter_values, nothing).full()
            for x, u in zip(xs, us)
        ]
        given = {"kappa": kappa, "covariance": nothing, "gain": gain}
        status, _ = robust_solve(
            solver,
            model,
            limits,
            SPEED,
            rounds=1,
            off=off,
            slopes=limit_slopes(model, limits),
            **given,
        )
        assert status == 0, "from the back-offs that were found, nothing moves"
        robust_solve(solver, model, limits, SPEED, kappa=0.0, covariance=nothing, gain=gain)
        again = [float(limits(solver.get(k, "x"))) for k in range(n + 1)]
    assert max(again) == pytest.approx(SPEED, abs=1e-4), "limits of an earlier call are gone"
    assert off[1, 0] < off[worst, 0]
    traces = np.array([np.trace(w) for w in added])
    assert np.ptp(traces) > 1e-3 * traces.mean(), "W is the stage's own"
    assert 0.35 < beyond["plain"] < 0.65
    assert beyond["robust"] < 0.06


def share_beyond(model, limits, xs, us, gain, draws=300):
    """Of flights of the model itself about a plan, at its last sample; noise as the model says it
    there."""
    rng, count = np.random.default_rng(5), 0
    p, nothing = model.parameter_values, np.zeros((len(model.error_states),) * 2)
    roots = []
    for x, u in zip(xs[:-1], us):
        values, vectors = np.linalg.eigh(model["covariance_step"](x, u, p, nothing).full())
        roots.append(vectors * np.sqrt(np.maximum(values, 0.0)))
    for _ in range(draws):
        x = xs[0]
        for k, root in enumerate(roots):
            u = us[k] + gain @ model["boxminus"](x, xs[k]).full().ravel()
            x = (
                model["boxplus"](model["f_d"](x, u, p), root @ rng.standard_normal(root.shape[1]))
                .full()
                .ravel()
            )
        count += float(limits(x)) > SPEED
    return count / draws


@consumers.needs("acados")
def test_a_session_leaves_environment_and_path_as_they_were():
    before, path = dict(os.environ), list(sys.path)
    with session(consumers.ACADOS) as home:
        assert os.environ["ACADOS_SOURCE_DIR"] == str(home)
        assert (home / "lib").is_dir()
        assert not (home / "casadi").exists(), "the wheel's own casadi must stay out of the way"
        with session(home) as again:  # an installed acados looks like this
            assert again == home
        assert os.environ["ACADOS_SOURCE_DIR"] == str(home)
    assert dict(os.environ) == before
    assert sys.path == path


def test_an_unpacked_wheel_is_laid_out_as_acados_wants_it(tmp_path):
    for part in ("install/lib", "install/include", "install/bin", "acados_template"):
        (tmp_path / "wheel" / "acados" / part).mkdir(parents=True)
    home = lay_out(tmp_path / "wheel", tmp_path / "home")
    assert sorted(p.name for p in home.iterdir()) == ["bin", "include", "interfaces", "lib"]
    assert (
        home / "interfaces" / "acados_template" / "acados_template"
    ).resolve().name == "acados_template"
    with pytest.raises(FileNotFoundError, match="no unpacked comma-deps-acados"):
        lay_out(tmp_path / "nothing", tmp_path / "other")


@pytest.mark.parametrize("kind", ["physics", "hybrid"])
def test_the_fast_form_of_f_d_has_exact_slopes_and_no_silent_curvature(kind):
    model = of(model_functions({"physics": cases.physics, "hybrid": cases.hybrid}[kind]()), "m")
    step = first_order(model)
    x, u = ca.MX.sym("x", len(model.states)), ca.MX.sym("u", len(model.inputs))
    lam = ca.MX.sym("lam", len(model.states))
    after, both = step(x, u, model.parameter_values), ca.vertcat(x, u)
    bend = ca.jacobian(ca.jtimes(after, both, lam, True), both)
    values = ca.Function("all", [x, u, lam], [after, ca.jacobian(after, both), bend])
    point = model.reference_state + 0.01, model.reference_inputs, np.ones(len(model.states))
    got = [v.full() for v in values(*point)]
    plain = [v.full() for v in model["f_d_jac_raw"](*point[:2], model.parameter_values)]
    np.testing.assert_allclose(got[0], plain[0], atol=1e-14)
    np.testing.assert_allclose(got[1], np.hstack(plain[1:3]), atol=1e-14)
    assert np.isnan(got[2]).any(), "a second derivative that is not there must not look like zero"


def test_the_difference_of_f_and_f_d_is_the_delay():
    slow = of(model_functions(cases.physics(0.013)), "slow")
    found = explicit_difference(slow)
    assert set(found) == set(slow.states[: slow.own_states])
    assert 0.005 < found["rotor.1"] < 0.1, (
        "a change of a tenth that comes a sample late is seen in the rotors"
    )
    # The uncertain delay would keep its history states at zero delay too.
    at_once = replace(cases.physics(0.0), covariance_names=("mass",), covariance=np.array([[1e-8]]))
    quick = of(model_functions(at_once), "quick")
    assert len(quick.states) == quick.own_states
    assert max(explicit_difference(quick).values()) < 0.005 * max(found.values())
