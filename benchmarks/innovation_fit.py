"""How fast is the innovation-form fit against peers on the same model and data?

One simulated flight of a nano quadrotor (20 s at 100 Hz, N = 2000, closed loop, process noise); a
model with 17 states (rigid body with quaternion, four rotors) and 13 free parameters, every one
started 25 % off. Noise levels and the initial state are held, because that is what every peer can
do. One BLAS thread, every competitor in a process of its own.

    python -m benchmarks.innovation_fit [--aeroid-python PYTHON] [--cap 600] [--only NAME,...]
    [--runs 5]

All of the rows "gain held" minimise the same sum, 1/2 sum |S^-1/2 e_k|^2 over the innovations of
x(k+1) = F(x(k), u_k) boxplus K e_k, with K and S of the start values. The row `greybox` is the fit
as users get it: K and S follow the parameters, their derivatives included, and log det S counts.
AeroID runs its own filter-error method, an extended Kalman filter in raw coordinates, on the same
differential equations. Whatever they minimise, the final parameters of all are judged by one
function: the log likelihood of the stationary innovation form.
"""

from __future__ import annotations

import argparse
import ctypes
import datetime
import json
import os
import platform
import resource
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import numpy as np  # noqa: E402 (after the thread counts)

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
EFFECTS = ("motor_lag", "rotor_drag", "blade_flapping", "rotational_damping")
TRUTH = {
    "inertia.xx": 1.43e-5,
    "inertia.yy": 1.43e-5,
    "inertia.zz": 2.89e-5,
    "thrust.c2": 0.14375,
    "torque.c2": 9.75e-4,
    "center_of_mass.x": 1e-3,
    "motor_lag.tau": 0.05,
    "rotor_drag.k_x": 2.0e-6,
    "rotor_drag.k_y": 2.5e-6,
    "blade_flapping.k_flap": 2.5e-8,
    "rotational_damping.d_p": 2e-5,
    "rotational_damping.d_q": 3e-5,
    "rotational_damping.d_r": 1e-5,
}
"""The free parameters and what they are in the plant."""
START = {n: v * (1.25 if i % 2 else 0.75) for i, (n, v) in enumerate(TRUTH.items())}
SECONDS = 20.0
OURS = ("greybox", "greybox, gain held", "scipy trf on our compiled residual, gain held")
PEERS = (
    "scipy trf, finite differences, MX step in the VM",
    "scipy trf, finite differences, SX step in the VM",
    "IPOPT Gauss-Newton, MX step in the VM",
    "IPOPT Gauss-Newton, SX step in the VM",
    "IPOPT exact Hessian, MX step in the VM",
    "IPOPT exact Hessian, SX step in the VM",
    "AeroID filter error",
)


# --------------------------------------------------------------------------------------- the case


def make_case(folder: Path) -> None:
    """Fly the plant; leave log.npz and vehicle.toml in `folder`."""
    from greybox.excitation.injection import rich_excitation
    from greybox.excitation.waypoints import RandomWaypoints
    from greybox.plants import effects as plant_effects
    from greybox.plants.flight_log import fly
    from greybox.plants.presets import controller_for, nano
    from greybox.plants.vehicle_file import write_vehicle

    plant = nano(
        [
            plant_effects.MotorLag(tau=0.05),
            plant_effects.RotorDrag(k_x=2.0e-6, k_y=2.5e-6),
            plant_effects.BladeFlapping(k_flap=2.5e-8),
            plant_effects.CenterOfMassOffset(c_x=1e-3),
            plant_effects.RotationalDamping(d_p=2e-5, d_q=3e-5, d_r=1e-5),
        ]
    )
    log = fly(
        plant,
        controller_for(plant),
        RandomWaypoints(),
        rich_excitation(),
        SECONDS,
        seed=1,
        warm_up=1.0,
    )
    np.savez(folder / "log.npz", **{k: v for k, v in log.items() if not k.startswith("omega")})
    write_vehicle(folder / "vehicle.toml", plant)


