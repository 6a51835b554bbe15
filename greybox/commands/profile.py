"""`greybox profile`: likelihood intervals of single parameters of a fit, with the curve behind
each."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, cast

from greybox.commands.command_line import Subcommands, effects_file_option, typed
from greybox.commands.console import Console, json_option
from greybox.commands.flight_logs import flight_log_options
from greybox.commands.going_on import going_on
from greybox.commands.judgement import admitted, begun_with, source_option
from greybox.commands.model_options import names
from greybox.commands.own_model import loaded, model_file_option, read_flights_of

if TYPE_CHECKING:
    from greybox.data import Dataset
    from greybox.estimation.document import ParameterRow
    from greybox.estimation.options import FitChoices
    from greybox.estimation.profile import Profile
    from greybox.estimation.result import Fit
    from greybox.model.identified import IdentifiedModel
    from greybox.report.profile_report import ProfileDocument, ProfileRow

KEPT = ("predictor", "criterion", "solver", "per_flight", "fixed", "estimate_noise")
"""Choices of the fit that are taken from its fit.json."""


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "profile",
        help="likelihood intervals of single parameters of a fit",
        description="Hold one parameter along a grid, fit all others again, and give the interval "
        "in which the likelihood ratio keeps it: right where a symmetric error bar is not (bounds, "
        "ratios, weak excitation). Writes profile.json and report.html. Exit code 0: done; 1: "
        "done, and an interval has no end on one side, or refused, as the model is not finished; "
        "2: bad input.",
    )
    p.add_argument(
        "model",
        metavar="MODEL.json",
        help="model file of `greybox fit`, with its fit.json beside it",
    )
    p.add_argument(
        "--train",
        required=True,
        nargs="+",
        metavar="LOG",
        help="the flights that the model was fitted to",
    )
    p.add_argument(
        "--of",
        required=True,
        type=names,
        metavar="a,b",
        help="parameters or noise levels (noise.sensor.p)",
    )
    p.add_argument(
        "--level",
        type=float,
        default=0.95,
        help="probability of the interval (default %(default)s)",
    )
    flight_log_options(p)
    effects_file_option(p)
    model_file_option(p)
    p.add_argument("--out", default="greybox-profile", metavar="DIR", help="folder for the results")
    source_option(p)
    json_option(p, "profile.json")
    p.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Fit again from the model's values, profile, report. Returns 1 where an interval has no
    end, or the model is not finished."""
    import math

    from greybox.commands.front_door import profile
    from greybox.errors import DataError
    from greybox.files import write_atomic, write_json
    from greybox.report.profile_report import profile_report

    if not 0 < arguments.level < 1:
        raise DataError(
            "--level", expected="a probability", got=f"{arguments.level:g}", fix="--level 0.95"
        )
    if not admitted(arguments, arguments.model):
        return 1
    console = Console.of(arguments)
    out, (model, train, beside) = Path(arguments.out), _read(arguments)
    with going_on(arguments, console, [beside]):
        found, profiles = _fitted(model, train, beside), []
        for k, name in enumerate(arguments.of):
            console.share(f"{name} ({k + 1} of {len(arguments.of)})", k / len(arguments.of))
            profiles.append(profile(found, name, level=arguments.level))
    content: ProfileDocument = {
        "schema": "greybox.profile/1",
        "command": typed("profile"),
        "model": found.model.name,
        "level": arguments.level,
        "profiles": [_plain(p, found) for p in profiles],
    }
    write_json(out / "profile.json", content)
    write_atomic(out / "report.html", profile_report(content))
    console.result(
        content,
        *(_line(p, found) for p in profiles),
        f"wrote profile.json and report.html in {out}",
    )
    return 0 if all(math.isfinite(p.lower) and math.isfinite(p.upper) for p in profiles) else 1


