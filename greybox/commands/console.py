"""What a command tells: progress on standard error, its result on standard output, and the JSON of
--json."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping

from greybox.commands.command_line import Options


def json_option(p: Options, content: str) -> None:
    """Declare --json, which hands `content` (fit.json, "the statement") to programs."""
    p.add_argument(
        "--json",
        metavar="F",
        default=None,
        help=f"also write {content} to F ('-': standard output)",
    )


def printed_json_option(p: Options) -> None:
    """Declare --json of a command that only lists: to a file, or instead of its text."""
    p.add_argument(
        "--json",
        nargs="?",
        const="-",
        metavar="FILE",
        help="machine-readable, to FILE or standard output",
    )


def _worked() -> float:
    """[s] on a clock that goes on where an earlier run of the same work was stopped."""
    from greybox.journal import spared

    return time.monotonic() + spared()


class Console:
    """The terminal of a command. Where its JSON goes to standard output (`json`: "-", a path or
    None), nothing else does, and no progress is said; warnings still are, on standard error."""

    def __init__(self, json: str | None) -> None:
        from greybox.progress import TimeLeft

        self.json = json
        self.quiet = json == "-"
        self._began = time.perf_counter()
        self._left = TimeLeft(_worked)

    @classmethod
    def of(cls, arguments: argparse.Namespace) -> Console:
        """That of a command with --json."""
        return cls(arguments.json)

    @property
    def seconds(self) -> float:
        """[s] since the console was opened."""
        return time.perf_counter() - self._began

    def say(self, text: str) -> None:
        """A line about what is being done."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    def say_when(self, text: str) -> None:
        """The same, after the seconds that have passed."""
        self.say(f"  {self.seconds:4.0f} s  {text}")

    def share(self, text: str, share: float) -> None:
        """What is being done, and the share of all (0 to 1) that is."""
        self.say(f"  {100 * share:3.0f} %  {text}{self._left.after(share)}")

    def solver(self, iteration: int, cost: float, decrement: float) -> None:
        """An iteration of a solver."""
        rest = self._left.after_step(iteration, decrement)
        self.say(
            f"  iteration {iteration:3d}  cost {cost:14.4f}  expected decrease "
            f"{decrement:.3g}{rest}"
        )

    def result(self, content: Mapping[str, object], *lines: str) -> None:
        """`content` as JSON where it was asked for, and `lines` for people. Raises
        `OutputError`."""
        from greybox.files import dump_json, write_json

        if self.quiet:
            sys.stdout.write(dump_json(content))
            return
        print(
            "\n".join(lines)
        )  # first: a file that cannot be written must not hide what took minutes
        if self.json:
            write_json(self.json, content)