def load(folder: Path) -> tuple[Any, Any]:
    """(model, data) of the case."""
    from greybox import build_model, dataset_from_arrays, read_vehicle

    with np.load(folder / "log.npz") as log:
        data = dataset_from_arrays(
            log["t"], {k: log[k] for k in log.files if k != "t"}, name="flight"
        )
    return build_model(read_vehicle(str(folder / "vehicle.toml")), data.channels, EFFECTS), data


def problem_of(model: Any, data: Any, predictor: Any = None) -> Any:
    """The fit as a minimisation: 13 unknowns without priors, noise levels and initial state
    held."""
    from greybox.estimation.criteria.gaussian import Gaussian
    from greybox.estimation.predictors.innovation import Innovation
    from greybox.estimation.problem import make_problem

    return make_problem(
        model,
        data,
        predictor=predictor or Innovation(),
        criterion=Gaussian(),
        free=list(TRUTH),
        values=START,
        priors={n: (v, float("inf")) for n, v in START.items()},
        estimate_noise=False,
        estimate_initial=False,
    )


def held_predictor() -> Any:
    """The innovation form whose gain and covariance stay those of the start values."""
    from greybox.estimation.gain import Riccati
    from greybox.estimation.predictors.innovation import Innovation, StationaryGain
    from greybox.estimation.settling import RecordGains, held

    class GainHeld(StationaryGain[Riccati]):
        name = "innovation"

        def prepare(self, problem: Any) -> Riccati:
            return Innovation().riccati(problem, problem.start, False)

        def gains(self, problem: Any, theta: Any, slopes: bool) -> list[RecordGains]:
            return [held(problem.prepared(self), r) for r in problem.records]

    return GainHeld()


def natural(problem: Any) -> np.ndarray:
    """The unknowns' sizes, by which every competitor scales them."""
    return np.array([u.start for u in problem.unknowns])


class Clock:
    """CPU seconds of this process and wall seconds since it was made."""

    def __init__(self) -> None:
        self.cpu, self.wall = _cpu(), time.perf_counter()

    def read(self) -> tuple[float, float]:
        return _cpu() - self.cpu, time.perf_counter() - self.wall


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


# ------------------------------------------------------------------------------------ competitors


def run_ours(name: str, folder: Path, runs: int) -> dict[str, Any]:
    """Our fits: the first set-up in a process, then set-up and solution `runs` times."""
    from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt

    model, data = load(folder)
    held = "held" in name
    first = Clock()
    problem_of(model, data, held_predictor() if held else None)
    rows: dict[str, Any] = {"first_setup": first.read(), "setup": [], "solve": []}
    theta, converged, evaluations = None, False, 0
    for _ in range(runs):
        clock = Clock()
        problem = problem_of(model, data, held_predictor() if held else None)
        rows["setup"].append(clock.read())
        clock = Clock()
        if name.startswith("scipy"):
            theta, converged, evaluations = _trf_compiled(problem)
        else:
            theta, status = LevenbergMarquardt().solve(problem, problem.start)
            converged, evaluations = status.converged, status.evaluations
        rows["solve"].append(clock.read())
    return rows | {
        "theta": list(theta),
        "converged": bool(converged),
        "evaluations": int(evaluations),
        "evaluation": evaluation(problem),
    }


def evaluation(problem: Any, runs: int = 31) -> dict[str, float]:
    """What one pass for residuals and Jacobian costs: median CPU milliseconds `with_gain` and its
    slopes, and of the `samples` alone, whose arithmetic is counted, in millions of `operations`."""
    predictor, engine, record = problem.predictor, problem.engine, problem.records[0]
    filters = predictor.gains(problem, problem.start, True)[0]
    gains, _, _ = filters.tables()

    def samples() -> None:
        engine.run(
            x0=record.x0,
            inputs=record.inputs,
            outputs=record.outputs,
            mask=record.mask,
            pattern=filters.pattern,
            gains=gains,
            p=problem.base,
            dt=record.dt,
            s0=np.zeros((engine.nd, problem.n)),
            want=frozenset({"innovations", "sensitivity"}),
        )

    def with_gain() -> None:
        list(predictor.blocks(problem, problem.start, True))

    took: dict[str, list[float]] = {"with_gain": [], "samples": []}
    for _ in range(runs):
        for name, call in (("with_gain", with_gain), ("samples", samples)):
            clock = Clock()
            call()
            took[name].append(clock.read()[0])
    count = record.n * operations(engine, problem.n, gains.derivative is not None)
    return {k: 1e3 * statistics.median(v) for k, v in took.items()} | {"operations": 1e-6 * count}


