"""RK4 with the stages' own Jacobians is the exact derivative of RK4, and calls the Gaussian process
once a stage."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from benchmarks.variational import derivative, rk4
from greybox.errors import ModelError
from greybox.model.dynamics import Dynamics
from greybox.model.parameter import nominal_values
from greybox.residual.hybrid import HybridModel
from mpc_export.c_code import write_c
from mpc_export.c_kernels import GPKernel
from tests.residual.hybrid_cases import craft, push


def hybrid() -> HybridModel:
    return HybridModel(inner=craft(), posterior=push(craft(), points=12))


def parameters(model: Dynamics) -> Any:
    chosen = nominal_values(model.parameters)
    return ca.DM([chosen[p.name] for p in model.parameters])


def plain(model: Dynamics, dt: float, substeps: int) -> Any:
    """The same integrator with CasADi's own Jacobian of the whole of it."""
    x, u = ca.MX.sym("x", len(model.states)), ca.MX.sym("u", len(model.inputs))
    p, h, after = ca.MX.sym("p", len(model.parameters)), dt / substeps, x
    for _ in range(substeps):
        k1 = model.f(0, after, u, p)
        k2 = model.f(0, after + h / 2 * k1, u, p)
        k3 = model.f(0, after + h / 2 * k2, u, p)
        k4 = model.f(0, after + h * k3, u, p)
        after = after + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return ca.Function("plain", [x, u, p], [after, ca.jacobian(after, x), ca.jacobian(after, u)])


def points(model: Dynamics, n: int) -> list[tuple[Any, Any]]:
    rng = np.random.default_rng(5)
    out = []
    for _ in range(n):
        x = model.reference({}) + 0.5 * rng.standard_normal(len(model.states))
        q = slice(model.states["attitude.w"], model.states["attitude.w"] + 4)
        x[q] /= np.linalg.norm(x[q])
        u = rng.uniform(0.3, 0.8, len(model.inputs))
        if "vbat" in model.inputs.names:
            u[model.inputs["vbat"]] = 3.7
        out.append((x, u))
    return out


@pytest.mark.parametrize("kind", ["physics", "hybrid"])
@pytest.mark.parametrize("substeps", [1, 3])
def test_it_is_the_derivative_of_the_integrator(kind: str, substeps: int) -> None:
    model: Any = craft() if kind == "physics" else hybrid()
    ours, theirs, p = (
        rk4(derivative(model), 0.05, substeps=substeps),
        plain(model, 0.05, substeps),
        parameters(model),
    )
    for x, u in points(model, 10):
        for got, want in zip(ours(x, u, p), theirs(x, u, p)):
            scale = max(1.0, np.abs(np.asarray(want)).max())
            assert np.abs(np.asarray(got - want)).max() <= 1e-12 * scale


def test_every_stage_calls_the_gaussian_process_once(tmp_path: Path) -> None:
    model = hybrid()
    kernel = GPKernel(
        name="gp_mean_jac", posterior=model.posterior, which=("mean", "mean_jacobian")
    )
    step = rk4(derivative(model, learned=kernel.function()), 0.02)
    source = write_c([step], tmp_path, prefix="m", kernels=[kernel])
    assert source.kernels == ("gp_mean_jac",)
    text = source.source.read_text()
    symbol = {
        m[1]: m[2]
        for m in re.finditer(
            r"^/\* (\w+):\(.*\) \*/\nstatic int (casadi_f\d+)\(", text, re.MULTILINE
        )
    }
    assert text.count(f"if ({symbol['f_slope']}(") == 4
    assert text.count(f"if ({symbol['gp_mean_jac']}(") == 1


def test_sizes_that_do_not_fit_are_refused() -> None:
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    with pytest.raises(ModelError, match="dx and J"):
        rk4(ca.Function("f", [x, u, p], [x]), 0.1)
