"""greybox validate MODEL.json --log C.csv ...: errors of a fitted model on flights that it never
saw."""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from greybox.commands.command_line import Subcommands, effects_file_option
from greybox.commands.console import Console, json_option
from greybox.commands.flight_logs import flight_log_options
from greybox.commands.judgement import (
    adapt_option,
    demand_adapt,
    exit_code,
    fault_lines,
    given_horizons,
    horizon_options,
)
from greybox.commands.mcap_option import mcap_option, need_mcap, need_ulog, write_if_asked
from greybox.commands.own_model import loaded, model_file_option, read_flights_of

if TYPE_CHECKING:
    from greybox.data import Dataset
    from greybox.model.identified import IdentifiedModel
    from greybox.validation.advice import Hint


def add(commands: Subcommands) -> None:
    """Add the subcommand."""
    p = commands.add_parser(
        "validate",
        help="judge a model on flights that it never saw",
        description="Open-loop errors of a model over several horizons, with persistence and dead "
        "reckoning beside them, errors one step ahead, coverage and residual tests. Faults of the "
        "logs are said first. Exit code 0: usable, or too calm to judge; 1: not usable, on all "
        "flights together or on most of them alone; 2: bad input.",
    )
    p.add_argument("model", metavar="MODEL.json", help="model file that `greybox fit` wrote")
    p.add_argument(
        "--log", nargs="+", required=True, metavar="LOG", help="flight logs of the model's vehicle"
    )
    flight_log_options(p)
    horizon_options(p)
    adapt_option(p)
    p.add_argument(
        "--measured-start",
        action="store_true",
        help="also start from the measured state (smoothed channels included)",
    )
    p.add_argument(
        "--rate", type=float, metavar="HZ", help="resample the logs (default: the model's own rate)"
    )
    p.add_argument("--keep-ground", action="store_true", help="keep take-off and landing")
    effects_file_option(p, "Python files with the model's own effects")
    model_file_option(p)
    mcap_option(p)
    p.add_argument(
        "--ulog",
        metavar="F.ulg",
        default=None,
        help="also write the flights (ground truth) beside the model's "
        "predictions (estimate) for PX4 Flight Review",
    )
    json_option(p, "the judgement")
    p.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Validate and print. Returns 0, or 1 where the model is not usable."""
    demand_adapt(arguments)
    need_mcap(arguments.mcap)
    need_ulog(arguments.ulog)
    from greybox.commands.ulog_out import need_topic, write_ulog
    from greybox.model.layer import physics_of
    from greybox.model.verdict import Outcome
    from greybox.progress import TimeLeft
    from greybox.validation.validate import validate

    model = loaded(arguments)
    if arguments.ulog is not None:
        need_topic(model)
    horizons = given_horizons(arguments, own=physics_of(model.dynamics) is None)
    dataset = read_flights_of(
        arguments,
        model.dynamics,
        arguments.log,
        rate=arguments.rate or 1.0 / model.sample_time,
        trim=not arguments.keep_ground,
    )
    hints, faults = _faults(model, dataset)
    if model.verdict is not None and model.verdict.outcome is Outcome.UNFINISHED:
        faults = [model.verdict.sentence, *faults]
        print(f"greybox validate: {model.verdict.sentence}", file=sys.stderr)
    left, begun = TimeLeft(), itertools.count()

    def progress(line: str) -> None:
        k = next(begun)
        if sys.stderr.isatty():
            print(
                f"{line} ({k + 1} of {len(dataset)}){left.after(k / len(dataset))}",
                file=sys.stderr,
                flush=True,
            )

    result = validate(
        model,
        dataset,
        **horizons,
        adapt=arguments.adapt,
        measured_start=arguments.measured_start,
        progress=progress,
        hints=hints,
    )
    result = replace(result, warnings=(*faults, *result.warnings))
    content = result.to_dict()
    on = content["adapted_on"]
    adapted = None if on is None else on["flights"]
    write_if_asked(arguments.mcap, model, dataset, adapted=adapted)
    if arguments.ulog is not None:
        write_ulog(arguments.ulog, model, dataset, adapted=adapted)
    Console.of(arguments).result(content, result.format())
    return exit_code(result.verdict)


def _faults(model: IdentifiedModel, data: Dataset) -> tuple[Sequence[Hint], list[str]]:
    """(what the checks of the flights of a vehicle say about its model, their faults in words,
    which are also said on standard error)."""
    from greybox.data.checks import check
    from greybox.model.layer import physics_of
    from greybox.validation.advice import hints_of_checks

    physics = physics_of(model.dynamics)
    if physics is None:
        return (), []
    report = check(data, physics.vehicle)
    lines = fault_lines(report)
    for line in lines:
        print(f"greybox validate: {line}", file=sys.stderr)
    noise = physics.kinematic_noise
    return hints_of_checks(report, effects=model.effects, kinematic_noise=noise), lines
