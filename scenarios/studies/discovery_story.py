"""The story of a missing effect, told twice: one hidden effect, then two at once, each with its
report.

    python -m scenarios.studies.discovery_story --out story

Hidden are rotor drag, then motor lag together with an offset of the centre of mass, in the vehicle
of `greybox.commands.missing_effect`. Every case gets its own folder with the logs, the vehicle file
and what `greybox discover` wrote. At the end the story stands beside what was hidden.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from greybox.cli import main as greybox
from greybox.commands.missing_effect import tell, write_story
from greybox.plants.effects import CenterOfMassOffset, MotorLag, PlantEffect, RotorDrag

STORIES: dict[str, tuple[PlantEffect, ...]] = {
    "one": (RotorDrag(k_x=2e-5, k_y=2.5e-5),),
    "pair": (MotorLag(tau=0.04), CenterOfMassOffset(c_x=0.004, c_y=-0.003)),
}


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
