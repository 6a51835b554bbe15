"""Does a hybrid know how sure it is? Stated uncertainty against errors on manoeuvres that nobody
fitted.

A simulated nano quadrotor (independent of greybox) hides a quadratic drag and a moment that is in
no catalogue. The physics model, which knows neither, is fitted to random waypoint flights; `learn`
adds what it misses; both are judged on figures of eight, lemniscates and circles. Printed per group
and horizon: RMSE, NLPD and the share of error vectors inside the stated 50 % and 95 % ellipsoids,
pooled over all held-out flights, for the physics as fitted, the physics with disturbance states,
and the hybrid. With --refit the physics is fitted with disturbance states and refitted beside what
is learned, "held" is the hybrid without the latter, and the parameters are compared with the truth.

    python -m scenarios.studies.hybrid_calibration [--flights 6] [--seconds 15] [--seed 0] [--points
    40] [--refit] [--out DIR]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from greybox.commands.missing_effect import ERRORS, SIGMA
from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.fit import fit
from greybox.estimation.options import FitOptions
from greybox.excitation.circle import Circle
from greybox.excitation.figure_eight import FigureEight
from greybox.excitation.injection import rich_excitation
from greybox.excitation.lemniscate import Lemniscate
from greybox.excitation.waypoints import RandomWaypoints
from greybox.files import write_json
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.plants import effects
from greybox.plants.effects.base import Body, PlantEffect
from greybox.plants.flight_log import Reference, fly, member
from greybox.plants.presets import controller_for, nano
from greybox.plants.quadrotor import Quadrotor
from greybox.plants.vectors import Number, Vector, norm
from greybox.plants.vehicle_file import write_vehicle
from greybox.residual.files import save_model
from greybox.residual.learn import Learned, learn
from greybox.residual.options import LearnOptions
from greybox.validation.result import Validation
from greybox.validation.validate import validate

KNOWN = ("motor_lag", "command_delay", "rotor_drag", "rotational_damping")
EXCITATION = 0.4
TARGETS = {1: (0.93, 0.97), 10: (0.90, 0.98), 50: (0.90, 0.99)}
"""Horizon in samples -> band for the coverage of the 95 % ellipsoids."""


@dataclass(frozen=True, kw_only=True)
class BankingMoment(PlantEffect):
    """M = c |v| (v_y, -v_x, 0) with the airspeed v in body axes; c [N m s^2/m^2]. No catalogue has
    it."""

    name: ClassVar[str] = "banking_moment"
    c: Number = 0.0

    def body_moment(self, body: Body) -> Vector:
        """Moment [N m]."""
        x, y, _ = body.airspeed
        size = norm(body.airspeed)
        return (self.c * y * size, -self.c * x * size, 0.0 * x)


def plant(hidden: bool = True) -> Quadrotor:
    """The true vehicle, with or without what the model does not know."""
    known = [
        effects.MotorLag(tau=0.05),
        effects.CommandDelay(d=0.012),
        effects.RotorDrag(k_x=2.0e-6, k_y=2.5e-6),
        effects.RotationalDamping(d_p=2e-5, d_q=3e-5, d_r=1e-5),
    ]
    unknown = [effects.ParasiticDrag(c_x=0.008, c_y=0.012, c_z=0.012), BankingMoment(c=3e-5)]
    return nano(known + unknown if hidden else known)


def vehicle(true_plant: Quadrotor) -> Vehicle:
    """Its vehicle file, ten per cent off."""
    with tempfile.TemporaryDirectory() as folder:
        return read_vehicle(
            write_vehicle(Path(folder) / "v.toml", true_plant, sigma=SIGMA, errors=ERRORS)
        )


def flights(
    true_plant: Quadrotor,
    references: Mapping[str, Reference],
    count: int,
    seconds: float,
    seed: int,
) -> Dataset:
    """`count` flights of every reference at 100 Hz, named after it."""
    sets = []
    for k, (label, reference) in enumerate(references.items()):
        seeds = [seed + 100 * k + i for i in range(count)]
        log = fly(
            true_plant,
            controller_for(true_plant),
            reference,
            rich_excitation(EXCITATION),
            seconds,
            seed=seeds,
            warm_up=1.0,
        )
        for i in range(count):
            one = {n: v for n, v in member(log, i).items() if not n.startswith("omega")}
            sets.append(dataset_from_arrays(one.pop("t"), one, name=f"{label}{i}"))
    whole = sets[0]
    for s in sets[1:]:
        whole = whole + s
    return whole


def training(true_plant: Quadrotor, count: int, seconds: float, seed: int) -> Dataset:
    """Flights between random waypoints."""
    return flights(true_plant, {"waypoints": RandomWaypoints()}, count, seconds, 10_000 * seed + 40)


def held_out(true_plant: Quadrotor, count: int, seconds: float, seed: int) -> Dataset:
    """Flights of other manoeuvres, `count` of each."""
    shapes: dict[str, Reference] = {
        "eight": FigureEight(period=5.5),
        "lemniscate": Lemniscate(period=5.0),
        "circle": Circle(period=5.0),
    }
    return flights(true_plant, shapes, count, seconds, 10_000 * seed + 4000)


def study(
    count: int, seconds: float, seed: int, points: int, *, refit: bool = False
) -> tuple[Learned, dict[str, Validation]]:
    """Fit, learn, judge: (what was learned, validation of "physics", "disturbed" and "hybrid").

    With `refit` the hybrid's physics was refitted beside what is learned, and "held" is the hybrid
    with the physics as fitted. That fit then has disturbance states too: what one without them
    leaves is no measure of what a refit gains.
    """
    true_plant = plant()
    train, test = (
        training(true_plant, count, seconds, seed),
        held_out(true_plant, max(1, count // 2), seconds, seed),
    )
    model = build_model(vehicle(true_plant), train.channels, KNOWN)
    plain = FitOptions(initialisation="nominal")
    noticing = FitOptions(disturbance=("force", "torque"))
    physics = fit(model, train, noticing if refit else plain).model
    options = LearnOptions(points=points, seed=seed, refit=refit)
    result = learn(physics, train, options, progress=_show)
    judged: dict[str, IdentifiedModel] = {
        "physics": physics,
        "disturbed": result.base,
        "hybrid": result.model,
    }
    if refit:
        judged["held"] = learn(physics, train, options, refit=False, progress=_show).model
    return result, {n: validate(m, test, horizon_samples=tuple(TARGETS)) for n, m in judged.items()}


def _show(text: str, share: float) -> None:
    print(f"  {100 * share:3.0f} %  {text}", flush=True)


def table(checked: Mapping[str, Validation]) -> str:
    """Per group and horizon the scores of every model, and whether the hybrid meets its targets."""
    lines = [
        f"{'group':10s} {'h':>3s} {'model':10s} {'RMSE':>9s} {'NLPD':>8s} {'in 50 %':>8s} "
        f"{'in 95 %':>8s}"
    ]
    missed = []
    groups = checked["hybrid"].table.groups if checked["hybrid"].table else {}
    for g in groups:
        for h, (low, high) in TARGETS.items():
            density = {}
            for name, validation in checked.items():
                e = validation.table.groups[g] if validation.table else None
                if e is None or e.nlpd is None or e.coverage is None:
                    continue
                density[name] = float(e.nlpd[h - 1])
                inside = {level: float(share[h - 1]) for level, share in e.coverage.items()}
                lines.append(
                    f"{g:10s} {h:3d} {name:10s} {e.rmse[h - 1]:9.4f} {density[name]:8.3f} "
                    f"{inside[0.5]:8.3f} {inside[0.95]:8.3f}"
                )
                if name == "hybrid" and not low <= inside[0.95] <= high:
                    missed.append(f"{g} at {h}: {inside[0.95]:.3f} not in {low:g}..{high:g}")
            if density["hybrid"] > density["physics"]:
                missed.append(f"{g} at {h}: density below the physics'")
    lines += [f"missed: {m}" for m in missed] or ["all targets met"]
    return "\n".join(lines)


def recovered(result: Learned) -> str:
    """Per parameter how far its estimate is from the truth, in per cent and in standard errors,
    before and after it was refitted."""
    true, lines = plant().parameters(), [f"{'parameter':26s} {'before':>20s} {'after':>20s}"]
    for m in result.moved:
        if m["name"] in true and m["std_after"]:
            truth = float(true[m["name"]])
            cells = [
                f"{100 * (value / truth - 1):+8.2f} % ({(value - truth) / std:+6.1f})"
                for value, std in (
                    (m["before"], m["std_before"]),
                    (m["after"], m["std_after"]),
                )
            ]
            lines.append(f"{m['name']:26s} {cells[0]:>20s} {cells[1]:>20s}")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study and print its table; with --out also write the hybrid and all results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--flights", type=int, default=6, help="training flights (half as many of each test shape)"
    )
    parser.add_argument("--seconds", type=float, default=15.0, help="length of a flight")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--points", type=int, default=40, help="support points")
    parser.add_argument(
        "--refit", action="store_true", help="show the hybrid whose physics was refitted too"
    )
    parser.add_argument("--out", metavar="DIR", help="folder for the models and results")
    options = parser.parse_args(arguments)
    result, checked = study(
        options.flights, options.seconds, options.seed, options.points, refit=options.refit
    )
    print(result.summary())
    print(table(checked))
    if result.refitted:
        print(recovered(result))
    if options.out:
        out = Path(options.out)
        save_model(result.base, out / "disturbed.json")
        save_model(result.model, out / "hybrid.json")
        content: dict[str, Any] = {**result.to_dict()}
        content["validation"] = {
            "before": checked["physics"].to_dict(),
            "after": checked["hybrid"].to_dict(),
        }
        write_json(out / "learn.json", content)


if __name__ == "__main__":
    main()
