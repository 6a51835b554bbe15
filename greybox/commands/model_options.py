"""How a model is built and fitted, as options of a command: what is left open is decided, or has
its default.

`fit_options` fills what is open with the defaults of an explicit fit; `given` hands on only what
was said.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Literal, cast

from greybox.commands.command_line import Options, effects_file_option

if TYPE_CHECKING:
    from greybox.automatic.fit import Prepared
    from greybox.automatic.setting import Given
    from greybox.commands.console import Console
    from greybox.data import Dataset
    from greybox.estimation.options import FitChoices, FitOptions
    from greybox.estimation.recipe import Recipe
    from greybox.estimation.result import Fit
    from greybox.estimation.solver import Progress, Solver
    from greybox.model.effect import Effect
    from greybox.model.identified import IdentifiedModel
    from greybox.model.vehicle import Vehicle


HELD: dict[str, bool | Literal["process"]] = {"none": True, "sensor": "process", "all": False}
"""Words of --hold-noise and the `estimate_noise` that they stand for."""


def names(text: str) -> tuple[str, ...]:
    """A comma-separated list of names; "none" is an empty one."""
    if text.strip() == "none":
        return ()
    return tuple(part.strip() for part in text.split(",") if part.strip())


def noise_levels(text: str) -> dict[str, float]:
    """name=value,name=value: noise levels in SI units, "noise." may be left out (sensor.p=0.05)."""
    return {n if n.startswith("noise.") else f"noise.{n}": v for n, v in values(text).items()}


def numbers(text: str) -> tuple[float, ...]:
    """Numbers separated by commas."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"expected numbers separated by commas, got '{text}'"
        ) from None


def values(text: str) -> dict[str, float]:
    """name=value,name=value: parameter values in SI units."""
    out = {}
    for part in names(text):
        name, _, value = part.partition("=")
        try:
            out[name] = float(value)
        except ValueError:
            raise argparse.ArgumentTypeError(f"expected NAME=NUMBER, got '{part}'") from None
    return out


def model_options(p: Options) -> None:
    """Declare what says how the model is built and fitted. All are open (None) unless they are
    said."""
    p.add_argument(
        "--effects",
        type=names,
        default=None,
        metavar="a,b",
        help="effects besides those in the vehicle file",
    )
    effects_file_option(
        p, "add the effects of these Python files, which are run (only what you trust)"
    )
    _unknown_options(p)
    _method_options(p)
    _noise_options(p)
    p.add_argument(
        "--input",
        choices=("command", "speed"),
        default=None,
        help="what drives the rotors (default: commands, or rotor speeds where the logs have no "
        "commands)",
    )
    p.add_argument(
        "--max-iterations",
        type=int,
        default=None,
        metavar="N",
        help="iteration limit of the solver",
    )


def _unknown_options(p: Options) -> None:
    """Which numbers are unknown."""
    p.add_argument(
        "--disturbance", type=names, default=None, metavar="force,torque", help="disturbance states"
    )
    p.add_argument(
        "--noise-parts",
        type=names,
        default=None,
        metavar="low_pass.gyro,...",
        help="sensors with a filter or coloured noise: low_pass, coloured, drift, line, delay",
    )
    p.add_argument(
        "--per-flight",
        type=names,
        default=None,
        metavar="a,b",
        help="parameters with one value per flight",
    )
    p.add_argument(
        "--shared",
        type=names,
        default=None,
        metavar="a,b",
        help="parameters with one value for all flights",
    )
    p.add_argument(
        "--fixed", type=names, default=None, metavar="a,b", help="parameters held at their value"
    )
    p.add_argument(
        "--considered",
        type=names,
        default=None,
        metavar="a,b",
        help="of those held, the ones whose stated error widens the errors of the others",
    )
    p.add_argument(
        "--free", type=names, default=None, metavar="a,b", help="fit exactly these parameters"
    )


def _method_options(p: Options) -> None:
    """By which method they are found."""
    p.add_argument(
        "--predictor",
        default=None,
        help="innovation, kalman, k-step, multi-step, multiple-shooting, simulation",
    )
    p.add_argument("--criterion", default=None, help="gaussian, robust, least-squares")
    p.add_argument(
        "--solver", default=None, help="levenberg-marquardt, gauss-newton, scipy-trf, ipopt"
    )
    p.add_argument(
        "--init", default=None, help="equation-error, noise, nominal, multistart, innovation"
    )


def _noise_options(p: Options) -> None:
    """Where they start, and which noise levels are held."""
    p.add_argument(
        "--noise",
        type=noise_levels,
        default=None,
        metavar="sensor.p=0.02,...",
        help="noise levels to start from, of a component (sensor.p) or a group (process.torque)",
    )
    p.add_argument(
        "--value",
        type=values,
        default=None,
        metavar="a=1,b=2",
        help="start values (of fixed parameters: values)",
    )
    p.add_argument(
        "--hold-noise",
        nargs="?",
        const="all",
        default=None,
        metavar="none|sensor|all|NAME,...",
        help="hold all noise levels at their start, the sensors' (sensor), or some by name",
    )
    p.add_argument(
        "--kinematic-noise",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="noise between attitude and gyro (clocks that drift)",
    )