def _read(arguments: argparse.Namespace) -> tuple[IdentifiedModel, Dataset, Path]:
    """The model, the flights that it was fitted to, and the fit.json beside it."""
    from greybox.errors import DataError
    from greybox.model.known import demand_known
    from greybox.model.layer import physics_of
    from greybox.model.noise_free import with_sensor_noise

    model = begun_with(loaded(arguments), arguments)
    demand_known(model)
    beside = Path(arguments.model).with_name("fit.json")
    if not beside.exists():
        raise DataError(
            "no fit.json beside the model",
            where=arguments.model,
            fix="keep both files of the fit together",
        )
    train = read_flights_of(arguments, model.dynamics, arguments.train, rate=1 / model.sample_time)
    if strangers := sorted(set(train.names) ^ set(model.trained_on)):
        raise DataError(
            f"flight {', '.join(strangers)}: not the flights of the fit",
            expected=", ".join(model.trained_on),
            fix="give the flights that it was fitted to",
        )
    physics = physics_of(model.dynamics)
    if physics is not None and train.hash != model.data_hash:
        train = with_sensor_noise(train, physics.vehicle)[0]
    return model, train, beside


def _fitted(model: IdentifiedModel, train: Dataset, beside: Path) -> Fit:
    """The fit behind a model file: again from its values, with the choices that its fit.json
    (`beside`) names."""
    from greybox.errors import FitError
    from greybox.estimation.fit import fit, noise_of
    from greybox.estimation.options import FitOptions
    from greybox.files import read_json

    content = read_json(beside, schema="greybox.fit/1")
    settings = content["settings"]
    choices = cast("FitChoices", {k: settings[k] for k in KEPT if k in settings})
    choices |= {"values": dict(model.values), "noise": noise_of(model), "initialisation": "nominal"}
    found = fit(model.dynamics, train, FitOptions.of(None, choices))
    if not found.converged:
        raise FitError(
            "the fit does not converge from its own values",
            fix="greybox fit first; a profile needs its optimum",
        )
    return _with_errors(found, content["parameters"])


def _with_errors(found: Fit, stated: Mapping[str, ParameterRow]) -> Fit:
    """The fit with the errors that its fit.json states: they hold what the likelihood alone does
    not see, as what the model lacks."""
    from dataclasses import replace

    wider = {
        n: replace(e, std=max(e.std, error)) if n in stated and (error := stated[n]["std"]) else e
        for n, e in found.parameters.items()
    }
    return replace(found, estimates=replace(found.estimates, parameters=wider))


def _plain(p: Profile, found: Fit) -> ProfileRow:
    std = found.parameters[p.name].std if p.name in found.parameters else found.noise[p.name][1]
    return {
        "name": p.name,
        "unit": p.unit,
        "estimate": p.estimate,
        "std": std,
        "limit": 2.0 * p.limit,
        "lower": p.lower,
        "upper": p.upper,
        "at_bound": _ends(p, found),
        "grid": p.grid.tolist(),
        "cost": p.cost.tolist(),
        "converged": p.converged.tolist(),
    }


def _ends(p: Profile, found: Fit) -> list[str]:
    """Which ends of the interval are bounds of the parameter, not what the data say."""
    place = found.problem.place(p.name, p.flight)
    assert place is not None
    u = found.problem.unknowns[place]
    return [
        side
        for side, end, bound in (("lower", p.lower, u.lower), ("upper", p.upper, u.upper))
        if end == bound
    ]


def _line(p: Profile, found: Fit) -> str:
    said = [f"{side} end is its bound" for side in _ends(p, found)]
    ends = (("lower", p.lower), ("upper", p.upper))
    said += [f"the data give no {side} end" for side, v in ends if abs(v) == float("inf")]
    said += ["some grid points did not converge"] if not p.converged.all() else []
    text = (
        f"{p.name}: {p.estimate:.5g} {p.unit}, {100 * p.level:g} % interval {p.lower:.5g} .. "
        f"{p.upper:.5g}"
    )
    return text + (f" ({'; '.join(said)})" if said else "")
