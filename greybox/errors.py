"""The errors that greybox raises. Each is also the builtin that a caller would catch.

An error is one line: what was expected, what came, where, and the usual fix. The command line
prints that line and ends with exit code 2.
"""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Iterable, Iterator

LONGEST_LINE = 1500
"""Characters of a message; what is longer quotes a file that is not what it should be, and loses
its middle."""


def printable(text: str) -> str:
    """On one line, with escapes for what a terminal would act on: names and paths may hold
    anything."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class GreyboxError(Exception):
    """Base of all errors that greybox raises on purpose. `str(error)` is one line for a person.

    Characters that a terminal would act on, which may come from a file, are written as escapes.
    """

    def __init__(
        self,
        message: str,
        *,
        where: str | None = None,
        expected: str | None = None,
        got: str | None = None,
        fix: str | None = None,
    ) -> None:
        parts = [f"{where}: {message}" if where else message]
        if expected:
            parts.append(f"expected {expected}")
        if got:
            parts.append(f"got {got}")
        line = "; ".join(parts)
        if fix:
            line += f". Usual fix: {fix}"
        line = printable(" ".join(line.split()))
        if len(line) > LONGEST_LINE:
            line = f"{line[: LONGEST_LINE // 2]} ... {line[-LONGEST_LINE // 3 :]}"
        self.line = line
        super().__init__(self.line)

    def __str__(self) -> str:
        return self.line


class DataError(GreyboxError, ValueError):
    """A log or a data set is not what its format promises."""


class VehicleError(GreyboxError, ValueError):
    """A vehicle file is not what its format promises."""


class ModelError(GreyboxError, ValueError):
    """A model cannot be built from the parts that were given."""


@contextlib.contextmanager
def solvable(what: str) -> Iterator[None]:
    """Raises `ModelError` instead of the LinAlgError of NumPy and SciPy: `what` asks of a model's
    matrices more than its numbers give, which is said of the model and not of a routine."""
    try:
        yield
    except ValueError as error:
        if type(error).__name__ != "LinAlgError":
            raise
        raise ModelError(
            f"{what}: a matrix of this model cannot be solved ({error})",
            fix="a fit without the parameters that are called weak; --debug shows where it is",
        ) from error


class FileFormatError(GreyboxError, ValueError):
    """A result or model file has the wrong schema, version or checksum."""


SLIP = 0.8
"""Likeness (`difflib`) of two names, capitals apart, from which on one is a slip for the other."""


def meant(name: str, known: Iterable[str]) -> str | None:
    """The name that `name` is most likely a slip for; None where none is like it."""
    small = {k.lower(): k for k in known}
    near = difflib.get_close_matches(name.lower()[:200], small, n=1, cutoff=SLIP)
    return small[near[0]] if near else None


def did_you_mean(names: Iterable[str], known: Iterable[str]) -> str:
    """ "; did you mean a, b?" of what `names` are slips for, empty where they are none."""
    known = list(known)
    found = [m for n in names if (m := meant(n, known)) is not None]
    return f"; did you mean {', '.join(dict.fromkeys(found))}?" if found else ""


class UnknownNameError(GreyboxError, KeyError):
    """A name that greybox does not know; the message carries the nearest names."""

    def __init__(
        self,
        kind: str,
        name: str,
        known: Iterable[str],
        *,
        where: str | None = None,
        fix: str | None = None,
    ) -> None:
        names, said = sorted(known), str(name)[:200]  # a file may say anything
        # What is the same but for capitals, or for what stands before a dot, comes first.
        same = [n for n in names if said.lower() in (n.lower(), n.lower().rpartition(".")[2])]
        close = difflib.get_close_matches(said, names, n=3, cutoff=0.5)
        near = list(dict.fromkeys([*same, *close]))[:3]
        shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        fix = fix or (f"did you mean {' or '.join(near)}?" if near else f"known: {shown}")
        super().__init__(f"unknown {kind} '{name}'", where=where, fix=fix)


class FitError(GreyboxError, RuntimeError):
    """An estimate could not be computed at all (a fit that merely did not converge is a status, not
    an error)."""


class MissingExtraError(GreyboxError, ImportError):
    """A library that comes with an optional extra is not installed."""


class OldFormWarning(FutureWarning):
    """A file speaks a form that the next minor version will not read; the message names the new
    one."""
