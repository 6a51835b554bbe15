"""`greybox mpc`: fly an identified model inside limits, in closed loop, and show how often they
were crossed."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.commands.command_line import Subcommands, typed
from greybox.commands.console import Console, json_option
from greybox.commands.judgement import even_so_option
from greybox.commands.mpc_own import OWN_ONLY, add_options, is_own, refuse
from greybox.commands.mpc_own import run as run_own
from greybox.errors import solvable

if TYPE_CHECKING:
    from greybox.report.mpc_documents import MpcDocument
    from mpc_export.mission.prepare import Flown


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "mpc",
        help="fly an identified model through a course with limits, with and without a tube",
        description="Fly controllers on an identified model through a course whose limits bind, "
        "many seeded flights each: the model alone, with limits tightened by a tube, with one "
        "constant back-off, and a cascade of PID loops. A model of your own holds outputs inside "
        "limits instead (--hold, --limit), and `rates` flies a rate controller on a linear model "
        "with a Gaussian process. Writes flights.jsonl (kept and resumed), mpc.json (mpc_own.json, "
        "mpc_rates.json) and report.html. Exit code 0: done, 1: refused, as the model is not "
        "usable, 2: bad input, 130: interrupted (the report shows what was flown until then).",
    )
    p.add_argument(
        "subject",
        metavar="MODEL.json|demo|rates",
        help="model file of `greybox fit` or `learn`; demo: identify a simulated vehicle with "
        "hidden effects from one flight first; rates: a linear model of the body rates with a "
        "process on its residual",
    )
    _world_options(p)
    _campaign_options(p)
    even_so_option(p)
    p.add_argument("--out", default="greybox-mpc", metavar="DIR", help="folder for the results")
    p.add_argument(
        "--mcap",
        metavar="F.mcap",
        default=None,
        help="also write the watched flights with their plans, for Foxglove, Rerun or PlotJuggler",
    )
    add_options(p)
    json_option(p, "mpc.json")
    p.set_defaults(run=run)


def _world_options(p: argparse.ArgumentParser) -> None:
    """What is flown, where."""
    p.add_argument(
        "--plant",
        metavar="MODULE:ATTRIBUTE",
        help="the vehicle that is flown, with reset, step, measure and truth (default: the model "
        "itself, disturbed; Python code that is run, only what you trust)",
    )
    p.add_argument(
        "--log",
        nargs="+",
        default=[],
        metavar="LOG",
        help="real flights whose unexplained force and torque "
        "disturb the model (default: the identified process noise)",
    )
    p.add_argument(
        "--course",
        default="mpc_export.mission:OBSTACLE_COURSE",
        metavar="MODULE:ATTRIBUTE",
        help="path and "
        "limits, an mpc_export.mission.Course (default: a wall, a gap, a low ceiling)",
    )


def _campaign_options(p: argparse.ArgumentParser) -> None:
    """How often, and what may go wrong."""
    p.add_argument(
        "--flights",
        type=int,
        default=20,
        metavar="N",
        help="flights per controller (default 20), after the training flights and rehearsals that "
        "the level asks for whatever N is",
    )
    p.add_argument(
        "--level",
        type=float,
        default=0.1,
        metavar="P",
        help="share of flights that may cross a limit (default 0.1)",
    )
    p.add_argument(
        "--pace",
        type=float,
        default=None,
        metavar="F",
        help="fly the course in F times the time (default: "
        "1, or slow enough for the speeds that the model was trained at)",
    )
    p.add_argument(
        "--jobs",
        type=int,
        default=1,
        metavar="N",
        help="flights at a time (default 1; 2 spoil solution times a bit)",
    )
    p.add_argument(
        "--risk",
        choices=("rehearsal", "boole"),
        default="rehearsal",
        help="how the level becomes a back-off: "
        "flights against the model itself (default), or Boole's inequality over touched limits",
    )
    p.add_argument("--seed", type=int, default=0, metavar="S", help="another set of gusts")


def _check(arguments: argparse.Namespace) -> None:
    from greybox.errors import GreyboxError

    if not 0 < arguments.level < 1:
        raise GreyboxError(
            "--level takes a share of flights", got=f"{arguments.level:g}", fix="--level 0.1"
        )
    if not 1 <= arguments.flights <= 1000:
        raise GreyboxError(
            "--flights takes 1 to 1000", got=str(arguments.flights), fix="--flights 20"
        )
    if arguments.jobs < 1:
        raise GreyboxError(
            "--jobs takes a number above zero", got=str(arguments.jobs), fix="--jobs 1"
        )
    if arguments.seed < 0:
        raise GreyboxError("--seed takes 0 or more", got=str(arguments.seed), fix="--seed 0")
    if arguments.pace is not None and not 0.5 <= arguments.pace <= 10:
        raise GreyboxError("--pace takes 0.5 to 10", got=f"{arguments.pace:g}", fix="--pace 2")


@solvable("mpc")
def run(arguments: argparse.Namespace) -> int:
    """Prepare, fly, report; what was flown is reported even when interrupted. Returns 0, or 1 where
    it refuses."""
    _check(arguments)
    # Training flights too are kept one by one.
    arguments.kept = f"what was flown is in {arguments.out}; the same command goes on"
    if arguments.subject == "rates":
        from greybox.commands.mpc_rates import run as rates

        return rates(arguments)
    from greybox.commands.judgement import gate
    from greybox.commands.mcap_option import need_mcap
    from greybox.files import read_json

    need_mcap(arguments.mcap)
    file = {} if arguments.subject == "demo" else read_json(arguments.subject)
    if is_own(file):
        return run_own(arguments, file)
    refuse(arguments, OWN_ONLY, "a model of your own", arguments.subject)
    judged = gate(file, arguments.subject, even_so=arguments.even_so)
    if not judged.open:
        judged.say("mpc")
        return 1
    from greybox.report.mpc_report import format_table
    from mpc_export.mission.campaign import WATCHED, flights

    console, out = Console.of(arguments), Path(arguments.out)
    command = typed("mpc", f"greybox mpc {shlex.quote(arguments.subject)}")
    flown = _prepared(arguments, console)
    judged.say("mpc")
    watched = flown.seeds[:WATCHED]
    try:
        flights(
            flown.hangar,
            flown.entries,
            flown.seeds,
            jobs=arguments.jobs,
            watched=watched,
            say=console.say_when,
        )
    except KeyboardInterrupt:
        stopped = "The run was interrupted: run the same command again to go on."
        _report(arguments, flown, watched, command, [stopped])
        raise
    content = _report(arguments, flown, watched, command, [])
    written = f"wrote flights.jsonl, mpc.json and report.html in {out} ({console.seconds:.0f} s)"
    warnings = (f"warning: {w}" for w in content["warnings"])
    console.result(content, format_table(content), content["verdict"], *warnings, written)
    return 0


def _prepared(arguments: argparse.Namespace, console: Console) -> Flown:
    """Models, plant and controllers, with the back-offs that training flights ask for."""
    from mpc_export.mission.prepare import Demo, MissionOptions, prepare

    demo = None
    if arguments.subject == "demo":
        from mpc_export.mission.demo import PLANT, identify

        demo = Demo(identify=identify, plant=PLANT)
    return prepare(
        arguments.subject,
        Path(arguments.out),
        MissionOptions(
            plant=arguments.plant,
            logs=tuple(arguments.log),
            course=arguments.course,
            pace=arguments.pace,
            risk=arguments.risk,
            flights=arguments.flights,
            level=arguments.level,
            seed=arguments.seed,
        ),
        demo=demo,
        jobs=arguments.jobs,
        say=console.say_when,
    )


def _report(
    arguments: argparse.Namespace,
    flown: Flown,
    watched: Sequence[int],
    command: str,
    warnings: Sequence[str],
) -> MpcDocument:
    """Write mpc.json, report.html and the recording of what was flown so far; the content of the
    first."""
    from greybox.files import write_atomic, write_json
    from greybox.report.mpc_report import mpc_report
    from mpc_export.mission.campaign import kept, read_traces
    from mpc_export.mission.summary import summary

    campaign, out = flown.hangar.campaign, Path(arguments.out)
    rows = kept(campaign, flown.entries, flown.seeds)
    content = summary(
        what=flown.what,
        task=campaign.mission(),
        entries=flown.entries,
        rows=rows,
        level=arguments.level,
        tuning=flown.tuning,
        seeds=flown.seeds,
        jobs=arguments.jobs,
        command=command,
        warnings=[*warnings, *flown.warnings],
    )
    write_json(out / "mpc.json", content)
    traces = read_traces(campaign, flown.entries, watched)
    write_atomic(out / "report.html", mpc_report(content, rows, traces))
    if arguments.mcap is not None:
        from greybox.commands.mcap_mpc import write_mpc_mcap

        write_mpc_mcap(arguments.mcap, rows, traces)
    return content
