"""`greybox frf`: the frequency response of flights, and of a model beside it."""

from __future__ import annotations

import argparse
import csv
import io
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.commands.command_line import Subcommands, effects_file_option, typed
from greybox.commands.console import Console, json_option
from greybox.commands.flight_logs import flight_log_options
from greybox.commands.judgement import admitted, source_option
from greybox.commands.model_options import names

if TYPE_CHECKING:
    from collections.abc import Sequence

    from greybox.data import Dataset
    from greybox.data.airframe import Airframe
    from greybox.linear.frf_result import FrequencyResponse, ResponseDocument
    from greybox.linear.logs import ChannelSpec
    from greybox.model.identified import IdentifiedModel
    from greybox.model.linear import LinearModel

OUTPUTS = ("p", "q", "r", "az")
"""Of a vehicle, where no outputs are named."""
CHIRP = "chirp"
"""Column that a log reader makes of a firmware's own excitation."""
WRITTEN = ("frf.json", "frf.csv", "report.html")


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "frf",
        help="frequency response of flights, with coherence and 95 %% bands",
        description="Magnitude, phase, coherence and 95 % bands of outputs over inputs, straight "
        "from the flights, with gain and lag. A channel is a column, a sum of columns ('a=u1+u2'), "
        "or with a vehicle a mixed command: roll, pitch, yaw, thrust. With --model the model's own "
        "response lies over it, and where they part is said. Writes frf.json, frf.csv and "
        "report.html. Exit code 0: done; 1: no frequency is usable (coherence too low, or a closed "
        "loop without references), or the model is not finished; 2: bad input.",
    )
    p.add_argument(
        "--train", required=True, nargs="+", metavar="LOG", help="flights; all are averaged"
    )
    p.add_argument(
        "--vehicle", metavar="V.toml", help="vehicle file: column names, and where the rotors are"
    )
    p.add_argument(
        "--model",
        metavar="MODEL.json",
        help="model file whose response is drawn over that of the flights",
    )
    _response_options(p)
    p.add_argument(
        "--rate",
        type=float,
        default=None,
        metavar="HZ",
        help="resample the logs (default: rate of the model)",
    )
    flight_log_options(p)
    effects_file_option(p)
    p.add_argument("--out", default="greybox-frf", metavar="DIR", help="folder for the results")
    source_option(p)
    json_option(p, "frf.json")
    p.set_defaults(run=run)


