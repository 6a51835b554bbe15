"""The story of a missing effect: a simulated quadrotor hides it, `greybox discover` looks for it,
and what it found is printed beside what was hidden.

A 250 mm quadrotor flies in closed loop through random waypoints. Its vehicle file is ten per cent
off in inertia and thrust and knows no effect. The test flight is another path with other noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from greybox.plants.effects import PlantEffect

SIGMA = {"inertia": 0.2, "thrust.c2": 0.2, "torque.c2": 0.3}
"""Relative standard deviations in the vehicle file."""
ERRORS = {"inertia": 1.1, "thrust.c2": 0.9, "torque.c2": 1.1}
"""Factors by which the vehicle file is wrong."""
LOGS = {"train_a": 1, "train_b": 2, "test": 11}
"""Flight -> seed of its path and noise."""


def write_story(folder: Path, hidden: Sequence[PlantEffect], seconds: float = 16.0) -> list[str]:
    """Fly, write logs and vehicle file to `folder`; the command line that searches them."""
    from greybox.excitation.injection import rich_excitation
    from greybox.excitation.waypoints import RandomWaypoints
    from greybox.plants.flight_log import fly, member, write_log
    from greybox.plants.presets import controller_for, x250
    from greybox.plants.vehicle_file import write_vehicle

    folder.mkdir(parents=True, exist_ok=True)
    plant = x250(hidden)
    log = fly(
        plant,
        controller_for(plant),
        RandomWaypoints(),
        rich_excitation(),
        seconds,
        seed=list(LOGS.values()),
        warm_up=1.0,
    )
    logs = [
        str(write_log(folder / f"{name}.csv", member(log, i), drop=["omega"]))
        for i, name in enumerate(LOGS)
    ]
    vehicle = write_vehicle(folder / "vehicle.toml", plant, sigma=SIGMA, errors=ERRORS)
    return ["discover", "--vehicle", str(vehicle), "--train", *logs[:2], "--test", logs[2]]


def tell(folder: Path, hidden: Sequence[PlantEffect]) -> None:
    """Print what was hidden beside what discovery.json in `folder` names, and how the gap
    closed."""
    from greybox.files import read_json
    from greybox.validation.gap import closed_in_words

    found = read_json(folder / "discovery.json")
    named = {e["name"]: e["parameters"] for e in found["effects"]}
    print(f"\n{'hidden':36s} {'true':>10s} {'found':>10s} {'std':>9s}")
    for effect in hidden:
        for full, value in effect.parameters().items():
            p = named.get(effect.name, {}).get(full.split(".", 1)[1])
            numbers = (
                f"{p['value']:10.4g} {p['std'] or float('nan'):9.2g}"
                if p
                else f"{'not named':>10s}"
            )
            print(f"{full:36s} {float(value):10.4g} {numbers}")
    others = sorted(set(named) - {e.name for e in hidden})
    print("named and not there:", ", ".join(others) or "nothing")
    for r in found["gap"]:
        if r["horizon_s"] == 0.5:
            closed = (
                "no gap"
                if r["closed"] is None
                else f"gap closed: {closed_in_words(r['closed'], r['before'], r['floor'])}"
            )
            print(
                f"{r['group']:10s} 0.5 s ahead: {r['before']:8.4g} -> {r['after']:8.4g} "
                f"{r['unit']:6s} {closed}"
            )
