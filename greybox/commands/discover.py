"""`greybox discover`: from a vehicle file, or a model of the user's own, and flights to
discovery.json, model.json, laws of what is left, report.html."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from greybox.data import Dataset
    from greybox.discovery.options import DiscoverChoices
    from greybox.discovery.result import Discovery
    from greybox.model.dynamics import StateSpaceModel
    from greybox.model.effect import Effect
    from greybox.model.identified import IdentifiedModel
    from greybox.model.vehicle import Vehicle

from greybox.commands.collector import what_is_there_stays
from greybox.commands.command_line import Subcommands, effects_file_option
from greybox.commands.console import Console, json_option
from greybox.commands.discover_folder import SearchFolder
from greybox.commands.flight_logs import flight_log_options
from greybox.commands.going_on import demand_source_stays, going_on
from greybox.commands.judgement import (
    accept_option,
    adapt_option,
    admitted,
    begun_with,
    demand_adapt,
    log_faults,
    source_option,
)
from greybox.commands.mcap_option import mcap_option, need_mcap, write_if_asked
from greybox.commands.model_options import names
from greybox.commands.own_model import model_file_option, read_flights_of


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "discover",
        help="find, name and add the effects that a vehicle file, or a model of your own, misses",
        description="Find where simulation and flights disagree, name what is missing with an "
        "e-value from flights that did not propose it, add it and show how far the gap closed. "
        "Writes discovery.json, model.json (the improved model), report.html and, where what is "
        "left follows a law, proposal_<n>.py and model_with_laws.json. Exit code 0: done, 1: not "
        "searched, as a fault of a log or of the vehicle file blocks, or the model of --from is "
        "not finished, 2: bad input, 130: interrupted (the files hold what was found until then, "
        "and the same command goes on).",
    )
    p.add_argument("--vehicle", metavar="V.toml", help="vehicle file (not needed with --from)")
    model_file_option(p, read=False)
    _earlier_options(p)
    p.add_argument("--train", nargs="+", default=[], metavar="LOG", help="flights to search in")
    p.add_argument(
        "--test",
        nargs="+",
        default=[],
        metavar="LOG",
        help="flights that propose nothing and judge (without: halves of the training flights)",
    )
    flight_log_options(p)
    _search_options(p)
    p.add_argument(
        "--rate",
        type=float,
        default=None,
        metavar="HZ",
        help="resample the logs to this rate (default: what the response of the craft needs)",
    )
    p.add_argument("--seed", type=int, default=0, help="seed of bootstraps and random halves")
    accept_option(p)
    p.add_argument(
        "--out",
        default=None,
        metavar="DIR",
        help="folder for the results (default greybox-discover, or that of --continue)",
    )
    mcap_option(p)
    json_option(p, "discovery.json")
    p.set_defaults(run=run, default_out=lambda arguments: arguments.folder or "greybox-discover")


def _earlier_options(p: argparse.ArgumentParser) -> None:
    """What an earlier search or fit has found."""
    p.add_argument(
        "--from",
        dest="since",
        metavar="MODEL.json",
        help="what has changed since this model: its numbers and their errors are the prior",
    )
    source_option(p)
    p.add_argument(
        "--continue",
        dest="folder",
        metavar="FOLDER",
        help="the flights are further ones: their evidence multiplies that of the names in FOLDER",
    )


def _search_options(p: argparse.ArgumentParser) -> None:
    """What is sought, in which model."""
    p.add_argument(
        "--alpha",
        type=float,
        default=0.05,
        help="probability of a false name on flights that miss nothing",
    )
    p.add_argument(
        "--max-effects",
        type=int,
        default=12,
        metavar="N",
        help="add no more than N effects (default 12)",
    )
    adapt_option(p)
    effects_file_option(
        p, "also offer the effects of these Python files, which are run (only what you trust)"
    )
    _model_options(p)
    p.add_argument(
        "--trace", action="store_true", help="also add what is certain and worth nothing"
    )
    p.add_argument(
        "--executor",
        metavar="dask://HOST:PORT",
        help="fit on the workers of this dask scheduler (extra cluster)",
    )
    p.add_argument(
        "--attainable",
        action="store_true",
        help="also learn, without a name, what could be closed",
    )


def _model_options(p: argparse.ArgumentParser) -> None:
    """Of the model that every fit of the search has."""
    p.add_argument(
        "--kinematic-noise",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="noise between attitude and gyro (default: where their clocks drift apart)",
    )
    p.add_argument(
        "--per-flight",
        type=names,
        default=(),
        metavar="a,b",
        help="parameters with one value per flight",
    )
    p.add_argument(
        "--fixed",
        type=names,
        default=(),
        metavar="a,b",
        help="parameters held at the vehicle file's value",
    )
    p.add_argument(
        "--hold-noise",
        choices=("none", "sensor"),
        default="none",
        help="sensor: hold the sensors' noise levels at those of the vehicle file",
    )


def _check(arguments: argparse.Namespace, out: Path) -> None:
    """Raise `GreyboxError` for options that do not fit together, before anything is read."""
    from greybox.cluster import host_of
    from greybox.errors import GreyboxError
    from greybox.residual.laws.effect_file import LAW_FILE

    if not 0 < arguments.alpha < 1:
        raise GreyboxError(
            "--alpha takes a probability", got=f"{arguments.alpha:g}", fix="--alpha 0.05"
        )
    if arguments.max_effects < 0:
        raise GreyboxError(
            "--max-effects takes 0 or more", got=str(arguments.max_effects), fix="--max-effects 12"
        )
    if arguments.executor is not None:
        host_of(arguments.executor)
    demand_adapt(arguments)
    demand_source_stays(arguments.since, out)
    need_mcap(arguments.mcap)
    if arguments.folder is not None:
        if arguments.mcap:
            raise GreyboxError(
                "--continue writes no recording",
                fix="greybox validate model.json --log LOGS --mcap F.mcap",
            )
        return
    if not arguments.train:
        raise GreyboxError("discover needs flights to search in", fix="--train LOGS")
    for path in map(Path, arguments.effects_file):
        if path.resolve().parent == out.resolve() and LAW_FILE.fullmatch(path.name):
            raise GreyboxError(
                f"{path}: a search that writes to {out} may write over it",
                fix="another --out, or rename the file",
            )
    given = [arguments.vehicle, arguments.model_file, arguments.since]
    if sum(g is not None for g in given) != 1:
        raise GreyboxError(
            "discover takes one of --vehicle, --model-file and --from",
            fix="--vehicle V.toml, --model-file own.py:build, or --from model.json",
        )


def _subject(
    arguments: argparse.Namespace, since: IdentifiedModel | None
) -> Vehicle | StateSpaceModel:
    """What is searched: a vehicle, or a model of the user's own. Raises `GreyboxError` for options
    that the latter does not have."""
    from greybox.errors import GreyboxError
    from greybox.model.dynamics import StateSpaceModel
    from greybox.model.layer import physics_of
    from greybox.model.own_model import load_own_model
    from greybox.model.vehicle import read_vehicle

    if arguments.vehicle is not None:
        return read_vehicle(arguments.vehicle)
    if since is not None:
        physics = physics_of(since.dynamics)
        if physics is not None:
            return physics.vehicle
        assert isinstance(since.core, StateSpaceModel)
        model = since.core
    else:
        model = load_own_model(arguments.model_file)
    for option in ("effects_file", "kinematic_noise", "accept", "keep_impossible", "executor"):
        if getattr(arguments, option):
            raise GreyboxError(
                f"--{option.replace('_', '-')} is for vehicles",
                got=f"the model {model.name} of your own",
                fix="leave it out; an effect of your own model is a parameter with a null",
            )
    return model


def run(arguments: argparse.Namespace) -> int:
    """Read, check, search, report."""
    from greybox.commands.discover_further import go_on
    from greybox.commands.vehicle_lines import say_vehicle
    from greybox.data.checks import CheckReport
    from greybox.discovery.workflow import refused
    from greybox.errors import GreyboxError
    from greybox.estimation.record import sample_time
    from greybox.model.dynamics import StateSpaceModel
    from greybox.model.effects_file import load_effects
    from greybox.model.identified import IdentifiedModel

    out, console = Path(arguments.out or "greybox-discover"), Console.of(arguments)
    _check(arguments, out)
    if not admitted(arguments, arguments.since):
        return 1
    if arguments.folder is not None:
        return go_on(arguments)
    offered = {path: load_effects(path) for path in arguments.effects_file}
    own = [e for effects in offered.values() for e in effects]
    since = None
    if arguments.since is not None:
        since = begun_with(IdentifiedModel.load(arguments.since, effects=own), arguments)
    subject = _subject(arguments, since)
    faults = (
        CheckReport(vehicle=subject.name, flights=(), findings=(), not_judged=())
        if isinstance(subject, StateSpaceModel)
        else log_faults(arguments, subject)
    )
    search = SearchFolder(out, f"What the model of {subject.name} misses", offered, faults)
    if faults.ok:
        train = read_flights_of(
            arguments, subject, arguments.train, rate=arguments.rate or "needed"
        )
        rate = arguments.rate or 1 / sample_time(train)
        test = read_flights_of(arguments, subject, arguments.test, rate=rate)
        if not isinstance(subject, StateSpaceModel):
            say_vehicle(subject, console.say)
        asked = _choices(arguments, own, since)
        with going_on(arguments, console):
            try:
                found = _searched(subject, train, test, asked, search, console, arguments.executor)
            except KeyboardInterrupt:
                arguments.kept = search.kept()
                raise
            search.write(found)
    elif isinstance(subject, StateSpaceModel):
        raise GreyboxError("faults are looked for in the flights of a vehicle only")
    else:
        found = refused(
            faults, subject, settings={"alpha": arguments.alpha, "seed": arguments.seed}
        )
        search.write(found)
    search.page()
    if found.fit is not None:
        write_if_asked(arguments.mcap, found.model, train, test)
    console.result(search.content, *search.lines(found), *_to_foretell(arguments, found))
    return 0 if faults.ok else 1


def _to_foretell(arguments: argparse.Namespace, found: Discovery) -> list[str]:
    """The command that makes a model to foretell with of what was named, where the one that named
    does not foretell."""
    verdict = found.model_verdict
    if verdict is None or not verdict.refused or arguments.vehicle is None:
        return []
    named = [n.name for n in found.names if n.name in found.model.effects]
    command = ["greybox", "fit", "--vehicle", arguments.vehicle, "--train", *arguments.train]
    command += ["--test", *arguments.test] if arguments.test else []
    command += ["--effects", ",".join(named)] if named else []
    command += ["--accept", arguments.accept] if arguments.accept else []
    return [f"next: {shlex.join(command)}"]


def _choices(
    arguments: argparse.Namespace, own: Sequence[Effect], since: IdentifiedModel | None
) -> DiscoverChoices:
    return {
        "own": own,
        "since": since,
        "alpha": arguments.alpha,
        "max_effects": arguments.max_effects,
        "adapt": arguments.adapt,
        "kinematic_noise": arguments.kinematic_noise,
        "per_flight": arguments.per_flight,
        "fixed": arguments.fixed,
        "hold_sensor_noise": arguments.hold_noise == "sensor",
        "attainable": arguments.attainable,
        "trace": arguments.trace,
        "seed": arguments.seed,
    }


def _searched(
    subject: Vehicle | StateSpaceModel,
    train: Dataset,
    test: Dataset,
    asked: DiscoverChoices,
    search: SearchFolder,
    console: Console,
    address: str | None,
) -> Discovery:
    """The search itself: fits side by side where there are cores, or on a cluster; every state of
    it is written."""
    from greybox.cluster import Cluster
    from greybox.cores import cores
    from greybox.discovery.workflow import discover
    from greybox.model.dynamics import StateSpaceModel
    from greybox.workers import Workers

    side_by_side = not isinstance(subject, StateSpaceModel) and (cores() > 1 or address is not None)
    with (
        what_is_there_stays(),
        Workers() if address is None else Cluster(address) as workers,
    ):
        return discover(
            subject,
            train,
            test,
            faults=search.faults,
            progress=console.share,
            save=search.write,
            executor=workers if side_by_side else None,
            **asked,
        )
