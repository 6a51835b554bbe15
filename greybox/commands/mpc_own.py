"""`greybox mpc` on a model of the user's own: hold outputs at values, inside limits, and show how
often they were passed."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.commands.command_line import Options, typed
from greybox.commands.console import Console
from greybox.commands.kept_runs import carried_out
from greybox.commands.model_options import numbers
from greybox.commands.own_model import model_file_option, range_options

if TYPE_CHECKING:
    from greybox.commands.judgement import Gate
    from greybox.files import Parsed

COURSE_ONLY: Mapping[str, object] = {
    "log": [],
    "course": "mpc_export.mission:OBSTACLE_COURSE",
    "pace": None,
    "jobs": 1,
    "risk": "rehearsal",
    "mcap": None,
}
"""Options of a model that flies a course, with the values that they have where nobody gave them."""
OWN_ONLY: Mapping[str, object] = {
    "hold": [],
    "limits": [],
    "ranges": [],
    "seconds": None,
    "horizon": 20,
    "model_file": None,
}
"""Options of a model of the user's own."""


def held_of(text: str) -> tuple[str, tuple[float, ...]]:
    """name=value,..."""
    name, mark, values = text.partition("=")
    if not mark or not values:
        raise argparse.ArgumentTypeError(f"expected OUTPUT=VALUE,..., got '{text}'")
    return name, numbers(values)


def add_options(p: Options) -> None:
    """Declare what a model of the user's own is asked."""
    g = p.add_argument_group("a model of your own (docs/own_model.md)")
    model_file_option(g)
    g.add_argument(
        "--hold",
        nargs="+",
        type=held_of,
        default=[],
        metavar="y=V,...",
        help="values that outputs are held at, one after the other",
    )
    range_options(
        g,
        inputs="the range of an input (default: that of the training data)",
        outputs="what outputs must not leave (-inf and inf: no limit on that side)",
    )
    g.add_argument(
        "--seconds",
        type=float,
        default=None,
        metavar="S",
        help="length of a run (default: five horizons for every value)",
    )
    g.add_argument(
        "--horizon", type=int, default=20, metavar="N", help="the horizon in samples (default 20)"
    )


def refuse(arguments: argparse.Namespace, options: Mapping[str, object], of: str, got: str) -> None:
    """Raise `GreyboxError` for an option that was given and belongs to another kind of model."""
    from greybox.errors import GreyboxError

    for name, default in options.items():
        if getattr(arguments, name) != default:
            option = {"limits": "limit", "ranges": "range"}.get(name, name).replace("_", "-")
            raise GreyboxError(f"--{option} belongs to {of}", got=got, fix="leave it out")


def is_own(content: Parsed) -> bool:
    """Whether a model file holds a model of the user's own, or a hybrid on one."""
    base = content.get("base")
    return "own" in (content.get("kind"), base.get("kind") if isinstance(base, dict) else None)


def _named_once(arguments: argparse.Namespace) -> None:
    """Raise `GreyboxError` for a name that is asked two things."""
    from greybox.errors import GreyboxError

    for option, given in (
        ("hold", arguments.hold),
        ("limit", arguments.limits),
        ("range", arguments.ranges),
    ):
        names = [pair[0] for pair in given]
        for name in names:
            if names.count(name) > 1:
                raise GreyboxError(f"--{option} names {name} more than once", fix="name it once")


def run(arguments: argparse.Namespace, content: Parsed) -> int:
    """Prepare, run, report; what ran is reported even when interrupted. Returns 0, or 1 where it
    refuses."""
    from greybox.files import write_atomic, write_json
    from greybox.report.mpc_documents import OwnDocument
    from greybox.report.mpc_own_report import mpc_own_report
    from mpc_export.kept_flights import flights, kept, read_traces
    from mpc_export.mission import judging
    from mpc_export.outputs.campaign import WATCHED, OwnCampaign, format_table, summary
    from mpc_export.outputs.machine import Asked

    judged = _admitted(arguments, content)
    if not judged.open:
        judged.say("mpc")
        return 1
    if arguments.model_file:
        _same_program(arguments)
    _named_once(arguments)
    asked = Asked(
        held=dict(arguments.hold),
        limits=dict(arguments.limits),
        ranges=dict(arguments.ranges),
        seconds=arguments.seconds,
    )
    console, out = Console.of(arguments), Path(arguments.out)
    own = OwnCampaign(
        out=out,
        file=Path(arguments.subject),
        asked=asked,
        level=arguments.level,
        horizon=arguments.horizon,
        plant=arguments.plant,
    )
    judged.say("mpc")
    out.mkdir(parents=True, exist_ok=True)
    own.tune(console.say_when)
    seeds = judging(arguments.flights, arguments.seed)
    watched = seeds[:WATCHED]
    command = typed("mpc", f"greybox mpc {shlex.quote(arguments.subject)}")

    def report() -> OwnDocument:
        found = summary(own, kept(own, own.names, seeds), seeds, command)
        write_json(out / "mpc_own.json", found)
        traces = read_traces(own, own.names, watched)[watched[0]]
        write_atomic(out / "report.html", mpc_own_report(found, traces))
        return found

    return carried_out(
        arguments,
        console,
        lambda: flights(own, own.names, seeds, say=console.say_when, watched=watched),
        report,
        format_table,
        file="mpc_own.json",
    )


def _admitted(arguments: argparse.Namespace, content: Parsed) -> Gate:
    """Whether the model may go on. Raises `GreyboxError` for options that no model of the user's
    own has."""
    from greybox.commands.judgement import gate
    from greybox.errors import GreyboxError

    refuse(arguments, COURSE_ONLY, "a vehicle that flies a course", "a model of your own")
    if not 2 <= arguments.horizon <= 200:
        raise GreyboxError(
            "--horizon takes 2 to 200 samples", got=str(arguments.horizon), fix="--horizon 20"
        )
    return gate(content, arguments.subject, even_so=arguments.even_so)


def _same_program(arguments: argparse.Namespace) -> None:
    from greybox.commands.own_model import loaded

    loaded(
        argparse.Namespace(
            model=arguments.subject, model_file=arguments.model_file, effects_file=[]
        )
    )
