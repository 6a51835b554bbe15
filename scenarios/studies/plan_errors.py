"""Does a planned flight deliver the standard errors that it promises? Many flights of one plan,
each fitted.

A vehicle file says what is known of a simulated craft; `greybox.planning` proposes a flight. An
independent NumPy plant with a controller flies the setpoints and injected signals as an autopilot
would, with sensor and process noise, once per seed; every log is fitted. The spread of the
estimates is held against the plan's standard errors, and the same for hover and figure of eight of
the same length, flown by the same plant.

    python -m scenarios.studies.plan_errors --seeds 64
    python -m scenarios.studies.plan_errors --seeds 64 --autopilot other
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from greybox.excitation.signal import Array
from greybox.excitation.trajectory import Trajectory
from greybox.plants import effects as plant_effects
from greybox.plants.controller import Gains
from greybox.plants.flight_log import fly, member
from greybox.plants.presets import DEFAULT, controller_for, x250
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vehicle_file import write_vehicle

WANTED = ("motor_lag", "rotor_drag", "rotational_damping")
DT = 0.01
AUTOPILOTS = {
    "planned": Gains(
        position=2.5,
        velocity=3.0,
        position_integral=0.0,
        height=2.5,
        climb=3.0,
        height_integral=0.0,
        attitude=60 / 13,
        yaw=15 / 6.5,
        rate=13.0,
        yaw_rate=6.5,
        rate_integral=0.0,
        tilt_max=0.61,
        rate_max=50.0,
    ),
    "other": DEFAULT,
}
"""Loop gains: those that the plan was simulated with, and another autopilot's, stiffer and with
integrators."""


def plant() -> Quadrotor:
    """The true craft: 0.5 kg, with lag, drag and damping."""
    return x250(
        [
            plant_effects.MotorLag(tau=0.04),
            plant_effects.RotorDrag(k_x=2.5e-5, k_y=3.0e-5),
            plant_effects.RotationalDamping(d_p=2e-3, d_q=3e-3, d_r=1e-3),
        ]
    )


@dataclass(frozen=True, kw_only=True)
class Table:
    """A flight's setpoints and injected signals, as reference and excitation of a simulated
    autopilot."""

    columns: Mapping[str, Array]

    def sample(self, time: Array, rng: np.random.Generator) -> Trajectory:
        """The reference at the table's own times."""
        c = self.columns

        def stack(letter: str) -> Array:
            return np.column_stack([c[f"sp_{letter}{a}"] for a in "xyz"])

        return Trajectory(
            position=stack(""),
            velocity=stack("v"),
            acceleration=stack("a"),
            yaw=c["sp_yaw"],
            yaw_rate=c["sp_yaw_rate"],
        )


