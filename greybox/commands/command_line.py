"""The command line: what commands declare their options with, and what a result keeps of it, so
that it can be made again."""

from __future__ import annotations

import argparse
import shlex
import sys
from typing import TypeAlias

Subcommands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"
"""What a command adds its parser to; argparse has no public name for it."""
Options: TypeAlias = argparse._ActionsContainer
"""A parser or a group of its options; argparse has no public name for both."""


def typed(command: str, otherwise: str | None = None) -> str:
    """What was typed, where it was this command; `otherwise` (default: its name) where another
    program or command reached it."""
    if sys.argv[1:2] == [command]:
        return "greybox " + shlex.join(sys.argv[1:])
    return otherwise or f"greybox {command}"


def effects_file_option(p: Options, what: str = "effects of your own in the model") -> None:
    """Declare --effects-file, whose help is `what`."""
    p.add_argument("--effects-file", nargs="+", default=[], metavar="E.py", help=what)
