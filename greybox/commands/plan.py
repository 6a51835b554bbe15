"""`greybox plan`: excitation flights that make the wanted parameters known, with the standard
errors to expect."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from greybox.model.dynamics import StateSpaceModel
    from greybox.model.effect import Effect
    from greybox.model.identified import IdentifiedModel
    from greybox.model.vehicle import Vehicle
    from greybox.planning.document import PlanDocument
    from greybox.planning.result import Plan

from greybox.commands.command_line import Subcommands, effects_file_option, typed
from greybox.commands.console import Console, json_option
from greybox.commands.judgement import admitted, begun_with, source_option
from greybox.commands.model_options import names, noise_levels, numbers, values
from greybox.commands.own_model import loaded, model_file_option, range_options


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "plan",
        help="propose excitation flights, with the standard errors to expect",
        description="Propose excitation flights within limits, chosen for the information that "
        "they give about the parameters (D-optimal), with expected standard errors and the effects "
        "they separate. Writes plan.json, setpoints and expected log per flight (flight_1.csv, "
        "expected_1.csv), plan.png and report.html. Exit code 0: done; 1: done, but nothing will "
        "be known of some wanted parameter, or the model is not finished; 2: bad input.",
    )
    p.add_argument("--vehicle", metavar="V.toml", help="vehicle file")
    model_file_option(p)
    range_options(
        p,
        inputs="of a model of your own: the range of every input",
        outputs="of a model of your own: what outputs must not leave",
    )
    p.add_argument(
        "--model",
        metavar="MODEL.json",
        help="fitted model: its values, noise and covariance are what is known",
    )
    _knowledge_options(p)
    _length_options(p)
    _room_options(p)
    p.add_argument(
        "--setpoints-only",
        action="store_true",
        help="only manoeuvres that need no injected signals",
    )
    p.add_argument("--seed", type=int, default=0, help="seed of the multi-sines' phases")
    p.add_argument("--out", default="greybox-plan", metavar="DIR", help="folder for the results")
    source_option(p)
    json_option(p, "plan.json")
    p.set_defaults(run=run)


def _knowledge_options(p: argparse.ArgumentParser) -> None:
    """What is wanted, and what is taken for known."""
    p.add_argument(
        "--for",
        dest="effects",
        type=names,
        default=(),
        metavar="a,b",
        help="effects that the flights are for",
    )
    effects_file_option(
        p, "know the effects of these Python files too, which are run (only what you trust)"
    )
    p.add_argument(
        "--free", type=names, default=None, metavar="a,b", help="estimate exactly these parameters"
    )
    p.add_argument(
        "--value", type=values, default={}, metavar="a=1,b=2", help="values that are taken for true"
    )
    p.add_argument(
        "--noise",
        type=noise_levels,
        default={},
        metavar="sensor.p=0.02,...",
        help="noise levels, of a component (sensor.p) or a group (process.torque)",
    )
    p.add_argument(
        "--sensors",
        type=names,
        default=None,
        metavar="a,b",
        help="what is logged: position, velocity, attitude, gyro, accelerometer (default: [noise])",
    )


def _length_options(p: argparse.ArgumentParser) -> None:
    """How much is flown."""
    p.add_argument(
        "--seconds",
        type=float,
        default=60.0,
        metavar="S",
        help="length of all flights together (default 60)",
    )
    p.add_argument(
        "--piece", type=float, default=5.0, metavar="S", help="length of one manoeuvre (default 5)"
    )
    p.add_argument(
        "--flights",
        type=int,
        default=1,
        metavar="N",
        help="how many flights to split them into (default 1)",
    )
    p.add_argument(
        "--rate",
        type=float,
        default=None,
        metavar="HZ",
        help="sample rate (default 100, or the model's)",
    )


def _room_options(p: argparse.ArgumentParser) -> None:
    """What may not be left."""
    p.add_argument(
        "--box",
        type=numbers,
        default=(4.0, 4.0, 2.5),
        metavar="L,W,H",
        help="room to fly in [m]: length x, width y, height above the floor (default 4,4,2.5)",
    )
    p.add_argument(
        "--floor", type=float, default=0.3, metavar="M", help="lowest height [m] (default 0.3)"
    )
    p.add_argument(
        "--speed", type=float, default=3.0, metavar="V", help="highest speed [m/s] (default 3)"
    )
    p.add_argument(
        "--tilt",
        type=float,
        default=35.0,
        metavar="DEG",
        help="largest tilt [degrees], at most 35 (default 35)",
    )
    p.add_argument(
        "--command",
        dest="range",
        type=numbers,
        default=None,
        metavar="LO,HI",
        help="range of the rotor commands (default: the vehicle's less 2 %% at both ends)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Plan, write, report. Returns 0, or 1 where nothing will be known of a wanted parameter, or
    the model is not finished."""
    import numpy as np

    from greybox.model.effects_file import load_effects
    from greybox.planning import plan
    from greybox.planning.limits import Limits

    if not admitted(arguments, arguments.model):
        return 1
    if (own_model := _own_model(arguments)) is not None:
        return _run_own(arguments, own_model)
    _check(arguments)
    own = {e.name: e for path in arguments.effects_file for e in load_effects(path)}
    vehicle, model = _subject(arguments, own.values())
    limits = Limits(
        box=arguments.box,
        floor=arguments.floor,
        speed=arguments.speed,
        tilt=float(np.radians(arguments.tilt)),
        command=arguments.range,
    )
    console = Console.of(arguments)
    found = plan(
        None if model else vehicle,
        model=model,
        effects=[own.get(n, n) for n in arguments.effects],
        seconds=arguments.seconds,
        piece=arguments.piece,
        flights=arguments.flights,
        limits=limits,
        free=arguments.free,
        values=arguments.value,
        noise=arguments.noise,
        sensors=arguments.sensors,
        sample_time=1 / arguments.rate if arguments.rate else None,
        setpoints_only=arguments.setpoints_only,
        seed=arguments.seed,
        say=lambda text: console.say(f"  {text}"),
    )
    content = found.to_dict()
    content["command"] = typed("plan")
    out = Path(arguments.out)
    count = _write(found, content, float(vehicle.gravity), out)
    console.result(
        content,
        found.summary(),
        f"wrote plan.json, {count} flight(s) as CSV, plan.png and report.html in {out}",
    )
    blind = [n for n in found.subject.wanted if not np.isfinite(found.errors[n][0])]
    return 1 if blind else 0


