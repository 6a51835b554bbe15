"""`greybox learn`: from a model file and its training flights to hybrid.json and report.html."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.commands.command_line import Subcommands, typed
from greybox.commands.console import Console, json_option
from greybox.commands.flight_logs import flight_log_options
from greybox.commands.going_on import going_on
from greybox.commands.judgement import (
    accept_option,
    adapt_option,
    admitted,
    demand_adapt,
    exit_code,
    given_horizons,
    horizon_options,
    log_faults,
    refuse_faults,
    source_option,
)
from greybox.commands.mcap_option import mcap_option, need_mcap, write_if_asked
from greybox.commands.own_model import loaded, model_file_option, read_flights_of

if TYPE_CHECKING:
    from greybox.data import Dataset
    from greybox.model.identified import IdentifiedModel
    from greybox.model.verdict import Verdict
    from greybox.residual.document import LearnDocument
    from greybox.residual.learn import Learned
    from greybox.residual.learners import Learner
    from greybox.validation.options import HorizonChoices

JUDGING = 0.95
"""Share of the work that is done when the model is judged."""


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "learn",
        help="learn what a fitted model misses as a Gaussian process",
        description="Learn what a fitted model misses as a Gaussian process and calibrate its "
        "uncertainty. Writes hybrid.json, learn.json and report.html (where nothing was worth "
        "learning, hybrid.json is the physics with calibrated uncertainty). Exit code 0: usable "
        "(or too calm to judge), 1: not usable, or refused, as the model is not finished, 2: bad "
        "input, 130: interrupted (the same command goes on; on a linear model it starts again).",
    )
    p.add_argument(
        "model",
        metavar="MODEL.json",
        help="model file that `greybox fit` or `greybox linear` wrote",
    )
    p.add_argument(
        "--train",
        required=True,
        nargs="+",
        metavar="LOG",
        help="the flights that the model was fitted to",
    )
    p.add_argument(
        "--test", nargs="+", default=[], metavar="LOG", help="flights that only the validation sees"
    )
    flight_log_options(p)
    accept_option(p)
    _learner_options(p)
    adapt_option(p)
    horizon_options(p)
    p.add_argument(
        "--effects-file",
        nargs="+",
        default=[],
        metavar="F.py",
        help="effects of your own in the model, and the laws of model_with_laws.json",
    )
    model_file_option(p)
    source_option(p)
    _linear_options(p)
    p.add_argument("--seed", type=int, default=0, help="seed of subsets and restarts")
    p.add_argument("--out", default="greybox-learn", metavar="DIR", help="folder for the results")
    mcap_option(p)
    json_option(p, "learn.json")
    p.set_defaults(run=run)


def _learner_options(p: argparse.ArgumentParser) -> None:
    """What is learned, of which inputs."""
    p.add_argument(
        "--points", default="50", metavar="M", help="support points, a number or auto (default 50)"
    )
    p.add_argument(
        "--learner",
        default="gp",
        metavar="NAME",
        help="gp (default), random-features, neural (a network with "
        "a Bayesian last layer), ensemble (of networks), sparse (a law of few terms), tcn and "
        "lstm (a convolution, a long short-term memory over earlier commands), or own.py:Name, Python that is run",
    )
    p.add_argument("--kernel", default="se", help="se, matern32, matern52, or linear+ one of these")
    p.add_argument(
        "--inputs",
        default=None,
        metavar="a,b",
        help="features (default: sets of them compete); u1[t-3] is a command of three samples ago",
    )
    p.add_argument(
        "--place",
        action="store_true",
        help="let the place in the room compete as a feature too (walls, vents): "
        "what it teaches holds in this room only",
    )
    p.add_argument(
        "--refit",
        action="store_true",
        help="refit the physics beside what is learned; kept where left-out flights want it",
    )


def _linear_options(p: argparse.ArgumentParser) -> None:
    """What only a linear model asks for."""
    p.add_argument(
        "--vehicle", metavar="V.toml", help="of a linear model: vehicle file, for its column names"
    )
    p.add_argument(
        "--channels",
        metavar="'roll=u4-u2,...'",
        help="of a linear model: sums of columns that its channels are "
        "(default: as in fit.json beside it)",
    )
    p.add_argument(
        "--guard",
        action="store_true",
        help="of a linear model: raise the sparse GP's "
        "variance to that of the full one (docs/residual.md)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Read, check, learn, validate before and after, report. Returns the exit code."""
    from greybox.commands.learn_output import is_linear, run_output
    from greybox.errors import GreyboxError
    from greybox.model.layer import physics_of
    from greybox.residual.learners import GP, learner_for

    demand_adapt(arguments)
    _points(arguments.points)  # what is wrong is said before logs are read
    need_mcap(arguments.mcap)
    linear = is_linear(arguments.model)
    _demand_options(arguments, linear=linear)
    if not admitted(arguments, arguments.model):
        return 1
    if linear:
        return run_output(arguments)
    model, console = loaded(arguments), Console.of(arguments)
    learner = learner_for(arguments.learner, _points(arguments.points), arguments.kernel)
    physics = physics_of(model.dynamics)
    horizons = given_horizons(arguments, own=physics is None)
    accepted_faults: list[str] = []
    if physics is not None:
        faults = log_faults(arguments, physics.vehicle)
        if not faults.ok:
            return refuse_faults(faults, console, "learning")
        accepted_faults = faults.accepted_lines()
    elif arguments.accept:
        raise GreyboxError(
            "--accept is for vehicles",
            got=f"the model {model.name} of your own",
            fix="leave it out",
        )
    return _learned(arguments, console, model, learner or GP, horizons, accepted_faults)


