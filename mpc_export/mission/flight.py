"""Flights of any controller over a course against any plant: what a row says, and what an animation
needs.

A plant has `reset(seed, position=)`, `step(u, dt)`, `measure(u)` by column of a log, `states()` or
`truth()["states"]`. A controller is a `TubeController` or has its `start`, `sample`, `u`, `plan`,
`events`, `descending`.
"""

from __future__ import annotations

import importlib
import inspect
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from greybox.errors import GreyboxError
from greybox.files import to_plain
from greybox.frames import numeric
from greybox.model.identified import IdentifiedModel
from greybox.model.vehicle import Vehicle
from greybox.report.mpc_documents import CELL, Crossing, FlightRow, Scores
from greybox.symbolic import FloatArray
from mpc_export.adaptation import flight_parameters
from mpc_export.feedback import Weights
from mpc_export.mission.cascade import CascadeController
from mpc_export.mission.course import Course, SampledPath
from mpc_export.mission.model_plant import ModelPlant, RehearsedPlant
from mpc_export.mission.trace import Trace
from mpc_export.tube.controller import Event, Plan, TubeController
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.risk import touching

STEP = 0.02
"""Sample time of plans, or the multiple of the model's own that comes next [s]."""
ANCILLARY = 64.0
"""Weight on position of the gain inside the tube; eight times the plan's keeps the tube narrow
(docs/tube_mpc.md)."""
TRUE = ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "p", "q", "r")
CRASH = 100.0
"""Cost of a flight that ends in a crash, per second."""
REACH = 0.15
"""How far before its stretch a plane is respected [m]."""
_SLOW = 0.05
"""Low pass of the cascade's own velocity, where none is measured [s]."""


class PlantError(GreyboxError, ValueError):
    """What --plant or --course names cannot be flown."""


@dataclass(frozen=True, kw_only=True)
class Mission:
    """A course flown at `pace` (2: half as fast) with plans every `problem.dt` and samples every
    `dt` [s]."""

    course: Course
    problem: TubeProblem
    dt: float
    pace: float


def paced(course: Course, pace: float) -> Course:
    """The course in `pace` times the time."""
    legs = tuple(replace(leg, time=pace * leg.time, hold=pace * leg.hold) for leg in course.legs)
    return replace(course, legs=legs)


def top_speed(course: Course) -> float:
    """Highest speed of the reference [m/s]."""
    path = course.sample(np.asarray(np.arange(0.0, course.duration, 0.01)))
    return float(np.linalg.norm(path.velocity, axis=1).max())


def natural_pace(model: IdentifiedModel, course: Course) -> float:
    """1, or how much slower the course must be for its speed to stay below the highest that the
    model was trained at.

    Half of that speed counts where a log has no velocity: nothing is known then.
    """
    seen = [max(abs(v) for v in model.domain[n]) for n in ("vx", "vy", "vz") if n in model.domain]
    fastest = max(seen) if seen else 0.5 * top_speed(course)
    return max(1.0, math.ceil(20.0 * top_speed(course) / max(fastest, 0.1)) / 20.0)


def mission(model: IdentifiedModel, course: Course, pace: float = 1.0) -> Mission:
    """The course at the sample time that suits the model."""
    chosen = paced(course, pace)
    problem = TubeProblem(
        dt=model.sample_time * max(1, round(STEP / model.sample_time)),
        horizon=20,
        planes=len(chosen.planes),
        command_min=chosen.command_min,
        command_max=chosen.command_max,
        tilt_max=chosen.tilt_max,
        ancillary=Weights(position=ANCILLARY),
    )
    return Mission(course=chosen, problem=problem, dt=model.sample_time, pace=pace)


# ----------------------------------------------------------------------------------------- plants


class Plant(Protocol):
    """What flies. `measure` may take the command that begins now; a plant may also have `states`
    (true states by name), else they are in `truth()["states"]`."""

    def reset(self, seed: int = 0, *, position: tuple[float, float, float] = ...) -> None:
        """At rest at a place [m]."""

    def step(self, u: FloatArray, dt: float | None = None) -> None:
        """Hold the command u (n_u,) for dt seconds."""

    def measure(self, u: FloatArray | None = None) -> Mapping[str, float]:
        """Measurements now by column."""
        ...

    def truth(self) -> Mapping[str, Any]:
        """What a log does not say."""
        ...


@runtime_checkable
class KnowsRotors(Protocol):
    """A plant that says how many rotors it has; of another the model is believed."""

    @property
    def rotors(self) -> int:
        """Their number."""
        ...


@runtime_checkable
class KnowsStates(Protocol):
    """A plant that says its true states by themselves."""

    def states(self) -> Mapping[str, float]:
        """By name."""
        ...


