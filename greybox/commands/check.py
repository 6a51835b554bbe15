"""`greybox check`: look for data faults in flight logs before anything is fitted to them."""

from __future__ import annotations

import argparse

from greybox.commands.console import Console, json_option
from greybox.commands.judgement import accept_option, accepted


def add(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser."""
    parser = subparsers.add_parser(
        "check",
        help="look for data faults in flight logs",
        description="Look for faults of clock, units, frames, motor order and alignment, and of "
        "the vehicle file. Exit code 0: nothing blocks a fit; 1: a fault does; 2: bad input.",
    )
    parser.add_argument(
        "logs", nargs="+", metavar="LOG", help="flight log of any format (docs/logs.md)"
    )
    parser.add_argument("--vehicle", required=True, metavar="V.toml", help="vehicle file")
    parser.add_argument(
        "--mapping",
        metavar="MAP.toml",
        help="which fields of the logs are which channels (docs/logs.md)",
    )
    accept_option(parser)
    json_option(parser, "the findings")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Check the logs, print the report, write the JSON. Returns 0, or 1 where a fault blocks a
    fit."""
    from greybox.data.logs import read_table
    from greybox.model.faults import check
    from greybox.model.vehicle import read_vehicle

    file = arguments.vehicle
    vehicle = read_vehicle(file)
    logs = [read_table(p, vehicle, mapping=arguments.mapping) for p in arguments.logs]
    report = check(logs, vehicle, accept=accepted(arguments.accept), file=file)
    console = Console.of(arguments)
    console.result(report.to_dict(), report.summary())
    believed = vehicle.beliefs.sentence()
    if believed and not console.quiet:
        print(believed)
    return 0 if report.ok else 1
