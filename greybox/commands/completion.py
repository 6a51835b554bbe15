"""`greybox completion`: a script that completes commands and options in bash, zsh or tcsh.

greybox completion bash > ~/.local/share/bash-completion/completions/greybox
"""

from __future__ import annotations

import argparse
import sys

from greybox.commands.command_line import Subcommands

SHELLS = ("bash", "zsh", "tcsh")


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "completion",
        help="print a script that completes this command line in a shell",
        description="Print a completion script; put it where the shell looks for one, e.g. "
        "greybox completion bash > ~/.local/share/bash-completion/completions/greybox. Needs the "
        "extra `completion`.",
    )
    p.add_argument("shell", choices=SHELLS, help="the shell that the script is for")
    p.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the script. Returns 0. Raises `MissingExtraError` without shtab."""
    from greybox.cli import build_parser
    from greybox.distribution import install_line
    from greybox.errors import MissingExtraError

    try:
        import shtab
    except ImportError:
        raise MissingExtraError(
            "a completion script needs shtab, which is not installed",
            fix=install_line("completion"),
        ) from None
    sys.stdout.write(shtab.complete(build_parser(), shell=arguments.shell) + "\n")
    return 0
