"""The command line: `greybox COMMAND ...`. Each command is one file in greybox/commands with `add`
and `run`.

Exit codes: 0 done, 1 done and the answer is no (a check that found blocking faults, a model that is
not usable), 2 bad input or usage (one line on standard error), 130 interrupted (what was done until
then is kept).
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import sys
import warnings
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, NoReturn, TextIO

COMMANDS = (
    "identify",
    "vehicle",
    "plan",
    "inspect",
    "check",
    "fit",
    "validate",
    "profile",
    "linear",
    "frf",
    "learn",
    "discover",
    "compare",
    "export",
    "twin",
    "mpc",
    "effects",
    "examples",
    "demo",
    "selftest",
    "cite",
    "completion",
)
WRITTEN = ("out", "json", "draft", "mcap", "ulog")
"""Options that name a file or a folder to write."""


def _version() -> str:
    from greybox.distribution import VERSION

    return f"greybox {VERSION}"


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, said by the command that was meant; the options `before`
    stand before that command."""

    before: Collection[str] = ()

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """As of its base; but what is left over is an error here, not of the outermost parser."""
        known, left = super().parse_known_args(args, namespace)
        if said := [word for word in left if word != "--"]:
            self._left_over(said[0])
        return known, []

    def _check_value(self, action: argparse.Action, value: str) -> None:
        from greybox.errors import UnknownNameError

        if action.choices is not None and value not in action.choices:
            option = "".join(f"value of {o}" for o in action.option_strings[-1:])
            kind = option or ("command" if action.nargs == argparse.PARSER else action.dest)
            self._end(UnknownNameError(kind, value, map(str, action.choices)))

    def error(self, message: str) -> NoReturn:
        """End with exit code 2 and one line."""
        from greybox.errors import GreyboxError

        self._end(GreyboxError(message, fix=f"{self.prog} --help"))

    def _left_over(self, word: str) -> NoReturn:
        from greybox.errors import GreyboxError, UnknownNameError

        options = {o: a for o, a in self._option_string_actions.items() if o.startswith("--")}
        if word in self.before:
            fix = f"greybox {word} {self.prog.partition(' ')[2]} ..."
            self._end(GreyboxError(f"{word} stands before the command", fix=fix))
        if word.startswith("-"):
            self._end(UnknownNameError("option", word.partition("=")[0], options))
        kind = os.path.splitext(word)[1]
        takers = [
            o
            for o, action in options.items()
            if kind and str(action.metavar).partition(":")[0].endswith(kind)
        ] or [o for o, action in options.items() if action.metavar == "LOG"]
        fix = ", ".join(f"{o} {word}" for o in takers) or f"{self.prog} --help"
        self._end(GreyboxError(f"no option says what {word} is", fix=fix))

    def _end(self, error: Exception) -> NoReturn:
        self.exit(2, f"{self.prog}: {error}\n")


def build_parser() -> argparse.ArgumentParser:
    """The argument parser with all commands."""
    parser = _Parser(
        prog="greybox",
        description="From flight logs to a model that a controller trusts.",
        epilog="Exit codes: 0 done; 1 done, and the answer is no (blocking faults, a model that is "
        "not usable); 2 bad "
        "input or usage, one line says what; 130 interrupted, what was done until then is kept.",
    )
    parser.add_argument("--version", action="version", version=_version())
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.add_argument(
        "--quiet",
        action="store_true",
        help="no progress, no tables: only errors, --json - and the exit code",
    )
    # What no command need declare: where it writes, and what an interrupt leaves.
    parser.set_defaults(**dict.fromkeys(WRITTEN), default_out=None, one_file=False, kept=None)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS:
        importlib.import_module(f"greybox.commands.{name}").add(commands)
        commands.choices[name].before = parser._option_string_actions
    return parser


