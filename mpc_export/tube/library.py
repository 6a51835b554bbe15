"""The tube MPC as one C library: NAME_tube.h and .c, with static memory and nothing to link but libm.

One call takes measurements and gives the next command. In it are the identified filter with its
gate and its rival, the steady state, the plan with its tube, the QP, condensed or by Riccati recursions, and the
fallback: the controller of controller.py without calibration, adaptation and the declared descent,
which is a bit in the answer instead.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np

from greybox.errors import ModelError
from greybox.files import write_atomic
from greybox.symbolic import FloatArray
from mpc_export.adaptation import UNBOUNDED
from mpc_export.c_code import CSource, Real, single_precision, write_c
from mpc_export.c_kernels import kernels_of
from mpc_export.c_names import renamed
from mpc_export.c_text import broken
from mpc_export.feedback import NEAR
from mpc_export.template import filled, places_in
from mpc_export.tube import linear as linear_library
from mpc_export.tube.clock import EARLY, LATE
from mpc_export.tube.controller import (
    FAILURES,
    NEAR_STEADY,
    ROUNDING,
    SLACK,
    Reference,
    TubeController,
    near_heading,
)
from mpc_export.tube.descent import HELD, Way
from mpc_export.tube.estimator import MEASURED
from mpc_export.tube.heading import TURN
from mpc_export.tube.rival import BELIEVED, CLEARLY
from mpc_export.tube.solver import COARSE, PRIMAL, QP, QP_TOLERANCE, driver, settled
from mpc_export.tube.stages import block
from mpc_export.tube.told import PRESENT, PUSH, SLOW, heaviest

CONDENSED = 20
"""Stages up to which the QP is condensed: its work grows with their cube, that of a Riccati recursion
with their number."""
QP_ITERATIONS = 12
"""Iterations of the QP at most: what is found then is the plan, if it keeps its limits."""
MEMORY = """  tube_solver solver;
  tube_data data;
  tube_real steady_x[NX], steady_u[NU];
  tube_real plan_x[N + 1][NX], plan_u[N][NU]; /* that of the last solution */
  tube_real kappa_u;
  int adrift, has_plan, plan_age, failures;
"""
"""What plans keep in the library's memory."""
Words: TypeAlias = dict[str, str | float]
"""What stands in the templates: C as it is, or a number."""
Number: TypeAlias = float | np.generic


def write_library(
    pilot: TubeController, folder: Path, *, name: str, real: Real, linear: bool = False
) -> tuple[tuple[Path, ...], dict[str, str]]:
    """Write the library of `pilot` into `folder`; returns its C files, and the words of their
    templates. linear: the linear tube (linear.py).

    Raises `ModelError` for a controller that calibrates, adapts or has no planes: those stay on a
    desktop.
    """
    if pilot.calibrate or pilot.adapt is not None:
        raise ModelError("a controller that calibrates or adapts has no C library", fix="leave it")
    if not pilot.problem.planes:
        raise ModelError("the C library has room for at least one plane", got="planes = 0")
    f = pilot.functions
    made = {n: v for n, v in pilot.solver.stages.functions.items() if n != "tube_spread"}
    needed = [f["boxminus"]] if linear else [*made.values(), f["target_step"], f["boxminus"]]
    kernels = kernels_of(pilot.functions)
    model = write_c(needed, folder, prefix=f"{name}_tube_model", real=real, kernels=kernels)
    own = write_c(
        [pilot.filter["filter_step"]],
        folder,
        prefix=f"{name}_tube_filter",
        real=real,
        kernels=kernels_of(pilot.filter),
    )
    words = _words(pilot, own, name, real)
    if linear:
        words |= linear_library.words(pilot, name)
    write_atomic(folder / f"{name}_tube.h", broken(filled_with("tube/tube.h", words)))
    text = _linear(pilot, model, words) if linear else _nonlinear(pilot, model, words)
    text = single_precision(text) if real == "float" else text
    includes = [f'#include "{name}_{part}.h"\n' for part in ("tube", "tube_model", "tube_filter")]
    write_atomic(folder / f"{name}_tube.c", broken("".join([*includes, text])))
    ends = ("tube", "tube_model", "tube_filter")
    return tuple(folder / f"{name}_{end}.c" for end in ends), words


