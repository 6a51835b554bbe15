"""`greybox fit`: from flight logs to fit.json, model.json and report.html."""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from greybox.estimation.document import FitDocument
    from greybox.estimation.result import Fit
    from greybox.model.verdict import Verdict
    from greybox.validation.result import Validation

from greybox.commands.collector import nothing_collected, what_is_there_stays
from greybox.commands.command_line import Subcommands
from greybox.commands.console import Console, json_option
from greybox.commands.fit_flights import Job, begun
from greybox.commands.fit_said import lines, recipe_of, report, save, with_pushes
from greybox.commands.flight_logs import flight_log_options
from greybox.commands.going_on import demand_source_stays, going_on
from greybox.commands.judgement import (
    accept_option,
    adapt_option,
    admitted,
    demand_adapt,
    exit_code,
    horizon_options,
    refuse_faults,
    source_option,
)
from greybox.commands.mcap_option import mcap_option, need_mcap
from greybox.commands.model_options import (
    fit_open,
    fit_with,
    given,
    model_options,
)
from greybox.commands.own_model import model_file_option


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "fit",
        help="fit a Newton-Euler model to flight logs",
        description="Fit a Newton-Euler model to flight logs by the prediction error method. What "
        "is not said is decided from the flights, each choice with its reason; command.sh says all "
        "of them. Writes fit.json, model.json and report.html. Exit code 0: usable (or the flights "
        "are too calm to judge), 1: not usable, or a fault of all flights or of the vehicle file "
        "blocks, or the model of --from is not finished, 2: bad input, 130: interrupted (the same "
        "command goes on; with --model-file it starts again).",
    )
    p.add_argument("--vehicle", metavar="V.toml", help="vehicle file")
    model_file_option(p, read=False)
    p.add_argument(
        "--from",
        dest="source",
        metavar="MODEL.json",
        help="a model of a craft like this one: effects begin where its own are, believed within "
        "half their size, and stay where they foretell these flights better",
    )
    source_option(p)
    p.add_argument("--train", required=True, nargs="+", metavar="LOG", help="flights to fit")
    p.add_argument(
        "--test", nargs="+", default=[], metavar="LOG", help="flights that only the validation sees"
    )
    flight_log_options(p)
    model_options(p)
    p.add_argument(
        "--rate", type=float, default=None, metavar="HZ", help="resample the logs to this rate"
    )
    horizon_options(p)
    adapt_option(p)
    p.add_argument(
        "--manual",
        action="store_true",
        help="decide nothing: what is not said has its plain default",
    )
    p.add_argument(
        "--keep-noise-free",
        action="store_true",
        help="add no noise to sensors that have none, as a simulator's",
    )
    p.add_argument(
        "--judge-left-out",
        action="store_true",
        help="judge on pieces of the training flights that a fit of its own leaves out, too",
    )
    p.add_argument(
        "--all-flights",
        action="store_true",
        help="fit flights with blocking faults or of another craft, too",
    )
    accept_option(p)
    p.add_argument("--seed", type=int, default=0, help="seed of random starts")
    p.add_argument("--out", default="greybox-fit", metavar="DIR", help="folder for the results")
    mcap_option(p)
    json_option(p, "fit.json")
    p.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Read, check, decide, fit, validate, report."""
    from greybox.commands.fit_own import RESULTS
    from greybox.commands.fit_own import run as run_own
    from greybox.commands.vehicle_lines import say_vehicle
    from greybox.files import withdraw
    from greybox.model.faults import BadDataError
    from greybox.model.vehicle import read_vehicle

    _check(arguments)
    demand_source_stays(arguments.source, Path(arguments.out))
    if arguments.model_file is not None:
        return run_own(arguments)
    if not admitted(arguments, arguments.source):
        return 1
    console, vehicle = Console.of(arguments), read_vehicle(arguments.vehicle)
    try:
        job = begun(arguments, vehicle, console)
    except BadDataError as bad:
        withdraw(Path(arguments.out), *RESULTS)
        return refuse_faults(bad.report, console, "a fit")
    say_vehicle(job.vehicle, console.say)
    console.say(f"{job.prepared.data}")
    with what_is_there_stays(), going_on(arguments, console):
        result = _fitted(job, console)
        result, content, seen, pushed = _judged(job, result)
    with nothing_collected():
        written = report(job, result, content, seen)
    table = seen.table_text() if seen is not None and job.test.flights else ""
    console.result(
        content, *lines(job, result, table, content, pushed), f"wrote {written} in {job.out}"
    )
    return exit_code(result.verdict) if result.verdict is not None or result.converged else 1


def _fitted(job: Job, console: Console) -> Fit:
    """The fit with calibrated uncertainty. It is saved before anything else can go wrong, as
    unfinished; an interrupted one is saved, too."""
    from greybox.automatic.lasting import with_lasting
    from greybox.automatic.wanted import with_rivals
    from greybox.commands.fit_own import RESULTS, interrupted
    from greybox.estimation.status import Interrupted
    from greybox.files import withdraw
    from greybox.model.verdict import UNFINISHED
    from greybox.validation.calibration import calibrated

    arguments, data = job.arguments, job.prepared.data
    try:
        if arguments.manual:
            result = fit_with(arguments, job.vehicle, data, console.solver, job.source)
        else:
            said = replace(given(arguments), source=job.source)
            result = fit_open(job.vehicle, job.prepared, said, console)
    except Interrupted as stop:
        withdraw(job.out, *RESULTS)
        save(job, stop.kept.judged(UNFINISHED))
        arguments.kept = interrupted(job.out)
        raise
    withdraw(job.out, *RESULTS)
    save(job, result.judged(UNFINISHED))
    arguments.kept = f"the fit is in {job.out}, unfinished"
    console.say("how sure the model is of what it foretells, and how well it does that:")
    return calibrated(with_lasting(with_rivals(result, data), data), data)


def _judged(job: Job, result: Fit) -> tuple[Fit, FitDocument, Validation | None, list[str]]:
    """(the fit with its verdict, fit.json as it was saved, the validation, what pushes without a
    name tell). One that cannot be judged is kept, with the reason."""
    from greybox.errors import GreyboxError
    from greybox.files import write_json

    content = save(job, result)
    file = shlex.quote(str(job.out / "model.json"))
    job.arguments.kept = (
        f"the fit is in {job.out}, not judged: greybox validate {file} --log LOGS judges it"
    )
    seen, pushed = None, list[str]()
    try:
        seen, left_out = _validated(job, result)
        result, pushed = with_pushes(job, result.judged(seen.verdict))
        content = save(job, result)
        if job.test.flights and left_out is not None:
            content["left_out"] = left_out.to_dict()
            write_json(job.out / "fit.json", content)
    except GreyboxError as error:
        content["warnings"].insert(0, f"no validation: {error}")
        print(f"greybox fit: no validation: {error}", file=sys.stderr)
        write_json(job.out / "fit.json", content)
    return result, content, seen, pushed


def _validated(job: Job, result: Fit) -> tuple[Validation, Verdict | None]:
    """What `judged` gives."""
    from greybox.automatic.judged import judged

    arguments, test = job.arguments, job.test
    return judged(
        result,
        job.prepared,
        recipe_of(job, result),
        test,
        reports=() if job.faults is None else (job.faults,),
        adapt=arguments.adapt,
        left_out=arguments.judge_left_out or not (test.flights or arguments.manual),
        horizons=job.horizons,
    )


def _check(arguments: argparse.Namespace) -> None:
    """Raise `GreyboxError` for options that do not fit together, before anything is read."""
    from greybox.errors import GreyboxError

    if (arguments.vehicle is None) == (arguments.model_file is None):
        raise GreyboxError(
            "fit takes a vehicle file or a model of your own",
            expected="one of --vehicle and --model-file",
            fix=f"--vehicle V.toml; greybox vehicle new --from {shlex.quote(arguments.train[0])} "
            "--out V.toml begins one",
        )
    if arguments.source is not None and arguments.vehicle is None:
        raise GreyboxError(
            "--from takes the effects of another craft",
            expected="--vehicle V.toml, the file of this one",
        )
    need_mcap(arguments.mcap)
    demand_adapt(arguments)