def named(option: str, name: str, example: str) -> object:
    """What `module:attribute` names, importable from here. Raises `PlantError`."""
    module, _, attribute = name.partition(":")
    if not module or not attribute:
        raise PlantError(option, expected="module:attribute", got=repr(name), fix=example)
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        return getattr(importlib.import_module(module), attribute)
    except Exception as error:
        raise PlantError(
            f"{option} {name}: {type(error).__name__}: {error}", fix=f"name it like {example}"
        ) from None


def load_course(name: str) -> Course:
    """The course that `module:attribute` names. Raises `PlantError`."""
    found = named("--course", name, "mpc_export.mission:OBSTACLE_COURSE")
    if not isinstance(found, Course):
        raise PlantError(
            f"--course {name}", expected="an mpc_export.mission.Course", got=type(found).__name__
        )
    return found


def load_plant(name: str) -> Any:
    """The plant that `module:attribute` names: a plant, or a class or function that makes one.
    Raises `PlantError`."""
    found = named("--plant", name, "my_plant:Vehicle")
    try:
        plant = found() if inspect.isclass(found) or inspect.isfunction(found) else found
    except Exception as error:
        raise PlantError(
            f"--plant {name} cannot be made: {type(error).__name__}: {error}",
            fix="a class or function without arguments",
        ) from None
    missing = [
        n for n in ("reset", "step", "measure", "truth") if not callable(getattr(plant, n, None))
    ]
    if missing:
        raise PlantError(
            f"--plant {name} has no {', '.join(missing)}",
            expected="reset, step, measure, truth",
            got=type(plant).__name__,
        )
    return plant


def fitting(plant: Plant, model: IdentifiedModel, start: tuple[float, float, float, float]) -> None:
    """Whether the plant has what the model's controller asks for. Raises `PlantError`."""
    commands = [n for n in model.dynamics.inputs.names if n != "vbat"]
    rotors = plant.rotors if isinstance(plant, KnowsRotors) else len(commands)
    if rotors != len(commands):
        raise PlantError(
            "plant and model differ in their commands",
            expected=f"{len(commands)} rotors",
            got=str(rotors),
        )
    try:
        plant.reset(0, position=start[:3])
        seen, now = plant.measure(), truth(plant)
    except Exception as error:
        raise PlantError(
            f"the plant cannot be started: {type(error).__name__}: {error}",
            expected="reset(seed, position=(x, y, z)), measure()",
        ) from None
    lost = [n for n in TRUE if n not in now]
    if lost:
        raise PlantError(f"the plant's truth has no {', '.join(lost)}", expected=", ".join(TRUE))
    needed = [n for n in model.dynamics.outputs.names if n not in seen]
    if len(needed) == len(model.dynamics.outputs.names):
        raise PlantError(
            "the plant measures nothing that the model knows", expected=", ".join(needed)
        )


def truth(plant: Plant) -> Mapping[str, float]:
    """True states of a plant by name."""
    return states_of(plant)()


def states_of(plant: Plant) -> Callable[[], Mapping[str, float]]:
    """What gives a plant's true states by name; found once, for it is asked at every sample."""
    if isinstance(plant, KnowsStates):
        return plant.states

    def told() -> Mapping[str, float]:
        states: Mapping[str, float] = plant.truth()["states"]
        return states

    return told


# ------------------------------------------------------------------------------------ controllers


class Pilot(Protocol):
    """What flies a plant: `u` (n_u,) the present command, `plan` the last plan, if it makes any."""

    u: FloatArray
    plan: Plan | None
    events: list[Event]

    @property
    def descending(self) -> bool:
        """Whether the path was given up."""
        ...

    def start(self) -> None:
        """Forget everything."""

    def sample(self, time: float, seen: Mapping[str, float], /) -> FloatArray:
        """The command from the next sample on."""
        ...


class CoursePlanes:
    """Planes of the course that exist near the reference, `moved` [m] toward the path: (n, planes,
    4) at the times (n,)."""

    def __init__(self, course: Course, moved: float = 0.0) -> None:
        self.course, self.moved = course, moved

    def __call__(self, time: FloatArray) -> FloatArray:
        """Normal and offset, zeros and 1 where there is none."""
        place = self.course.sample(time).position
        out = np.zeros((time.size, len(self.course.planes), 4))
        out[..., 3] = 1.0
        for j, plane in enumerate(self.course.planes):
            there = plane.exists(place, REACH)
            out[there, j, :3], out[there, j, 3] = plane.normal, plane.offset - self.moved
        return out


def controller(model: IdentifiedModel, task: Mission) -> TubeController:
    """The tube controller on the course, not tightened yet. In flight it calibrates, and learns what
    differed between the training flights."""
    return TubeController(
        model=model,
        problem=task.problem,
        reference=task.course,
        planes=CoursePlanes(task.course),
        integrate=False,
        calibrate=True,
        adapt={} if flight_parameters(model) else None,
        lost=0.5 * task.course.lost,
    )