def _nonlinear(pilot: TubeController, model: CSource, words: Mapping[str, str]) -> str:
    qp: QP = "condensed" if pilot.problem.horizon <= CONDENSED else "riccati"
    stages = pilot.solver.stages
    bent = matrix(stages.bent.reshape(len(stages.bent), -1))
    own = driver("", settled(pilot.solver.sizes, stages, model), "double", qp)
    texts = [
        # the controller knows its model by a name of its own
        renamed(own, "tube_model_", f"{model.prefix}_"),
        f"static const tube_real bent[N + 1][ND * ND] = {bent};\n",
        *(filled_with(f"tube/{part}.c", words) for part in ("sample", "plan", "call")),
    ]
    return "".join(texts)


def _linear(pilot: TubeController, model: CSource, words: Mapping[str, str]) -> str:
    libraries, text = linear_library.driver()
    parts = (filled_with(f"tube/{part}.c", words) for part in ("sample", "linear", "call"))
    return "".join([libraries, linear_library.settled(pilot, model), text, *parts])


def filled_with(template: str, words: Mapping[str, str]) -> str:
    """The template with those of the words that it asks for."""
    own = places_in(template)
    return filled(template, **{k: v for k, v in words.items() if k in own})


def braced(values: Iterable[Number]) -> str:
    """Numbers as an initialiser of C."""
    numbers = [repr(v.item() if isinstance(v, np.generic) else v) for v in values]
    return f"{{{', '.join(numbers) or '0'}}}"


def matrix(values: Iterable[Iterable[Number]]) -> str:
    """Rows of numbers as an initialiser of C."""
    return "{\n  " + ",\n  ".join(braced(row) for row in values) + "}"


def _words(pilot: TubeController, own: CSource, name: str, real: Real) -> dict[str, str]:
    """What stands in the templates for their @words@."""
    coarse = COARSE if real == "float" else 1.0
    words: Words = {"NAME": name, "UPPER": name.upper(), "real": real, "memory": MEMORY}
    words |= _limits(pilot) | _sizes(pilot) | _states(pilot) | _sensors(pilot)
    words |= _filter(pilot, own) | _rules(pilot) | _told(pilot)
    words |= {
        "tolerance": 1e-6 * coarse,
        "near_steady": NEAR_STEADY * coarse,
        "qp_tolerance": QP_TOLERANCE[real],
        "primal_tolerance": PRIMAL,
        "qp_iterations": QP_ITERATIONS,
    }
    return {k: v if isinstance(v, str) else repr(v) for k, v in words.items()}


def _limits(pilot: TubeController) -> Words:
    """Of commands and tilt, and by how much they are tightened."""
    problem, kappa = pilot.problem, np.zeros(pilot.problem.planes + 1)
    kappa[: len(pilot.kappa)] = pilot.kappa
    return {
        "kappa": braced(kappa),
        "kappa_u": float(pilot.kappa_u),
        "low": problem.command_min,
        "high": problem.command_max,
        "rate": problem.rate_max,
        "tilt_max": problem.tilt_max,
        "penalty": problem.penalty,
        "penalty_square": problem.penalty_square,
    }


def _sizes(pilot: TubeController) -> Words:
    """Names and numbers of columns and states, times."""
    f, problem = pilot.filter, pilot.problem
    return {
        "outputs": " ".join(f.outputs.names),
        "inputs": " ".join(f.inputs.names),
        "states": " ".join(f.states.names),
        "n_y": len(f.outputs),
        "n_u": len(f.inputs),
        "n_e": len(f.sampled.dynamics.innovation_columns),
        "n_x": len(f.states),
        "own": f.own_states,
        "sensors": len(pilot.estimator.gate.sensors),
        "lags": len(pilot.past) + 1,
        "sample": pilot.model.sample_time,
        "late": LATE,
        "early": EARLY,
        "dt": problem.dt,
        "every": pilot.every,
        "horizon": problem.horizon,
        "planes": problem.planes,
        "attempts": problem.attempts,
        "slack": SLACK,
    }


