"""`greybox identify`: the whole chain from flight logs to a judged model for a controller, in one
folder."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from greybox.commands.command_line import Subcommands, typed
from greybox.commands.console import Console, json_option
from greybox.commands.judgement import accept_option, accepted
from greybox.commands.model_options import names


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "identify",
        help="do all of it: from flight logs to a judged model for a controller",
        description="inspect, check, fit, discover, fit again with what was found, learn, validate "
        "and export, each the plain command of its name with its own folder, and one page. The "
        "same command again goes on where it was stopped. A model that is NOT USABLE is not "
        "learned from or exported. Without a vehicle file the log is asked for one. Exit code 0: "
        "usable (or the flights are too calm to judge), 1: not usable, 2: bad input, 130: "
        "interrupted.",
    )
    p.add_argument(
        "inputs", nargs="*", metavar="VEHICLE.toml LOG", help="vehicle file and the flights to fit"
    )
    p.add_argument(
        "--vehicle", metavar="V.toml", help="the vehicle file, said as to the other commands"
    )
    p.add_argument(
        "--train",
        nargs="+",
        default=[],
        metavar="LOG",
        help="the flights to fit, said as to the other commands",
    )
    p.add_argument("--test", nargs="+", default=[], metavar="LOG", help="flights that only judge")
    p.add_argument(
        "--mapping",
        metavar="MAP.toml",
        help="which fields of the logs are which channels (docs/logs.md)",
    )
    p.add_argument(
        "--skip",
        type=names,
        default=(),
        metavar="a,b",
        help="leave stages out: discover,learn,export,...",
    )
    p.add_argument(
        "--rate", type=float, default=None, metavar="HZ", help="resample the logs to this rate"
    )
    p.add_argument(
        "--guess",
        action="store_true",
        help="without a vehicle file: go on with the one guessed from the log",
    )
    p.add_argument(
        "--even-so",
        action="store_true",
        help="learn and export although the model was judged not usable",
    )
    accept_option(p)
    p.add_argument("--seed", type=int, default=0, help="seed of all stages")
    p.add_argument(
        "--out", default="greybox-identify", metavar="DIR", help="folder for the results"
    )
    json_option(p, "identify.json")
    p.set_defaults(run=run)


def _sorted(arguments: argparse.Namespace) -> tuple[str | None, list[str]]:
    """(vehicle file, None where none was named; logs to fit). No log is TOML, so that the vehicle
    file may stand behind them. Raises `GreyboxError` for two of them."""
    from greybox.errors import GreyboxError

    files = [path for path in arguments.inputs if Path(path).suffix == ".toml"]
    logs = [path for path in arguments.inputs if path not in files] + arguments.train
    named = ([] if arguments.vehicle is None else [arguments.vehicle]) + files
    if len(named) > 1:
        raise GreyboxError(
            "identify takes one vehicle file",
            got=", ".join(named),
            fix="one chain for each, with an --out of its own",
        )
    return (named[0] if named else None), logs


def run(arguments: argparse.Namespace) -> int:
    """Run the chain and print its first line. Returns 0, or 1 where the model is not usable."""
    from greybox.commands.chain.guess import guessed_vehicle
    from greybox.commands.chain.record import FILE
    from greybox.commands.chain.request import Request
    from greybox.commands.chain.run import run_chain
    from greybox.errors import GreyboxError
    from greybox.files import read_json

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    out = Path(arguments.out)
    vehicle, logs = _sorted(arguments)
    if not logs:
        raise GreyboxError(
            "no flights to fit", fix="greybox identify --vehicle V.toml --train A.csv B.csv"
        )
    if vehicle is None:
        vehicle = guessed_vehicle(logs, out, go_on=arguments.guess, say=say)
    if arguments.rate is not None and not arguments.rate > 0:
        raise GreyboxError(
            "--rate takes a rate above zero", got=f"{arguments.rate:g} Hz", fix="--rate 100"
        )
    request = Request(
        vehicle=vehicle,
        train=tuple(logs),
        test=tuple(arguments.test),
        out=out,
        mapping=arguments.mapping,
        rate=arguments.rate,
        seed=arguments.seed,
        skip=frozenset(arguments.skip),
        even_so=arguments.even_so,
        accept=accepted(arguments.accept),
    )
    command = typed("identify", "greybox " + shlex.join(["identify", vehicle, *logs]))
    arguments.kept = f"the stages that ended are in {out}; the same command goes on"
    found = run_chain(request, command=command, say=say, progress=sys.stderr)
    outcome = found.outcome
    if outcome.stopped:
        if outcome.exit_code == 130:
            say(outcome.line)
            raise KeyboardInterrupt
        raise GreyboxError(outcome.line)
    why = outcome.verdict.get("why", ()) if outcome.verdict else ()
    lines = [outcome.line, *(f"  {w}" for w in why), f"model: {outcome.model} ({outcome.why})"]
    for record in found.so_far.done.values():
        ended = f"skipped ({record.skipped})" if record.skipped else f"{record.seconds:.0f} s"
        failed = "" if record.finished else f", failed: {' '.join(record.lines[-1:])}"
        lines.append(f"  {record.folder:11} {ended}{failed}")
    Console.of(arguments).result(read_json(out / FILE), *lines, f"wrote {out / 'report.html'}")
    return outcome.exit_code