def tightened(
    pilot: TubeController, task: Mission, *, kappa: float = 0.0, moved: float = 0.0
) -> TubeController:
    """The same controller from its next start on, planes and tilt tightened by `kappa` standard
    deviations, the commands by one of them at most, planes moved by `moved` [m]. Nothing is
    compiled anew."""
    pilot.kappa, pilot.kappa_u = (kappa,) * (len(task.course.planes) + 1), min(kappa, 1.0)
    pilot.planes = CoursePlanes(task.course, moved)
    return pilot


class Cascade:
    """The cascade of PID loops, with the vehicle file as its only knowledge, behind the tube's
    interface."""

    descending = False
    plan: Plan | None = None

    def __init__(self, vehicle: Vehicle, task: Mission) -> None:
        self.inner = CascadeController(vehicle)
        self.task = task
        self.events: list[Event] = []
        self.start()

    def start(self) -> None:
        """Forget everything."""
        self.inner.reset()
        self.u = np.full(self.inner.vehicle.n_rotors, self.inner.hover)
        self._place: FloatArray | None = None
        self._velocity = np.zeros(3)

    def sample(self, time_: float, seen: Mapping[str, float]) -> FloatArray:
        """The command from the next sample on; velocity by filtered differences where none is
        measured."""
        goal = self.task.course.sample(np.array([time_ + self.task.dt]))
        if "vx" not in seen:
            place = np.array([seen[n] for n in "xyz"])
            if self._place is not None:
                share = self.task.dt / (self.task.dt + _SLOW)
                self._velocity = (1 - share) * self._velocity + share * (
                    place - self._place
                ) / self.task.dt
            self._place = place
            seen = {**seen, **dict(zip(("vx", "vy", "vz"), self._velocity.tolist(), strict=True))}
        self.u = self.inner(seen, goal, self.task.dt)
        return self.u


# --------------------------------------------------------------------------------------- a flight


def fly(
    pilot: Pilot,
    plant: Plant,
    task: Mission,
    seed: int,
    *,
    near: float | None = None,
    watch: bool = False,
) -> FlightRow:
    """One flight as a row of plain values; with `watch` also "trace", what an animation needs.

    near: also count the limits that plans touch, closer than this [m]. Keys: seed, crashed, margins
    (least distance to every plane [m], None: never beside it), tilt [rad], rmse [m], cost (per
    second, CRASH for a crash), late (samples whose answer took longer than a sample), solve_ms
    (every solution), events (time and what of the first twenty), event_kinds (how many of each),
    descended (whether the path was given up), nearest (least distance to any plane per cell [m]),
    crossings (plane, time and depth where it was deepest).
    """
    reference = task.course.sample(_times(task))
    trace = (
        Trace(pilot, task.problem.horizon) if watch and isinstance(pilot, TubeController) else None
    )
    flown = _flown(pilot, plant, task, seed, near=near, trace=trace)
    out: dict[str, object] = {"seed": seed, **_scores(flown, pilot, task, reference)}
    if near is not None:
        out["pairs"] = flown.pairs
    if watch:
        out["trace"] = {**_shown(flown, task), "plans": trace.plans if trace is not None else []}
    found: FlightRow = to_plain(out)
    return found


@dataclass(frozen=True, kw_only=True)
class _Flown:
    """What a flight left: true states (n, 13) and commands (n, n_u) up to its end, seconds of every
    answer, milliseconds of every solution, limits that plans touched."""

    path: FloatArray
    commands: FloatArray
    spent: FloatArray
    solve: list[float]
    pairs: int
    crashed: bool


def _times(task: Mission) -> FloatArray:
    return np.asarray(task.dt * np.arange(round(task.course.duration / task.dt)), dtype=float)


def _flown(
    pilot: Pilot,
    plant: Plant,
    task: Mission,
    seed: int,
    *,
    near: float | None,
    trace: Trace | None,
) -> _Flown:
    """The loop itself: the command of a sample is held while the answer to it is computed."""
    course = task.course
    plant.reset(seed, position=course.start[:3])
    pilot.start()
    u = np.array(pilot.u)
    times = _times(task)
    reference = course.sample(times)
    rows, commands, spent, solve, pairs = [], [], [], [], 0
    last: Plan | None = None
    takes_command, states = _takes_argument(plant.measure), states_of(plant)
    crashed = False
    for k in range(len(times)):
        seen = plant.measure(u) if takes_command else plant.measure()
        began = time.perf_counter()
        after = pilot.sample(float(times[k]), seen)
        spent.append(time.perf_counter() - began)
        now = states()
        rows.append([now[n] for n in TRUE])
        commands.append(u)
        if not np.linalg.norm(np.array(rows[-1][:3]) - reference.position[k]) <= course.lost:
            crashed = True
            break
        plant.step(u, task.dt)
        u = np.array(after)
        if pilot.plan is not None and pilot.plan is not last:
            last = pilot.plan
            solve.append(1e3 * last.outcome.seconds)
            if isinstance(pilot, TubeController):
                pairs += int(touching(pilot.solver, near)[:-1].sum()) if near is not None else 0
                if trace is not None:
                    trace.look(pilot)
    return _Flown(
        path=np.array(rows),
        commands=np.array(commands),
        spent=np.array(spent),
        solve=solve,
        pairs=pairs,
        crashed=crashed,
    )


