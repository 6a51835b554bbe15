"""What do acados and TinyMPC make of the plan that the exported tube MPC computes?

    python -m benchmarks.tube_peers --acados DIR --tinympc-python PYTHON [--problems 30]

Starts beside a wall, from rest at hover, the tube's back-offs left out: the plan alone. Everybody
starts cold from hover. The answer that counts is acados SQP, converged. The exported C and acados
take one real-time iteration of the whole problem (nonlinear model, rates, tilt, wall with slack).
TinyMPC has a linear model, diagonal costs, boxes and its own terminal cost: it is given the model at
hover with the command before as a state, the changes of commands as inputs, rates and commands as
boxes and the wall as a hard one; no tilt. Times are CPU time of the process around the call from
Python, for everybody.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import numpy as np  # noqa: E402 (after the thread counts)

from greybox.symbolic import FloatArray  # noqa: E402
from mpc_export.acados import session  # noqa: E402
from mpc_export.functions import model_functions  # noqa: E402
from mpc_export.tube.on_acados import acados_solver  # noqa: E402
from mpc_export.tube.problem import TubeProblem  # noqa: E402
from mpc_export.tube.problem_expressions import Problem  # noqa: E402
from mpc_export.tube.solver import TubeSolver  # noqa: E402
from mpc_export.tube.stages import block  # noqa: E402
from tests.mpc_export import cases  # noqa: E402

RESULTS = Path(__file__).resolve().parent / "results"
HERE = Path(__file__).resolve().parent
WALL = 0.15
"""Of the place along x [m]."""
REPEATS = 5
MOST = 5000
"""Iterations of TinyMPC."""
Answer = tuple[FloatArray, float, bool]
"""Commands (N, n_u), seconds, and whether there is a plan."""


def starts(solver: TubeSolver, many: int) -> list[FloatArray]:
    """States (n_x,) about hover, at rest or not, on this side of the wall."""
    rng, x = np.random.default_rng(0), solver.stages.steady[0]
    spread = np.zeros(len(solver.model.error_states))
    for name, v in {"position": 0.1, "velocity": 0.4, "attitude": 0.08, "rate": 0.3}.items():
        spread[block(solver.model, name, error=True)] = v
    found = []
    for _ in range(many):
        d = spread * rng.standard_normal(len(spread))
        found.append(np.asarray(solver.model["boxplus"](x, d)).ravel())
    return found


def ours(solver: TubeSolver, x: FloatArray) -> Answer:
    """One real-time iteration."""
    spent = []
    for _ in range(REPEATS):
        solver.reset()
        d = solver.data
        d["tube_updates_max"][()], d["qp_iterations_max"][()] = 0, 12
        d["x0"][:] = x
        d["plane"][:, 0] = [1.0, 0.0, 0.0, WALL]
        begin = time.process_time()
        outcome = solver.solve()
        spent.append(time.process_time() - begin)
    return d["u"].astype(float).copy(), float(np.median(spent)), outcome.status == 0


def with_acados(problem: Problem, home: Path, work: Path, kind: Any) -> Callable[..., Answer]:
    """acados with Gauss-Newton and HPIPM; kind "SQP" or "SQP_RTI"."""
    p, task = problem, problem.task
    solver = acados_solver(problem, home, work, kind, tolerance=1e-6, limited_end=True)
    x_hover, u_hover = p.solver.stages.steady
    planes = np.tile([0.0, 0.0, 0.0, 1.0], (task.planes, 1))
    planes[0] = [1.0, 0.0, 0.0, WALL]
    given = np.concatenate([np.zeros(7), u_hover, planes.ravel(), x_hover])
    given[:3] = x_hover[:3]

    def solve(x: FloatArray) -> Answer:
        spent, start = [], np.concatenate([x, u_hover])
        for _ in range(REPEATS):
            solver.reset()
            for k in range(p.n + 1):
                solver.set(k, "x", np.concatenate([x_hover, u_hover]))
                solver.set(k, "p", given)
                if k < p.n:
                    solver.set(k, "u", u_hover)
            for side in ("lbx", "ubx"):
                solver.constraints_set(0, side, start)
            begin = time.process_time()
            status = solver.solve()
            spent.append(time.process_time() - begin)
        plan = np.array([solver.get(k, "u") for k in range(p.n)])
        return plan, float(np.median(spent)), status in (0, 5)  # 5: one iteration, as asked for

    return solve


def for_tinympc(solver: TubeSolver, problems: list[FloatArray], rho: float) -> dict[str, Any]:
    """The linear problem: state (error states kept, change of the command in force), input the
    change of the command."""
    f, task, w = solver.model, solver.problem, solver.problem.weights
    keep, nu = list(solver.stages.keep), solver.sizes["NU"]
    x, u = solver.stages.steady
    a, b = (v.full()[keep] for v in f["f_d_jac"](x, u, f.parameter_values)[1:3])
    nk = len(keep)
    own = np.block([[a[:, keep], b], [np.zeros((nu, nk)), np.eye(nu)]])
    into = np.vstack([b, np.eye(nu)])
    q = np.zeros(len(f.error_states))
    for name, v in {"position": w.position, "velocity": w.velocity, "rate": w.rate}.items():
        q[block(f, name, error=True)] = v**2
    q[block(f, "attitude", error=True)[2]] = w.yaw**2
    low, high = np.full(nk + nu, -1e3), np.full(nk + nu, 1e3)
    low[nk:], high[nk:] = task.command_min - u, task.command_max - u
    high[keep.index(block(f, "position", error=True)[0])] = WALL - x[0]
    begin = [np.asarray(f["boxminus"](s, x)).ravel()[keep] for s in problems]
    return {
        "A": own.tolist(),
        "B": into.tolist(),
        "Q": np.concatenate([q[keep], np.full(nu, w.command**2)]).tolist(),
        "R": [w.change**2] * nu,
        "N": task.horizon,
        "u_min": [-task.rate_max] * nu,
        "u_max": [task.rate_max] * nu,
        "x_min": low.tolist(),
        "x_max": high.tolist(),
        "starts": [np.concatenate([d, np.zeros(nu)]).tolist() for d in begin],
        "rho": rho,
        "most": MOST,
        "tolerance": 1e-3,
    }


def tinympc(python: str, solver: TubeSolver, problems: list[FloatArray], rho: float) -> Any:
    """Answers and iterations of TinyMPC."""
    done = subprocess.run(
        [python, str(HERE / "tube_peers_tinympc.py")],
        input=json.dumps(for_tinympc(solver, problems, rho)),
        capture_output=True,
        text=True,
        check=True,
    )
    found = json.loads(done.stdout[done.stdout.index("{") :])
    changes = np.array(found["commands"])
    commands = solver.stages.steady[1] + np.cumsum(changes, axis=1)
    solved = [n < MOST for n in found["iterations"]]
    return list(zip(commands, found["seconds"], solved, strict=True)), found["iterations"]


def compared(
    answers: dict[str, list[Answer]], iterations: dict[str, float]
) -> list[dict[str, Any]]:
    """A row per solver, against acados, converged."""
    best, same = answers["acados, converged"], answers["acados, one iteration"]
    rows = []
    for name, found in answers.items():
        first = [np.abs(f[0][0] - b[0][0]).max() for f, b in zip(found, best, strict=True)]
        plan = [np.abs(f[0] - b[0]).max() for f, b in zip(found, best, strict=True)]
        alike = [np.abs(f[0][0] - b[0][0]).max() for f, b in zip(found, same, strict=True)]
        rows.append(
            {
                "solver": name,
                "CPU microseconds, median": round(1e6 * float(np.median([f[1] for f in found])), 1),
                "CPU microseconds, most": round(1e6 * max(f[1] for f in found), 1),
                "first command off, median": float(np.median(first)),
                "first command off, most": float(np.max(first)),
                "first command off one iteration of acados, median": float(np.median(alike)),
                "plan off, median": float(np.median(plan)),
                "without a plan": sum(not f[2] for f in found),
                **({"iterations": iterations[name]} if name in iterations else {}),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--acados", default=os.environ.get("GREYBOX_ACADOS"), required=False)
    parser.add_argument("--tinympc-python", help="a Python that has tinympc")
    parser.add_argument("--problems", type=int, default=30)
    parser.add_argument("--points", type=int, default=0)
    parser.add_argument("--rho", type=float, nargs="+", default=[1.0, 10.0, 100.0])
    parser.add_argument("--out", type=Path, default=RESULTS / "tube_peers.json")
    arguments = parser.parse_args()
    if not arguments.acados:
        raise SystemExit("--acados DIR, or GREYBOX_ACADOS, is needed")
    model = cases.hybrid(points=arguments.points) if arguments.points else cases.disturbed()
    task = TubeProblem(dt=0.02, horizon=10, planes=2, attempts=1)
    functions = model_functions(model, dt=task.dt, with_=("covariance", "target"), measured=False)
    made = {
        "exported C, float": TubeSolver(functions, task, qp="condensed", real="float"),
        "exported C, double": TubeSolver(functions, task, qp="condensed"),
        "on a desktop, HPIPM": TubeSolver(functions, task),
    }
    base = made["on a desktop, HPIPM"]
    problems = starts(base, arguments.problems)
    answers: dict[str, list[Answer]] = {}
    with ExitStack() as stack:
        home = stack.enter_context(session(arguments.acados))
        work = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        whole = Problem(base)
        for name, kind in (("acados, converged", "SQP"), ("acados, one iteration", "SQP_RTI")):
            solve = with_acados(whole, home, work, kind)
            answers[name] = [solve(x) for x in problems]
    for name, solver in made.items():
        answers[name] = [ours(solver, x) for x in problems]
    iterations: dict[str, float] = {}
    for rho in arguments.rho if arguments.tinympc_python else ():
        name = f"TinyMPC, linear, rho {rho:g}"
        answers[name], took = tinympc(arguments.tinympc_python, base, problems, rho)
        iterations[name] = float(np.median(took))
    rows = compared(answers, iterations)
    for row in rows:
        print(" | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()))
    content = {"question": __doc__.split("\n\n")[0], "problems": len(problems), "rows": rows}
    arguments.out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
