"""`greybox vehicle`: write a vehicle file from a template or from answers, and say what in one is
implausible."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable

from greybox.commands.command_line import Subcommands
from greybox.commands.console import Console, json_option

TEMPLATES = {
    "crazyflie": "Crazyflie 2.1, 27 g, measured by Förster (2015)",
    "racer250": "250 mm racing quadrotor of 0.75 kg (Agilicious, 2022)",
    "duckiedrone": "Duckiedrone DD21, 0.635 kg, estimated by Ghoul (2026)",
    "x": "any quadrotor in X, sized by mass, arm and hover command",
    "plus": "any quadrotor in plus, sized by mass, arm and hover command",
}
QUESTIONS = (
    ("name", "name of the craft", str),
    ("mass", "mass ready to fly [kg]", float),
    ("mass.sigma", "how sure is the mass, one sigma [kg]", float),
    ("arm", "distance from the centre to a motor axis [m]", float),
    ("hover", "command in hover, 0 to 1 (from a log or the pilot's stick)", float),
    ("actuator.rotor_radius", "radius of a propeller [m]", float),
    ("battery.nominal_voltage", "nominal voltage of the battery [V]", float),
)
"""What is asked on a terminal: key, question, type. An empty answer keeps the template's number."""


def add(subparsers: Subcommands) -> None:
    """Declare the command and its two subcommands."""
    parser = subparsers.add_parser(
        "vehicle",
        help="write a vehicle file, or say what in one is implausible",
        description="Write a vehicle file (new) or judge one (check). Exit code 0: done; 1: check "
        "found something that no craft has; 2: bad input.",
    )
    kinds = parser.add_subparsers(dest="vehicle_command", required=True, metavar="new|check")
    new = kinds.add_parser(
        "new",
        help="write a vehicle file from a template, a log, a simulator's file, or from answers on "
        "a terminal",
        description="Write a vehicle file. --from takes motor order, spins, arms and the hover "
        "command from a log of PX4, Betaflight or a Crazyflie, and says what you must measure; or "
        "the whole craft from a simulator's file: SDF, URDF, MJCF, RotorPy (.py), crazyflow "
        "(.toml), PX4 (.params). Without --template and --from questions are asked on the "
        "terminal. Templates: " + "; ".join(f"{k}: {v}" for k, v in TEMPLATES.items()) + ".",
    )
    new.add_argument("--template", metavar="NAME", help=", ".join(TEMPLATES))
    new.add_argument(
        "--from", metavar="FILE", dest="log", help="take what a log or a simulator's file knows"
    )
    new.add_argument(
        "--set",
        nargs="+",
        action="extend",
        default=[],
        metavar="KEY=VALUE",
        dest="changes",
        help="change numbers: mass=0.5 arm=0.12 hover=0.45 thrust.c2.sigma=0.5 name=mine",
    )
    new.add_argument(
        "--out", metavar="V.toml", help="file to write (default, and '-': standard output)"
    )
    new.add_argument("--force", action="store_true", help="write over an existing file")
    new.set_defaults(run=run_new, one_file=True)
    check = kinds.add_parser(
        "check",
        help="say what in a vehicle file is implausible",
        description="Judge a vehicle file: thrust to weight, hover command, inertia, rotor "
        "positions and spins, torque, motor lag, sigmas, slips of unit. Exit code 0: nothing "
        "blocks; 1: no craft is like that; 2: not a vehicle file.",
    )
    check.add_argument("vehicle", metavar="V.toml", help="vehicle file")
    json_option(check, "the findings")
    check.set_defaults(run=run_check)


