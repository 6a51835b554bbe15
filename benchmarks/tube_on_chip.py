"""What does the whole tube MPC cost as float C on a Cortex-M7 (emulated: instructions, never
cycles), and how far are its commands from those in double?

    python -m benchmarks.tube_on_chip --points 0 20 50 --horizon 10 20 --flights 5
    python -m benchmarks.tube_on_chip --points 0 20 --horizon 5 --linear --part M4F

Needs `tests`: the craft of the export's tests with motor lag, delay and, with points, a Gaussian
process of that many support points that pushes three channels; or a model of your own (`--model`).
Every flight goes around a circle of its own size and speed, beside a wall that cuts it, with noise,
a gap and a spike in its measurements; float and double compute from the same ones. On the emulator it flies the
first two seconds of the first flights. `--linear --part M4F --horizon 5` is the linear tube.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from benchmarks import cortex
from greybox.residual.files import load_model
from greybox.symbolic import FloatArray
from mpc_export.tube.controller import TubeController
from mpc_export.tube.in_process import TubeInC
from mpc_export.tube.library import flight, paths
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.target import write_tube
from tests.mpc_export import cases

RESULTS = Path(__file__).resolve().parent / "results"
SHORT = 200
"""Samples on the emulator."""


class Circle:
    """radius [m] about (0, 0, 1), speed [m/s], heading 0."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.radius, self.speed = float(rng.uniform(0.3, 1.0)), float(rng.uniform(0.5, 2.0))

    def sample(self, time: FloatArray) -> Any:
        """At the times (n,)."""
        r, w = self.radius, self.speed / self.radius
        c, s, zero = np.cos(w * time), np.sin(w * time), np.zeros(len(time))
        return SimpleNamespace(
            position=np.column_stack([r * c, r * s, zero + 1.0]),
            velocity=np.column_stack([-r * w * s, r * w * c, zero]),
            acceleration=np.column_stack([-r * w * w * c, -r * w * w * s, zero]),
            yaw=zero,
        )

    def planes(self, time: FloatArray) -> FloatArray:
        """A wall at x = 0.8 radius."""
        found = np.zeros((len(time), 2, 4))
        found[:, :, 3] = 1.0
        found[:, 0] = [1.0, 0.0, 0.0, 0.8 * self.radius]
        return found


def flights(
    pilot: TubeController, folder: Path, many: int, seconds: float, linear: bool = False
) -> dict[str, Any]:
    """Float and double on the same measurements; of the linear tube also each flying the model
    itself: where nothing flies back, its integral action lets rounding grow."""
    made = {}
    for real in ("double", "float"):
        (folder / real).mkdir()
        made[real] = TubeInC(pilot, folder / real, real=real, linear=linear)
    steps = round(seconds / pilot.model.sample_time)
    worst, apart, beyond, failed, plans = [], [], 0, 0, 0
    for seed in range(many):
        path = Circle(seed)
        pilot.reference, pilot.planes = path, path.planes
        made["double"].reference, made["double"].planes = path, path.planes
        y = flight(pilot, steps, seed, made["double"] if linear else None)["measured"]
        commands = {}
        for real, flown in made.items():
            flown.reference, flown.planes = path, path.planes
            flown.start()
            commands[real] = np.array(
                [
                    flown.sample(k * flown.dt, dict(zip(flown.columns, row)))
                    for k, row in enumerate(y)
                ]
            )
        if linear:
            own = [flight(pilot, steps, seed, m)["commands"] for m in made.values()]
            apart.append(np.abs(own[1] - own[0]).max(axis=1))
        off = np.abs(commands["float"] - commands["double"]).max(axis=1)
        worst.append(float(off.max()))
        beyond += int((off > 1e-3).sum())
        failed += sum(s & 256 > 0 for s in made["float"].said)
        plans += steps // pilot.every
    closed = (
        {
            "largest difference in closed loops": float(np.max(apart)),
            "samples beyond 1e-3 in closed loops": int((np.array(apart) > 1e-3).sum()),
        }
        if apart
        else {}
    )
    return {
        **closed,
        "flights": many,
        "seconds each": seconds,
        "largest difference": max(worst),
        "median of flights": float(np.median(worst)),
        "samples beyond 1e-3": beyond,
        "samples": many * steps,
        "plans without solution in float": failed,
        "plans": plans,
    }


