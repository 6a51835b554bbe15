"""Flights of the tube study: the course, the controllers over it, and what counts as crossed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.frames import numeric
from greybox.model.identified import IdentifiedModel
from greybox.plants.controller import Setpoint
from greybox.plants.presets import controller_for
from mpc_export.feedback import Weights
from mpc_export.mission import OBSTACLE_COURSE
from mpc_export.mission.craft import vehicle
from mpc_export.mission.flight import CRASH, REACH, tracking_cost
from mpc_export.tube.controller import TubeController
from mpc_export.tube.problem import TubeProblem

Array = NDArray[np.float64]
TILT_PER_METRE = 2.0
"""Planes that are moved by a constant take this much off the tilt [rad/m]."""
DT = 0.01
THERE = 0.05
"""A lap ends when the craft stays so near to the end of the course [m]."""
PROBLEM = TubeProblem(
    dt=0.02,
    horizon=20,
    planes=len(OBSTACLE_COURSE.planes),
    command_min=OBSTACLE_COURSE.command_min,
    command_max=OBSTACLE_COURSE.command_max,
    tilt_max=OBSTACLE_COURSE.tilt_max,
    ancillary=Weights(position=64.0),
)
"""The ancillary gain holds the place eight times as hard as the plan: after 0.4 s the tube is 7 mm
wide instead of 16."""


class Route:
    """The course's reference and planes at multiples of DT, computed once."""

    def __init__(self) -> None:
        self.times: Array = np.asarray(
            DT * np.arange(round((OBSTACLE_COURSE.duration + 1.0) / DT)), dtype=float
        )
        self.whole = OBSTACLE_COURSE.sample(self.times)
        self.limits = np.zeros((self.times.size, len(OBSTACLE_COURSE.planes), 4))
        self.limits[..., 3] = 1.0
        for j, plane in enumerate(OBSTACLE_COURSE.planes):
            there = plane.exists(self.whole.position, REACH)
            self.limits[there, j, :3], self.limits[there, j, 3] = plane.normal, plane.offset

    def _rows(self, time_: Array) -> Any:
        return np.minimum(np.rint(np.asarray(time_) / DT).astype(int), self.times.size - 1)

    def sample(self, time_: Array) -> Any:
        """The reference at these times (n,)."""
        rows = self._rows(time_)
        return type(self.whole)(**{k: v[rows] for k, v in vars(self.whole).items()})

    def planes(self, time_: Array, moved: float = 0.0) -> Array:
        """Planes of the course that exist near the reference at these times, `moved` [m] toward the
        path."""
        out = self.limits[self._rows(time_)].copy()
        out[(out[..., :3] != 0).any(axis=-1), 3] -= moved
        return out


@cache
def route() -> Route:
    """The one path of the course."""
    return Route()


def controller(
    model: IdentifiedModel,
    *,
    deviations: float = 0.0,
    moved: float = 0.0,
    white: bool = False,
    worst: bool = False,
) -> TubeController:
    """The tube controller on the course; `deviations` tighten planes and tilt, one of them at most
    the commands."""
    problem = replace(PROBLEM, kind="worst case") if worst else PROBLEM
    return TubeController(
        model=model,
        problem=replace(problem, tilt_max=problem.tilt_max - TILT_PER_METRE * moved),
        reference=route(),
        planes=lambda t: route().planes(t, moved),
        kappa=(deviations,) * (len(OBSTACLE_COURSE.planes) + 1),
        kappa_u=min(deviations, 1.0),
        integrate=False,
        white=white,
    )


class Cascade:
    """The cascade controller behind the tube controller's interface."""

    def __init__(self) -> None:
        self.inner = controller_for(vehicle())
        self.plan = None
        self.events: list[Any] = []
        self.start()

    def start(self) -> None:
        """Forget everything."""
        self.inner.reset()
        self.u = np.full(4, float(np.mean(vehicle().airframe.hover_speed)))

    def sample(self, time_: float, seen: dict[str, float]) -> Array:
        """The command from the next sample on."""
        path = route().sample(np.array([time_ + DT]))
        goal = Setpoint(
            position=tuple(path.position[0]),
            velocity=tuple(path.velocity[0]),
            acceleration=tuple(path.acceleration[0]),
            yaw=float(path.yaw[0]),
            yaw_rate=float(path.yaw_rate[0]),
        )
        self.u = np.array(self.inner(seen, goal, DT, (0.0, 0.0, 0.0, 0.0)))
        return self.u


def flight(
    pilot: Any, seed: int, at: Callable[[int, Any, Any], None] | None = None, plant: Any = None
) -> dict[str, Any]:
    """One flight over the course: margins, tracking error, cost, lap [s], times.
    `at(k, plant, pilot)` is called after every plan.

    plant: default the course's vehicle.
    """
    plant = vehicle() if plant is None else plant
    start = OBSTACLE_COURSE.start
    plant.reset(seed, position=start[:3])
    pilot.start()
    u = np.array(pilot.u)
    steps = round(OBSTACLE_COURSE.duration / DT)
    states, commands, seconds, crashed = [], [], [], False
    reference = route().sample(route().times[:steps])
    last = None
    for k in range(steps):
        after = pilot.sample(DT * k, plant.measure(u))
        now = plant.states()
        states.append([now[n] for n in TRUE])
        commands.append(u)
        if np.linalg.norm(states[-1][:3] - reference.position[k]) > OBSTACLE_COURSE.lost:
            crashed = True
            break
        plant.step(u, DT)
        u = np.array(after)
        if pilot.plan is not None and pilot.plan is not last:
            last = pilot.plan
            seconds.append(last.outcome.seconds)
            if at is not None:
                at(k, plant, pilot)
    path, given = np.array(states), np.array(commands)
    margins = {n: float(m.min()) for n, m in OBSTACLE_COURSE.margins(path[:, :3]).items()}
    tilt = np.arccos(
        np.clip(
            numeric("rotate", path[:, 6:10], np.tile([0.0, 0.0, 1.0], (len(path), 1)))[:, 2], -1, 1
        )
    )
    error = np.linalg.norm(path[:, :3] - reference.position[: len(path)], axis=1)
    away = np.linalg.norm(path[:, :3] - reference.position[-1], axis=1)
    out = {
        "seed": seed,
        "crashed": crashed,
        "margins": margins,
        "tilt": float(tilt.max()),
        "rmse": float(np.sqrt(np.mean(error**2))),
        "lap": DT * (1 + int(np.flatnonzero(away > THERE).max())),
        "cost": CRASH if crashed else tracking_cost(path, given, reference, PROBLEM.weights),
        "events": len(pilot.events),
    }
    if seconds:
        out |= {
            "median_ms": 1e3 * float(np.median(seconds)),
            "p99_ms": 1e3 * float(np.quantile(seconds, 0.99)),
            "most_ms": 1e3 * max(seconds),
        }
    return out


TRUE = ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "p", "q", "r")


def crossed(record: dict[str, Any]) -> bool:
    """Whether the flight crossed a plane or crashed."""
    return bool(record["crashed"] or min(record["margins"].values()) < 0)


def tilted(record: dict[str, Any]) -> bool:
    """Whether the flight tilted too far or crashed."""
    return bool(record["crashed"] or record["tilt"] > OBSTACLE_COURSE.tilt_max)