def _learned(
    arguments: argparse.Namespace,
    console: Console,
    model: IdentifiedModel,
    learner: Learner | str,
    horizons: HorizonChoices,
    warnings: Sequence[str],
) -> int:
    """Read the flights, learn from them, judge and report, with `warnings` first; what was found
    until an interrupt is kept. Returns the exit code."""
    from greybox.commands.learn_output import feature_names
    from greybox.data.halves import demand_disjoint
    from greybox.residual.learn import learn_checked

    train, test = (
        read_flights_of(arguments, model.dynamics, paths, rate=1.0 / model.sample_time)
        for paths in (arguments.train, arguments.test)
    )
    demand_disjoint(train.files, test.files)
    with going_on(arguments, console):
        learned = learn_checked(
            model,
            train,
            features=feature_names(arguments.inputs),
            place=arguments.place,
            kernel=arguments.kernel,
            points=_points(arguments.points),
            learner=learner,
            seed=arguments.seed,
            refit=arguments.refit,
            progress=console.share,
        )
        content = _content(learned, model, train)
        content["warnings"][:0] = warnings
        return _judge_and_report(
            arguments,
            console,
            learned,
            content,
            model=model,
            train=train,
            test=test,
            horizons=horizons,
        )


def _judge_and_report(
    arguments: argparse.Namespace,
    console: Console,
    learned: Learned,
    content: LearnDocument,
    *,
    model: IdentifiedModel,
    train: Dataset,
    test: Dataset,
    horizons: HorizonChoices,
) -> int:
    """Write what was learned, validate it against `model`, write that. Returns the exit code."""
    from greybox.commands.learn_output import RESULTS
    from greybox.files import withdraw, write_atomic, write_json
    from greybox.report.learn_report import learn_report
    from greybox.residual.before_after import judge_both
    from greybox.residual.files import save_model

    out = Path(arguments.out)
    # What was learned is safe before anything else can go wrong.
    withdraw(out, *RESULTS)
    save_model(learned.model, out / "hybrid.json")
    write_json(out / "learn.json", content)
    arguments.kept = (
        f"what was learned is in {out}, not judged: greybox validate "
        f"{shlex.quote(str(out / 'hybrid.json'))} --log LOGS judges it"
    )
    verdict = judge_both(
        content,
        (model, learned.model),
        test if test.flights else train,
        base=shlex.quote(arguments.model),
        horizons=horizons,
        adapt=arguments.adapt,
        say=lambda text: console.share(text, JUDGING),
    )
    hybrid = replace(learned.model, verdict=verdict)
    save_model(hybrid, out / "hybrid.json")
    if not test.flights:
        content["warnings"].append(
            "validated on the flights that were learned from: give --test flights"
        )
    write_json(out / "learn.json", content)
    report = write_atomic(
        out / "report.html", learn_report(content, title=f"What {model.name} misses")
    )
    after = content["validation"].get("after")
    on, said = (None, []) if after is None else (after["adapted_on"], after["warnings"])
    write_if_asked(
        arguments.mcap, hybrid, train, test, adapted=None if on is None else on["flights"]
    )
    console.result(
        content,
        *_first_lines(content, verdict),
        *(f"warning: {w}" for w in dict.fromkeys([*content["warnings"], *said])),
        learned.summary(),
        f"wrote hybrid.json, learn.json and {report.name} in {out}",
    )
    return exit_code(verdict)


def _first_lines(content: LearnDocument, verdict: Verdict | None) -> list[str]:
    """Whether what was learned is better than the physics alone, and what the model is worth; what
    speaks against its use first."""
    from greybox.model.verdict import NOT_JUDGED

    if verdict is None:
        return [NOT_JUDGED]
    beside = content.get("against_physics")
    better = [] if beside is None else [beside["line"]]
    return [*verdict.lines(), *better] if verdict.refused else [*better, *verdict.lines()]


def _content(learned: Learned, model: IdentifiedModel, train: Dataset) -> LearnDocument:
    """learn.json before anything is judged."""
    content = learned.to_dict()
    unseen = sorted(set(model.trained_on) - set(train.names))
    if unseen:
        content["warnings"].append(
            f"the model was also fitted to {', '.join(unseen)}, which were not given"
        )
    return {**content, "command": typed("learn")}


def _points(text: str) -> int | str:
    """Number of support points, or "auto"."""
    from greybox.errors import GreyboxError

    if text == "auto":
        return text
    points = int(text) if text.strip().isdecimal() else 0
    if points < 1:
        raise GreyboxError(
            "--points takes a number above zero or auto", got=repr(text), fix="--points 50"
        )
    return points


def _demand_options(arguments: argparse.Namespace, *, linear: bool) -> None:
    """Options that belong to one kind of model, or exclude each other."""
    from greybox.errors import GreyboxError

    if arguments.place and arguments.inputs:
        raise GreyboxError(
            "--place competes with other sets, --inputs is the only one", fix="one of the two"
        )
    if linear:
        for given, option in (
            (arguments.mcap, "--mcap"),
            (arguments.place, "--place"),
            (arguments.refit, "--refit"),
            (arguments.keep_impossible, "--keep-impossible"),
            (arguments.accept, "--accept"),
        ):
            if given:
                raise GreyboxError(
                    f"{option} is for models of a vehicle",
                    got=f"the linear model {arguments.model}",
                )
        if arguments.guard and arguments.learner != "gp":
            raise GreyboxError(
                "--guard is for the Gaussian process", got=f"--learner {arguments.learner}"
            )
    elif arguments.guard:
        raise GreyboxError(
            "--guard is for linear models: what is learned of physics has its variance from the "
            "errors ahead"
        )
