"""`greybox fit`: from flight logs to fit.json, model.json and report.html."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from greybox.data import Dataset
    from greybox.estimation.options import FitOptions
    from greybox.estimation.result import Fit
    from greybox.estimation.solver import Progress, Solver
    from greybox.model.vehicle import Vehicle

from greybox.commands.judgement import exit_code, given_horizons, horizon_options


def names(text: str) -> tuple[str, ...]:
    """A comma-separated list of names."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def noise_levels(text: str) -> dict[str, float]:
    """name=value,name=value: noise levels in SI units, "noise." may be left out (sensor.p=0.05)."""
    return {n if n.startswith("noise.") else f"noise.{n}": v for n, v in values(text).items()}


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


def add(subparsers: Any) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "fit",
        help="fit a Newton-Euler model to flight logs",
        description="Fit a Newton-Euler model to flight logs by the prediction error method. Writes fit.json, model.json "
        "and report.html. Exit code 0: usable (or the flights are too calm to judge), 1: not usable, 2: bad input, 130: "
        "interrupted.",
    )
    p.add_argument("--vehicle", required=True, metavar="V.toml", help="vehicle file")
    p.add_argument("--train", required=True, nargs="+", metavar="LOG", help="flights to fit")
    p.add_argument("--test", nargs="+", default=[], metavar="LOG", help="flights that only the validation sees")
    p.add_argument("--mapping", metavar="MAP.toml", help="which fields of the logs are which channels (docs/logs.md)")
    model_options(p)
    p.add_argument("--rate", type=float, default=None, metavar="HZ", help="resample the logs to this rate")
    horizon_options(p)
    p.add_argument("--adapt", type=float, default=None, metavar="S", help="adapt per-flight parameters on S seconds")
    p.add_argument("--seed", type=int, default=0, help="seed of random starts")
    p.add_argument("--out", default="greybox-fit", metavar="DIR", help="folder for the results")
    p.add_argument("--json", metavar="F", default=None, help="also write fit.json to F ('-': standard output)")
    p.set_defaults(run=run)


def model_options(p: Any) -> None:
    """Declare what says how the model is built and fitted; `fit_with` takes it."""
    p.add_argument("--effects", type=names, default=(), metavar="a,b", help="effects besides those in the vehicle file")
    p.add_argument("--effects-file", nargs="+", default=[], metavar="E.py",
                   help="add the effects of these Python files, which are run (only what you trust)")  # fmt: skip
    p.add_argument("--disturbance", type=names, default=(), metavar="force,torque", help="disturbance states")
    p.add_argument("--per-flight", type=names, default=(), metavar="a,b", help="parameters with one value per flight")
    p.add_argument("--shared", type=names, default=(), metavar="a,b", help="parameters with one value for all flights")
    p.add_argument("--fixed", type=names, default=(), metavar="a,b", help="parameters held at their value")
    p.add_argument("--free", type=names, default=None, metavar="a,b", help="fit exactly these parameters")
    p.add_argument(
        "--predictor",
        default="innovation",
        help="innovation, kalman, k-step, multi-step, multiple-shooting, simulation",
    )
    p.add_argument("--criterion", default="gaussian", help="gaussian, robust, least-squares")
    p.add_argument(
        "--solver", default="levenberg-marquardt", help="levenberg-marquardt, gauss-newton, scipy-trf, ipopt"
    )
    p.add_argument("--init", default="equation-error", help="equation-error, noise, nominal, multistart, innovation")
    p.add_argument("--noise", type=noise_levels, default={}, metavar="sensor.p=0.02,...",
                   help="noise levels to start from, of a component (sensor.p) or a group (process.torque)")  # fmt: skip
    p.add_argument(
        "--value", type=values, default={}, metavar="a=1,b=2", help="start values (of fixed parameters: values)"
    )
    p.add_argument("--hold-noise", nargs="?", const="all", default="none", choices=("none", "sensor", "all"),
                   help="hold the sensors' or all noise levels at their start")  # fmt: skip
    p.add_argument("--kinematic-noise", action="store_true", help="noise between attitude and gyro (clocks that drift)")
    p.add_argument("--input", choices=("command", "speed"), default="command", help="what drives the rotors")
    p.add_argument("--max-iterations", type=int, default=None, metavar="N", help="iteration limit of the solver")


