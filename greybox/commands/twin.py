"""greybox twin MODEL.json --out DIR: an identified model as files of the simulators that people
use, with what each of them folds or loses."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from greybox.commands.command_line import Subcommands, effects_file_option
from greybox.commands.console import Console, json_option
from greybox.commands.judgement import even_so_option

if TYPE_CHECKING:
    from greybox.data import Dataset
    from greybox.model.identified import IdentifiedModel

NAMES = (
    "numpy",
    "jax",
    "rotorpy",
    "mujoco",
    "crazyflow",
    "drone-models",
    "pybullet",
    "gazebo",
    "px4",
    "ardupilot",
    "isaac",
    "jsbsim",
    "flightgoggles",
)


def add(commands: Subcommands) -> None:
    """Add the subcommand."""
    p = commands.add_parser(
        "twin",
        help="write a fitted model as files of simulators",
        description="Write a fitted model as files of simulators, and say of every effect whether "
        "the simulator says it, folds it into something else, or loses it, with the size of what "
        "is lost over the training flights. Existing files are kept unless --force is given. Exit "
        "code 0: done, 1: refused, as the model is not usable, 2: bad input.",
    )
    p.add_argument(
        "model",
        metavar="MODEL",
        nargs="?",
        help="model file of fit, discover or learn; or a vehicle file (V.toml), for what its data "
        "sheet says",
    )
    p.add_argument("--out", metavar="DIR", help="folder to write to")
    p.add_argument(
        "--compare",
        nargs=2,
        metavar=("OLD", "NEW"),
        help="instead: what has changed between two models of a craft, in newtons and percent, "
        "and what it does to a flight",
    )
    p.add_argument(
        "--target",
        default="",
        metavar="T,...",
        help=f"some of {', '.join(NAMES)} (default: all that can express the craft)",
    )
    _draw_options(p)
    p.add_argument(
        "--force",
        action="store_true",
        help="write over existing files, and remove those of the twin that was there",
    )
    effects_file_option(p)
    even_so_option(p)
    json_option(p, "the statement")
    p.set_defaults(run=run)


def _draw_options(p: argparse.ArgumentParser) -> None:
    """Craft as uncertain as the fit left them, and flights to judge them by."""
    p.add_argument(
        "--draws",
        type=int,
        metavar="N",
        help="also N craft as uncertain as the fit left them, as arrays and as a TOML of ranges",
    )
    p.add_argument("--seed", type=int, default=0, help="of the draws (default %(default)s)")
    p.add_argument(
        "--train",
        nargs="+",
        default=[],
        metavar="LOG",
        help="the flights of the fit: how strongly what is unexplained pushes a craft about, and "
        "how far flights differ in it, is counted on them (needs --draws); without it the draws "
        "have the filter's levels, which are those of one step ahead",
    )
    p.add_argument(
        "--check",
        nargs="+",
        default=[],
        metavar="LOG",
        help="flights that no fit saw: how many of them the drawn craft hold in their 95 %% band, "
        "beside a box of +-30 %% (needs --draws)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Read, judge, write, say what is left out. Returns 0, or 1 where the model is not usable."""
    from greybox.errors import DataError, UnknownNameError
    from greybox.simulators.make import twin

    if arguments.compare:
        return _compare(arguments)
    if arguments.model is None or arguments.out is None:
        raise DataError(
            "MODEL and --out are needed", expected="MODEL --out DIR, or --compare OLD NEW"
        )
    names = tuple(n.strip() for n in arguments.target.split(",") if n.strip())
    if arguments.target and not names:
        raise DataError(f"--target {arguments.target!r} names none", expected=", ".join(NAMES))
    for name in names:
        if name not in NAMES:
            raise UnknownNameError("target", name, NAMES)
    model = _model(arguments.model, arguments.effects_file, even_so=arguments.even_so)
    if model is None:
        return 1
    for option, logs in (("--check", arguments.check), ("--train", arguments.train)):
        if logs and not arguments.draws:
            raise DataError(f"{option} without draws", fix="add --draws 200")
    train = _flights(model, arguments.train, ()) if arguments.train else None
    known = () if train is None else train.names
    flights = None
    if arguments.check:
        flights = _flights(model, arguments.check, (*model.trained_on, *known))
    made = twin(
        model,
        names,
        out=arguments.out,
        force=arguments.force,
        even_so=True,  # the gate was asked
        draws=arguments.draws,
        seed=arguments.seed,
        train=train,
        check=flights,
    )
    written = f"\nwritten: {len(made.files) + 1} files in {arguments.out}"
    Console.of(arguments).result(made.to_dict(), made.summary(), written)
    return 0


def _model(path: str, effects_files: list[str], *, even_so: bool) -> IdentifiedModel | None:
    """A model of a vehicle, or None where it was judged not usable, or a vehicle file is of no
    craft that flies (which is said)."""
    from greybox.commands.judgement import gate
    from greybox.files import read_json
    from greybox.model.effects_file import load_effects
    from greybox.model.plausibility import vehicle_findings
    from greybox.model.vehicle import read_vehicle
    from greybox.residual.files import load_model
    from greybox.simulators.data_sheet import model_of

    if path.endswith(".toml"):
        vehicle = read_vehicle(path)
        wrong = [f for f in vehicle_findings(vehicle) if f.severity == "blocking"]
        if wrong and not even_so:
            line = f"{path}: {wrong[0].line()}. To go on all the same: --even-so"
            print(f"greybox twin: {line}", file=sys.stderr)
            return None
        print(f"greybox twin: {path}: a data sheet; no flight was fitted", file=sys.stderr)
        return model_of(vehicle)
    own = [e for file in effects_files for e in load_effects(file)]
    model = load_model(path, effects=own)
    judged = gate(read_json(path), path, even_so=even_so)
    judged.say("twin")
    return model if judged.open else None


def _flights(model: IdentifiedModel, logs: list[str], known: tuple[str, ...]) -> Dataset:
    """Logs of the model's vehicle at its rate, of flights that are not `known`."""
    from greybox.data.logs import read_logs
    from greybox.errors import DataError

    flights = read_logs(logs, model.physics.vehicle, rate=1.0 / model.sample_time)
    if seen := sorted(set(flights.names) & set(known)):
        raise DataError(
            f"{', '.join(seen)} took part in the fit",
            expected="--check flights that no fit saw",
            fix="give other flights",
        )
    return flights


def _compare(arguments: argparse.Namespace) -> int:
    """Say what has changed between two models. Returns 0, or 1 where one is not usable."""
    from greybox.simulators.compare import compare

    if arguments.model is not None or arguments.out is not None:
        from greybox.errors import DataError

        raise DataError("--compare takes two models and nothing else", fix="leave out MODEL, --out")
    old, new = (
        _model(path, arguments.effects_file, even_so=arguments.even_so)
        for path in arguments.compare
    )
    if old is None or new is None:
        return 1
    found = compare(old, new)
    Console.of(arguments).result(found.to_dict(), found.summary())
    return 0