def run_new(arguments: argparse.Namespace) -> int:
    """Write the file. Returns 0. Raises `VehicleError`, `UnknownNameError`, `OutputError`."""
    from greybox.errors import VehicleError
    from greybox.files import no_overwriting
    from greybox.model.vehicle_template import TEMPLATES as KNOWN
    from greybox.model.vehicle_template import settings, vehicle_text

    out = None if arguments.out == "-" else arguments.out
    if out:
        no_overwriting(out, "--out", force=arguments.force)
    changes = settings(arguments.changes)
    name = arguments.template
    if arguments.log:
        if name is not None:
            raise VehicleError(
                "--from and --template exclude each other", fix="give one of the two"
            )
        return _tell(_from_log(arguments.log, changes), out)
    if name is None:
        if not sys.stdin.isatty():
            raise VehicleError(
                "no template, and no terminal to ask on",
                expected=f"--template {', '.join(KNOWN)}",
                fix="--template x --set mass=0.5 arm=0.12",
            )
        try:
            name, answers = ask(lambda prompt: input(prompt))
        except EOFError:
            raise VehicleError(
                "the answers ended before the questions", fix="answer all, or use --template"
            ) from None
        changes = answers | changes
    return _tell(vehicle_text(name, changes), out)


def _from_log(log: str, changes: dict[str, object]) -> str:
    """The file from a log; says on standard error what the log knew and what must be measured."""
    from greybox.model.vehicle_from_log import vehicle_from_log
    from greybox.simulators.sources import is_simulator_file, vehicle_from_simulator

    if is_simulator_file(log):
        text, craft = vehicle_from_simulator(log, changes)
        for line in craft.to_measure:
            print(f"to measure: {line}", file=sys.stderr)
        return text
    found = vehicle_from_log(log, changes)
    for line in found.known:
        print(f"from the log: {line}", file=sys.stderr)
    for line in found.to_measure:
        print(f"to measure: {line}", file=sys.stderr)
    return found.text


def _tell(text: str, out: str | None) -> int:
    """Write the file, or print it. Returns 0. Raises `OutputError`."""
    from greybox.files import write_atomic

    if not out:
        print(text, end="")
        return 0
    print(
        f"wrote {write_atomic(out, text)}; now weigh, measure and run: greybox vehicle check "
        f"{shlex.quote(str(out))}"
    )
    return 0


def ask(reply: Callable[[str], str]) -> tuple[str, dict[str, object]]:
    """(template, settings) from questions; `reply` takes a prompt and gives the answer. A bad
    number is asked for again."""
    import tomllib

    from greybox.model.vehicle_template import template_text

    for key, text in TEMPLATES.items():
        print(f"  {key:12} {text}")
    name = reply("template [x]: ").strip() or "x"
    data = tomllib.loads(template_text(name))
    arm = max((r["position"][0] ** 2 + r["position"][1] ** 2) ** 0.5 for r in data["rotor"])
    known: dict[str, object] = {
        "name": data["name"],
        "mass": data["mass"]["value"],
        "mass.sigma": "1 %",
        "arm": round(arm, 4),
        "hover": "as in the template",
        "actuator.rotor_radius": data["actuator"]["rotor_radius"],
        "battery.nominal_voltage": data["battery"]["nominal_voltage"],
    }
    answers: dict[str, object] = {}
    for key, question, kind in QUESTIONS:
        while (answer := reply(f"{question} [{known[key]}]: ").strip()) != "":
            try:
                answers[key] = kind(answer)
                break
            except ValueError:
                print(f"  a number is needed here, got '{answer}'")
    return name, answers


def run_check(arguments: argparse.Namespace) -> int:
    """Judge the file, print the findings, write the JSON. Returns 0, or 1 where something
    blocks."""
    from greybox.data.readers.mapping import mapping_text
    from greybox.model.plausibility import check_vehicle
    from greybox.model.vehicle import columns_by_channel, read_vehicle

    vehicle = read_vehicle(arguments.vehicle)
    lines = []
    if columns_by_channel(arguments.vehicle):
        lines += ["[columns] by group, in place of what the file holds:"]
        lines += [mapping_text(vehicle.columns.to_dict(), prefix="columns.")]
    report = check_vehicle(vehicle, where=arguments.vehicle)
    Console.of(arguments).result(report.to_dict(), *lines, report.summary())
    return 0 if report.ok else 1