def _response_options(p: argparse.ArgumentParser) -> None:
    """Of what the response is, and at which frequencies."""
    p.add_argument(
        "--inputs",
        type=names,
        default=(),
        metavar="roll,pitch",
        help="all inputs that move at once (default: those of the "
        "model; of a vehicle roll,pitch,yaw,thrust)",
    )
    p.add_argument(
        "--outputs",
        type=names,
        default=(),
        metavar="p,q",
        help="outputs (default: those of the model; of a vehicle p,q,r,az)",
    )
    p.add_argument(
        "--references",
        type=names,
        default=(),
        metavar="sp_x",
        help="signals that excite a closed loop from outside, at "
        "least one per input (default: the chirp of a Betaflight log, for one input)",
    )
    p.add_argument(
        "--band",
        type=_band,
        default=None,
        metavar="LOW,HIGH",
        help="frequencies [Hz] (default: all)",
    )
    p.add_argument(
        "--window",
        type=float,
        default=None,
        metavar="S",
        help="longest window (default: as the flights allow)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Read, estimate, report. Returns 1 where no response has a frequency that can be used, or the
    model is not finished."""
    from greybox.files import withdraw, write_atomic, write_json
    from greybox.linear.frf import frf
    from greybox.report.frf_report import frf_report

    if not admitted(arguments, arguments.model):
        return 1
    model, vehicle = _subject(arguments)
    inputs, outputs = _named(arguments, model, vehicle)
    data, references = _flights(arguments, vehicle, model, inputs, outputs)
    found = frf(
        data,
        inputs,
        outputs,
        references=references,
        vehicle=vehicle,
        model=model,
        band=arguments.band,
        window=arguments.window,
    )
    content: ResponseDocument = {**found.to_dict(), "command": typed("frf")}
    out = Path(arguments.out)
    page, table = frf_report(content), _table(found)
    withdraw(out, *WRITTEN)
    write_json(out / "frf.json", content)
    write_atomic(out / "frf.csv", table)
    write_atomic(out / "report.html", page)
    Console.of(arguments).result(content, found.summary(), f"wrote {', '.join(WRITTEN)} in {out}")
    return 0 if found.measured else 1


def _band(text: str) -> tuple[float, float]:
    """LOW,HIGH in Hz."""
    try:
        low, high = (float(v) for v in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected LOW,HIGH in Hz, got '{text}'") from None
    return low, high


def _subject(
    arguments: argparse.Namespace,
) -> tuple[IdentifiedModel | LinearModel | None, Airframe | None]:
    """The model and the vehicle, as far as they are given."""
    from greybox.commands.front_door import load
    from greybox.errors import DataError
    from greybox.linear.frf_channels import vehicle_of
    from greybox.model.effects_file import load_effects
    from greybox.model.identified import IdentifiedModel
    from greybox.model.linear import LinearModel
    from greybox.model.vehicle import read_vehicle

    vehicle: Airframe | None = read_vehicle(arguments.vehicle) if arguments.vehicle else None
    if arguments.model is None:
        return None, vehicle
    model = load(
        arguments.model, effects=[e for path in arguments.effects_file for e in load_effects(path)]
    )
    if not isinstance(model, IdentifiedModel | LinearModel):
        raise DataError(
            "a hybrid that predicts channels from their past has no response to inputs alone",
            where=arguments.model,
            fix="pass the linear model that it was learned on",
        )
    return model, vehicle or vehicle_of(model)


def _named(
    arguments: argparse.Namespace,
    model: IdentifiedModel | LinearModel | None,
    vehicle: Airframe | None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Inputs and outputs: those that were named, else those of the vehicle, else those of the
    model."""
    from greybox.errors import DataError
    from greybox.linear.frf_channels import mixers
    from greybox.model.linear import LinearModel

    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = OUTPUTS
    if vehicle is not None:
        inputs = tuple(mixers(vehicle))
        if model is not None and not isinstance(model, LinearModel):
            outputs = tuple(n for n in OUTPUTS if n in model.dynamics.innovations.names)
    elif model is not None:
        inputs, outputs = model.dynamics.inputs.names, model.dynamics.outputs.names
    elif not (arguments.inputs and arguments.outputs):
        raise DataError(
            "which inputs and outputs?", fix="--vehicle V.toml, or --inputs u1,u2 --outputs p,q"
        )
    return arguments.inputs or inputs, arguments.outputs or outputs


def _flights(
    arguments: argparse.Namespace,
    vehicle: Airframe | None,
    model: IdentifiedModel | LinearModel | None,
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> tuple[Dataset, tuple[str, ...]]:
    """The flights on one clock, every needed column a channel, and the references."""
    from greybox.data import Dataset
    from greybox.data.conditioning import condition
    from greybox.data.logs import read_possible
    from greybox.linear.frf_channels import channels
    from greybox.linear.logs import with_columns

    raws = [
        read_possible(
            p, vehicle, mapping=arguments.mapping, keep_impossible=arguments.keep_impossible
        )
        for p in arguments.train
    ]
    references: tuple[str, ...] = arguments.references
    if not references and all(CHIRP in raw.extra for raw in raws):
        references = (CHIRP,) if len(inputs) == 1 else ()
        if not references:
            print(
                "the logs have a chirp: with one input at a time (--inputs roll) it is the "
                "reference",
                file=sys.stderr,
            )
    specs: list[ChannelSpec] = []
    for what, given in (("inputs", inputs), ("outputs", outputs), ("references", references)):
        if given or what != "references":
            specs += channels(given, vehicle, what, raws[0].channels)
    rate = arguments.rate
    if rate is None and model is not None:
        rate = 1 / model.sample_time
    flights = [
        condition(
            with_columns(raw, specs, str(path)),
            vehicle,
            rate=rate,
            trim=vehicle is not None,
            where=str(path),
        )
        for raw, path in zip(raws, arguments.train, strict=True)
    ]
    data = Dataset(flights=tuple(flights))
    for removed in data.removed:
        print(removed.line(), file=sys.stderr, flush=True)
    return data, references


def _table(found: FrequencyResponse) -> str:
    """frf.csv."""
    rows = list(found.rows())
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{v:.7g}" if isinstance(v, float) else v for k, v in row.items()})
    return text.getvalue()
