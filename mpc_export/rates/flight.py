"""One flight of a rate controller below the outer loops, as a row of plain values."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NotRequired

import numpy as np

from greybox.files import to_plain
from greybox.frames import numeric
from greybox.model.vehicle import Vehicle
from greybox.report.mpc_documents import Answered, RatesTrace
from greybox.symbolic import FloatArray
from mpc_export.mission.cascade import CascadeController, Gains
from mpc_export.mission.course import SampledPath
from mpc_export.mission.flight import Plant, truth
from mpc_export.rates.controller import RateController
from mpc_export.rates.craft import DT, OUTPUTS, Task

NEAR = 0.02
"""A limit that the next sample of a plan comes closer to than this is touched [rad/s]."""
THIN = 2
"""Every so many samples a trace is kept."""


@dataclass(kw_only=True)
class Pilot:
    """Outer loops of the vehicle file and a rate controller below; without one the PID loops of the
    cascade."""

    outer: CascadeController
    inner: RateController | None = None

    def start(self) -> FloatArray:
        """Forget everything; the command to begin with."""
        self.outer.reset()
        u = np.full(self.outer.vehicle.n_rotors, self.outer.hover)
        if self.inner is not None:
            self.inner.start(u)
        return u

    def sample(self, seen: Mapping[str, float], goal: SampledPath) -> tuple[FloatArray, FloatArray]:
        """(command from the next sample on, body rates that were asked for)."""
        if self.inner is None:
            before = self.outer.place.copy()
            asked = self.outer.asked(seen, goal, DT)[1]
            self.outer.place = before
            return self.outer(seen, goal, DT), asked
        specific, rates = self.outer.asked(seen, goal, DT)
        euler = numeric("euler", np.array([[seen[n] for n in ("qw", "qx", "qy", "qz")]]))[0]
        y = np.array([seen[n] for n in OUTPUTS])
        attitude = (float(euler[0]), float(euler[1]))
        return self.inner.sample(y, attitude, rates, self.outer.collective(specific)), rates


def outer_loops(card: Vehicle, task: Task) -> CascadeController:
    """The cascade of a vehicle file that never asks for a rate beyond the limit."""
    return CascadeController(card, Gains(rate_max=task.limit))


class Flight(Answered):
    """One flight, as `fly` explains it."""

    seed: int
    crashed: bool
    worst: list[float]
    beyond: int
    samples: int
    rmse: float
    away: float
    touched: int
    failures: int
    trace: NotRequired[RatesTrace]


def _at(path: SampledPath, k: int) -> SampledPath:
    """One sample of a path."""
    return SampledPath(
        position=path.position[k : k + 1],
        velocity=path.velocity[k : k + 1],
        acceleration=path.acceleration[k : k + 1],
        yaw=path.yaw[k : k + 1],
        yaw_rate=path.yaw_rate[k : k + 1],
    )


def _sampled(task: Task, times: FloatArray, seed: int) -> SampledPath:
    """The path of a flight at the times (n,) [s]."""
    drawn = task.path.sample(times, np.random.default_rng([seed, 1]))
    return SampledPath(
        position=drawn.position,
        velocity=drawn.velocity,
        acceleration=drawn.acceleration,
        yaw=drawn.yaw,
        yaw_rate=drawn.yaw_rate,
    )


def fly(pilot: Pilot, plant: Plant, task: Task, seed: int, *, watch: bool = False) -> Flight:
    """One flight. Keys: seed, crashed, worst (largest true |rate| of each axis [rad/s]), beyond
    (samples with a rate beyond the limit), samples, rmse (rates against what was asked [rad/s]),
    away (rms distance from the path [m]), touched (limits that plans touch), solve_ms, failures
    (plans without a solution), and with `watch` a trace."""
    times = np.asarray(DT * np.arange(round(task.seconds / DT) + 1), dtype=float)
    path = _sampled(task, times, seed)
    x, y, z = path.position[0]
    plant.reset(seed, position=(x, y, z))
    u = pilot.start()
    rates, asks, gaps, spent, touched, plans = [], [], [], [], 0, []
    crashed = False
    for k in range(len(times) - 1):
        seen = plant.measure(u)
        now = truth(plant)
        gap = np.array([now[n] for n in "xyz"]) - path.position[k]
        rates.append([now[n] for n in OUTPUTS])
        gaps.append(float(gap @ gap))
        if not gaps[-1] <= task.lost**2:
            crashed = True
            break
        goal = _at(path, k + 1)
        began = time.perf_counter()
        after, wanted = pilot.sample(seen, goal)
        spent.append(1e3 * (time.perf_counter() - began))
        asks.append(wanted)
        inner = pilot.inner
        if inner is not None and inner.plan is not None:
            touched += int((inner.margins() < NEAR).sum())
            if watch and k % THIN == 0:
                plans.append(
                    {"y": np.round(inner.plan.y, 3), "sigma": np.round(inner.plan.sigma, 4)}
                )
        plant.step(u, DT)
        u = np.array(after)
    flown, asked = np.abs(np.array(rates)), np.array(asks)
    # What was asked at one sample can be there at the next.
    error = np.array(rates)[1 : len(asked) + 1] - asked[: len(rates) - 1]
    row: dict[str, object] = {
        "seed": seed,
        "crashed": crashed,
        "worst": flown.max(axis=0),
        "beyond": int((flown > task.limit).any(axis=1).sum()),
        "samples": len(flown),
        "rmse": float(np.sqrt(np.mean(error**2))),
        "away": float(np.sqrt(np.mean(gaps))),
        "touched": touched,
        "solve_ms": np.round(spent, 2),
        "failures": 0 if pilot.inner is None else pilot.inner.failures,
    }
    if watch:
        row["trace"] = {
            "step": THIN * DT,
            "rates": np.round(np.array(rates)[::THIN], 3),
            "asked": np.round(asked[::THIN], 3),
            "plans": plans,
        }
    found: Flight = to_plain(row)
    return found
