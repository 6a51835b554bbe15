"""`greybox effects`: the catalogue of physical effects that a model may have, from their
declarations.

`python -m greybox.commands.effects --markdown` writes the page docs/effects.md to standard output.
"""

from __future__ import annotations

import argparse
import sys

from greybox.commands.command_line import Subcommands, effects_file_option
from greybox.commands.console import Console, printed_json_option
from greybox.commands.effect_stages import STAGES


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "effects",
        help="list the physical effects that a model may have",
        description="List the catalogue of effects: name, stage, parameters with units, what is "
        "needed, references.",
    )
    p.add_argument("names", nargs="*", metavar="NAME", help="only these effects (default: all)")
    p.add_argument("--stage", choices=tuple(STAGES), help="only the effects of one stage")
    effects_file_option(
        p, "also list the effects of these Python files, which are run (only what you trust)"
    )
    printed_json_option(p)
    p.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """List the chosen effects. Returns 0. Raises `UnknownNameError` for an unknown name,
    `ModelError` for a bad file."""
    from greybox.commands.effects_output import catalogue, text
    from greybox.errors import UnknownNameError
    from greybox.model.effects import CATALOGUE

    known = {e.name: e for e in CATALOGUE}
    if arguments.effects_file:
        from greybox.model.effects_file import load_effects

        known |= {e.name: e for path in arguments.effects_file for e in load_effects(path)}
    for name in arguments.names:
        if name not in known:
            raise UnknownNameError("effect", name, known)
    chosen = tuple(known[n] for n in arguments.names) or tuple(known.values())
    if arguments.stage:
        chosen = tuple(e for e in chosen if e.stage == arguments.stage)
    Console.of(arguments).result(catalogue(chosen), text(chosen))
    return 0


if __name__ == "__main__":
    from greybox.commands.effects_output import markdown

    if sys.argv[1:] != ["--markdown"]:
        sys.exit("usage: python -m greybox.commands.effects --markdown")
    sys.stdout.write(markdown())