def operations(engine: Any, n: int, moving_gain: bool) -> int:
    """Additions, multiplications and function calls of one sample with `n` parameters: of the step,
    of its slopes, and of the sparse products that carry the sensitivities S on (d: correction)."""
    from greybox.symbolic import operation_names

    names = operation_names()
    idle = {"INPUT", "OUTPUT", "CONST", "ASSIGN"}
    functions = (engine.value, engine.slope, engine.move, engine.turn)
    expressions = sum(
        names[f.instruction_id(k)] not in idle for f in functions for k in range(f.n_instructions())
    )
    a, b, ex, ep = (engine.slope.nnz_out(i) for i in range(4))
    j1, j2 = (engine.turn.nnz_out(i) for i in range(2))
    dense = engine.nd * engine.ne  # d = K e: dd = K de + dK e
    products = 2 * n * (a + ex + j1 + j2 + dense * (2 if moving_gain else 1))
    return expressions + products + b + ep


def _trf_compiled(problem: Any) -> tuple[Any, bool, int]:
    """scipy's trust region on the whitened residuals and exact Jacobian of our engine."""
    import scipy.optimize

    scale, memory = natural(problem), {}

    def at(z: np.ndarray) -> Any:
        key = z.tobytes()
        if key not in memory:
            memory.clear()
            block = next(iter(problem.predictor.blocks(problem, z * scale, True)))
            root = np.linalg.inv(np.linalg.cholesky(block.covariance[0]))
            slope = (root @ block.jacobian).reshape(-1, z.size)[:, np.argsort(block.columns)]
            memory[key] = (block.e @ root.T).ravel(), slope * scale
        return memory[key]

    out = scipy.optimize.least_squares(
        lambda z: at(z)[0], problem.start / scale, lambda z: at(z)[1]
    )
    return out.x * scale, out.status > 0, out.nfev


def vm_residual(problem: Any, kind: str) -> tuple[Any, Any]:
    """(unknowns (13, scaled), whitened innovations): mapaccum of the predictor step, as CasADi's
    users write it.

    kind "MX": the step itself is an MX graph, the natural form; "SX": the step is expanded to
    scalars first, which the virtual machine runs several times faster.
    """
    import casadi as ca

    d, record = problem.dynamics, problem.records[0]
    riccati = problem.prepared(problem.predictor)
    gain, covariance, _, _ = riccati.gain(record.patterns[0])
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    sym = {"SX": ca.SX, "MX": ca.MX}[kind]
    x, u = sym.sym("x", len(d.states)), sym.sym("u", len(d.inputs))
    y, z = sym.sym("y", len(d.outputs)), sym.sym("z", problem.n)
    p = sym(ca.DM(problem.base))
    for i, unknown in enumerate(problem.unknowns):
        p[[q.name for q in d.parameters].index(unknown.name)] = natural(problem)[i] * z[i]
    quiet = ca.DM.zeros(len(d.noises))
    predicted = d.output(0, x, u, p, quiet, problem.dt)
    e = d.innovation(y, predicted, x)
    after = d.boxplus(d.step(0, x, u, p, quiet, problem.dt), ca.DM(gain) @ e)
    step = ca.Function("step", [x, u, y, z], [after, ca.DM(root) @ e])
    unknowns = ca.MX.sym("z", problem.n)
    _, whitened = step.mapaccum("record", record.n)(
        ca.DM(record.x0),
        ca.DM(record.inputs.T),
        ca.DM(record.outputs.T),
        ca.repmat(unknowns, 1, record.n),
    )
    return unknowns, ca.vec(whitened)


