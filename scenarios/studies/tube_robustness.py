"""What the tube controller does when something breaks in flight: rotors, battery, samples,
measurements, solver, clock.

Every fault of `FAULTS` begins in the middle of a flight over the obstacle course (a seeded time
between 2 and 4 s), against the independent plant in gusts, ten flights or more each, the same seeds
for all. The vehicle lifts 3.4 times its weight. A flight ends at the end of the course, or at the
ground (z = 0) where the controller has declared a descent. Per flight:

    broken      a Python exception, a command that is not finite, beyond its limits or its rate limit: none may be
    outcome     "course" (flown to its end), "landed" (declared descent, ground touched slower than SOFT and flatter than
                FLAT), "crashed" (farther than `lost` from the path without a declared descent, or a
                hard landing)
    crossings   planes that the true position crossed while the course was flown
    events      what the controller said of itself, by kind

    python -m scenarios.studies.tube_robustness --out OUT [--flights 10] [--model hybrid.json]
    [--only rotor-30,battery]

Rows go to OUT/robustness.jsonl as they come, and a second run goes on where the first stopped.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from greybox.files import append_json_line
from greybox.plants.effects.base import Hub, PlantEffect
from greybox.plants.quadrotor import Quadrotor
from greybox.residual.files import load_model
from greybox.symbolic import FloatArray
from mpc_export.mission import JUDGING_SEEDS, OBSTACLE_COURSE
from mpc_export.mission.craft import vehicle
from mpc_export.mission.flight import Mission, controller, mission, tightened
from mpc_export.tube.controller import TubeController
from scenarios.studies.rows import read_rows

KAPPA = 1.5
"""Standard deviations of the back-offs, as the tube of 20 % a flight has them."""
BEGIN = (2.0, 4.0)
"""A fault begins at a time drawn between these [s]."""
SOFT, FLAT = 1.5, math.radians(35.0)
"""Speed downward [m/s] and tilt [rad] of a landing that is none of the hard ones."""
PATIENCE = 6.0
"""So long after the end of the course a descent may last [s]."""
ROUNDING = 1e-6
PLACE, ALL = (
    ("x", "y", "z"),
    ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "p", "q", "r", "ax", "ay", "az"),
)


@dataclass(frozen=True, kw_only=True)
class WeakRotors(PlantEffect):
    """Thrust and torque of every rotor times its factor from `begin` [s] on: a chipped blade, a
    sagging battery."""

    name: ClassVar[str] = "weak_rotors"
    begin: float
    factors: tuple[float, ...]

    def parameters(self) -> dict[str, Any]:
        """None: it is no effect that a model could name."""
        return {}

    def thrust_factor(self, hub: Hub) -> Any:
        """1 before `begin`."""
        return self.factors[hub.index] if hub.body.time >= self.begin else 1.0

    torque_factor = thrust_factor


Seen = dict[str, float]
Change = Callable[[Seen, int, np.random.Generator], Seen | None]
"""Measurements k samples after the fault began -> those that arrive; None: the controller is not
called at all."""


@dataclass(frozen=True, kw_only=True)
class Fault:
    """What breaks. factors: of the thrust, `weak` one's or all rotors'; seen: what happens to
    measurements; failing: how many plans the QP fails for; clock: by how much the clock that the
    controller is told jumps [s]."""

    name: str
    text: str
    weak: float = 1.0
    all_rotors: bool = False
    seen: Change | None = None
    failing: int = 0
    clock: float = 0.0


def _lost(columns: Sequence[str], samples: float, value: float = math.nan) -> Change:
    return lambda seen, k, _: seen | dict.fromkeys(columns, value) if k < samples else seen


def _one(samples: float, value: float) -> Change:
    """One channel, drawn by the flight's seed."""

    def change(seen: Seen, k: int, rng: np.random.Generator) -> Seen:
        names = [c for c in ALL if c in seen]
        if k >= samples:
            return seen
        seed = int(rng.bit_generator.seed_seq.entropy[0])  # type: ignore[attr-defined]
        return seen | {names[seed % len(names)]: value}

    return change


def _now_and_then(share: float, what: Callable[[Seen, np.random.Generator], Seen | None]) -> Change:
    return lambda seen, k, rng: what(seen, rng) if rng.random() < share else seen


def _spike(columns: Sequence[str], size: float) -> Callable[[Seen, np.random.Generator], Seen]:
    def change(seen: Seen, rng: np.random.Generator) -> Seen:
        name = columns[int(rng.integers(len(columns)))]
        return seen | {name: seen[name] + size * float(rng.choice((-1.0, 1.0)))}

    return change


def _called(samples: int) -> Change:
    return lambda seen, k, _: None if k < samples else seen


