"""greybox export MODEL.json --out DIR: a fitted model as C, CasADi and numbers that a controller
can use without greybox."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from greybox.commands.command_line import Subcommands, effects_file_option
from greybox.commands.console import Console, json_option
from greybox.commands.judgement import even_so_option
from greybox.commands.own_model import model_file_option

if TYPE_CHECKING:
    from mpc_export.predictors import Fitted

TARGETS = (
    "c",
    "casadi",
    "acados",
    "do-mpc",
    "rockit",
    "l4acados",
    "fmu",
    "crazyflie-app",
    "px4-module",
    "ros2",
    "tube",
    "tube-linear",
)
GROUPS = ("covariance", "filter", "target", "hessian", "nominal", "adapt", "calibrate", "pilot")


def add(commands: Subcommands) -> None:
    """Add the subcommand."""
    p = commands.add_parser(
        "export",
        help="write a fitted model as C and CasADi for a controller",
        description="Write anything fitted (physics, hybrid, linear, output hybrid, NARX, LSTM, "
        "Gaussian process) as a folder that a controller can use without greybox: C with a "
        "self-test, CasADi functions rebuilt from numbers, golden vectors, a manifest. An existing "
        "folder is replaced only when it is such a bundle, as it was written. Exit code 0: done, "
        "1: refused, as the model is not usable, 2: bad input.",
    )
    p.add_argument(
        "model",
        metavar="MODEL.json",
        help="model file of `greybox fit`, `learn`, `discover` or "
        "`linear`, or what save() of a NARX, LSTM or Gaussian process wrote",
    )
    p.add_argument("--out", required=True, metavar="DIR", help="the bundle's folder")
    _bundle_options(p)
    effects_file_option(p)
    model_file_option(p)
    even_so_option(p)
    p.add_argument(
        "--no-cache", action="store_true", help="build anew even if the same export is in the cache"
    )
    p.add_argument(
        "--force",
        action="store_true",
        help="replace a bundle although files in it were changed or added",
    )
    json_option(p, "the manifest")
    p.set_defaults(run=run)


def _bundle_options(p: argparse.ArgumentParser) -> None:
    """What the bundle is and holds."""
    p.add_argument(
        "--target",
        default="c,casadi",
        metavar="T,...",
        help=f"some of {', '.join(TARGETS)} (default %(default)s, which come too where --with asks "
        "for functions and neither is named)",
    )
    p.add_argument("--float", action="store_true", help="C in single precision")
    p.add_argument(
        "--name", metavar="NAME", help="prefix of everything in C (default: the folder's name)"
    )
    p.add_argument(
        "--dt",
        type=float,
        metavar="S",
        help="sample time (default: the one that the model was identified at)",
    )
    p.add_argument(
        "--with", dest="groups", default="", metavar="G,...", help=f"also {', '.join(GROUPS)}"
    )
    p.add_argument(
        "--runtime",
        default="",
        metavar="P,...",
        help="parameters that stay arguments: mass, ..., gp.weights",
    )
    p.add_argument(
        "--points", type=int, metavar="M", help="fewer support points for the learned part"
    )
    p.add_argument(
        "--horizon",
        type=int,
        metavar="N",
        help="stages of the plan of the target tube (default 10; of tube-linear 5)",
    )
    p.add_argument(
        "--attempts",
        type=int,
        choices=(1, 2),
        default=1,
        help="attempts at a plan in one step of the target tube (default %(default)s)",
    )


def _split(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())


def run(arguments: argparse.Namespace) -> int:
    """Read, export, say what was written. Returns 0, or 1 where the model is not usable."""
    from greybox.commands.judgement import gate
    from greybox.errors import DataError, UnknownNameError
    from greybox.files import read_json

    for what, given, known in (
        ("export target", arguments.target, TARGETS),
        ("group", arguments.groups, GROUPS),
    ):
        for name in _split(given):
            if name not in known:
                raise UnknownNameError(what, name, known)
    if not _split(arguments.target):
        raise DataError(
            "--target", expected=f"some of {', '.join(TARGETS)}", got=repr(arguments.target)
        )
    if arguments.dt is not None and not 0 < arguments.dt < float("inf"):
        raise DataError("--dt", expected="a positive number of seconds", got=f"{arguments.dt:g}")
    if arguments.points is not None and arguments.points < 1:
        raise DataError("--points", expected="1 support point or more", got=str(arguments.points))
    if arguments.horizon is not None and not 2 <= arguments.horizon <= 100:
        raise DataError("--horizon", expected="2 to 100 stages", got=str(arguments.horizon))
    model = _model(arguments)
    judged = gate(read_json(arguments.model), arguments.model, even_so=arguments.even_so)
    if not judged.open:
        judged.say("export")
        return 1
    from mpc_export.bundle import describe, write_bundle

    bundle = write_bundle(
        model,
        arguments.out,
        name=arguments.name,
        dt=arguments.dt,
        targets=_split(arguments.target),
        real="float" if arguments.float else "double",
        with_=_split(arguments.groups),
        runtime_parameters=_split(arguments.runtime),
        points=arguments.points,
        horizon=arguments.horizon,
        attempts=arguments.attempts,
        use_cache=not arguments.no_cache,
        force=arguments.force,
        even_so=True,  # the gate was asked
    )
    judged.say("export")
    Console.of(arguments).result(bundle.manifest, describe(bundle))
    return 0


def _model(arguments: argparse.Namespace) -> Fitted:
    """A fitted model of any kind. Raises `FileFormatError`, `ModelError`."""
    from greybox.commands.own_model import loaded
    from greybox.model.effects_file import load_effects
    from mpc_export.predictors import read_model

    if arguments.model_file:
        return loaded(arguments)
    own = [e for path in arguments.effects_file for e in load_effects(path)]
    return read_model(arguments.model, effects=own)