def run_vm(name: str, folder: Path) -> dict[str, Any]:
    """scipy or IPOPT on the predictor in CasADi's virtual machine."""
    import casadi as ca
    import scipy.optimize

    problem = problem_of(*load(folder), held_predictor())
    scale, kind = natural(problem), "SX" if "SX" in name else "MX"
    clock = Clock()
    z, r = vm_residual(problem, kind)
    start = problem.start / scale
    if name.startswith("scipy"):
        residual = ca.Function("residual", [z], [r])
        setup, clock = clock.read(), Clock()
        out = scipy.optimize.least_squares(
            lambda v: residual(v).full().ravel(), start, method="trf"
        )
        x, converged, evaluations = out.x, out.status > 0, out.nfev
    else:
        f = 0.5 * ca.sumsqr(r)
        options: dict[str, Any] = {
            "ipopt.print_level": 0,
            "print_time": False,
            "ipopt.tol": 1e-6,
            "ipopt.sb": "yes",
        }
        if "Gauss-Newton" in name:
            slope = ca.jacobian(r, z)
            none, factor, multipliers = (
                ca.MX.sym("none", 0),
                ca.MX.sym("factor"),
                ca.MX.sym("multipliers", 0),
            )
            options["hess_lag"] = ca.Function(
                "gauss_newton",
                [z, none, factor, multipliers],
                [ca.triu(factor * (slope.T @ slope))],
                ["x", "p", "lam_f", "lam_g"],
                ["triu_hess_gamma_x_x"],
            )
        solver = ca.nlpsol("solver", "ipopt", {"x": z, "f": f}, options)
        setup, clock = clock.read(), Clock()
        out = solver(x0=start)
        stats = solver.stats()
        x, converged, evaluations = out["x"].full().ravel(), stats["success"], stats["iter_count"]
    return {
        "setup": [setup],
        "solve": [clock.read()],
        "theta": list(x * scale),
        "converged": bool(converged),
        "evaluations": int(evaluations),
    }


def write_aeroid(folder: Path) -> None:
    """The differential equations as C (dynamics.so) and the numbers of the case (aeroid.npz) for
    the other interpreter.

    AeroID gets them as callbacks that take a microsecond, far less than hand-written NumPy would
    need.
    """
    import casadi as ca

    from greybox.estimation.build import build

    problem = problem_of(*load(folder))
    d, record = problem.dynamics, problem.records[0]
    x, u = ca.SX.sym("x", len(d.states)), ca.SX.sym("u", len(d.inputs))
    free = ca.SX.sym("free", problem.n)
    p = ca.SX(ca.DM(problem.base))
    for i, unknown in enumerate(problem.unknowns):
        p[[q.name for q in d.parameters].index(unknown.name)] = free[i]
    generator = ca.CodeGenerator("dynamics.c", {"with_header": False})
    generator.add(ca.Function("f", [x, u, free], [ca.densify(d.f(0, x, u, p))]))
    generator.add(ca.Function("h", [x, u, free], [ca.densify(d.h(0, x, u, p))]))
    library = build([("dynamics.c", generator.dump(), ("-O2", "-fPIC", "-w"))])
    (folder / "dynamics.so").write_bytes(library.read_bytes())
    process, sensor = problem.noise_levels(problem.start)
    by_name = dict(zip(d.innovations.names, sensor))
    values = {n: problem.base[i] for i, n in enumerate(q.name for q in d.parameters)}
    mass = values["mass"]
    # Raw coordinates: a quaternion component moves by half an angle; the force noise reaches the
    # accelerometer too.
    noise_of = {"q": 0.5 * by_name["attitude.x"]}
    measured = [
        noise_of["q"] if n in ("qw", "qx", "qy", "qz") else _level(by_name, n)
        for n in d.outputs.names
    ]
    variance = np.square(measured)
    variance[[n in ("ax", "ay", "az") for n in d.outputs.names]] += (process[0] / mass) ** 2
    spectrum, spread = np.zeros(len(d.states)), np.zeros(len(d.states))
    sigma = dict(zip(d.error_states.names, record.x0_sigma))
    for i, n in enumerate(d.states.names):
        block, axis = n.split(".")
        if block == "velocity":
            spectrum[i] = (process[0] / mass) ** 2 * problem.dt
        if block == "rate":
            spectrum[i] = (
                process[3 + "xyz".index(axis)] / values[f"inertia.{axis}{axis}"]
            ) ** 2 * problem.dt
        spread[i] = 0.5 * sigma["d_attitude.x"] if block == "attitude" else sigma[f"d_{n}"]
    np.savez(
        folder / "aeroid.npz",
        states=d.states.names,
        inputs=d.inputs.names,
        outputs=d.outputs.names,
        names=[q.name for q in problem.unknowns],
        start=problem.start,
        t=problem.dt * np.arange(record.n),
        u=record.inputs,
        y=record.outputs,
        x0=record.x0,
        spectrum=spectrum,
        variance=variance,
        spread=spread**2,
        dt=problem.dt,
    )


