"""What commands do with runs that are kept one by one: run, report, print; what ran is reported
even when interrupted."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TypedDict, TypeVar

from greybox.commands.console import Console


class Judged(TypedDict):
    """A result file that says in words what came out."""

    verdict: str


Content = TypeVar("Content", bound=Judged)


def carried_out(
    arguments: argparse.Namespace,
    console: Console,
    run: Callable[[], object],
    report: Callable[[], Content],
    format_table: Callable[[Content], str],
    *,
    file: str,
) -> int:
    """`report` writes `file` and report.html into --out and returns what it wrote. Returns 0."""
    out = arguments.out
    try:
        run()
    except KeyboardInterrupt:
        report()
        raise
    found = report()
    written = f"wrote flights.jsonl, {file} and report.html in {out} ({console.seconds:.0f} s)"
    console.result(found, format_table(found), found["verdict"], written)
    return 0