def _told(pilot: TubeController) -> Words:
    """Run-time parameters whose value is told, and the push that speaks of them."""
    own, names = pilot.estimator.told.own, pilot.filter.states.names
    numbers = {
        "told_low": [one.low for one in own],
        "told_high": [one.high for one in own],
        "seen_low": [max(one.seen[0], -UNBOUNDED) for one in own],
        "seen_high": [min(one.seen[1], UNBOUNDED) for one in own],
        "per_force": [one.per_force for one in own],
    }
    text = ", ".join(f"{i} {one.says()}" for i, one in enumerate(own))
    return {
        **{k: braced(v or [0.0]) for k, v in numbers.items()},
        "n_p": len(own),
        "told": text or "none",
        "push": names.index(PUSH) if PUSH in names else -1,
        "present": PRESENT,
        "slow": SLOW,
        "heaviest": heaviest(pilot.model),
    }


def _states(pilot: TubeController) -> Words:
    """Where blocks begin, hover, and the history of commands."""
    f, plan, problem = pilot.filter, pilot.functions, pilot.problem
    x, u = pilot.solver.stages.steady
    # the command in force at the start, whatever the pilot has flown since
    held = np.clip(u, problem.command_min, problem.command_max)
    extended = f.sampled.extended(x[: f.own_states], pilot._column(held))[0]
    past = [n.split(".") for n in plan.states.names[plan.own_states :]]
    places = {f"at_{v}": block(plan, v)[0] for v in ("position", "velocity", "attitude", "rate")}
    errors = {f"d_{v}": block(plan, v, error=True)[0] for v in ("position", "velocity")}
    return {
        **places,
        **errors,
        "hover_x": braced(x),
        "hover_u": braced(u),
        "lag_of": braced([*(int(n[2]) - 1 for n in past), 0]),
        "command_of": braced([*(f.inputs[n[1]] for n in past), 0]),
        "filter_past": braced([*extended[f.own_states :], 0.0]),
        "parameters": braced([*plan.parameter_values] or [0.0]),
        "most": braced([*pilot.estimator.most, 0.0]),
    }


def _sensors(pilot: TubeController) -> Words:
    """Which columns make an innovation, which innovations a sensor, and where an estimate begins."""
    f = pilot.filter
    groups, sensors = f.sampled.dynamics.innovation_columns, pilot.estimator.gate.sensors
    sensor_of = np.zeros(len(groups), dtype=int)
    for k, (_, rows) in enumerate(sensors):
        sensor_of[rows] = k
    poses = {k for k, _ in pilot.estimator.pose}
    attitude = [c for c in ("qw", "qx", "qy", "qz") if c in f.outputs.names]
    start = [
        (f.outputs.names.index(c), block(f, at)[i])
        for at, columns in MEASURED.items()
        for i, c in enumerate(columns)
        if set(columns) <= set(f.outputs.names)
    ]
    return {
        "columns": matrix([[int(c in names) for c in f.outputs.names] for names in groups]),
        "sensor_of": braced(sensor_of),
        "of_pose": braced([int(k in poses) for k in range(len(sensors))]),
        "of_sensor": braced([len(rows) for _, rows in sensors]),
        "inverse": matrix(pilot.estimator.gate.inverse),
        "attitude_columns": braced(
            [f.outputs.names.index(c) for c in attitude] if len(attitude) == 4 else [-1] * 4
        ),
        "n_starts": len(start),
        "start_from": "{" + ", ".join(f"{{{a}, {b}}}" for a, b in [*start, (0, 0)]) + "}",
    }


def _filter(pilot: TubeController, own: CSource) -> Words:
    """Memory of the filter's function, and when its estimate counts."""
    step = own.functions[0]
    return {
        "filter_iw": max(1, step.sz_iw),
        "filter_w": max(1, step.sz_w),
        "filter_arg": max(5, step.sz_arg),
        "filter_res": max(3, step.sz_res),
        "blind": pilot.estimator.blind,
        "clearly": CLEARLY,
        "believed": BELIEVED,
    }