def _level(levels: dict[str, float], column: str) -> float:
    renamed = {"x": "position.x", "y": "position.y", "z": "position.z"}
    renamed |= {"vx": "velocity.x", "vy": "velocity.y", "vz": "velocity.z"}
    return levels[renamed.get(column, column)]


def run_aeroid(folder: Path) -> dict[str, Any]:
    """AeroID's filter-error method. Needs numpy, scipy and aeroid only."""
    import aeroid

    case = np.load(folder / "aeroid.npz")
    names = [str(n) for n in case["names"]]
    u, dt = np.ascontiguousarray(case["u"]), float(case["dt"])
    library = ctypes.CDLL(str(folder / "dynamics.so"))
    x_in, u_in, p_in = np.zeros(case["x0"].size), np.zeros(u.shape[1]), np.zeros(len(names))
    memory: dict[str, Any] = {"params": None, "held": 0, "middle": False}

    def wrap(function: Any, size: int) -> Callable[[Any, Any, Any], np.ndarray]:
        out = np.zeros(size)
        arguments = (ctypes.c_void_p * 16)(x_in.ctypes.data, u_in.ctypes.data, p_in.ctypes.data)
        results = (ctypes.c_void_p * 16)(out.ctypes.data)
        integers, reals = (ctypes.c_longlong * 16)(), (ctypes.c_double * 4096)()

        def call(x: Any, command: Any, params: Any) -> np.ndarray:
            x_in[:], u_in[:] = x, command
            if params is not memory["params"]:
                memory["params"] = params
                p_in[:] = [params[n] for n in names]
            function(arguments, results, integers, reals, 0)
            return out.copy()

        return call

    f, h = wrap(library.f, x_in.size), wrap(library.h, case["outputs"].size)

    def dynamics(t: float, x: Any, _: Any, params: Any) -> np.ndarray:
        # AeroID would run the command linearly between samples; the log's commands are held. The
        # four stages come in order: start, twice the middle, end; the end of a step still sees the
        # step's own command.
        place = t / dt
        if 0.25 < place % 1.0 < 0.75:
            memory["held"], memory["middle"] = int(place), True
        elif memory["middle"]:
            memory["middle"] = False
        else:
            memory["held"] = round(place)
        return f(x, u[memory["held"]], params)

    columns = {str(n): u[:, i] for i, n in enumerate(case["inputs"])}
    columns |= {str(n): case["y"][:, i] for i, n in enumerate(case["outputs"])}
    model = aeroid.Model(
        states=[str(n) for n in case["states"]],
        controls=[str(n) for n in case["inputs"]],
        parameters=dict(zip(names, map(float, case["start"]))),
        dynamics=dynamics,
        outputs=[str(n) for n in case["outputs"]],
        measurement=lambda t, x, command, params: h(x, command, params),
    )
    data = aeroid.FlightData(time=case["t"], channels=columns)

    def note(intermediate_result: Any) -> None:
        (folder / "aeroid_theta.json").write_text(
            json.dumps(list(intermediate_result.x * np.abs(case["start"])))
        )

    clock = Clock()
    result = aeroid.identify(
        model,
        data,
        names,
        method="filter_error",
        x0=case["x0"],
        process_noise=np.diag(case["spectrum"]),
        measurement_noise=np.diag(case["variance"]),
        filter_options={"P0": np.diag(case["spread"])},
        optimizer_options={"callback": note},
    )
    return {
        "setup": [(0.0, 0.0)],
        "solve": [clock.read()],
        "theta": [result.parameters[n] for n in names],
        "converged": result.success,
        "evaluations": result.n_evaluations,
    }


