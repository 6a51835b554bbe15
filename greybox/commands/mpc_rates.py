"""`greybox mpc rates`: the paper's idea flown, a rate controller on a linear model with a Gaussian
process."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from greybox.commands.command_line import typed
from greybox.commands.console import Console
from greybox.commands.kept_runs import carried_out
from greybox.commands.mpc_own import COURSE_ONLY, OWN_ONLY, refuse

OTHERS: Mapping[str, object] = {**COURSE_ONLY, "plant": None, "even_so": False}
"""Options of a model that flies a course."""


def run(arguments: argparse.Namespace) -> int:
    """Identify, fly, report; what was flown is reported even when interrupted. Returns 0."""
    refuse(arguments, OWN_ONLY, "a model of your own", "rates")
    refuse(arguments, OTHERS, "a model that flies a course", "rates")
    from greybox.files import write_atomic, write_json
    from greybox.report.mpc_documents import RatesDocument
    from greybox.report.rates_report import rates_report
    from mpc_export.kept_flights import flights, kept, read_traces
    from mpc_export.mission import judging
    from mpc_export.rates.campaign import (
        TEXTS,
        WATCHED,
        format_table,
        prepare,
        summary,
    )
    from mpc_export.rates.craft import DT

    console, out = Console.of(arguments), Path(arguments.out)
    flown = prepare(out, arguments.level, console.say_when)
    seeds = judging(arguments.flights, arguments.seed)
    watched = seeds[:WATCHED]

    def report() -> RatesDocument:
        content = summary(
            flown, kept(flown, list(TEXTS), seeds), seeds, typed("mpc", "greybox mpc rates")
        )
        write_json(out / "mpc_rates.json", content)
        write_atomic(
            out / "report.html",
            rates_report(content, read_traces(flown, list(TEXTS), watched), stage=DT),
        )
        return content

    return carried_out(
        arguments,
        console,
        lambda: flights(flown, list(TEXTS), seeds, say=console.say_when, watched=watched),
        report,
        format_table,
        file="mpc_rates.json",
    )