def fit_with(
    arguments: argparse.Namespace, vehicle: Vehicle, train: Dataset, progress: Progress | None = None
) -> Fit:
    """Build the model that the options ask for and fit it to the flights of `train`. Returns a `Fit`."""
    from greybox.estimation.fit import fit
    from greybox.estimation.record import sample_time
    from greybox.model.effects_file import load_effects
    from greybox.model.model import build_model

    model = build_model(
        vehicle,
        train.channels,
        (*arguments.effects, *(e for path in arguments.effects_file for e in load_effects(path))),
        input=arguments.input,
        sample_time=sample_time(train),
        noncausal=train.noncausal,
        kinematic_noise=arguments.kinematic_noise,
    )
    return fit(model, train, fit_options(arguments), progress=progress)


def fit_options(arguments: argparse.Namespace) -> FitOptions:
    """The choices that the command's arguments make."""
    from greybox.estimation.options import FitOptions

    held = arguments.hold_noise
    return FitOptions(
        predictor=arguments.predictor,
        criterion=arguments.criterion,
        solver=_solver(arguments.solver, arguments.max_iterations),
        initialisation=arguments.init,
        disturbance=arguments.disturbance,
        free=arguments.free,
        fixed=arguments.fixed,
        per_flight=arguments.per_flight,
        shared=arguments.shared,
        values=arguments.value,
        noise=arguments.noise,
        estimate_noise="process" if held == "sensor" else held == "none",
        seed=arguments.seed,
    )


def run(arguments: argparse.Namespace) -> int:
    """Read, check, fit, validate, report."""
    from greybox.commands.vehicle_lines import say_vehicle
    from greybox.data import Dataset
    from greybox.data.checks import check
    from greybox.data.logs import read_logs
    from greybox.errors import GreyboxError
    from greybox.estimation.record import sample_time
    from greybox.estimation.status import Interrupted
    from greybox.files import dump_json, write_atomic, write_json
    from greybox.model.vehicle import read_vehicle
    from greybox.report.fit_report import fit_report
    from greybox.validation.advice import hints_of_checks, hints_of_fit
    from greybox.validation.validate import validate

    quiet = arguments.json == "-"
    say = (lambda *a: None) if quiet else (lambda *a: print(*a, file=sys.stderr))
    horizons = given_horizons(arguments)
    vehicle = read_vehicle(arguments.vehicle)
    train = read_logs(arguments.train, vehicle, rate=arguments.rate, mapping=arguments.mapping)
    test = (
        read_logs(arguments.test, vehicle, rate=arguments.rate, mapping=arguments.mapping)
        if arguments.test
        else Dataset(flights=())
    )
    both = sorted(set(train.names) & set(test.names))
    if both:
        raise GreyboxError(
            f"flight {', '.join(both)} is both train and test", fix="give every flight to one of the two"
        )
    if test.flights and abs(sample_time(test) - sample_time(train)) > 1e-6 * sample_time(train):
        test = read_logs(arguments.test, vehicle, rate=1 / sample_time(train), mapping=arguments.mapping)
    if arguments.adapt is not None and not arguments.adapt > 0:
        raise GreyboxError("--adapt takes a time above zero", got=f"{arguments.adapt:g} s", fix="--adapt 5")
    faults = check(train + test, vehicle)
    warnings = [f"data fault in {f.flight}: {f.message}" for f in faults.findings if f.severity == "blocking"]
    for warning in warnings:
        print(f"greybox fit: {warning}", file=sys.stderr)
    say_vehicle(vehicle, say)
    say(f"{train}")

    def progress(iteration: int, cost: float, decrement: float) -> None:
        say(f"  iteration {iteration:3d}  cost {cost:14.4f}  expected decrease {decrement:.3g}")

    out = Path(arguments.out)

    def save(result: Any) -> dict[str, Any]:
        content: dict[str, Any] = result.to_dict()
        content["warnings"] = [*warnings, *content["warnings"]]
        ours = sys.argv[1:2] == ["fit"]
        content["command"] = "greybox " + shlex.join(sys.argv[1:]) if ours else "greybox fit"
        write_json(out / "fit.json", content)
        result.model.save(out / "model.json")
        return content

    try:
        result = fit_with(arguments, vehicle, train, progress)
    except Interrupted as stop:
        save(stop.kept)
        for name in ("report.html", "validate.json"):  # of an earlier fit, whose numbers are gone
            (out / name).unlink(missing_ok=True)
        say(f"the best values so far are in {out / 'fit.json'} and {out / 'model.json'}")
        raise
    # The fit is safe before anything else can go wrong.
    content = save(result)
    validated = test if test.flights else train
    checked: dict[str, Any] | None = None
    table = ""
    try:
        hints = (
            *hints_of_checks(faults, effects=result.model.effects, kinematic_noise=arguments.kinematic_noise),
            *hints_of_fit(result),
        )
        seen = validate(result.model, validated, **horizons, adapt=arguments.adapt, hints=hints)
        result = result.judged(seen.verdict)
        content = save(result)
        checked, table = seen.to_dict(), seen.table_text()
    except GreyboxError as error:
        content["warnings"].insert(0, f"no validation: {error}")
        print(f"greybox fit: no validation: {error}", file=sys.stderr)
        write_json(out / "fit.json", content)
    if checked is not None:
        if not test.flights:
            checked.setdefault("warnings", []).insert(
                0, "validated on the flights that were fitted: give --test flights"
            )
            table = ""
        write_json(out / "validate.json", checked)
    else:
        (out / "validate.json").unlink(missing_ok=True)  # of an earlier fit
    adapted = ((checked or {}).get("adapted_on") or {}).get("flights", {})
    page = fit_report(
        content, series(result.model, train, test, adapted=adapted), checked, title=f"Fit of {vehicle.name}"
    )
    report = write_atomic(out / "report.html", page)
    if arguments.json == "-":
        sys.stdout.write(dump_json(content))
    elif arguments.json:
        write_json(arguments.json, content)
    if not quiet:
        print(result.summary())
        if table:
            print(f"{table}\n")
        print(f"wrote {', '.join(p.name for p in sorted(out.glob('*.json')))} and {report.name} in {out}")
    return exit_code(result.verdict) if result.verdict is not None or result.converged else 1