# -------------------------------------------------------------------------------------- the table


def compete(name: str, folder: Path, cap: float, runs: int, python: str) -> dict[str, Any]:
    """Run one competitor in a process of its own; `capped` where it took more than `cap` seconds of
    CPU time."""
    command = [
        python,
        str(Path(__file__).resolve()),
        "--one",
        name,
        "--folder",
        str(folder),
        "--runs",
        str(runs),
    ]
    # An interpreter of another environment must not see this one's packages.
    environment = (
        dict(os.environ, PYTHONPATH=str(HERE.parent))
        if python == sys.executable
        else dict(os.environ)
    )
    clock = Clock()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    limit = int(np.ceil(cap))
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        env=environment,
        cwd=folder,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5)),
    )
    if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        row: dict[str, Any] = {
            "setup": [(0.0, 0.0)],
            "capped": True,
            "converged": False,
            "theta": None,
        }
        row["solve"] = [
            (after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime, clock.read()[1])
        ]
        noted = folder / "aeroid_theta.json"
        if name.startswith("AeroID") and noted.exists():
            row["theta"] = json.loads(noted.read_text())
        return row | {"evaluations": None}
    if done.returncode:
        return {"error": (done.stderr.strip().splitlines() or ["no output"])[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def _median(rows: Sequence[Sequence[float]], which: int = 0) -> float:
    return statistics.median(r[which] for r in rows)


def main(argv: Sequence[str] | None = None) -> None:
    """Run all competitors, print the table and write results/innovation_fit.json."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument(
        "--aeroid-python", default=sys.executable, help="interpreter of an environment with aeroid"
    )
    parser.add_argument(
        "--cap", type=float, default=600.0, help="CPU seconds after which a peer is stopped"
    )
    parser.add_argument("--runs", type=int, default=5, help="runs of ours before every peer")
    parser.add_argument("--only", default="", help="parts of the peers' names, separated by commas")
    parser.add_argument("--out", type=Path, default=RESULTS / "innovation_fit.json")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.one:
        name, folder = arguments.one, arguments.folder
        if name in OURS:
            row = run_ours(name, folder, arguments.runs)
        else:
            row = run_aeroid(folder) if name.startswith("AeroID") else run_vm(name, folder)
        print(json.dumps(row))
        return
    wanted = [w.strip() for w in arguments.only.split(",") if w.strip()]
    peers = [p for p in PEERS if not wanted or any(w in p for w in wanted)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_case(folder)
        problem = problem_of(*load(folder))  # also fills the build cache
        if any(p.startswith("AeroID") for p in peers):
            write_aeroid(folder)
        rows: dict[str, dict[str, Any]] = {}

        def ours(who: str) -> None:
            new = compete(who, folder, arguments.cap, arguments.runs, sys.executable)
            if "error" in new:
                raise SystemExit(f"{who}: {new['error']}")
            if who in rows:
                for key in ("setup", "solve"):
                    new[key] = rows[who][key] + new[key]
                new["first_setup"] = rows[who]["first_setup"]
            rows[who] = new

        for who in OURS:
            ours(who)
        for peer in peers:
            python = arguments.aeroid_python if peer.startswith("AeroID") else sys.executable
            print(f"running {peer} ...", file=sys.stderr, flush=True)
            rows[peer] = compete(peer, folder, arguments.cap, 1, python)
            ours(OURS[0])  # interleaved: what else the machine does hits all alike
    table = []
    base = _median(rows[OURS[0]]["solve"])
    base_total = base + rows[OURS[0]]["first_setup"][0]
    for who, row in rows.items():
        if "error" in row:
            table.append({"who": who, "error": row["error"]})
            continue
        solve = _median(row["solve"])
        setup = row["first_setup"][0] if "first_setup" in row else _median(row["setup"])
        loglik = None
        if row["theta"] is not None:
            loglik = -problem.evaluate(np.array(row["theta"]), 0).likelihood
        table.append(
            {
                "who": who,
                "solve_cpu_s": solve,
                "solve_wall_s": _median(row["solve"], 1),
                "setup_cpu_s": setup,
                "setup_again_cpu_s": _median(row["setup"]),
                "ratio_solve": solve / base,
                "ratio_with_setup": (solve + setup) / base_total,
                "log_likelihood": loglik,
                "converged": row["converged"],
                "evaluations": row["evaluations"],
                "capped": row.get("capped", False),
                "runs": len(row["solve"]),
                "parameters": row["theta"],
                "date": datetime.date.today().isoformat(),
            }
            | ({"evaluation": row["evaluation"]} if "evaluation" in row else {})
        )
    print(render(table))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    ran = [r["who"] for r in table]
    if arguments.out.exists():  # peers that did not run keep their row, with the ratio of its day
        kept = json.loads(arguments.out.read_text())["rows"]
        table += [r for r in kept if r["who"] not in ran]
    result = {
        "question": __doc__.splitlines()[0] if __doc__ else "",
        "samples": problem.records[0].n,
        "states": len(problem.dynamics.states),
        "parameters": [u.name for u in problem.unknowns],
        "start": list(problem.start),
        "truth": [TRUTH[u.name] for u in problem.unknowns],
        "log_likelihood_at_truth": -problem.evaluate(
            np.array([TRUTH[u.name] for u in problem.unknowns]), 0
        ).likelihood,
        "machine": {
            "processor": platform.machine(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
        },
        "load_at_end": os.getloadavg()[0],
        "rows": table,
    }
    arguments.out.write_text(json.dumps(result, indent=1) + "\n")


def render(table: Sequence[dict[str, Any]]) -> str:
    """The table as text."""
    lines = [
        f"{'who':50s} {'solve':>9s} {'ratio':>8s} {'set-up':>8s} {'ratio':>8s} {'log lik.':>11s}  "
        "converged (evaluations)",
        f"{'':50s} {'CPU s':>9s} {'':>8s} {'CPU s':>8s} {'of sums':>8s}",
    ]
    for r in table:
        if "error" in r:
            lines.append(f"{r['who']:50s} failed: {r['error']}")
            continue
        more = ">" if r["capped"] else ""
        loglik = "-" if r["log_likelihood"] is None else f"{r['log_likelihood']:.3f}"
        done = (
            "stopped at the cap"
            if r["capped"]
            else f"{'yes' if r['converged'] else 'no'} ({r['evaluations']})"
        )
        lines.append(
            f"{r['who']:50s} {more + format(r['solve_cpu_s'], '.3f'):>9s} "
            f"{more + format(r['ratio_solve'], '.1f'):>8s} {r['setup_cpu_s']:8.2f} "
            f"{more + format(r['ratio_with_setup'], '.1f'):>8s} {loglik:>11s}  {done}"
        )
    lines += ["", "one evaluation of residuals and Jacobian, CPU:"]
    for r in table:
        if said := r.get("evaluation"):
            lines.append(
                f"{r['who']:50s} {said['with_gain']:.1f} ms with the gain, without it "
                f"{said['samples']:.1f} ms for {said['operations']:.1f} million operations: "
                f"{said['operations'] / said['samples']:.2f} in a nanosecond"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
