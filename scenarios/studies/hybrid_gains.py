"""On which plants does the paper's hybrid gain over its linear model, and on which can it not?

A linear model of p, q, r and a Gaussian process on its output residual, with the paper's inputs of
the sample before (rates, roll, pitch, commands), are fitted to three flights of 20 s and judged on
two others. The process can only gain where the linear model misses something, and where what is
missed follows from its inputs. Printed per plant: root mean square error of the rates .01, .05, .1
and .2 s ahead, mean over the axes, of the linear model and of the hybrid over it.

    python -m scenarios.studies.hybrid_gains [--out FILE] [--figure FILE.png]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from greybox.files import write_json
from greybox.plants.effects import (
    BatterySag,
    BladeFlapping,
    CenterOfMassOffset,
    MotorLag,
    PlantEffect,
    RotorDrag,
)
from greybox.plants.presets import LARGE_SENSORS, X250, x250
from greybox.plants.quadrotor import Quadrotor
from greybox.symbolic import FloatArray
from mpc_export.mission.craft import GUSTS
from mpc_export.rates.craft import OUTPUTS, training_log
from mpc_export.rates.identify import fitted, segments_of_logs

AHEAD = (1, 5, 10, 20)
"""Samples of 10 ms."""
START, EVERY = 300, 10
"""First origin, and samples between origins."""
TEST = (50, 51)
"""Training seeds of the flights that judge: no model has seen them."""
QUICK = MotorLag(tau=0.03)
REST = (RotorDrag(k_x=4e-5, k_y=5e-5), CenterOfMassOffset(c_x=0.004, c_y=-0.003))


@dataclass(frozen=True, kw_only=True)
class Plant:
    """What the linear model misses, whether the process's inputs tell it, the plant and how it
    climbs."""

    missed: str
    told: str
    make: Callable[[], Quadrotor]
    climbs: float = 4.0


def _x250(*effects: PlantEffect) -> Callable[[], Quadrotor]:
    return lambda: x250((*effects, *REST), process=GUSTS)


def _proportional(inertia: tuple[float, float, float] = (2.1e-3, 2.4e-3, 3.9e-3)) -> Quadrotor:
    """Thrust that goes with the command itself."""
    frame = replace(X250, thrust=(0.0, 2.268, 0.0), torque=(0.0, 0.0297, 0.0), inertia=inertia)
    return Quadrotor(frame, (QUICK, *REST), sensors=LARGE_SENSORS, process=GUSTS)


PLANTS = {
    "climbs": Plant(
        missed="thrust with the square of speed, pitch by roll and yaw",
        told="yes",
        make=_x250(QUICK),
    ),
    "climbs, no lag": Plant(missed="the same", told="yes", make=_x250()),
    "climbs, slow motors": Plant(
        missed="the same",
        told="in part: rotors follow older commands",
        make=_x250(MotorLag(tau=0.1)),
    ),
    "level": Plant(missed="the same, less of it", told="yes", make=_x250(QUICK), climbs=0.3),
    "linear thrust": Plant(
        missed="pitch by roll and yaw (gyroscopic)", told="yes", make=_proportional
    ),
    "a ball": Plant(
        missed="nothing", told="-", make=lambda: _proportional((2.4e-3, 2.4e-3, 2.4e-3))
    ),
    "battery": Plant(
        missed="square of speed and of voltage",
        told="speed, not voltage",
        make=_x250(QUICK, BatterySag(nominal_voltage=11.1, c_V=1.0)),
    ),
    "flapping": Plant(
        missed="moments of the air's speed",
        told="no: speed is not among them",
        make=_x250(QUICK, BladeFlapping(k_flap=8e-6)),
    ),
}


def judged(plant: Plant, say: Callable[[str], None]) -> dict[str, Any]:
    """Errors (rad/s) of linear model and hybrid by samples ahead, and for which outputs the process
    was kept."""
    hybrid = fitted(
        [training_log(i, plant=plant.make(), climbs=plant.climbs) for i in range(3)], say
    )
    tests = segments_of_logs(
        [training_log(i, plant=plant.make(), climbs=plant.climbs) for i in TEST]
    )
    errors: dict[str, list[FloatArray]] = {"linear": [], "hybrid": []}
    for segment in tests:
        y = segment.matrix(OUTPUTS)
        origins = np.arange(START, segment.n - max(AHEAD) - 1, EVERY)
        for name, model in (("linear", hybrid.base), ("hybrid", hybrid)):
            mean, _ = model.free_run(segment, origins, max(AHEAD))
            errors[name].append(y[origins[:, None] + np.arange(1, max(AHEAD) + 1)] - mean)
    rmse = {
        n: [
            float(np.sqrt(np.nanmean(np.concatenate(e)[:, k - 1] ** 2, axis=0)).mean())
            for k in AHEAD
        ]
        for n, e in errors.items()
    }
    return {
        "missed": plant.missed,
        "told": plant.told,
        **rmse,
        "kept": [bool(v) for v in hybrid.posterior.active],
        "ratio": [h / b for h, b in zip(rmse["hybrid"], rmse["linear"], strict=True)],
    }


def draw(rows: dict[str, dict[str, Any]], path: Path) -> None:
    """Error of the hybrid over that of its linear model, by plant and time ahead."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(7.5, 3.2), constrained_layout=True)
    places = np.arange(len(rows))
    for j, k in enumerate(AHEAD):
        values = [row["ratio"][j] for row in rows.values()]
        axis.bar(
            places + 0.2 * (j - 1.5),
            values,
            width=0.18,
            color=f"C{j}",
            label=f"{0.01 * k:g} s ahead",
        )
    axis.axhline(1.0, color="k", lw=0.8)
    axis.set_xticks(places, [n.replace(", ", ",\n") for n in rows], fontsize=8)
    axis.set_ylabel("error, hybrid over linear")
    axis.set_ylim(0.0, 1.35)
    axis.legend(ncol=4, fontsize=8, loc="upper left")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def main(argv: Sequence[str] | None = None) -> int:
    """All plants."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", default=None)
    parser.add_argument("--figure", default=None)
    parser.add_argument("--plants", nargs="+", default=list(PLANTS), choices=list(PLANTS))
    arguments = parser.parse_args(argv)
    rows = {}
    for name in arguments.plants:
        row = rows[name] = judged(PLANTS[name], lambda _: None)
        ratios = " ".join(f"{v:5.2f}" for v in row["ratio"])
        errors = " ".join(f"{v:6.3f}" for v in row["linear"])
        kept = "".join(n if on else "-" for n, on in zip(OUTPUTS, row["kept"], strict=True))
        print(f"{name:20s} linear {errors}  hybrid over it {ratios}  kept {kept}", flush=True)
    if arguments.out:
        write_json(arguments.out, rows)
    if arguments.figure:
        draw(rows, Path(arguments.figure))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
