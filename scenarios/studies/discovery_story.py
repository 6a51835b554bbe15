"""The story of a missing effect, told twice: one hidden effect, then two at once, each with its report.

    python -m scenarios.studies.discovery_story --out story

A 250 mm quadrotor flies in closed loop through random waypoints. Its vehicle file is ten per cent off in inertia and
thrust and knows no effect. Hidden are rotor drag, then motor lag together with an offset of the centre of mass. Every
case gets its own folder with the logs, the vehicle file and what `greybox discover` wrote; the test flight is another
path with other noise. At the end the story stands beside what was hidden.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from greybox.cli import main as greybox
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.plants.effects import CenterOfMassOffset, MotorLag, PlantEffect, RotorDrag
from greybox.plants.flight_log import fly, member, write_log
from greybox.plants.presets import controller_for, x250
from greybox.plants.vehicle_file import write_vehicle
from scenarios.studies.discovery_grid import ERRORS, SIGMA

STORIES: dict[str, tuple[PlantEffect, ...]] = {
    "one": (RotorDrag(k_x=2e-5, k_y=2.5e-5),),
    "pair": (MotorLag(tau=0.04), CenterOfMassOffset(c_x=0.004, c_y=-0.003)),
}
LOGS = {"train_a": 1, "train_b": 2, "test": 11}
"""Flight -> seed of its path and noise."""


def write_story(folder: Path, hidden: Sequence[PlantEffect], seconds: float = 16.0) -> list[str]:
    """Fly, write logs and vehicle file to `folder`; the command line that searches them."""
    folder.mkdir(parents=True, exist_ok=True)
    plant = x250(hidden)
    log = fly(
        plant, controller_for(plant), RandomWaypoints(), rich_excitation(), seconds, seed=list(LOGS.values()),
        warm_up=1.0,
    )  # fmt: skip
    logs = [write_log(folder / f"{name}.csv", member(log, i), drop=["omega"]) for i, name in enumerate(LOGS)]
    vehicle = write_vehicle(folder / "vehicle.toml", plant, sigma=SIGMA, errors=ERRORS)
    return ["discover", "--vehicle", str(vehicle), "--train", *map(str, logs[:2]), "--test", str(logs[2])]


def tell(folder: Path, hidden: Sequence[PlantEffect]) -> None:
    """Print what was hidden beside what was found, and how the gap closed."""
    found = json.loads((folder / "discovery.json").read_text())
    named = {e["name"]: e["parameters"] for e in found["effects"]}
    print(f"\n{'hidden':36s} {'true':>10s} {'found':>10s} {'std':>9s}")
    for effect in hidden:
        for full, value in effect.parameters().items():
            p = named.get(effect.name, {}).get(full.split(".", 1)[1])
            numbers = f"{p['value']:10.4g} {p['std'] or float('nan'):9.2g}" if p else f"{'not named':>10s}"
            print(f"{full:36s} {float(value):10.4g} {numbers}")
    others = sorted(set(named) - {e.name for e in hidden})
    print("named and not there:", ", ".join(others) or "nothing")
    for r in found["gap"]:
        if r["horizon_s"] == 0.5:
            share = "no gap" if r["closed"] is None else f"{100 * r['closed']:.1f} % closed"
            print(f"{r['group']:10s} 0.5 s ahead: {r['before']:8.4g} -> {r['after']:8.4g} {r['unit']:6s} {share}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Both stories; the exit code is that of the command."""
    parser = argparse.ArgumentParser(description="One hidden effect and a pair, found and named.")
    parser.add_argument("--out", default="discovery_story")
    parser.add_argument("--only", choices=tuple(STORIES), default=None)
    options = parser.parse_args(arguments)
    for name, hidden in STORIES.items():
        if options.only not in (None, name):
            continue
        folder = Path(options.out) / name
        print(f"\n== {name}: hidden in the plant: {', '.join(e.name for e in hidden)}")
        code = greybox([*write_story(folder, hidden), "--out", str(folder)])
        if code:
            return code
        tell(folder, hidden)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
