"""The command line that a result keeps, so that it can be made again."""

from __future__ import annotations

import shlex
import sys


def typed(command: str, otherwise: str | None = None) -> str:
    """What was typed, where it was this command; `otherwise` (default: its name) where another
    program or command reached it."""
    if sys.argv[1:2] == [command]:
        return "greybox " + shlex.join(sys.argv[1:])
    return otherwise or f"greybox {command}"