FAULTS = {
    f.name: f
    for f in (
        Fault(name="none", text="nothing breaks"),
        Fault(name="rotor-30", text="one rotor loses 30 % of its thrust", weak=0.7),
        Fault(
            name="rotor-75",
            text="one rotor loses 75 % of its thrust: no steady hover with yaw",
            weak=0.25,
        ),
        Fault(
            name="battery", text="voltage falls: all thrusts times 0.85", weak=0.85, all_rotors=True
        ),
        Fault(
            name="collapse",
            text="voltage collapses: all thrusts times 0.315, less than the weight",
            weak=0.315,
            all_rotors=True,
        ),
        Fault(name="drop-1", text="one sample without measurements", seen=_lost(ALL, 1)),
        Fault(
            name="drop-10", text="ten samples in a row without measurements", seen=_lost(ALL, 10)
        ),
        Fault(
            name="drop-1%",
            text="1 % of the samples without measurements",
            seen=_now_and_then(0.01, lambda s, _: {}),
        ),
        Fault(name="nan-one", text="one channel NaN for 0.5 s", seen=_one(50, math.nan)),
        Fault(name="inf-one", text="one channel infinite for 0.5 s", seen=_one(50, math.inf)),
        Fault(name="nan-all", text="all channels NaN for 0.1 s", seen=_lost(ALL, 10)),
        Fault(
            name="inf-all", text="all channels infinite for 0.1 s", seen=_lost(ALL, 10, -math.inf)
        ),
        Fault(name="place-lost", text="no position from then on", seen=_lost(PLACE, math.inf)),
        Fault(name="all-lost", text="no measurement from then on", seen=_lost(ALL, math.inf)),
        Fault(name="qp-1", text="the QP fails once", failing=1),
        Fault(name="qp-5", text="the QP fails five times in a row", failing=5),
        Fault(name="qp-50", text="the QP fails fifty times in a row", failing=50),
        Fault(name="late-1", text="the controller is not called for one sample", seen=_called(1)),
        Fault(
            name="late-10", text="the controller is not called for ten samples", seen=_called(10)
        ),
        Fault(
            name="late-5%",
            text="5 % of the calls do not come",
            seen=_now_and_then(0.05, lambda s, _: None),
        ),
        Fault(name="clock+1", text="the clock jumps ahead by 1 s", clock=1.0),
        Fault(name="clock-1", text="the clock jumps back by 1 s", clock=-1.0),
        Fault(
            name="spikes",
            text="1 % of the positions 0.5 m off",
            seen=_now_and_then(0.01, _spike(PLACE, 0.5)),
        ),
        Fault(
            name="wild",
            text="1 % of the samples with one channel 1e6 off",
            seen=_now_and_then(0.01, _spike(ALL, 1e6)),
        ),
        Fault(
            name="gyro",
            text="1 % of the gyro's samples 5 rad/s off",
            seen=_now_and_then(0.01, _spike(("p", "q", "r"), 5.0)),
        ),
    )
}


def broken_vehicle(fault: Fault, begin: float, rotor: int) -> Quadrotor:
    """The course's vehicle with rotors that grow weak."""
    whole = vehicle()
    factors = [1.0] * 4 if not fault.all_rotors else [fault.weak] * 4
    factors[rotor] = fault.weak
    return Quadrotor(
        whole.airframe,
        (*whole.effects, WeakRotors(begin=begin, factors=tuple(factors))),
        battery=whole.battery,
        sensors=whole.sensors,
        process=whole.process,
    )


def fly(pilot: TubeController, task: Mission, fault: Fault, seed: int) -> dict[str, Any]:
    """One flight as a row of plain values."""
    course, dt, limits = task.course, task.dt, task.problem
    rng = np.random.default_rng([seed, 77])
    begin, rotor = float(rng.uniform(*BEGIN)), int(rng.integers(4))
    plant = broken_vehicle(fault, begin, rotor)
    plant.reset(seed, position=course.start[:3])
    pilot.start()
    u = np.array(pilot.u)
    steps = round(course.duration / dt)
    reference = course.sample(np.asarray(dt * np.arange(steps + 1), dtype=float))
    path, broken, outcome, calls = [], [], "course", 0
    flown = steps
    for k in range(steps + round(PATIENCE / dt)):
        if k >= steps and not pilot.descending:
            break
        time, on = dt * k, dt * k >= begin
        seen: Seen | None = plant.measure(u)
        after = int((time - begin) / dt + 1e-9)
        if on and fault.seen is not None and seen is not None:
            seen = fault.seen(seen, after, rng)
        calls += on and not (k + 1) % pilot.every
        bad = on and fault.failing and calls <= fault.failing
        pilot.solver.data["penalty"][()] = math.nan if bad else limits.penalty
        try:
            following = u if seen is None else np.array(pilot.sample(time + fault.clock * on, seen))
        except Exception as error:
            broken.append(f"{type(error).__name__}: {error}")
            outcome = "crashed"
            break
        if not np.isfinite(following).all():
            broken.append("a command is not finite")
            outcome = "crashed"
            break
        if (
            following.min() < limits.command_min - ROUNDING
            or following.max() > limits.command_max + ROUNDING
        ):
            broken.append(f"command beyond its limits: {following.round(4).tolist()}")
        if np.abs(following - u).max() > limits.rate_max + ROUNDING:
            broken.append(f"command changes by {np.abs(following - u).max():.3f}")
        now = plant.states()
        path.append([now[n] for n in ("x", "y", "z", "vz", "qx", "qy")])
        if pilot.descending and flown == steps:
            flown = k
        if pilot.descending and now["z"] <= 0.0:
            soft = now["vz"] > -SOFT and _tilt(np.array(path[-1:]))[0] < FLAT
            outcome = "landed" if soft else "crashed"
            break
        far = np.linalg.norm(np.array(path[-1][:3]) - reference.position[min(k, steps)])
        if not pilot.descending and not far <= course.lost:
            outcome = "crashed"
            break
        plant.step(u, dt)
        u = following
    else:
        outcome = "in the air"
    return _row(fault, seed, begin, np.array(path), flown, outcome, broken, pilot, task)


