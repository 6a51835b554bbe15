"""The learned residual as l4acados asks for it, in a sequential quadratic programme like its own.
Needs casadi and numpy.

    python examples/l4acados_hover.py [--steps 20] [--json]

l4acados does with acados what is done here with a QP solver of CasADi: linearise the nominal step
and the residual at every point of the horizon, solve the QP, repeat. The result must be that of
IPOPT with the whole hybrid model.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import numpy.typing as npt

BUNDLE = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(BUNDLE / "python"))

from consumers.exported import Exported, load  # noqa: E402
from consumers.hover import Hover, hover, residual, solve  # noqa: E402
from consumers.l4acados import LearnedResidual, nominal  # noqa: E402


def sequence(
    model: Exported, task: Hover, learned: LearnedResidual, iterations: int = 100
) -> tuple[npt.NDArray[np.float64], list[float]]:
    """(U (N, n_u), largest change of every iteration): Gauss-Newton on nominal step + B r, states
    eliminated from the QP."""
    nx, nu, n = len(model.states), len(model.inputs), task.steps
    slopes = nominal(model)["f_d_jac_raw"]
    x, u = ca.MX.sym("x", nx), ca.MX.sym("u", nu)
    errors = residual(model, x, u)
    stage = ca.Function("stage", [x, u], [errors, ca.jacobian(errors, x), ca.jacobian(errors, u)])
    weights = np.concatenate([model.dt * task.state_weights, model.dt * task.input_weights])
    final = np.concatenate([task.final * task.state_weights, np.zeros(nu)])
    points, inputs = np.tile(task.start, (n + 1, 1)), np.tile(model.reference_inputs, (n, 1))
    shape = {"h": ca.Sparsity.dense(n * nu, n * nu), "a": ca.Sparsity(0, n * nu)}
    solver = ca.conic(
        "qp", "qrqp", shape, {"print_iter": False, "print_header": False, "print_info": False}
    )
    sizes: list[float] = []
    for _ in range(iterations):
        value, slope = learned.value_and_jacobian(np.hstack([points[:n], inputs]))
        hessian, gradient = np.zeros((n * nu, n * nu)), np.zeros(n * nu)
        by_input, shift = (
            np.zeros((nx, n * nu)),
            task.start - points[0],
        )  # dx_k = by_input @ dU + shift
        moves = []
        for k in range(n + 1):
            moves.append((by_input, shift))
            error, by_x, by_u = (v.full() for v in stage(points[k], inputs[min(k, n - 1)]))
            jacobian, weight = by_x @ by_input, final
            if k < n:
                jacobian[:, k * nu : (k + 1) * nu] += by_u
                weight = weights
            hessian += jacobian.T @ (weight[:, None] * jacobian)
            gradient += jacobian.T @ (weight * (error.ravel() + by_x @ shift))
            if k < n:
                after, a, b, _ = (
                    v.full() for v in slopes(points[k], inputs[k], model.parameter_values)
                )
                a, b = a + learned.B @ slope[:, k, :nx], b + learned.B @ slope[:, k, nx:]
                shift = a @ shift + after.ravel() + learned.B @ value[k] - points[k + 1]
                by_input = a @ by_input
                by_input[:, k * nu : (k + 1) * nu] += b
        lower, upper = (np.tile(v, n) - inputs.ravel() for v in (model.lower, model.upper))
        step = solver(h=hessian, g=gradient, lbx=lower, ubx=upper)["x"].full().ravel()
        points = points + np.array([g @ step + s for g, s in moves])
        inputs = inputs + step.reshape(n, nu)
        sizes.append(float(np.abs(step).max()))
        if sizes[-1] < 1e-7:
            break
    return inputs, sizes


def main() -> None:
    """Iterate and compare with IPOPT."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--json", action="store_true", help="print numbers for a program")
    arguments = parser.parse_args()
    model = load(BUNDLE)
    task = hover(model, arguments.steps)
    learned = LearnedResidual(model)
    inputs, sizes = sequence(model, task, learned)
    difference = float(np.abs(inputs - solve(model, task)[1]).max())
    deviation = float(np.sqrt(learned.current_variance.max()))
    if arguments.json:
        print(json.dumps({"difference": difference, "iterations": len(sizes), "last": sizes[-1]}))
    else:
        print(
            f"{len(sizes)} iterations, last change {sizes[-1]:.1e}; largest difference to IPOPT "
            f"{difference:.1e}"
        )
        print(f"largest standard deviation of the residual along the horizon: {deviation:.2g}")


if __name__ == "__main__":
    main()
