"""`greybox demo`: the shipped real flights end to end, through the commands that a user would
type."""

from __future__ import annotations

import argparse
import shlex
import time
from pathlib import Path

from greybox.commands.command_line import Subcommands


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "demo",
        help="check, fit and judge shipped real flights; find an effect that a simulation hides",
        description="Check the shipped flights of a Crazyflie, fit them by the plain command, "
        "judge the model on flights that the fit never saw, and write a page. Then hide an effect "
        "in a simulated vehicle and let `greybox discover` look for it. Every command is printed "
        "before it runs. A few minutes. Exit code 0: done; 1: a model is not usable; 2: bad input.",
    )
    # Not `out`: the commands that run inside lock their own folders.
    p.add_argument(
        "--out", dest="folder", default="demo_out", metavar="DIR", help="folder for the results"
    )
    p.add_argument("--all", action="store_true", help="all nine training flights instead of five")
    p.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run the demo. Returns the exit code of the first command that did not end with 0, or 0."""
    from greybox.commands.missing_effect import tell, write_story
    from greybox.examples import nanobench_split, vehicle_path
    from greybox.files import check_writable
    from greybox.plants.effects import RotorDrag

    folder = Path(arguments.folder)
    check_writable(folder, folder=True)
    began = time.perf_counter()
    train, test = nanobench_split()
    flights = list(map(str, train if arguments.all else train[::2]))
    vehicle = str(vehicle_path("nanobench"))
    codes = []
    print("1. Are the logs sound?")
    codes.append(_command("check", "--vehicle", vehicle, *flights))
    print("\n2. Fit, then judge on flights that the fit never saw.")
    fit = ["--train", *flights, "--test", *map(str, test), "--out", str(folder)]
    codes.append(_command("fit", "--vehicle", vehicle, *fit))
    if 2 in codes or 130 in codes:
        return max(codes)
    print("\n3. What is missing? A simulated vehicle hides one effect, which is looked for.")
    story = folder / "missing_effect"
    hidden = (RotorDrag(k_x=2e-5, k_y=2.5e-5),)
    codes.append(_command(*write_story(story, hidden), "--out", str(story)))
    if (story / "discovery.json").exists():
        tell(story, hidden)
    print(f"\nDone in {time.perf_counter() - began:.0f} s. Open these pages:")
    for page in (folder / "report.html", story / "report.html"):
        print(f"  {page.resolve()}")
    return next((code for code in codes if code), 0)


def _command(*words: str) -> int:
    """Print a command and run it here."""
    from greybox.cli import main

    print(f"$ greybox {shlex.join(words)}\n", flush=True)
    return main(words)
