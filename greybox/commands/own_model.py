"""What the commands have in common for models of the user's own: the option that names the program,
reading a model file with it, and reading the logs of either kind of model."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from greybox.commands.command_line import Options
from greybox.commands.model_options import numbers

if TYPE_CHECKING:
    from greybox.data import Dataset
    from greybox.model.dynamics import Dynamics
    from greybox.model.identified import IdentifiedModel
    from greybox.model.vehicle import Vehicle


def model_file_option(p: Options, *, read: bool = True) -> None:
    """Declare --model-file. `read`: the command reads a fitted model, which holds the equations."""
    more = "; a model.json holds the equations, so that this only checks it" if read else ""
    p.add_argument(
        "--model-file",
        metavar="OWN.py:BUILD",
        help="a Python program, which is run, and its function that returns a StateSpaceModel of "
        f"your own (docs/own_model.md){more}",
    )


def range_of(text: str) -> tuple[str, tuple[float, float]]:
    """name=low,high."""
    name, _, both = text.partition("=")
    ends = numbers(both) if both else ()
    if len(ends) != 2:
        raise argparse.ArgumentTypeError(f"expected NAME=LOW,HIGH, got '{text}'")
    return name, (ends[0], ends[1])


def range_options(p: Options, *, inputs: str, outputs: str) -> None:
    """Declare --range and --limit, whose help is `inputs` and `outputs`."""
    for name, what, metavar, text in (
        ("range", "ranges", "u=LO,HI", inputs),
        ("limit", "limits", "y=LO,HI", outputs),
    ):
        p.add_argument(
            f"--{name}", dest=what, nargs="+", type=range_of, default=[], metavar=metavar, help=text
        )


def loaded(arguments: argparse.Namespace) -> IdentifiedModel:
    """The model file of a command, with the effects and the program that were named.

    Raises `ModelError` where the program's model is not the one that was fitted, and what
    `load_model` raises.
    """
    from greybox.errors import ModelError
    from greybox.model.dynamics import StateSpaceModel
    from greybox.model.effects_file import load_effects
    from greybox.model.own_model import load_own_model, same_model
    from greybox.residual.files import load_model

    own = [e for path in arguments.effects_file for e in load_effects(path)]
    model = load_model(arguments.model, effects=own)
    if arguments.model_file:
        made = load_own_model(arguments.model_file)
        core = model.core
        if not isinstance(core, StateSpaceModel) or not same_model(core, made):
            raise ModelError(
                f"{arguments.model_file} is not the model of this file",
                where=arguments.model,
                expected=model.core.name,
                got=f"{made.name}, or other equations",
                fix="fit again after a change, or leave --model-file out: the file holds its own",
            )
    return model


def read_flights_of(
    arguments: argparse.Namespace,
    dynamics: Dynamics | Vehicle,
    paths: Sequence[str],
    *,
    rate: float | Literal["needed"] | None = None,
    trim: bool = True,
) -> Dataset:
    """Logs for a model: of a vehicle by its columns and airborne part; of any other model its
    inputs and outputs by their names, the whole record, at its own rate where what the response of
    a craft is `"needed"` is asked for. No paths, no flights."""
    from greybox.commands.flight_logs import read_flight_logs
    from greybox.data import Dataset
    from greybox.model.layer import physics_of
    from greybox.model.vehicle import Vehicle

    if not paths:
        return Dataset(flights=())
    if isinstance(dynamics, Vehicle):
        return read_flight_logs(arguments, paths, dynamics, rate=rate, trim=trim)
    physics = physics_of(dynamics)
    if physics is not None:
        return read_flight_logs(arguments, paths, physics.vehicle, rate=rate, trim=trim)
    from greybox.linear.logs import ChannelSpec, read_records

    inputs, outputs = (
        [ChannelSpec(name=n, terms=((1.0, n),)) for n in layout.names]
        for layout in (dynamics.inputs, dynamics.outputs)
    )
    own = None if rate == "needed" else rate
    found = read_records(paths, inputs, outputs, rate=own, mapping=arguments.mapping)
    return Dataset(flights=found.flights)
