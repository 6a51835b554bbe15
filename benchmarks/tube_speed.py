"""How long does a step of the tube controller take, and the same problem solved to the end, next to
IPOPT, do-mpc, acados?

    python -m benchmarks.tube_speed --models DIR [--points 50 100] [--acados DIR] [--flights 3]
    [--problems 8]

DIR holds hybrid-50.json and hybrid-100.json (and is given them by identification where it does not:
minutes). First the controller flies the obstacle course: every call of `TubeController.sample` is
timed, filter, variance propagation, data transfer and Python included. Then problems of these
flights, with the back-offs that stood in them held fixed, are solved from one cold start (every
state the present one, every command that of hover) to a KKT residual of 1e-6 by all solvers: same
discretisation (the exported f_d), cost, limits and slack. The last stage has no limits, because
do-mpc has no place for them. One thread; CPU time of the thread next to wall time, and the
machine's load.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import casadi as ca  # noqa: E402 (after the thread counts)
import numpy as np  # noqa: E402

from greybox.residual.files import load_model, save_model  # noqa: E402
from mpc_export.acados import session  # noqa: E402
from mpc_export.do_mpc import do_mpc  # noqa: E402
from mpc_export.mission import JUDGING_SEEDS, OBSTACLE_COURSE  # noqa: E402
from mpc_export.mission.craft import vehicle  # noqa: E402
from mpc_export.mission.flight import controller, mission, tightened  # noqa: E402
from mpc_export.tube.on_acados import acados_solver  # noqa: E402
from mpc_export.tube.problem_expressions import Problem  # noqa: E402

RESULTS = Path(__file__).resolve().parent / "results"
TOLERANCE, KAPPA, DEADLINE = 1e-6, 1.5, 0.01
SET = ("x0", "u_before", "ref", "x_end", "plane", "backoff", "backoff_u")
OFF = -10.0
"""Back-off of a limit that is not there."""


def identified(folder: Path, points: int) -> Path:
    """The model file with a Gaussian process of so many points."""
    path = folder / f"hybrid-{points}.json"
    if not path.exists():
        from greybox.residual.learn import learn
        from greybox.residual.noise_levels import refit_noise
        from scenarios.studies.tube_mpc import models, training_flight

        folder.mkdir(parents=True, exist_ok=True)
        data = training_flight()
        physics = (
            load_model(folder / "pem.json")
            if (folder / "pem.json").exists()
            else models(folder)["pem"]
        )
        learned = learn(physics, data, points=points, seed=0).model
        save_model(replace(refit_noise(learned, data, each=True), horizon_noise=None), path)
    return path


# -------------------------------------------------------------------------------- steps in flight


def in_flight(
    path: Path, flights: int, problems: int
) -> tuple[dict[str, Any], Any, list[dict[str, np.ndarray]]]:
    """(times of a step, the controller, problems that were met) of flights over the course."""
    model = load_model(path)
    task = mission(model, OBSTACLE_COURSE)
    pilot = tightened(controller(model, task), task, kappa=KAPPA)
    plant, course, met = vehicle(), task.course, []
    spent: dict[str, list[tuple[float, float]]] = {"plan": [], "filter": [], "solver": []}
    parts: list[list[float]] = []
    inner = pilot.solver.solve

    def solve() -> Any:
        begin = time.perf_counter(), time.thread_time()
        outcome = inner()
        spent["solver"].append((time.perf_counter() - begin[0], time.thread_time() - begin[1]))
        parts.append([outcome.seconds_linear, outcome.seconds_tube, outcome.seconds_qp])
        return outcome

    pilot.solver.solve = solve
    steps = round(course.duration / task.dt)
    for seed in JUDGING_SEEDS[:flights]:
        plant.reset(seed, position=course.start[:3])
        pilot.start()
        u, last = pilot.u, None
        for k in range(steps):
            seen = plant.measure(u)
            begin = time.perf_counter(), time.thread_time()
            after = pilot.sample(task.dt * k, seen)
            times = time.perf_counter() - begin[0], time.thread_time() - begin[1]
            planned, last = pilot.plan is not last, pilot.plan
            spent["plan" if planned else "filter"].append(times)
            if planned and seed == JUDGING_SEEDS[0]:
                met.append({name: pilot.solver.data[name].copy() for name in SET})
            plant.step(u, task.dt)
            u = np.array(after)
    pilot.solver.solve = inner
    row: dict[str, Any] = {
        "what": "step in flight",
        "points": len(model.dynamics.posterior.support),
    }
    row |= {
        "states": pilot.functions.sizes["n_x"],
        "horizon": task.problem.horizon,
        "flights": flights,
    }
    for name, found in spent.items():
        wall, cpu = 1e3 * np.array(found).T
        row[name] = {
            "count": len(wall),
            **{f"wall {k}": v for k, v in quantiles(wall).items()},
            **{f"cpu {k}": v for k, v in quantiles(cpu).items()},
            "wall beyond the deadline": int(np.sum(wall > 1e3 * DEADLINE)),
            "cpu beyond the deadline": int(np.sum(cpu > 1e3 * DEADLINE)),
        }
    row["solver parts, wall median"] = dict(
        zip(("linearisation", "tube", "QP"), np.round(1e3 * np.median(parts, axis=0), 3).tolist())
    )
    at = np.linspace(0, len(met) - 1, problems + 2).round().astype(int)[1:-1]
    return row, pilot, [common(met[i]) for i in at]


def quantiles(ms: np.ndarray) -> dict[str, float]:
    """Median, 99th and 99.9th percentile."""
    shares = {"median": 0.5, "p99": 0.99, "p99.9": 0.999}
    return {name: round(float(np.quantile(ms, q)), 3) for name, q in shares.items()}


def common(met: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The problem without limits at the first and the last stage."""
    out = {k: v.copy() for k, v in met.items()}
    for k in (0, -1):
        out["plane"][k], out["backoff"][k] = [0.0, 0.0, 0.0, 1.0], OFF
    return out


