"""Steer a displaced craft back to its reference with acados. Needs this bundle, casadi, numpy,
acados and a C compiler.

    python examples/acados_hover.py --acados DIR [--steps 20] [--json]

DIR: an installed acados, or the folder of `pip install --no-deps --target DIR comma-deps-acados`.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from acados_template import AcadosOcp

BUNDLE = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(BUNDLE / "python"))

from consumers.acados import acados_model, session  # noqa: E402
from consumers.exported import Exported, load  # noqa: E402
from consumers.hover import Hover, hover, residual, solve  # noqa: E402


def problem(model: Exported, task: Hover, home: Path, work: Path, optimise: str) -> AcadosOcp:
    """The optimal control problem as an AcadosOcp."""
    from acados_template import AcadosOcp

    ocp = AcadosOcp()
    ocp.model = acados_model(model)
    ocp.acados_include_path, ocp.acados_lib_path = str(home / "include"), str(home / "lib")
    ocp.code_export_directory = str(work / "generated")
    ocp.dims.N = task.steps
    ocp.model.cost_y_expr = residual(model, ocp.model.x, ocp.model.u)
    ocp.model.cost_y_expr_e = residual(model, ocp.model.x)
    ocp.cost.cost_type = ocp.cost.cost_type_e = "NONLINEAR_LS"
    ocp.cost.W = np.diag(np.concatenate([task.state_weights, task.input_weights]))
    ocp.cost.W_e = np.diag(task.final * task.state_weights)
    ocp.cost.yref = np.zeros(len(ocp.cost.W))
    ocp.cost.yref_e = np.zeros(len(ocp.cost.W_e))
    bounded = np.flatnonzero(np.isfinite(model.lower) & np.isfinite(model.upper))
    ocp.constraints.idxbu = bounded
    ocp.constraints.lbu, ocp.constraints.ubu = model.lower[bounded], model.upper[bounded]
    ocp.constraints.x0 = task.start
    ocp.parameter_values = model.parameter_values
    options = ocp.solver_options
    options.tf = task.steps * model.dt
    options.integrator_type = "DISCRETE"
    options.hessian_approx = "GAUSS_NEWTON"
    options.nlp_solver_type = "SQP"
    options.nlp_solver_max_iter = 100
    options.qp_solver = "PARTIAL_CONDENSING_HPIPM"
    options.qp_solver_iter_max = 200
    options.tol = 1e-8
    options.qp_tol = 1e-10
    options.ext_fun_compile_flags = optimise
    return ocp


def main() -> None:
    """Build, solve, compare with IPOPT."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--acados", default=os.environ.get("ACADOS_SOURCE_DIR"), help="default: $ACADOS_SOURCE_DIR"
    )
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--optimise", default="-O2", help="compiler flags of the generated code")
    parser.add_argument("--json", action="store_true", help="print numbers for a program")
    arguments = parser.parse_args()
    if not arguments.acados:
        parser.error("where is acados? give --acados DIR or set ACADOS_SOURCE_DIR")
    model = load(BUNDLE)
    task = hover(model, arguments.steps)
    with session(arguments.acados) as home, tempfile.TemporaryDirectory() as scratch:
        from acados_template import AcadosOcpSolver

        work = Path(scratch)
        begin = time.perf_counter()
        ocp = problem(model, task, home, work, arguments.optimise)
        solver = AcadosOcpSolver(ocp, json_file=str(work / "ocp.json"), verbose=False)
        built = time.perf_counter() - begin
        for k in range(task.steps + 1):
            solver.set(k, "x", task.start)
        for k in range(task.steps):
            solver.set(k, "u", model.reference_inputs)
        begin = time.perf_counter()
        status = solver.solve()
        solved = time.perf_counter() - begin
        inputs = np.array([solver.get(k, "u") for k in range(task.steps)])
    difference = float(np.abs(inputs - solve(model, task)[1]).max())
    if arguments.json:
        print(
            json.dumps(
                {
                    "status": int(status),
                    "inputs": inputs.tolist(),
                    "difference": difference,
                    "built": built,
                }
            )
        )
    else:
        print(
            f"built in {built:.1f} s, solved in {1e3 * solved:.1f} ms, status {status} (0: solved)"
        )
        print("first command:", dict(zip(model.inputs, np.round(inputs[0], 4).tolist())))
        print(f"largest difference to IPOPT: {difference:.1e}")
    if status:
        sys.exit(f"acados did not solve it: status {status}")


if __name__ == "__main__":
    main()