@dataclass(frozen=True, kw_only=True)
class Injected:
    """The injected columns of a table."""

    columns: Mapping[str, Array]

    def sample(self, time: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Mixer inputs (N, 4): thrust, roll, pitch, yaw; no setpoint offsets."""
        mixer = np.column_stack(
            [self.columns[f"inj_{n}"] for n in ("thrust", "roll", "pitch", "yaw")]
        )
        return mixer, np.zeros_like(mixer)


def noise_of(craft: Quadrotor, dt: float = DT) -> dict[str, float]:
    """The plant's process noise per sample, under greybox's names."""
    axes = {"force": craft.process.force, "torque": craft.process.torque}
    out: dict[str, float] = {}
    for group, level in axes.items():
        three = level if isinstance(level, tuple) else (level,) * 3
        out |= {f"noise.process.{group}.{a}": float(v) / dt**0.5 for a, v in zip("xyz", three)}
    return out


def truths(craft: Quadrotor) -> dict[str, float]:
    """True values under greybox's names."""
    return {k: float(v) for k, v in craft.truth()["parameters"].items()}


def spread(
    columns: Mapping[str, Array],
    model: Any,
    free: Sequence[str],
    seeds: Sequence[int],
    noise: Mapping[str, float],
    gains: Gains,
) -> tuple[dict[str, Array], dict[str, Array], int]:
    """Estimates by name (runs,), the fits' own standard errors, and how many failed, of the flight
    flown once per seed."""
    from greybox.data import dataset_from_arrays
    from greybox.estimation.fit import fit

    craft = plant()
    seconds = DT * len(columns["t"])
    logs = fly(
        craft,
        controller_for(craft, gains),
        Table(columns=columns),
        Injected(columns=columns),
        seconds,
        DT,
        list(seeds),
    )
    values: dict[str, list[float]] = {}
    stds: dict[str, list[float]] = {}
    failed = 0
    for k in range(len(seeds)):
        log = member(logs, k)
        data = dataset_from_arrays(
            log["t"], {n: v for n, v in log.items() if n != "t"}, name=f"seed {seeds[k]}"
        )
        result = fit(model, data, free=free, noise=dict(noise))
        failed += not result.converged
        for n, e in result.parameters.items():
            values.setdefault(n, []).append(e.value)
            stds.setdefault(n, []).append(e.std)
    return (
        {n: np.array(v) for n, v in values.items()},
        {n: np.array(v) for n, v in stds.items()},
        failed,
    )


def study(
    seeds: Sequence[int], *, seconds: float = 60.0, naive: bool = True, autopilot: str = "planned"
) -> dict[str, Any]:
    """Plan, fly, fit. Rows by parameter: predicted and measured spread of the plan and of the naive
    flight."""
    from greybox.model.vehicle import read_vehicle
    from greybox.planning import plan
    from greybox.planning.excitation_blocks import excitation_blocks
    from greybox.planning.setpoints import setpoints

    craft = plant()
    noise = noise_of(craft)
    with tempfile.TemporaryDirectory() as folder:
        path = write_vehicle(
            Path(folder) / "v.toml",
            craft,
            sigma={"inertia": 0.3, "thrust": 0.3, "torque": 0.5},
            known=WANTED,
        )
        vehicle = read_vehicle(path)
    declared = {
        "motor_lag.tau",
        *(f"rotor_drag.k_{a}" for a in "xy"),
        *(f"rotational_damping.d_{a}" for a in "pqr"),
    }
    core = {n for n, q in vehicle.quantities.items() if not q.exact}
    made = plan(vehicle, effects=WANTED, free=sorted(declared | core), seconds=seconds, noise=noise)
    model = made.subject.dynamics
    gravity = float(vehicle.gravity)
    (steps,) = made.flights
    out: dict[str, Any] = {"plan": made, "rows": {}}
    flights = {"plan": steps}
    if naive:
        every = {
            p.name: p
            for p in excitation_blocks(
                made.subject.flying, made.limits, seconds=steps[0][0].seconds
            )
        }
        count = len(steps)
        flights["naive"] = ((every["hover"], 1.0),) * ((count + 1) // 2) + (
            (every["figure_eight"], 1.0),
        ) * (count // 2)
    free = list(made.subject.free)
    for name, flown in flights.items():
        columns = setpoints(flown, made.limits, DT, gravity)
        values, stds, failed = spread(columns, model, free, seeds, noise, AUTOPILOTS[autopilot])
        out[f"failed_{name}"] = failed
        for n in free:
            row = out["rows"].setdefault(n, {})
            predicted = (made.errors if name == "plan" else made.naive)[n][0]
            row[name] = {
                "predicted": predicted,
                "measured": float(values[n].std(ddof=1)),
                "own": float(np.median(stds[n])),
                "bias": float(values[n].mean() - truths(craft).get(n, np.nan)),
            }
    return out


def report(result: Mapping[str, Any], runs: int) -> str:
    """The table as text."""
    head = (
        f"{runs} flights each: standard deviations, the fits' own over the measured one, bias "
        "over the measured one"
    )
    lines = [
        head,
        f"{'':32}{'predicted':>11}{'measured':>11}{'ratio':>7}{'fit/meas':>9}{'bias':>9}",
    ]
    for n, row in result["rows"].items():
        for name, r in row.items():
            ratio = r["measured"] / r["predicted"]
            numbers = f"{r['predicted']:11.3g}{r['measured']:11.3g}{ratio:7.2f}{r['own'] / r['measured']:9.2f}"
            lines.append(f"{n + ' (' + name + ')':32}{numbers}{r['bias'] / r['measured']:9.2f}")
    both = [row for row in result["rows"].values() if "naive" in row]
    if both:
        gain = np.median([r["naive"]["measured"] / r["plan"]["measured"] for r in both])
        hope = np.median([r["naive"]["predicted"] / r["plan"]["predicted"] for r in both])
        lines.append(
            f"naive over plan, median of the measured spreads: {gain:.2f} (predicted {hope:.2f})"
        )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--autopilot", choices=tuple(AUTOPILOTS), default="planned")
    parser.add_argument(
        "--plan-only", action="store_true", help="leave out hover and figure of eight"
    )
    arguments = parser.parse_args(argv)
    result = study(
        range(arguments.seeds),
        seconds=arguments.seconds,
        naive=not arguments.plan_only,
        autopilot=arguments.autopilot,
    )
    print(result["plan"].summary())
    print(report(result, arguments.seeds))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