def _rules(pilot: TubeController) -> Words:
    """Of the fallback, the heading and what is said."""
    return {
        "near_position": NEAR["position"],
        "near_velocity": NEAR["velocity"],
        "near_heading": near_heading(pilot.problem),
        "turning": braced(pilot._turning),
        "turned": pilot._turned,
        "most_turn": TURN,
        "held": HELD,
        "rounding": ROUNDING,
        "failures": FAILURES,
    }


class Pilot(Protocol):
    """What flies."""

    def start(self) -> None:
        """Forget everything."""
        ...

    def sample(self, time: float, measured: Mapping[str, float | None] | None) -> FloatArray:
        """The command that is in force from the next sample on, (n_u,)."""
        ...


def flight(
    pilot: TubeController, samples: int, seed: int = 0, flown: Pilot | None = None
) -> dict[str, FloatArray]:
    """A flight of the model itself under `pilot`, or under its library `flown`, with a gap and a spike in its measurements:
    measured (samples, n_y), NaN where nothing was, commands (samples, n_u), and the states after
    each (samples, n_x)."""
    f, rng = pilot.filter, np.random.default_rng(seed)
    pilot.start()
    if flown is not None:
        flown.start()
    x, u = pilot.estimate.copy(), pilot.u.copy()
    groups = f.sampled.dynamics.innovation_columns
    noise = np.array(
        [
            min(n for n, names in zip(f.noise.sensor, groups, strict=True) if c in names)
            for c in f.outputs.names
        ]
    )
    told = {one.name: one.reference for one in pilot.estimator.told.own}
    rows, commands, states = [], [], []
    for k in range(samples):
        y = f["h"](x, u, f.parameter_values).full().ravel()
        y += noise * rng.standard_normal(len(y))
        if samples // 3 <= k < samples // 3 + 4:
            y[:] = np.nan
        if k == samples // 2:
            y[0] += 50.0
        y = y.astype(np.float32).astype(float)
        known = dict(zip(f.outputs.names, y.tolist())) | told
        command = (flown or pilot).sample(k * pilot.model.sample_time, known)
        rows.append(y)
        commands.append(command)
        x, u = f["f_d"](x, u, f.parameter_values).full().ravel(), np.array(command)
        states.append(x)
    return {
        "measured": np.array(rows),
        "commands": np.array(commands),
        "states": np.array(states),
    }


def paths(pilot: TubeController, samples: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What the library is given in a flight from time 0: place (4,) to start at, path (samples,
    stages + 1, 10) at every sample, and planes (stages + 1, planes, 4), those of the start."""
    problem, dt = pilot.problem, pilot.model.sample_time
    ahead: FloatArray = np.asarray(dt + problem.dt * np.arange(problem.horizon + 1), dtype=float)
    rows = [along(pilot.reference, np.asarray(k * dt + ahead, dtype=float)) for k in range(samples)]
    planes = np.zeros((problem.horizon + 1, problem.planes, 4))
    planes[:, :, 3] = 1.0
    place = along(pilot.reference, np.zeros(1))[0, [0, 1, 2, 9]]
    return place, np.array(rows), planes if pilot.planes is None else pilot.planes(ahead)


def along(reference: Reference, times: FloatArray) -> FloatArray:
    """Position, velocity, acceleration and yaw (n, 10) as NAME_tube_path has them."""
    path = reference.sample(times)
    return np.column_stack([path.position, path.velocity, path.acceleration, path.yaw])


class Still:
    """A reference that stands at place = (x, y, z, heading)."""

    def __init__(self, place: Sequence[float]) -> None:
        self.place = np.asarray(place, dtype=float)

    def sample(self, time: FloatArray) -> Way:
        """At the times (n,)."""
        zero = np.zeros((len(time), 3))
        return Way(
            position=np.tile(self.place[:3], (len(time), 1)),
            velocity=zero,
            acceleration=zero,
            yaw=np.full(len(time), self.place[3]),
        )
