"""acados, from a bundle alone, solves an optimal control problem of the exported model as IPOPT does."""

from __future__ import annotations

import os
import sys
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from mpc_export.acados import acados_model, explicit_difference, first_order, lay_out, session
from mpc_export.exported import load, of
from mpc_export.functions import model_functions
from mpc_export.hover import hover, solve
from tests.mpc_export import cases, consumers


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
