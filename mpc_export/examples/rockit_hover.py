"""Steer a displaced craft back to its reference with rockit. Needs this bundle, casadi, numpy and
rockit-meco.

python examples/rockit_hover.py [--steps 20] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

BUNDLE = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(BUNDLE / "python"))

from consumers.exported import load  # noqa: E402
from consumers.hover import final_cost, hover, solve, stage_cost  # noqa: E402
from consumers.rockit import rockit_problem  # noqa: E402


def main() -> None:
    """Solve and compare with plain IPOPT."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--json", action="store_true", help="print numbers for a program")
    arguments = parser.parse_args()
    model = load(BUNDLE)
    task = hover(model, arguments.steps)
    ocp, _, u = rockit_problem(
        model,
        task,
        lambda x, u: stage_cost(model, task, x, u),
        lambda x: final_cost(model, task, x),
    )
    sampled = ocp.solve().sample(u, grid="control")[1]  # (n,) of one command
    inputs = np.reshape(sampled, (-1, len(model.inputs)))[: task.steps]
    difference = float(np.abs(inputs - solve(model, task)[1]).max())
    if arguments.json:
        print(json.dumps({"inputs": inputs.tolist(), "difference": difference}))
    else:
        print("first command:", dict(zip(model.inputs, np.round(inputs[0], 4).tolist())))
        print(f"largest difference to IPOPT: {difference:.1e}")


if __name__ == "__main__":
    main()