def _check(arguments: argparse.Namespace) -> None:
    """Raise `GreyboxError` for options that no vehicle can be planned with."""
    from greybox.errors import GreyboxError

    if arguments.vehicle is None and arguments.model is None:
        raise GreyboxError(
            "nothing to plan for",
            expected="a vehicle file, a fitted model or a model of your own",
            fix="--vehicle V.toml before the first flight, --model model.json after it; "
            "--model-file own.py:build",
        )
    for option, given, length in (("--box", arguments.box, 3), ("--command", arguments.range, 2)):
        if given is not None and len(given) != length:
            raise GreyboxError(
                f"{option} takes {length} numbers",
                got=str(len(given)),
                fix="--box 4,4,2.5 --command 0.1,0.9",
            )
    if arguments.rate is not None and not 10 <= arguments.rate <= 2000:
        raise GreyboxError(
            "--rate takes 10 to 2000 Hz", got=f"{arguments.rate:g}", fix="--rate 100"
        )


def _subject(
    arguments: argparse.Namespace, own: Iterable[Effect]
) -> tuple[Vehicle, IdentifiedModel | None]:
    """The vehicle, and the fitted model of it where one is given, whose vehicle goes before."""
    from greybox.errors import ModelError
    from greybox.model.layer import physics_of
    from greybox.model.vehicle import read_vehicle
    from greybox.residual.files import load_model

    model = None
    if arguments.model:
        model = begun_with(load_model(arguments.model, effects=own), arguments)
    vehicle = read_vehicle(arguments.vehicle) if arguments.vehicle else None
    if model is not None:
        if physics_of(model.dynamics) is None:
            raise ModelError(
                "only physics models can be planned for",
                got=model.name,
                fix="pass the model.json of greybox fit",
            )
        if vehicle is not None and vehicle != model.physics.vehicle:
            print(
                "greybox plan: the model was fitted with another vehicle file; the model's own is "
                "used",
                file=sys.stderr,
            )
        vehicle = model.physics.vehicle
    assert vehicle is not None
    return vehicle, model


def _write(found: Plan, content: PlanDocument, gravity: float, out: Path) -> int:
    """Flights to fly and to expect, picture, page and plan.json. Returns the number of flights."""
    from greybox.files import write_atomic, write_json
    from greybox.planning.setpoints import csv, setpoints
    from greybox.report.plan_report import plan_picture, plan_report

    dt = found.subject.sample_time
    sent = [setpoints(steps, found.limits, dt, gravity) for steps in found.flights]
    seen = [{"t": s.t, **s.channels} for f in found.log.flights for s in f.segments]
    both = list(zip(sent, seen, strict=True))
    for k, (to_fly, expected) in enumerate(both):
        write_atomic(out / f"flight_{k + 1}.csv", csv(to_fly))
        write_atomic(out / f"expected_{k + 1}.csv", csv(expected))
    write_atomic(out / "plan.png", plan_picture(content, both))
    write_atomic(out / "report.html", plan_report(content, both))
    write_json(out / "plan.json", content)
    return len(both)


def _own_model(arguments: argparse.Namespace) -> IdentifiedModel | StateSpaceModel | None:
    """The model of the user's own that is planned for: a fitted one, or that of a program; None for
    a vehicle."""
    from greybox.model.dynamics import StateSpaceModel
    from greybox.model.own_model import load_own_model

    if arguments.model:
        fitted = begun_with(loaded(arguments), arguments)
        return fitted if isinstance(fitted.core, StateSpaceModel) else None
    return load_own_model(arguments.model_file) if arguments.model_file else None


def _run_own(arguments: argparse.Namespace, model: IdentifiedModel | StateSpaceModel) -> int:
    """Plan input signals for a model of the user's own. Returns as `run`."""
    import numpy as np

    from greybox.errors import GreyboxError
    from greybox.files import write_atomic, write_json
    from greybox.planning.own_plan import plan_own
    from greybox.planning.setpoints import csv

    if arguments.vehicle or arguments.effects:
        raise GreyboxError(
            "a model of your own has no vehicle and no effects", fix="leave --vehicle and --for out"
        )
    found = plan_own(
        model,
        dict(arguments.ranges),
        limits=dict(arguments.limits),
        seconds=arguments.seconds,
        piece=arguments.piece,
        free=arguments.free,
        values=arguments.value,
        noise=arguments.noise,
        sample_time=1 / arguments.rate if arguments.rate else None,
        seed=arguments.seed,
    )
    out = Path(arguments.out)
    content = found.to_dict()
    content["command"] = typed("plan")
    segment = found.log.flights[0].segments[0]
    write_atomic(out / "experiment_1.csv", csv({"t": np.asarray(segment.t), **segment.channels}))
    write_json(out / "plan.json", content)
    Console.of(arguments).result(
        content,
        found.summary(),
        f"wrote plan.json and experiment_1.csv (inputs to play, outputs to expect) in {out}",
    )
    return 1 if found.blind else 0
