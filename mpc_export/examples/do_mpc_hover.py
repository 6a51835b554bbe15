"""Close the loop with do-mpc: from a displaced state back towards the reference. Needs this bundle,
casadi, numpy, do-mpc.

python examples/do_mpc_hover.py [--horizon 10] [--steps 5] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from pathlib import Path

import numpy as np

BUNDLE = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(BUNDLE / "python"))

from consumers.do_mpc import do_mpc_controller, do_mpc_simulator  # noqa: E402
from consumers.exported import load  # noqa: E402
from consumers.hover import final_cost, hover, solve, stage_cost  # noqa: E402


def main() -> None:
    """Fly some steps and compare the first command with IPOPT's on the same problem."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--horizon", type=int, default=10)
    parser.add_argument("--steps", type=int, default=5, help="steps of the closed loop")
    parser.add_argument("--json", action="store_true", help="print numbers for a program")
    arguments = parser.parse_args()
    # do-mpc calls numpy on casadi values, of which casadi 3.8 warns.
    warnings.filterwarnings("ignore", message="(?s).*numpy function was called on a casadi value")
    model = load(BUNDLE)
    task = hover(model, arguments.horizon)
    controller = do_mpc_controller(
        model,
        task,
        lambda x, u: stage_cost(model, task, x, u),
        lambda x: final_cost(model, task, x),
    )
    simulator = do_mpc_simulator(model, task.start)
    x, inputs, costs, solved = task.start, [], [float(final_cost(model, task, task.start))], True
    for _ in range(arguments.steps):
        u = controller.make_step(x.reshape(-1, 1))
        solved = solved and bool(controller.solver_stats["success"])
        simulator.make_step(u)
        x = np.asarray(simulator.x0.cat).ravel()
        inputs.append(np.asarray(u).ravel())
        costs.append(float(final_cost(model, task, x)))
    difference = float(np.abs(inputs[0] - solve(model, task)[1][0]).max())
    if arguments.json:
        states = {"solved": solved, "inputs": np.array(inputs).tolist(), "state": x.tolist()}
        print(json.dumps({**states, "costs": costs, "difference": difference}))
    else:
        print(
            f"every step solved: {solved}; cost of the state {', '.join(f'{c:.3g}' for c in costs)}"
        )
        print("first command:", dict(zip(model.inputs, np.round(inputs[0], 4).tolist())))
        print(f"its largest difference to IPOPT: {difference:.1e}")


if __name__ == "__main__":
    main()
