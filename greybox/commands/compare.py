"""`greybox compare`: all methods on the same flights, as one table (compare.json, report.html)."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from greybox.commands.command_line import Subcommands, typed
from greybox.commands.console import Console, json_option
from greybox.commands.flight_logs import flight_log_options, read_flight_logs
from greybox.commands.going_on import going_on
from greybox.commands.judgement import (
    accept_option,
    accepted,
    adapt_option,
    admitted,
    demand_adapt,
    horizon_options,
    log_faults,
    refuse_faults,
    source_option,
)
from greybox.commands.model_options import fitted_model, is_given, model_options, names

if TYPE_CHECKING:
    from greybox.baselines.compare_bench import Bench
    from greybox.baselines.document import CompareDocument
    from greybox.data import Dataset
    from greybox.model.identified import IdentifiedModel
    from greybox.model.vehicle import Vehicle


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "compare",
        help="compare linear, nonlinear, black-box and hybrid models on the same flights",
        description="Train every method on the same flights and judge them on the same samples of "
        "others: linear and nonlinear PEM, their hybrids with a Gaussian process, a GP alone, an "
        "LSTM, a TCN, networks on physics. The nonlinear model is that of plain `greybox fit`; "
        "options of it make it that of `greybox fit --manual` with these. Writes compare.json "
        "after every method, and report.html. Exit code 0: done, 1: a method failed (its row says "
        "why), a fault of the data blocks, or the model of --fitted is not finished, 2: bad input, "
        "130: interrupted (the same command goes on).",
    )
    p.add_argument("--vehicle", required=True, metavar="V.toml", help="vehicle file")
    p.add_argument("--train", required=True, nargs="+", metavar="LOG", help="flights to train on")
    p.add_argument(
        "--test",
        required=True,
        nargs="+",
        metavar="LOG",
        help="flights that only the judgement sees",
    )
    flight_log_options(p)
    accept_option(p)
    adapt_option(p)
    _method_options(p)
    horizon_options(p)
    p.add_argument(
        "--rate", type=float, default=None, metavar="HZ", help="resample the logs to this rate"
    )
    p.add_argument("--seed", type=int, default=0, help="seed of searches, subsets and networks")
    p.add_argument("--out", default="greybox-compare", metavar="DIR", help="folder for the results")
    json_option(p, "compare.json")
    nonlinear = p.add_argument_group("the nonlinear model, as in greybox fit")
    nonlinear.add_argument(
        "--fitted",
        metavar="MODEL.json",
        help="take the model that greybox fit made of the same training flights, and its rate; no "
        "other option of this group counts then",
    )
    model_options(nonlinear)
    source_option(nonlinear)
    p.set_defaults(run=run)


def _method_options(p: argparse.ArgumentParser) -> None:
    """Which methods, and how much each may try."""
    p.add_argument(
        "--budget",
        type=int,
        default=4,
        metavar="N",
        help="candidates of every method with choices (default 4)",
    )
    p.add_argument(
        "--points",
        type=int,
        default=50,
        metavar="M",
        help="support points of the force and torque GP",
    )
    p.add_argument(
        "--methods", type=names, default=None, metavar="a,b", help="only these methods, by name"
    )
    p.add_argument(
        "--learners",
        type=names,
        default=(),
        metavar="a,b",
        help="also every model (linear SISO, linear MIMO, nonlinear) with these learners, as in "
        "greybox learn; all: every learner that there is",
    )


def run(arguments: argparse.Namespace) -> int:
    """Read, check, run the methods one by one, report."""
    from greybox.baselines.compare import compare
    from greybox.data.halves import demand_disjoint
    from greybox.estimation.record import sample_time
    from greybox.files import write_atomic, write_json
    from greybox.model.vehicle import read_vehicle
    from greybox.report.compare_report import compare_report, format_table

    console = Console.of(arguments)
    learners = _checked(arguments)  # what is wrong is said before logs are read
    if not admitted(arguments, arguments.fitted):
        return 1
    vehicle = read_vehicle(arguments.vehicle)
    faults = log_faults(arguments, vehicle)
    if not faults.ok:
        return refuse_faults(faults, console, "a comparison")
    for warning in faults.accepted_lines():
        print(f"greybox compare: {warning}", file=sys.stderr)
    fitted = fitted_model(arguments, arguments.fitted)
    train = read_flight_logs(arguments, arguments.train, vehicle, rate=_rate(arguments, fitted))
    if fitted is not None:
        _demand_trained_on(fitted, arguments.fitted, train)
    test = read_flight_logs(arguments, arguments.test, vehicle, rate=1 / sample_time(train))
    demand_disjoint(train.files, test.files)
    bench = _bench(arguments, vehicle, train, test, fitted, console)
    out = Path(arguments.out)
    command = typed("compare")
    with going_on(arguments, console):
        for partial in compare(bench, arguments.methods, learners=learners):
            # What is done stays done, whatever happens to the next method.
            content: CompareDocument = {**partial, "command": command}
            write_json(out / "compare.json", content)
            write_atomic(out / "report.html", compare_report(content))
            done, left = len(content["methods"]), len(content["not_run"])
            arguments.kept = f"{done} of {done + left} methods are in {out / 'compare.json'}"
            console.share(f"{done} of {done + left} done", done / (done + left))
    console.result(content, format_table(content), f"wrote compare.json and report.html in {out}")
    for m in content["methods"]:
        if m["status"] != "done":
            print(f"greybox compare: {m['method']}: {m['status']}: {m['error']}", file=sys.stderr)
    return 1 if any(m["status"] == "failed" for m in content["methods"]) else 0


def _checked(arguments: argparse.Namespace) -> tuple[str, ...]:
    """The learners of --learners. Raises `GreyboxError` for options that say nothing."""
    from greybox.baselines.compare_methods import pairs
    from greybox.commands.judgement import given_horizons
    from greybox.errors import GreyboxError
    from greybox.residual.learners import GP, LEARNERS

    learners = (
        (GP, *LEARNERS) if tuple(arguments.learners) == ("all",) else tuple(arguments.learners)
    )
    pairs(learners)
    given_horizons(arguments)
    demand_adapt(arguments)
    if arguments.budget < 1:
        raise GreyboxError(
            "--budget takes a number above zero", got=str(arguments.budget), fix="--budget 4"
        )
    return learners


def _bench(
    arguments: argparse.Namespace,
    vehicle: Vehicle,
    train: Dataset,
    test: Dataset,
    fitted: IdentifiedModel | None,
    console: Console,
) -> Bench:
    """The flights with the choices of the command line; the model of --fitted, or one that is
    fitted when a method first asks for it."""
    from greybox.baselines.compare_bench import Bench
    from greybox.baselines.compare_options import CompareOptions
    from greybox.commands.judgement import horizon_steps
    from greybox.estimation.record import sample_time

    return Bench(
        vehicle=vehicle,
        train=train,
        test=test,
        fit=lambda: fitted or _fit(arguments, vehicle, train, console),
        options=CompareOptions(
            adapt=arguments.adapt,
            budget=arguments.budget,
            seed=arguments.seed,
            points=arguments.points,
            horizons=horizon_steps(arguments, sample_time(train)),
        ),
        say=lambda text: console.say(f"  {text}"),
        fitted=fitted is not None,
    )


def _fit(
    arguments: argparse.Namespace, vehicle: Vehicle, train: Dataset, console: Console
) -> IdentifiedModel:
    """The model that plain `greybox fit` decides on; with options of it exactly what they say."""
    from greybox.automatic.fit import prepare
    from greybox.commands.model_options import fit_open, fit_with, given
    from greybox.validation.calibration import calibrated

    if is_given(arguments):
        return fit_with(arguments, vehicle, train, console.solver).model
    prepared = prepare(vehicle, train, decide_rate=False, accept=accepted(arguments.accept))
    found = fit_open(vehicle, prepared, given(arguments), console)
    return calibrated(found, prepared.data).model


def _rate(
    arguments: argparse.Namespace, fitted: IdentifiedModel | None
) -> float | Literal["needed"] | None:
    """Rate [Hz] of all flights: what was asked for, that of the model of --fitted, what plain
    `greybox fit` would take, or (None) that of the logs, with options of the fit."""
    if arguments.rate is not None:
        return float(arguments.rate)
    if fitted is not None:
        return 1.0 / fitted.sample_time
    return None if is_given(arguments) else "needed"


def _demand_trained_on(model: IdentifiedModel, path: str, train: Dataset) -> None:
    """Raise `GreyboxError` for a model that was fitted to other flights."""
    from greybox.errors import GreyboxError

    if not set(model.trained_on) <= set(train.names):
        raise GreyboxError(
            "the model was fitted to other flights than --train names",
            where=path,
            expected=", ".join(train.names),
            got=", ".join(model.trained_on),
            fix="greybox fit --train with these flights, or leave --fitted out",
        )