def fit_with(
    arguments: argparse.Namespace,
    vehicle: Vehicle,
    train: Dataset,
    progress: Progress | None = None,
    source: IdentifiedModel | None = None,
) -> Fit:
    """The explicit fit: what is open has its default. `source`: a model of a craft like this one,
    whose effects `vehicle` has already."""
    from greybox.automatic.like import lasting
    from greybox.estimation.fit import fit
    from greybox.estimation.record import sample_time
    from greybox.model.model import build_model

    model = build_model(
        vehicle,
        train.channels,
        (*(arguments.effects or ()), *_own_effects(arguments)),
        input=arguments.input,
        sample_time=sample_time(train),
        noncausal=train.noncausal,
        kinematic_noise=bool(arguments.kinematic_noise),
    )
    options = fit_options(arguments)
    if source is not None:
        options = options.but(priors=lasting(source, options.disturbance))
    return fit(model, train, options, progress=progress)


def fit_open(vehicle: Vehicle, prepared: Prepared, said: Given, console: Console) -> Fit:
    """The fit to prepared flights for which all is decided that was not `said`; `console` gets
    every decision. Raises what `fit_decided` raises."""
    from greybox.automatic.borrow import decide_for
    from greybox.automatic.fit import fit_decided

    console.say("deciding what is open, on pieces of the flights that are left out:")
    for done in prepared.decisions():
        console.say(f"  {done.about}: {done.choice} ({done.reason})")
    own, decided = decide_for(vehicle, prepared, said, say=console.say)
    console.say("fitting all flights:")
    return fit_decided(own, prepared, decided, say=console.say, progress=console.solver)


def explicit_recipe(arguments: argparse.Namespace, fitted: Fit) -> Recipe:
    """The explicit fit as a recipe; the logs have their rate already."""
    from greybox.estimation.recipe import Recipe
    from greybox.model.layer import physics_of

    physics = physics_of(fitted.model.dynamics)
    return Recipe(
        effects=(*(arguments.effects or ()), *_own_effects(arguments)),
        input=physics.input if physics else "command",
        kinematic_noise=bool(arguments.kinematic_noise),
        options=fit_options(arguments),
    )


def fit_options(arguments: argparse.Namespace) -> FitOptions:
    """The choices of an explicit fit: those that were said, defaults for the rest."""
    from greybox.estimation.options import FitOptions

    return FitOptions.of(None, _choices(arguments)).but(seed=arguments.seed)


def given(arguments: argparse.Namespace) -> Given:
    """What was said, for `greybox.automatic`: the rest is open."""
    from greybox.automatic.setting import Given

    own = _own_effects(arguments)
    effects = None if arguments.effects is None and not own else (*(arguments.effects or ()), *own)
    return Given(
        effects=effects,
        input=arguments.input,
        kinematic_noise=arguments.kinematic_noise,
        adapt=arguments.adapt,
        choices={**_choices(arguments), "seed": arguments.seed},
    )


def is_given(arguments: argparse.Namespace) -> bool:
    """Whether any of the options that `model_options` declares was said."""
    more = (arguments.effects, arguments.input, arguments.kinematic_noise)
    said = any(value is not None for value in more) or bool(arguments.effects_file)
    return said or bool(_choices(arguments))


def _choices(arguments: argparse.Namespace) -> FitChoices:
    """The fields of `FitOptions` that were said."""
    held = () if arguments.hold_noise is None else names(arguments.hold_noise)
    groups = [word for word in held if word in HELD]
    levels = [n if n.startswith("noise.") else f"noise.{n}" for n in held if n not in HELD]
    solver = arguments.solver
    if solver is not None or arguments.max_iterations is not None:
        solver = _solver(solver or "levenberg-marquardt", arguments.max_iterations)
    said = {
        "predictor": arguments.predictor,
        "criterion": arguments.criterion,
        "solver": solver,
        "initialisation": arguments.init,
        "disturbance": arguments.disturbance,
        "noise_parts": arguments.noise_parts,
        "free": arguments.free,
        "fixed": arguments.fixed,
        "considered": arguments.considered,
        "per_flight": arguments.per_flight,
        "shared": arguments.shared,
        "values": arguments.value,
        "noise": arguments.noise,
        "estimate_noise": HELD[groups[-1]] if groups else None,
        "held_noise": levels or None,
    }
    return cast("FitChoices", {name: v for name, v in said.items() if v is not None})


def fitted_model(arguments: argparse.Namespace, path: str | None) -> IdentifiedModel | None:
    """The physics of a model file, with effects of --effects-file where it has some; None without a
    path. Raises as `IdentifiedModel.load`: `FileFormatError` for a model with a learned part, whose
    numbers are not those of the physics alone."""
    from greybox.model.identified import IdentifiedModel

    return None if path is None else IdentifiedModel.load(path, effects=_own_effects(arguments))


def _own_effects(arguments: argparse.Namespace) -> list[Effect]:
    from greybox.model.effects_file import load_effects

    return [e for path in arguments.effects_file for e in load_effects(path)]


def _solver(name: str, limit: int | None) -> str | Solver:
    """The solver, with another iteration limit where one is given."""
    from greybox.errors import UnknownNameError
    from greybox.estimation.solvers import SOLVERS

    if name not in SOLVERS:
        raise UnknownNameError("solver", name, SOLVERS)
    return name if limit is None else SOLVERS[name](max_iterations=limit)