def closed_loop(
    pilot: TubeController, folder: Path, many: int, seconds: float, linear: bool
) -> dict[str, Any]:
    """The model itself flown by the library in float: is the wall kept after the first second?"""
    made = TubeInC(pilot, folder, real="float", linear=linear)
    f, steps = pilot.filter, round(seconds / pilot.model.sample_time)
    place = [f.states.names.index(f"position.{a}") for a in "xyz"]
    beyond, away, failed, plans = [], [], 0, 0
    for seed in range(many):
        path = Circle(seed)
        for own in (pilot, made):
            own.reference, own.planes = path, path.planes
        states = flight(pilot, steps, seed, made)["states"][:, place]
        times = np.asarray(pilot.model.sample_time * np.arange(1, steps + 1), dtype=float)
        away.append(np.sqrt(((states - path.sample(times).position) ** 2).sum(axis=1).mean()))
        beyond.append((states[times > 1.0, 0] - 0.8 * path.radius).max())
        failed += sum(s & 256 > 0 for s in made.said)
        plans += steps // pilot.every
    return {
        "closed loops": many,
        "of these over the wall": int(np.sum(np.array(beyond) > 0)),
        "farthest over it [m]": float(np.max(beyond)),
        "rms from the circle [m]": float(np.mean(away)),
        "plans without solution there": failed,
        "plans there": plans,
    }


def pilot_of(model: Any, horizon: int, arguments: argparse.Namespace) -> TubeController:
    """The controller that is written as C."""
    return TubeController(
        model=model,
        problem=TubeProblem(
            dt=0.05 if arguments.linear else 0.02,
            horizon=horizon,
            planes=2,
            attempts=arguments.attempts,
        ),
        reference=Circle(0),
        planes=Circle(0).planes,
        kappa=(2.0, 2.0, 2.0),
        kappa_u=1.0,
    )


def on_chip(pilot: TubeController, part: Any, arguments: argparse.Namespace) -> dict[str, Any]:
    """What the first flights cost there."""
    counts, plans, off = [], [], 0.0
    with tempfile.TemporaryDirectory() as name:
        folder, linear = Path(name), arguments.linear
        files = write_tube(pilot, folder, name="craft", real="float", linear=linear)
        flown = None
        if linear:
            (folder / "double").mkdir()
            flown = TubeInC(pilot, folder / "double", real="double", linear=True)
        for seed in range(arguments.chip_flights):
            path = Circle(seed)
            for own in (pilot, flown):
                if own is not None:
                    own.reference, own.planes = path, path.planes
            recorded = flight(pilot, SHORT, seed, flown)
            given = recorded["measured"], paths(pilot, SHORT), part, pilot.model.sample_time
            run = cortex.fly_on_cortex(files[:-1], "craft", *given)
            counts.append(run.instructions)
            plans.append(run.instructions[run.instructions > 0.3 * run.instructions.max()])
            off = max(off, float(np.abs(run.commands - recorded["commands"]).max()))
    return {
        "flights on the chip": arguments.chip_flights,
        "instructions, largest": float(np.max(counts)),
        "instructions of a plan, median": float(np.median(np.concatenate(plans))),
        "instructions of a sample between": float(np.min(counts)),
        "flash_bytes": run.flash,
        "ram_bytes": run.ram,
        "stack_bytes": run.stack,
        "from Python" if not linear else "from double": off,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", type=Path)
    parser.add_argument("--points", type=int, nargs="+", default=[0, 20, 50])
    parser.add_argument("--horizon", type=int, nargs="+", default=[10, 20])
    parser.add_argument("--flights", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--chip-flights", type=int, default=1)
    parser.add_argument("--closed-loops", type=int, default=0)
    parser.add_argument("--attempts", type=int, choices=(1, 2), default=1)
    parser.add_argument("--linear", action="store_true", help="the linear tube")
    parser.add_argument("--part", choices=("M7F", "M4F"), default="M7F")
    parser.add_argument("--out", type=Path, default=RESULTS / "tube_on_chip.json")
    arguments = parser.parse_args()
    missing = cortex.missing_tool()
    if missing:
        raise SystemExit(
            f"{missing} is needed (Debian: gcc-arm-none-eabi libnewlib-arm-none-eabi "
            "qemu-system-arm)"
        )
    part = {"M7F": cortex.M7F, "M4F": cortex.M4F}[arguments.part]
    rows: list[dict[str, Any]] = []
    for points in [0] if arguments.model else arguments.points:
        if arguments.model:
            model = load_model(arguments.model)
        else:
            model = cases.hybrid(points=points) if points else cases.disturbed()
        for horizon in arguments.horizon:
            pilot = pilot_of(model, horizon, arguments)
            row = {"part": arguments.part, "points": points, "horizon": horizon}
            row |= {"linear": arguments.linear, "attempts": arguments.attempts}
            row |= on_chip(pilot, part, arguments)
            print(json.dumps(row), flush=True)
            if arguments.flights:
                with tempfile.TemporaryDirectory() as name:
                    flown = arguments.flights, arguments.seconds, arguments.linear
                    row |= flights(pilot, Path(name), *flown)
                print(json.dumps(row), flush=True)
            if arguments.closed_loops:
                with tempfile.TemporaryDirectory() as name:
                    flown = arguments.closed_loops, arguments.seconds, arguments.linear
                    row |= closed_loop(pilot, Path(name), *flown)
                print(json.dumps(row), flush=True)
            rows.append(row)
    content = {"question": __doc__.split("\n\n")[0], "rows": rows}
    arguments.out.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
