"""What each part of `greybox fit` gains on the NanoBench flights: a ladder from motors alone to all.

    python -m scenarios.studies.fit_ladder --out DIR [--fitted FIT]

FIT is the folder of a plain `greybox fit` of the nine training flights (made in DIR where none is
given). Its recipe, as it prints it, is fitted again with parts left out; every rung starts from the
same values. The rungs, cumulative:

    motors and gains      motor lag, command delay, sensor biases; likelihood one step ahead; a
                          prediction starts from the measured state, smoothed velocities included
    + start by the filter the same model from what its filter says
    + chosen effects      the effects that the plain fit chose
    + 5 s of the flight   what belongs to a flight from its first five seconds
    + pushes that last    disturbance states of force and torque that fade within `HELD` seconds
    + their own time      that time scale fitted
    + errors ahead        errors up to half a second ahead in place of one step: the plain fit
    + learned part        `greybox learn` on it

Printed: mean absolute error of the vector norm at `AHEAD` on the five judged flights, and CPU
seconds of each fit. What DIR has is not made again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from greybox.data import Dataset
from greybox.data.logs import read_logs
from greybox.examples import NANOBENCH_TEST, NANOBENCH_TRAIN, flight_path, vehicle_path
from greybox.model.identified import IdentifiedModel
from greybox.model.vehicle import read_vehicle
from greybox.validation.horizon_table import HorizonTable
from greybox.validation.validate import validate
from scenarios.studies.few_flights import command

ADAPT, AHEAD, HELD = 5.0, (10, 50, 100), 1.0
GROUPS = ("position", "velocity", "rotation", "rate")
MOTORS = ("motor_lag", "command_delay", "gyro_bias", "accelerometer_bias")
TIMES = ("disturbance.force.T", "disturbance.torque.T")
Recipe = dict[str, str | None]


@dataclass(frozen=True, kw_only=True)
class Rung:
    """A model, by the name of its fit, and how it is judged."""

    label: str
    fit: str
    adapt: float | None = ADAPT
    measured: bool = False


RUNGS = (
    Rung(label="motors and gains", fit="motors", adapt=None, measured=True),
    Rung(label="+ start by the filter", fit="motors", adapt=None),
    Rung(label="+ chosen effects", fit="effects", adapt=None),
    Rung(label="+ 5 s of the flight", fit="effects"),
    Rung(label="+ pushes that last", fit="held"),
    Rung(label="+ their own time", fit="likelihood"),
    Rung(label="+ errors ahead", fit="plain"),
    Rung(label="+ learned part", fit="learned"),
)


@dataclass(kw_only=True)
class Ladder:
    """Fits in `out`, the plain one in `plain`; `seconds` of CPU of those that were made."""

    out: Path
    plain: Path
    seconds: dict[str, float] = field(default_factory=dict)

    def model(self, fit: str) -> Path:
        """The model file of a fit, made where it is not there."""
        if fit == "plain":
            return self.made("plain", self.plain / "model.json", ["fit"], self.plain)
        if fit == "learned":
            start = ["learn", str(self.model("plain")), "--adapt", f"{ADAPT:g}"]
            return self.made(fit, self.out / fit / "hybrid.json", start, self.out / fit)
        told = json.loads((self.model("plain").parent / "fit.json").read_text())
        options = without(recipe_of(told["explicit"]["options"]), fit)
        words = [w for k, v in options.items() for w in ((k,) if v is None else (k, v))]
        return self.made(fit, self.out / fit / "model.json", ["fit", *words], self.out / fit)

    def made(self, fit: str, model: Path, words: Sequence[str], folder: Path) -> Path:
        """`model`, which the command writes into `folder`."""
        if not model.exists():
            flights = [str(flight_path("nanobench", n)) for n in NANOBENCH_TRAIN]
            vehicle = ["--vehicle", str(vehicle_path("nanobench"))] if words[0] == "fit" else []
            self.seconds[fit] = command(*words, *vehicle, "--train", *flights, "--out", str(folder))
            print(f"{fit}: {self.seconds[fit]:.0f} s of CPU", flush=True)
        return model


def recipe_of(options: Sequence[str]) -> Recipe:
    """Option -> its value, None where it has none."""
    recipe: Recipe = {}
    for word in options:
        if word.startswith("--"):
            recipe[word] = None
        else:
            recipe[list(recipe)[-1]] = word
    return recipe


def without(recipe: Mapping[str, str | None], fit: str) -> Recipe:
    """The recipe with the parts left out that the fit lacks."""
    out = dict(recipe) | {"--predictor": "innovation"}
    if fit == "held":
        out["--fixed"] = ",".join([*(recipe.get("--fixed") or "").split(","), *TIMES]).strip(",")
    pushes = fit not in ("motors", "effects")
    effects = MOTORS if fit == "motors" else tuple((recipe["--effects"] or "").split(","))
    out["--effects"] = ",".join(effects)
    if not pushes:
        out["--disturbance"] = "none"

    def there(name: str) -> bool:
        effect = name.split(".")[0]
        known = effect in effects or effect in ("inertia", "center_of_mass", "thrust", "process")
        if "disturbance." in name:
            return pushes
        return known or effect in ("sensor", "torque", "mass")

    for option in ("--value", "--noise", "--per-flight"):
        kept = [w for w in (recipe.get(option) or "").split(",") if w and there(w.split("=")[0])]
        if fit == "held" and option == "--value":
            kept = [w for w in kept if w.split("=")[0] not in TIMES]
            kept += [f"{n}={HELD:g}" for n in TIMES]
        out[option] = ",".join(kept)
    return {k: v for k, v in out.items() if v != ""}


def table_of(rung: Rung, model: IdentifiedModel, data: Dataset) -> HorizonTable:
    """Errors of a rung. Raises `SystemExit` where nothing could be predicted."""
    found = validate(model, data, adapt=rung.adapt or 0.0, skip=ADAPT, measured_start=rung.measured)
    table = found.measured_start if rung.measured else found.table
    if table is None:
        raise SystemExit(f"{rung.label}: nothing could be predicted")
    return table


def main(arguments: Sequence[str] | None = None) -> None:
    """Fit what is not there, judge, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--fitted", type=Path, metavar="FIT", help="folder of the plain fit")
    options = parser.parse_args(arguments)
    ladder = Ladder(out=options.out, plain=options.fitted or options.out / "plain")
    vehicle = read_vehicle(vehicle_path("nanobench"))
    data = read_logs([flight_path("nanobench", n) for n in NANOBENCH_TEST], vehicle)
    print(f"{'mean absolute error':24}" + "".join(f"{g:22}" for g in GROUPS).rstrip())
    for rung in RUNGS:
        table = table_of(rung, IdentifiedModel.load(ladder.model(rung.fit)), data)
        cells = (
            " ".join(f"{float(table.groups[g].mae[h - 1]):<6.4f}" for h in AHEAD) for g in GROUPS
        )
        print(f"{rung.label:24}" + "  ".join(cells), flush=True)


if __name__ == "__main__":
    main()
