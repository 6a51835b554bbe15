"""`greybox check`: look for data faults in flight logs before anything is fitted to them."""

from __future__ import annotations

import argparse

from greybox.commands.judgement import accept_option, accepted


def add(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser."""
    parser = subparsers.add_parser(
        "check",
        help="look for data faults in flight logs",
        description="Look for faults of clock, units, frames, motor order and alignment. "
        "Exit code 0: nothing blocks a fit; 1: a fault does; 2: bad input.",
    )
    parser.add_argument("logs", nargs="+", metavar="LOG", help="flight log of any format (docs/logs.md)")
    parser.add_argument("--vehicle", required=True, metavar="V.toml", help="vehicle file")
    parser.add_argument(
        "--mapping", metavar="MAP.toml", help="which fields of the logs are which channels (docs/logs.md)"
    )
    accept_option(parser)
    parser.add_argument("--json", metavar="F", help="write the result as JSON to this file (- = standard output)")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Check the logs, print the report, write the JSON. Returns 0, or 1 where a fault blocks a fit."""
    from greybox.commands.judgement import tell
    from greybox.commands.vehicle_lines import say_vehicle
    from greybox.data.checks import check_logs
    from greybox.model.vehicle import read_vehicle

    vehicle = read_vehicle(arguments.vehicle)
    report = check_logs(
        arguments.logs, vehicle, mapping=arguments.mapping, accept=accepted(arguments.accept)
    )
    code = tell(report, arguments.json)
    if arguments.json != "-":
        say_vehicle(vehicle, print)
    return code
