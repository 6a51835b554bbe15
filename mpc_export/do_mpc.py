"""do-mpc: a discrete `do_mpc.model.Model` of an exported model, and an MPC and a simulator set up
with it.

Variables are vectors in the bundle's order: `_x` "x" (n_x), `_u` "u" (n_u), `_p` "p" (n_p, where
the model has any); the outputs are the auxiliary expression "y". do-mpc 5, imported inside the
functions.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from do_mpc.controller import MPC
    from do_mpc.model import Model
    from do_mpc.simulator import Simulator

    from mpc_export.exported import Exported, Expr
    from mpc_export.hover import Hover


def do_mpc() -> ModuleType:
    """The package, without what it says of optional features that are not needed here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import do_mpc as package
    return package


def do_mpc_model(model: Exported) -> Model:
    """A configured discrete model, set up: x_next = f_d(x, u, p), auxiliary y = h(x, u, p)."""
    out = do_mpc().model.Model("discrete", "MX")
    x = out.set_variable("_x", "x", shape=(len(model.states), 1))
    u = out.set_variable("_u", "u", shape=(len(model.inputs), 1))
    p = (
        out.set_variable("_p", "p", shape=(len(model.parameters), 1))
        if model.parameters
        else model.parameter_values
    )
    out.set_expression("y", model["h"](x, u, p))
    out.set_rhs("x", model["f_d"](x, u, p))
    out.setup()
    return out


def do_mpc_controller(
    model: Exported,
    problem: Hover,
    stage_cost: Callable[[Expr, Expr], Expr],
    final_cost: Callable[[Expr], Expr],
) -> MPC:
    """An `do_mpc.controller.MPC`, set up; the costs are functions (x, u) -> cost and x -> cost of
    the problem's horizon."""
    inner = do_mpc_model(model)
    out = do_mpc().controller.MPC(inner)
    out.settings.n_horizon = problem.steps
    out.settings.t_step = model.dt
    out.settings.store_full_solution = False
    out.settings.supress_ipopt_output()
    out.settings.nlpsol_opts["ipopt.tol"] = 1e-10
    out.settings.nlpsol_opts["ipopt.bound_relax_factor"] = 0.0
    x, u = inner.x["x"], inner.u["u"]
    out.set_objective(mterm=final_cost(x), lterm=stage_cost(x, u))
    out.set_rterm(u=0.0)
    out.bounds["lower", "_u", "u"] = model.lower
    out.bounds["upper", "_u", "u"] = model.upper
    if model.parameters:
        template = out.get_p_template(1)
        template["_p", 0] = model.parameter_values
        out.set_p_fun(lambda _: template)
    out.setup()
    out.x0 = problem.start
    out.u0 = model.reference_inputs
    out.set_initial_guess()
    return out


def do_mpc_simulator(model: Exported, start: npt.ArrayLike) -> Simulator:
    """A `do_mpc.simulator.Simulator` of the same model, set up, at `start` (n_x)."""
    out = do_mpc().simulator.Simulator(do_mpc_model(model))
    out.set_param(t_step=model.dt)
    if model.parameters:
        template = out.get_p_template()
        template["p"] = model.parameter_values
        out.set_p_fun(lambda _: template)
    out.setup()
    out.x0 = np.asarray(start)
    return out
