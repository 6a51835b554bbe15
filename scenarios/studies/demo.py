"""The demo: shipped real flights, end to end, through the command line that a user would type.

Checks the logs, fits the Newton-Euler model to the training flights by the plain command, which decides everything from the
flights and judges on others that the fit never saw, and writes a report. Then the story of a missing effect: what
`greybox discover` finds in a simulated vehicle whose file does not know its rotors' drag.

    make demo      (or: python -m scenarios.studies.demo --out demo_out)
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

from greybox.cli import main as greybox
from greybox.examples import nanobench_split, vehicle_path
from scenarios.studies.discovery_story import main as tell


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demo; the exit code is that of the fit."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", default="demo_out")
    parser.add_argument("--all", action="store_true", help="all nine training flights instead of five")
    arguments = parser.parse_args(argv)
    began = time.perf_counter()
    train, test = nanobench_split()
    if not arguments.all:
        train = train[::2]
    vehicle = str(vehicle_path("nanobench"))
    print("1. Are the logs sound?")
    greybox(["check", "--vehicle", vehicle, *map(str, train)])
    print("\n2. Fit, then validate on flights that the fit never saw.")
    code = greybox(
        ["fit", "--vehicle", vehicle, "--train", *map(str, train), "--test", *map(str, test), "--out", arguments.out]
    )
    if code == 2:
        return code
    story = Path(arguments.out) / "missing_effect"
    print("\n3. What is missing in a vehicle file? One effect is hidden in a simulated vehicle and looked for.")
    tell(["--only", "one", "--out", str(story)])
    print(f"\nThe story in pictures: {(story / 'one' / 'report.html').resolve()}")
    print(f"\nDone in {time.perf_counter() - began:.0f} s. Open {Path(arguments.out).resolve() / 'report.html'}")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