def _abandon_output() -> None:
    """What is still to be printed goes nowhere: nobody reads it, or there is no room."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _left(arguments: argparse.Namespace) -> str:
    """What an interrupt leaves: what the command keeps, where its folder holds a file of it."""
    from pathlib import Path

    from greybox.journal import FILE

    out = arguments.out
    if arguments.kept and (out is None or any(p.is_file() for p in Path(out).rglob("*"))):
        return str(arguments.kept)
    if out is not None and (Path(out) / FILE).is_file():
        return "nothing was written; the same command goes on where it was stopped before"
    return "nothing was written; the same command starts again"


@contextlib.contextmanager
def _hush(arguments: argparse.Namespace) -> Iterator[None]:
    """Nothing on standard error; nothing on standard output either, unless a file was asked for
    there."""
    with (
        open(os.devnull, "w") as nowhere,
        contextlib.redirect_stderr(nowhere),
        contextlib.ExitStack() as stack,
    ):
        if arguments.json != "-" and arguments.command != "completion":
            stack.enter_context(contextlib.redirect_stdout(nowhere))
        yield


class _PlainText:
    """A stream that hands on text with escapes for what a terminal would act on: names of files and
    what stands in them reach the terminal in many lines, and must not move its cursor."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._within_line = False

    def write(self, text: str) -> int:
        """As of a text stream."""
        from greybox.errors import printable

        if not text.isprintable():
            text = "".join(c if c in "\n\t" else printable(c) for c in text)
        if not text:
            return 0
        self._within_line = True  # until it is written: an interrupt may cut it
        written = int(self._stream.write(text))
        self._within_line = not text.endswith("\n")
        return written

    def last_line(self, text: str) -> None:
        """A line of its own, even where an interrupt cut another before its end."""
        print(f"\n{text}" if self._within_line else text, file=self)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    out, err = _PlainText(sys.stdout), _PlainText(sys.stderr)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        return _main(argv, err.last_line)


@contextlib.contextmanager
def _warnings_on_one_line() -> Iterator[None]:
    """What a file of an older form is told, said once on standard error like an error; other
    warnings as ever."""
    from greybox.errors import OldFormWarning

    with warnings.catch_warnings():
        shown = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, OldFormWarning):
                print(f"greybox: {message}", file=sys.stderr)
            else:
                shown(message, category, filename, lineno, file, line)

        warnings.showwarning = show
        yield


def _main(argv: Sequence[str] | None, last_line: Callable[[str], None]) -> int:
    from greybox.distribution import NAME, other_greybox
    from greybox.errors import GreyboxError
    from greybox.interrupts import kept_interrupts

    if (other := other_greybox()) is not None:
        print(
            f"greybox: this environment also holds another package called greybox ({other}), which "
            "puts its files into the same folder. Usual fix: pip uninstall greybox && pip install "
            f"--force-reinstall {NAME}",
            file=sys.stderr,
        )

    try:
        parser = build_parser()
        if not (sys.argv[1:] if argv is None else argv):
            parser.print_help()
            return 2
        arguments = parser.parse_args(argv)
    except KeyboardInterrupt:
        last_line("greybox: interrupted")
        return 130
    try:
        with contextlib.ExitStack() as stack:
            if arguments.out is None and arguments.default_out is not None:
                arguments.out = arguments.default_out(arguments)
            for option in WRITTEN:
                if (path := getattr(arguments, option)) not in (None, "-"):
                    from greybox.files import check_writable, sole_writer

                    folder = option == "out" and not arguments.one_file
                    check_writable(path, folder=folder)
                    if folder:
                        stack.enter_context(sole_writer(path))
            stack.enter_context(kept_interrupts())
            stack.enter_context(_warnings_on_one_line())
            if arguments.quiet:
                stack.enter_context(_hush(arguments))
            code = int(arguments.run(arguments))
            sys.stdout.flush()
            return code
    except GreyboxError as error:
        if arguments.debug:
            raise
        last_line(f"greybox {arguments.command}: {error}")
        return 2
    except KeyboardInterrupt:
        last_line(f"greybox {arguments.command}: interrupted; {_left(arguments)}")
        return 130
    except BrokenPipeError:
        _abandon_output()
        return 0
    except OSError as error:
        if arguments.debug:
            raise
        where = error.filename or "standard output"
        last_line(f"greybox {arguments.command}: {where}: {error.strerror or error}")
        _abandon_output()
        return 2


if __name__ == "__main__":
    sys.exit(main())
