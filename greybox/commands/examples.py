"""`greybox examples [NAME]`: real flights that come with greybox, listed or copied with their
vehicle file."""

from __future__ import annotations

import argparse

from greybox.commands.command_line import Subcommands


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "examples",
        help="real flights to try greybox with",
        description="List the real flights that come with greybox, or copy a set of them: logs, "
        "vehicle file, licence, provenance.",
    )
    p.add_argument(
        "name", nargs="?", metavar="NAME", help="the set to copy (without it: list them)"
    )
    p.add_argument(
        "--out",
        metavar="DIR",
        default=None,
        help="folder for the copies (default: one of the set's name)",
    )
    p.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """List or copy. Returns 0. Raises `UnknownNameError`, `OutputError` and `GreyboxError` as
    `examples.copy` does."""
    from greybox import examples
    from greybox.errors import GreyboxError

    if arguments.name is None:
        if arguments.out is not None:
            raise GreyboxError(
                "--out needs the name of a set",
                expected=" or ".join(examples.SETS),
                fix=f"greybox examples {next(iter(examples.SETS))} --out {arguments.out}",
            )
        for name, what in examples.SETS.items():
            print(f"{name:15} {what}")
        print(f"greybox examples NAME copies one; they are in {examples.ROOT}")
        return 0
    copies = examples.copy(arguments.name, arguments.out or arguments.name)
    logs = [p for p in copies if p.name.endswith(".csv.gz")]
    print(f"{len(logs)} logs, vehicle.toml, licence and provenance: {logs[0].parent}")
    return 0