def _tilt(path: FloatArray) -> FloatArray:
    """Angle between thrust and vertical [rad], from the last two columns, qx and qy."""
    return np.asarray(
        np.arccos(np.clip(1.0 - 2.0 * (path[:, 4] ** 2 + path[:, 5] ** 2), -1.0, 1.0))
    )


def _row(
    fault: Fault,
    seed: int,
    begin: float,
    path: FloatArray,
    flown: int,
    outcome: str,
    broken: Sequence[str],
    pilot: TubeController,
    task: Mission,
) -> dict[str, Any]:
    course, n = task.course, min(flown, len(path), round(task.course.duration / task.dt))
    margins = {
        name: float(m.min(initial=np.inf)) for name, m in course.margins(path[:n, :3]).items()
    }
    reference = course.sample(np.asarray(task.dt * np.arange(n), dtype=float))
    down = path[flown:]
    return {
        "fault": fault.name,
        "seed": seed,
        "begin": round(begin, 3),
        "outcome": outcome,
        "broken": list(broken)[:5],
        "broken_count": len(broken),
        "crossed": {k: -v for k, v in margins.items() if v < 0},
        "rmse": float(np.sqrt(np.mean(np.sum((path[:n, :3] - reference.position) ** 2, axis=1)))),
        "tilt": float(_tilt(path).max()),
        "events": dict(Counter(e.what for e in pilot.events)),
        "seconds": round(task.dt * len(path), 2),
        "descent": None
        if not len(down)
        else {
            "begin": round(task.dt * flown, 2),
            "after": round(task.dt * flown - begin, 2),
            "fastest": float(-down[:, 3].min()),
            "touched": float(-down[-1, 3]),
            "tilt": float(_tilt(down).max()),
            "drift": float(np.linalg.norm(down[:, :2] - down[0, :2], axis=1).max()),
        },
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Per fault: outcomes, broken commands, flights that crossed a plane and how deep, error, tilt,
    events."""
    lines = [
        f"{'fault':10s} {'n':>3s} {'course':>6s} {'landed':>6s} {'crashed':>7s} {'broken':>6s} "
        f"{'crossed':>7s} {'deepest':>8s} {'RMSE':>7s} {'tilt':>5s}  events a flight"
    ]
    for name in FAULTS:
        mine = [r for r in rows if r["fault"] == name]
        if not mine:
            continue
        count = {
            o: sum(r["outcome"] == o for r in mine)
            for o in ("course", "landed", "crashed", "in the air")
        }
        depth = [max(r["crossed"].values()) for r in mine if r["crossed"]]
        kinds = Counter[str]()
        for r in mine:
            kinds.update(r["events"])
        said = ", ".join(
            f"{what}: {times / len(mine):.3g}" for what, times in sorted(kinds.items())
        )
        lines.append(
            f"{name:10s} {len(mine):3d} {count['course']:6d} {count['landed']:6d} "
            f"{count['crashed'] + count['in the air']:7d} "
            f"{sum(r['broken_count'] for r in mine):6d} {len(depth):7d} "
            f"{1e3 * max(depth, default=0.0):5.1f} mm {np.median([r['rmse'] for r in mine]):7.4f} "
            f"{math.degrees(max(r['tilt'] for r in mine)):4.0f}°  {said}"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", required=True, type=Path)
    parser.add_argument("--flights", type=int, default=10, help="flights per fault")
    parser.add_argument(
        "--model",
        type=Path,
        help="model file; default: the demo's hybrid, identified in OUT/models",
    )
    parser.add_argument("--only", help="faults, separated by commas")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.model is None:
        # imported here: identification needs what training a Gaussian process needs
        from mpc_export.mission.demo import identify

        options.model = identify(options.out / "models").get(
            "hybrid", options.out / "models" / "pem.json"
        )
    model = load_model(options.model)
    task = mission(model, OBSTACLE_COURSE)
    pilot = tightened(controller(model, task), task, kappa=KAPPA)
    log = options.out / "robustness.jsonl"
    rows = read_rows(log)
    done = {(r["fault"], r["seed"]) for r in rows}
    for name in options.only.split(",") if options.only else FAULTS:
        for seed in JUDGING_SEEDS[: options.flights]:
            if (name, seed) not in done:
                rows.append(fly(pilot, task, FAULTS[name], seed))
                append_json_line(log, rows[-1])
        print(table([r for r in rows if r["fault"] == name]).splitlines()[-1], flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
