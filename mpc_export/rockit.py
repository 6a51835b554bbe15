"""rockit: an optimal control problem in discrete time with an exported model (PyPI rockit-meco,
imported inside)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rockit import Ocp

    from mpc_export.exported import Exported, Expr
    from mpc_export.hover import Hover


def rockit_problem(
    model: Exported,
    problem: Hover,
    stage_cost: Callable[[Expr, Expr], Expr],
    final_cost: Callable[[Expr], Expr],
) -> tuple[Ocp, Expr, Expr]:
    """(ocp, x, u): `set_next` with f_d, bounds on the commands, the problem's start; the costs are
    functions of (x, u), x.

    `ocp.solve().sample(u, grid="control")` gives times and commands; the last row belongs to no
    sample.
    """
    from rockit import MultipleShooting, Ocp

    ocp = Ocp(t0=0, T=problem.steps * model.dt)
    x, u = ocp.state(len(model.states)), ocp.control(len(model.inputs))
    ocp.set_next(x, model["f_d"](x, u, model.parameter_values))
    ocp.subject_to(ocp.at_t0(x) == problem.start)
    ocp.subject_to(model.lower <= (u <= model.upper))
    ocp.add_objective(ocp.sum(stage_cost(x, u)) + ocp.at_tf(final_cost(x)))
    ocp.set_initial(x, problem.start)
    ocp.set_initial(u, model.reference_inputs)
    ocp.solver(
        "ipopt",
        {
            "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-10, "bound_relax_factor": 0.0},
            "print_time": False,
        },
    )
    ocp.method(MultipleShooting(N=problem.steps))
    return ocp, x, u
