"""The command line: `greybox COMMAND ...`. Each command is one file in greybox/commands with `add` and `run`.

Exit codes: 0 done, 1 done and the answer is no (a check that found blocking faults, a fit that did not converge),
2 bad input or usage (one line on standard error), 130 interrupted.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

COMMANDS = (
    "vehicle", "plan", "inspect", "check", "fit", "validate", "linear", "learn",
    "discover", "compare", "export", "mpc", "effects", "cite",
)  # fmt: skip


def _version() -> str:
    from importlib.metadata import version

    return f"greybox {version('greybox')}"


def build_parser() -> argparse.ArgumentParser:
    """The argument parser with all commands."""
    parser = argparse.ArgumentParser(
        prog="greybox", description="From flight logs to a model that a controller trusts."
    )
    parser.add_argument("--version", action="version", version=_version())
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        importlib.import_module(f"greybox.commands.{name}").add(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    from greybox.errors import GreyboxError

    arguments = build_parser().parse_args(argv)
    try:
        return int(arguments.run(arguments))
    except GreyboxError as error:
        if arguments.debug:
            raise
        print(f"greybox {arguments.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"greybox {arguments.command}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


if __name__ == "__main__":
    sys.exit(main())
