"""`greybox fit`: from flight logs to fit.json, model.json and report.html."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from greybox.automatic.fit import Prepared
    from greybox.data import Dataset
    from greybox.data.checks import CheckReport
    from greybox.data.raw import RawLog
    from greybox.estimation.document import FitDocument
    from greybox.estimation.recipe import Recipe
    from greybox.estimation.result import Fit
    from greybox.model.identified import IdentifiedModel
    from greybox.model.vehicle import Vehicle
    from greybox.model.verdict import Verdict
    from greybox.validation.options import HorizonChoices
    from greybox.validation.result import Validation

from greybox.commands.command_line import Subcommands, typed
from greybox.commands.console import Console, json_option
from greybox.commands.flight_logs import flight_log_options
from greybox.commands.judgement import (
    accept_option,
    accepted,
    adapt_option,
    demand_adapt,
    exit_code,
    fault_lines,
    given_horizons,
    horizon_options,
    refuse_faults,
)
from greybox.commands.mcap_option import mcap_option, need_mcap, write_if_asked
from greybox.commands.model_options import (
    explicit_recipe,
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
        "is not said is decided "
        "from the flights, each choice with its reason, and the explicit command is printed. "
        "Writes fit.json, model.json "
        "and report.html. Exit code 0: usable (or the flights are too calm to judge), 1: not "
        "usable, or a fault of all flights or of the vehicle file blocks, 2: bad input, 130: "
        "interrupted.",
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
    if arguments.model_file is not None:
        return run_own(arguments)
    console, vehicle = Console.of(arguments), read_vehicle(arguments.vehicle)
    try:
        job = _begun(arguments, vehicle, console)
    except BadDataError as bad:
        withdraw(Path(arguments.out), *RESULTS)
        return refuse_faults(bad.report, console, "a fit")
    say_vehicle(job.vehicle, console.say)
    console.say(f"{job.prepared.data}")
    result = _fitted(job, console)
    result, content, seen = _judged(job, result)
    written = _report(job, result, content, seen)
    table = seen.table_text() if seen is not None and job.test.flights else ""
    console.result(content, *_lines(job, result, table, content), f"wrote {written} in {job.out}")
    return exit_code(result.verdict) if result.verdict is not None or result.converged else 1


def _begun(arguments: argparse.Namespace, vehicle: Vehicle, console: Console) -> _Job:
    """What is to be fitted and judged. Raises `BadDataError` where a fault of the vehicle file or
    of all flights blocks."""
    from greybox.data.checks import check
    from greybox.model.faults import demand_sound, faults_of
    from greybox.model.identified import IdentifiedModel

    horizons, accept = given_horizons(arguments), accepted(arguments.accept)
    source = None if arguments.source is None else IdentifiedModel.load(arguments.source)
    demand_sound(faults_of(vehicle, accept=accept, file=arguments.vehicle), "a fit")
    prepared, test, files = _flights(arguments, vehicle)
    if source is not None and arguments.manual:
        vehicle = _like(source, vehicle, prepared, console)
    faults = check(test, vehicle, accept=accept) if test.flights else None
    return _Job(
        arguments=arguments,
        vehicle=vehicle,
        prepared=prepared,
        test=test,
        faults=faults,
        horizons=horizons,
        warnings=_warnings(arguments, vehicle, (prepared.report, faults), files),
        source=source,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Job:
    """What is fitted and judged: training flights as they are fitted, test flights with what their
    checks said, and what is said of all of them in fit.json."""

    arguments: argparse.Namespace
    vehicle: Vehicle
    prepared: Prepared
    test: Dataset
    faults: CheckReport | None
    horizons: HorizonChoices
    warnings: tuple[Sequence[str], Sequence[str]]
    source: IdentifiedModel | None

    @property
    def out(self) -> Path:
        return Path(self.arguments.out)

    def save(self, found: Fit) -> FitDocument:
        """Write fit.json and model.json. Returns the first."""
        from greybox.files import write_json

        content = _content(self, found)
        write_json(self.out / "fit.json", content)
        found.model.save(self.out / "model.json")
        return content


def _fitted(job: _Job, console: Console) -> Fit:
    """The fit, which is saved before anything else can go wrong, with calibrated uncertainty. An
    interrupted one is saved, too."""
    from greybox.automatic.wanted import with_rivals
    from greybox.commands.fit_own import RESULTS, interrupted
    from greybox.estimation.status import Interrupted
    from greybox.files import withdraw
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
        job.save(stop.kept)
        arguments.kept = interrupted(job.out)
        raise
    withdraw(job.out, *RESULTS)
    job.save(result)
    return calibrated(with_rivals(result, data), data)


def _judged(job: _Job, result: Fit) -> tuple[Fit, FitDocument, Validation | None]:
    """(the fit with its verdict, fit.json as it was saved, the validation). One that cannot be
    judged is kept, with the reason."""
    from greybox.errors import GreyboxError
    from greybox.files import write_json

    content = job.save(result)
    file = shlex.quote(str(job.out / "model.json"))
    job.arguments.kept = (
        f"the fit is in {job.out}, not judged: greybox validate {file} --log LOGS judges it"
    )
    seen = None
    try:
        seen, left_out = _validated(job, result)
        result = result.judged(seen.verdict)
        content = job.save(result)
        if job.test.flights and left_out is not None:
            content["left_out"] = left_out.to_dict()
            write_json(job.out / "fit.json", content)
    except GreyboxError as error:
        content["warnings"].insert(0, f"no validation: {error}")
        print(f"greybox fit: no validation: {error}", file=sys.stderr)
        write_json(job.out / "fit.json", content)
    return result, content, seen


def _warnings(
    arguments: argparse.Namespace,
    vehicle: Vehicle,
    flights: Sequence[CheckReport | None],
    files: Sequence[CheckReport],
) -> tuple[list[str], list[str]]:
    """(faults of the flights and of their files and what no model can be fitted to, what the files
    warn of), which are also said. Files show what reading takes out."""
    reports = [r for r in (*flights, *files) if r is not None]
    blocking = [line for r in reports for line in (*fault_lines(r), *r.accepted_lines())]
    first = [*dict.fromkeys(blocking), *_unfit(arguments, vehicle)]
    lines = [line for r in files for line in r.warning_lines()]
    for warning in (*first, *(f"warning: {line}" for line in lines)):
        print(f"greybox fit: {warning}", file=sys.stderr)
    return first, lines


def _content(job: _Job, result: Fit) -> FitDocument:
    """fit.json, with the commands that do the same."""
    content = result.to_dict()
    content["warnings"] = [*job.warnings[0], *content["warnings"], *job.warnings[1]]
    content["command"] = typed("fit")
    if "explicit" in content:
        content["explicit"]["command"] = _explicit(job, result)
        # The recipe speaks of the vehicle with another's effects.
        if job.arguments.source is not None:
            file = str(job.out / "model.json")
            content["explicit"]["python"] = (
                "from greybox.model.identified import IdentifiedModel\n"
                f"vehicle = IdentifiedModel.load({file!r}).physics.vehicle\n"
                f"{content['explicit']['python']}"
            )
    return content


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


def _like(
    source: IdentifiedModel, vehicle: Vehicle, prepared: Prepared, console: Console
) -> Vehicle:
    """The vehicle with the effects of the model that --from names."""
    from greybox.automatic.facts import facts_of
    from greybox.automatic.like import like

    found = like(vehicle, source, facts_of(prepared.data, vehicle, prepared.report))
    new = [n for n in found.effects if n not in vehicle.effects]
    console.say(f"taken from {source.name}: {', '.join(new) or 'nothing new'}")
    return found


def _report(job: _Job, result: Fit, content: FitDocument, seen: Validation | None) -> str:
    """Write validate.json, report.html and the recording. Returns the names of all files of the
    fit, for people."""
    from greybox.commands.flight_series import series
    from greybox.commands.responses import responses
    from greybox.data import Dataset
    from greybox.files import write_atomic, write_json
    from greybox.report.fit_report import fit_report
    from greybox.validation.usefulness import LEFT_OUT

    out, data, test = job.out, job.prepared.data, job.test
    checked = None if seen is None else seen.to_dict()
    if checked is not None:
        if not test.flights:
            verdict = result.verdict
            pieces = verdict is not None and verdict.judged_on == LEFT_OUT
            where = "pieces of the training flights" if pieces else "the flights that were fitted"
            checked["warnings"].insert(0, f"validated on {where}: give --test flights")
        write_json(out / "validate.json", checked)
    on = None if checked is None else checked["adapted_on"]
    adapted = {} if on is None else on["flights"]
    # The flight that judges is drawn; a fitted one where there is none.
    drawn = (Dataset(flights=()), test) if test.flights else (data,)
    drawing = series(result.model, *drawn, adapted=adapted)
    # What physics says on the terminal stands on the page, too.
    said: FitDocument = {**content, "warnings": [*_sanity_lines(result), *content["warnings"]]}
    answers = responses(result.model, data, test)
    title = f"Fit of {result.model.physics.vehicle.name}"
    report = write_atomic(
        out / "report.html", fit_report(said, drawing, checked, responses=answers, title=title)
    )
    write_if_asked(job.arguments.mcap, result.model, data, test, adapted=adapted)
    return f"{', '.join(p.name for p in sorted(out.glob('*.json')))} and {report.name}"


def _lines(job: _Job, result: Fit, table: str, content: FitDocument) -> list[str]:
    """The verdict and what the logs and physics say, the decisions with their reasons, the
    estimates, the explicit command."""
    first, *rest = result.summary().splitlines()
    if result.covariance.form:  # it is said at once, with what to do next
        rest.remove(f"warning: {result.covariance.form}")
    told = [f"warning: {w}" for some in job.warnings for w in some]
    lines = [first, *_next(job, result), *told, *_sanity_lines(result)]
    if result.provenance.decisions:
        lines += ["", "Decided, because nothing else was said:"]
        lines += [f"  {decision.line()}" for decision in result.provenance.decisions]
        lines += [""]
    lines += rest
    if table:
        lines += [table, ""]
    if "explicit" in content:
        lines += ["The same as an explicit command:", f"  {content['explicit']['command']}"]
    return lines


def _next(job: _Job, result: Fit) -> list[str]:
    """The command that names what is missing, where parameters stand in for that, or pushes
    without a name follow the motion and matter ahead or carry the craft."""
    from greybox.residual.followed import told_of_pushes

    verdict, form = result.verdict, result.covariance.form
    told = [form] if form else []
    if verdict is not None and not verdict.refused and verdict.groups and result.converged:
        told += told_of_pushes(result.model, job.prepared.data, verdict.groups)
    return [f"next: {_discover(job.arguments)}: {'; '.join(told)}"] if told else []


def _discover(arguments: argparse.Namespace) -> str:
    """The search in the same flights."""
    words = ["greybox", "discover", "--vehicle", arguments.vehicle, "--train", *arguments.train]
    for option, values in (
        ("--test", arguments.test),
        ("--mapping", [arguments.mapping] if arguments.mapping else []),
        ("--accept", [arguments.accept] if arguments.accept else []),
        ("--effects-file", arguments.effects_file),
    ):
        words += [option, *values] if values else []
    words += ["--keep-impossible"] if arguments.keep_impossible else []
    return shlex.join(words)


def _flights(
    arguments: argparse.Namespace, vehicle: Vehicle
) -> tuple[Prepared, Dataset, list[CheckReport]]:
    """(training flights as they are fitted, test flights at their rate, what is wrong with the
    files of both). Raises `GreyboxError` for a flight in both."""
    from greybox.automatic.fit import prepare, read_flights
    from greybox.data import Dataset
    from greybox.data.checks import check
    from greybox.data.dataset import demand_names_once
    from greybox.data.halves import demand_disjoint
    from greybox.data.logs import read_possible
    from greybox.estimation.record import sample_time

    keep = bool(arguments.keep_impossible)

    def read(paths: Sequence[str]) -> list[RawLog]:
        return [
            read_possible(p, vehicle, mapping=arguments.mapping, keep_impossible=keep)
            for p in paths
        ]

    logs, others = read(arguments.train), read(arguments.test)
    demand_names_once([r.flight for r in logs])
    demand_disjoint(*([(r.flight, r.sha256) for r in some] for some in (logs, others)))
    prepared = prepare(
        vehicle,
        logs,
        rate=arguments.rate,
        keep_impossible=keep,
        all_flights=arguments.all_flights or arguments.manual,
        decide_rate=not arguments.manual,
        accept=accepted(arguments.accept),
    )
    files = [
        check(some, vehicle, accept=prepared.report.accepted) for some in (logs, others) if some
    ]
    if not others:
        return prepared, Dataset(flights=()), files
    test = read_flights(others, vehicle, rate=prepared.rate)
    dt = sample_time(prepared.data)
    if any(abs(f.dt - dt) > 1e-6 * dt for f in test):
        test = read_flights(others, vehicle, rate=1 / dt)
    return prepared, test, files


def _unfit(arguments: argparse.Namespace, vehicle: Vehicle) -> list[str]:
    """What `greybox inspect` says first of training logs that no model can be fitted to, before
    anything is estimated.

    Reads the logs once more: what was read for the fit has not the rates of the log's own streams.
    """
    from greybox.data.inspection import inspect_log

    found = [
        (path, inspect_log(path, vehicle, mapping=arguments.mapping).unfit)
        for path in arguments.train
    ]
    return [
        f"greybox inspect calls {path} not usable: {'; '.join(why)}" for path, why in found if why
    ]


def _recipe(job: _Job, result: Fit) -> Recipe:
    """What was fitted."""
    return result.provenance.recipe or explicit_recipe(job.arguments, result)


def _validated(job: _Job, result: Fit) -> tuple[Validation, Verdict | None]:
    """What `judged` gives."""
    from greybox.automatic.judged import judged

    arguments, test = job.arguments, job.test
    return judged(
        result,
        job.prepared,
        _recipe(job, result),
        test,
        reports=() if job.faults is None else (job.faults,),
        adapt=arguments.adapt,
        left_out=arguments.judge_left_out or not (test.flights or arguments.manual),
        horizons=job.horizons,
    )


def _sanity_lines(result: Fit) -> list[str]:
    from greybox.validation.sanity import sanity_of

    return sanity_of(result).lines()


def _explicit(job: _Job, result: Fit) -> str:
    """The explicit command line: every choice is said, flights that were left out are not named."""
    from greybox.automatic.fit import adaptation

    arguments, prepared, recipe = job.arguments, job.prepared, _recipe(job, result)
    recipe = replace(recipe, adapt=adaptation(recipe, job.test, arguments.adapt))
    out = {f.flight for f in prepared.left_out}
    train = [p for p, name in zip(arguments.train, prepared.names, strict=True) if name not in out]
    words = recipe.command_line(arguments.vehicle, train, arguments.test)
    more = ["--mapping", arguments.mapping] if arguments.mapping else []
    told = [d.choice for d in result.provenance.decisions if d.option == "--from"]
    more += ["--from", arguments.source] if arguments.source and told != ["nothing"] else []
    more += (
        []
        if arguments.max_iterations is None
        else ["--max-iterations", str(arguments.max_iterations)]
    )
    more += ["--effects-file", *arguments.effects_file] if arguments.effects_file else []
    more += ["--keep-impossible"] if arguments.keep_impossible else []
    more += ["--accept", arguments.accept] if arguments.accept else []
    more += ["--judge-left-out"] if arguments.judge_left_out or not arguments.test else []
    return words + (" " + shlex.join(more) if more else "")