# ------------------------------------------------------------------------------------ the problem


Answer = dict[str, Any]


def timed(call: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """(result, wall and CPU milliseconds) of a call."""
    begin = time.perf_counter(), time.thread_time()
    found = call()
    return found, {
        "wall": 1e3 * (time.perf_counter() - begin[0]),
        "cpu": 1e3 * (time.thread_time() - begin[1]),
    }


def ours(problem: Problem) -> Callable[[dict[str, np.ndarray]], Answer]:
    """SQP with Gauss-Newton Hessian on HPIPM, in C."""
    solver = problem.solver

    def solve(given: dict[str, np.ndarray]) -> Answer:
        solver.reset()
        data = solver.data
        for name, value in given.items():
            data[name][:] = value
        data["x"][:], data["u"][:] = given["x0"], problem.hover
        data["tolerance"][()], data["qp_tolerance"][()] = TOLERANCE, 1e-8
        data["iterations_max"][()], data["tube_updates_max"][()] = 100, 0
        outcome, ms = timed(solver.solve)
        good = outcome.status == 0 and outcome.kkt <= TOLERANCE
        return {
            **ms,
            "iterations": outcome.iterations,
            "good": good,
            "u": data["u"].copy(),
            "cost": outcome.cost,
            "qp iterations": outcome.qp_iterations,
        }

    return solve


def ipopt(problem: Problem, hessian: str) -> Callable[[dict[str, np.ndarray]], Answer]:
    """Direct multiple shooting in CasADi's virtual machine."""
    p, task = problem, problem.task
    n, nx, nu, nl = p.n, p.nx, p.nu, p.nl
    x = [ca.MX.sym(f"x{k}", nx) for k in range(n + 1)]
    u = [ca.MX.sym(f"u{k}", nu) for k in range(n)]
    s = [ca.MX.sym(f"s{k}", nl) for k in range(1, n)]
    sizes = {"u_before": nu, "x_end": nx}
    given = {k: ca.MX.sym(k, v) for k, v in sizes.items()}
    ref, planes = ca.MX.sym("ref", 7 + nu, n), ca.MX.sym("plane", 4 * p.npl, n + 1)
    off, off_u = ca.MX.sym("off", nl, n + 1), ca.MX.sym("off_u", nu, n)
    cost: Any = 0.5 * ca.sumsqr(p.end(x[n], given["x_end"]))
    g, low, high = [], [], []
    values = p.model.parameter_values
    for k in range(n):
        before = u[k - 1] if k else given["u_before"]
        cost += 0.5 * ca.sumsqr(p.residual(x[k], u[k], before, ref[:, k]))
        g += [
            x[k + 1] - p.model["f_d"](x[k], u[k], values),
            u[k] - before,
            u[k] - off_u[:, k],
            u[k] + off_u[:, k],
        ]
        low += [
            np.zeros(nx),
            np.full(nu, -task.rate_max),
            np.full(nu, task.command_min),
            np.full(nu, -np.inf),
        ]
        high += [
            np.zeros(nx),
            np.full(nu, task.rate_max),
            np.full(nu, np.inf),
            np.full(nu, task.command_max),
        ]
        if k:
            g.append(p.limits(x[k], planes[:, k]) + off[:, k] - s[k - 1])
            low.append(np.full(nl, -np.inf))
            high.append(np.zeros(nl))
            cost += task.penalty * ca.sum1(s[k - 1]) + 0.5 * task.penalty_square * ca.sumsqr(
                s[k - 1]
            )
    parameters = ca.vertcat(*given.values(), *(ca.vec(v) for v in (ref, planes, off, off_u)))
    options = {
        "ipopt.print_level": 0,
        "print_time": False,
        "ipopt.tol": TOLERANCE,
        "ipopt.sb": "yes",
        "ipopt.hessian_approximation": hessian,
    }
    inner = ca.nlpsol(
        "ipopt",
        "ipopt",
        {"x": ca.vertcat(*x, *u, *s), "f": cost, "g": ca.vertcat(*g), "p": parameters},
        options,
    )
    free = np.full(n * nx, np.inf)

    def solve(found: dict[str, np.ndarray]) -> Answer:
        numbers = np.concatenate(
            [
                np.ravel(found[k])
                for k in ("u_before", "x_end", "ref", "plane", "backoff", "backoff_u")
            ]
        )
        start = np.concatenate(
            [np.tile(found["x0"], n + 1), np.tile(p.hover, n), np.zeros((n - 1) * nl)]
        )
        lower = np.concatenate(
            [found["x0"], -free, np.full(n * nu, task.command_min), np.zeros((n - 1) * nl)]
        )
        upper = np.concatenate(
            [found["x0"], free, np.full(n * nu, task.command_max), np.full((n - 1) * nl, np.inf)]
        )
        out, ms = timed(
            lambda: inner(
                x0=start,
                p=numbers,
                lbx=lower,
                ubx=upper,
                lbg=np.concatenate(low),
                ubg=np.concatenate(high),
            )
        )
        stats = inner.stats()
        plan = out["x"].full().ravel()[(n + 1) * nx : (n + 1) * nx + n * nu].reshape(n, nu)
        return {
            **ms,
            "iterations": stats["iter_count"],
            "good": stats["success"],
            "u": plan,
            "cost": float(out["f"]),
        }

    return solve


def with_do_mpc(problem: Problem) -> Callable[[dict[str, np.ndarray]], Answer]:
    """do-mpc with its own IPOPT; the command before is a state, slacks are inputs."""
    p, task = problem, problem.task
    model = do_mpc().model.Model("discrete", "MX")
    x, before = (
        model.set_variable("_x", k, shape=(v, 1)) for k, v in (("x", p.nx), ("before", p.nu))
    )
    u, s = (model.set_variable("_u", k, shape=(v, 1)) for k, v in (("u", p.nu), ("s", p.nl)))
    sizes = {"ref": 7 + p.nu, "plane": 4 * p.npl, "backoff": p.nl, "backoff_u": p.nu, "x_end": p.nx}
    tvp = {k: model.set_variable("_tvp", k, shape=(v, 1)) for k, v in sizes.items()}
    model.set_rhs("x", p.model["f_d"](x, u, p.model.parameter_values))
    model.set_rhs("before", u)
    model.setup()
    mpc = do_mpc().controller.MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step, mpc.settings.store_full_solution = (
        p.n,
        task.dt,
        False,
    )
    mpc.settings.supress_ipopt_output()
    mpc.settings.nlpsol_opts["ipopt.tol"] = TOLERANCE
    slack = task.penalty * ca.sum1(s) + 0.5 * task.penalty_square * ca.sumsqr(s)
    mpc.set_objective(
        lterm=0.5 * ca.sumsqr(p.residual(x, u, before, tvp["ref"])) + slack,
        mterm=0.5 * ca.sumsqr(p.end(x, tvp["x_end"])),
    )
    mpc.set_rterm(u=0.0, s=0.0)
    mpc.bounds["lower", "_u", "s"] = np.zeros((p.nl, 1))
    mpc.bounds["lower", "_u", "u"], mpc.bounds["upper", "_u", "u"] = (
        task.command_min,
        task.command_max,
    )
    mpc.set_nl_cons("limits", p.limits(x, tvp["plane"]) + tvp["backoff"] - s, ub=0.0)
    mpc.set_nl_cons("up", u - before - task.rate_max, ub=0.0)
    mpc.set_nl_cons("down", before - u - task.rate_max, ub=0.0)
    mpc.set_nl_cons("most", u + tvp["backoff_u"] - task.command_max, ub=0.0)
    mpc.set_nl_cons("least", task.command_min + tvp["backoff_u"] - u, ub=0.0)
    template, now = mpc.get_tvp_template(), {}

    def varying(_: float) -> Any:
        for k in range(p.n + 1):
            j = min(k, p.n - 1)
            rows = {
                "ref": now["ref"][j],
                "plane": now["plane"][k].ravel(),
                "backoff": now["backoff"][k],
            }
            for name, value in (
                rows | {"backoff_u": now["backoff_u"][j], "x_end": now["x_end"]}
            ).items():
                template["_tvp", k, name] = value
        return template

    now.update({k: np.zeros((p.n + 1, v)) for k, v in sizes.items()})
    now["x_end"] = np.zeros(p.nx)
    mpc.set_tvp_fun(varying)
    mpc.setup()

    def solve(found: dict[str, np.ndarray]) -> Answer:
        now.update(found)
        start = np.concatenate([found["x0"], found["u_before"]])
        mpc.reset_history()
        mpc.x0, mpc.u0 = start, np.concatenate([p.hover, np.zeros(p.nl)])
        mpc.set_initial_guess()
        first, ms = timed(lambda: mpc.make_step(start))
        stats = mpc.solver_stats
        plan = np.full((p.n, p.nu), np.nan)
        plan[0] = np.ravel(first)[: p.nu]
        return {
            **ms,
            "iterations": stats["iter_count"],
            "good": stats["success"],
            "u": plan,
            "cost": np.nan,
        }

    return solve


def with_acados(
    problem: Problem, home: Path, work: Path, kind: str
) -> Callable[[dict[str, np.ndarray]], Answer]:
    """acados with Gauss-Newton and HPIPM; kind "SQP" or "SQP_RTI"."""
    p, task = problem, problem.task
    solver = acados_solver(problem, home, work, kind, tolerance=TOLERANCE)

    def solve(found: dict[str, np.ndarray]) -> Answer:
        start = np.concatenate([found["x0"], found["u_before"]])
        solver.reset()
        for k in range(p.n + 1):
            j = min(k, p.n - 1)
            solver.set(k, "x", start)
            solver.set(
                k, "p", np.concatenate([found["ref"][j], found["plane"][k].ravel(), found["x_end"]])
            )
            if k < p.n:
                solver.set(k, "u", p.hover)
                solver.constraints_set(k, "lbu", task.command_min + found["backoff_u"][k])
                solver.constraints_set(k, "ubu", task.command_max - found["backoff_u"][k])
            if 0 < k < p.n:
                solver.constraints_set(k, "uh", -found["backoff"][k])
        for side in ("lbx", "ubx"):
            solver.constraints_set(0, side, start)
        status, ms = timed(solver.solve)
        plan = np.array([solver.get(k, "u") for k in range(p.n)])
        count = int(np.max(solver.get_stats("sqp_iter"))) if kind == "SQP" else 1
        answer = {
            **ms,
            "iterations": count,
            "good": status == 0,
            "u": plan,
            "cost": float(solver.get_cost()),
        }
        # by acados' own clock, which is wall time: only their ratio says something on a crowded
        # machine
        answer["qp iterations"] = int(np.sum(solver.get_stats("qp_iter")))
        return answer | {
            k: 1e3 * float(np.sum(solver.get_stats(f"time_{k}"))) for k in ("lin", "qp")
        }

    return solve


# ----------------------------------------------------------------------------------------- report


def compared(
    solvers: dict[str, Any], problems: list[dict[str, np.ndarray]], points: int
) -> list[dict[str, Any]]:
    """A row per solver; the quick ones solve every problem five times and their median counts."""
    answers: dict[str, list[Answer]] = {name: [] for name in solvers}
    for i, given in enumerate(problems):
        for name, solve in solvers.items():
            runs = [solve(given)]
            if runs[0]["wall"] < 200.0:
                runs += [solve(given) for _ in range(4)]
            middle = {k: float(np.median([r[k] for r in runs])) for k in ("wall", "cpu")}
            answers[name].append(runs[-1] | middle)
        print(
            f"problem {i + 1} of {len(problems)}",
            {n: round(a[-1]["cpu"], 1) for n, a in answers.items()},
            flush=True,
        )
    base = answers["ours"]
    rows = []
    for name, found in answers.items():
        both = [i for i, a in enumerate(found) if a["good"] and base[i]["good"]]
        row: dict[str, Any] = {
            "what": "cold start to 1e-6",
            "solver": name,
            "points": points,
            "problems": len(found),
        }
        row["solved"] = sum(bool(a["good"]) for a in found)
        for clock in ("cpu", "wall"):
            row[f"{clock} median"] = round(float(np.median([a[clock] for a in found])), 3)
            row[f"{clock} over ours"] = round(
                float(np.median([a[clock] / b[clock] for a, b in zip(found, base)])), 2
            )
        row["iterations"] = float(np.median([a["iterations"] for a in found]))
        row["cpu per iteration"] = round(
            float(np.median([a["cpu"] / max(a["iterations"], 1) for a in found])), 3
        )
        if "qp iterations" in found[0]:
            row["QP iterations"] = float(np.median([a["qp iterations"] for a in found]))
        if "lin" in found[0]:
            row["linearisation over QP, wall"] = round(
                float(np.median([a["lin"] / a["qp"] for a in found])), 2
            )
        gaps = [np.nanmax(np.abs(found[i]["u"] - base[i]["u"])) for i in both]
        row["largest difference of commands"] = float(np.max(gaps)) if gaps else None
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--models", type=Path, required=True)
    parser.add_argument("--points", type=int, nargs="+", default=[50, 100])
    parser.add_argument("--acados", default=os.environ.get("GREYBOX_ACADOS"))
    parser.add_argument("--flights", type=int, default=3)
    parser.add_argument("--problems", type=int, default=8)
    parser.add_argument("--out", type=Path, default=RESULTS / "tube_speed.json")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    load = [os.getloadavg()[0]]
    with ExitStack() as stack:
        home = stack.enter_context(session(arguments.acados)) if arguments.acados else None
        work = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for points in arguments.points:
            row, pilot, problems = in_flight(
                identified(arguments.models, points), arguments.flights, arguments.problems
            )
            rows.append(row)
            print(json.dumps(row, indent=1), flush=True)
            problem = Problem(pilot.solver)
            solvers: dict[str, Any] = {
                "ours": ours(problem),
                "IPOPT, exact Hessian, VM": ipopt(problem, "exact"),
            }
            solvers["IPOPT, BFGS, VM"] = ipopt(problem, "limited-memory")
            solvers["do-mpc"] = with_do_mpc(problem)
            if home is not None:
                solvers["acados SQP"] = with_acados(problem, home, work, "SQP")
                solvers["acados one RTI"] = with_acados(problem, home, work, "SQP_RTI")
            rows += compared(solvers, problems, points)
            load.append(os.getloadavg()[0])
    for row in rows:
        if "solver" in row:
            print(json.dumps(row))
    print(f"load {load}")
    content = {
        "question": "How long does a step of the tube controller take, and the same problem solved "
        "to the end, next to IPOPT, do-mpc and acados?",
        "unit": "ms, wall and CPU time of the thread",
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "load": load,
        "deadline": 1e3 * DEADLINE,
        "rows": rows,
    }
    arguments.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
