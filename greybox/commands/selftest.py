"""`greybox selftest`: does this installation do what it should? Each part is tried and held against
a known answer, in under a minute."""

from __future__ import annotations

import argparse
import time

from greybox.commands.command_line import Subcommands

LABELS = {"works": "works  ", "missing": "missing", "broken": "BROKEN "}


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "selftest",
        help="try what is installed, with known answers: compiler, fit, export, readers, PyTorch",
        description="Try what is installed and hold it against known answers: CasADi, C compiler, "
        "a fit of a simulated flight, a page, an export that is compiled and compared, log "
        "readers, the shipped flights, PyTorch. One line each, with the usual fix. Exit code 0: "
        "all that is installed works ('missing' is optional); 1: something is broken; 2: bad "
        "usage.",
    )
    p.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Try everything. Returns 0, or 1 where something is broken."""
    from greybox.commands.selftest_checks import CHECKS, Bench, outcome

    began = time.perf_counter()
    broken: list[str] = []
    missing: list[str] = []
    with Bench.open() as bench:
        for check in CHECKS:
            state, text, fix = outcome(check, bench)
            print(f"{LABELS[state]}  {check.name:15} {text}", flush=True)
            if fix:
                print(f"{'':9}{'':15} usual fix: {fix}", flush=True)
            {"broken": broken, "missing": missing}.get(state, []).append(check.name)
    seconds = f"({time.perf_counter() - began:.0f} s)"
    if broken:
        print(f"Not all of greybox works here: {', '.join(broken)} {seconds}")
        return 1
    rest = f"; not installed, and optional: {', '.join(missing)}" if missing else ""
    print(f"greybox works here{rest} {seconds}")
    return 0