def _solver(name: str, limit: int | None) -> str | Solver:
    """The solver, with another iteration limit where one is given."""
    from greybox.errors import UnknownNameError
    from greybox.estimation.solvers import SOLVERS

    if name not in SOLVERS:
        raise UnknownNameError("solver", name, SOLVERS)
    return name if limit is None else SOLVERS[name](max_iterations=limit)


def series(
    model: Any, *datasets: Any, adapted: Any = None, ahead_seconds: float = 0.5, limit: int = 3
) -> dict[str, Any]:
    """Time series of up to `limit` flights per data set for the report: measured, one step and some way ahead."""
    import numpy as np

    from greybox.estimation.filtering import Filter
    from greybox.report.flight_section import ChannelSeries, FlightSeries

    chosen: list[tuple[str, Any]] = []
    roles: Sequence[str] = ("train", "test")
    for role, data in zip(roles, datasets, strict=False):
        chosen += [(role, f) for f in data.flights[:limit]]
    runner = Filter(model)
    steps = max(1, round(ahead_seconds / model.sample_time))
    out: dict[str, Any] = {}
    for role, flight in chosen:
        segment = max(flight.segments, key=lambda s: s.n)
        own = (adapted or {}).get(flight.name)
        p = model.parameter_vector({k: v["value"] for k, v in own.items() if k in model.values}) if own else None
        filtered = runner.run(segment, p=p)
        origins = np.arange(0, max(filtered.record.n - steps - 1, 0))
        ahead = np.full_like(filtered.outputs, np.nan)
        if origins.size:
            ahead[origins + steps] = runner.rollout(filtered, origins, steps)[:, -1]
        channels = {
            signal.name: ChannelSeries(
                measured=filtered.record.outputs[:, j],
                unit=signal.unit,
                one_step=filtered.outputs[:, j],
                ahead=ahead[:, j],
            )
            for j, signal in enumerate(model.dynamics.outputs)
        }
        out[flight.name] = FlightSeries(
            t=segment.t, channels=channels, ahead_seconds=steps * model.sample_time, role=role
        )
    return out