def _tilt(path: FloatArray) -> FloatArray:
    """Angle (n,) between thrust and the vertical [rad]."""
    up = np.tile([0.0, 0.0, 1.0], (len(path), 1))
    return np.arccos(np.clip(numeric("rotate", path[:, 6:10], up)[:, 2], -1, 1))


def _scores(flown: _Flown, pilot: Pilot, task: Mission, reference: SampledPath) -> Scores:
    """The keys of `fly` that every flight has."""
    path, times = flown.path, _times(task)[: len(flown.path)]
    away = task.course.margins(path[:, :3])
    error = np.linalg.norm(path[:, :3] - reference.position[: len(path)], axis=1)
    weights = task.problem.weights
    return {
        "crashed": flown.crashed,
        "margins": {n: float(m.min()) for n, m in away.items()},
        "tilt": float(np.nanmax(_tilt(path))),
        "rmse": float(np.sqrt(np.mean(error**2))),
        "cost": CRASH if flown.crashed else tracking_cost(path, flown.commands, reference, weights),
        "late": int(np.sum(flown.spent > task.dt)),
        "samples": len(path),
        "seconds": float(times[-1]),
        "solve_ms": np.round(flown.solve, 2).tolist(),
        "events": [{"time": e.time, "what": e.what} for e in pilot.events[:20]],
        "event_count": len(pilot.events),
        "event_kinds": dict(Counter(e.what for e in pilot.events)),
        "descended": bool(pilot.descending),
        "nearest": _cells(times, np.min(list(away.values()), axis=0)),
        "crossings": _crossings(times, away),
    }


def _shown(flown: _Flown, task: Mission) -> dict[str, FloatArray]:
    """What an animation needs beside the plans, every so many samples."""
    path, every = flown.path, max(1, round(STEP / task.dt))
    nearest = np.min(list(task.course.margins(path[:, :3]).values()), axis=0)
    return {
        "time": np.round(_times(task)[: len(path) : every], 3),
        "path": np.round(path[::every, :3], 4),
        "attitude": np.round(path[::every, 6:10], 4),
        "tilt": np.round(_tilt(path)[::every], 4),
        "commands": np.round(flown.commands[::every], 4),
        "nearest": np.round(nearest[::every], 4),
    }


def tracking_cost(
    path: FloatArray, commands: FloatArray, reference: SampledPath, w: Weights
) -> float:
    """Tracking cost of a flight (n, 13) with the controller's weights, per sample."""
    yaw = numeric("euler", path[:, 6:10])[:, 2] - reference.yaw[: len(path)]
    terms = (
        w.position * (path[:, :3] - reference.position[: len(path)]),
        w.velocity * (path[:, 3:6] - reference.velocity[: len(path)]),
        w.yaw * np.sin(yaw)[:, None],
        w.rate * path[:, 10:13],
        w.change * np.diff(commands, axis=0),
    )
    return float(sum(0.5 * np.sum(v**2) for v in terms) / len(path))


def _takes_argument(function: Callable[..., object]) -> bool:
    try:
        return len(inspect.signature(function).parameters) > 0
    except (TypeError, ValueError):
        return False


def _cells(times: FloatArray, nearest: FloatArray) -> list[float]:
    cell = (times / CELL + 1e-9).astype(int)
    least = np.full(cell[-1] + 1, np.inf)
    np.minimum.at(least, cell, nearest)
    return [round(float(v), 4) if np.isfinite(v) else math.nan for v in least]


def _crossings(times: FloatArray, away: dict[str, FloatArray]) -> list[Crossing]:
    found: list[Crossing] = []
    for name, margin in away.items():
        k = int(np.argmin(margin))
        if margin[k] < 0:
            found.append({"plane": name, "time": float(times[k]), "depth": float(-margin[k])})
    return found


def flown_with(plant: str, model: IdentifiedModel, disturbances: list[FloatArray] | None) -> Plant:
    """The plant of a name: "model" is the identified model itself, "rehearsal" the same with a
    learned part that errs, everything else `module:attribute`."""
    if plant == "rehearsal":
        return RehearsedPlant(model)
    return ModelPlant(model, disturbances) if plant == "model" else load_plant(plant)
