"""`greybox linear`: from logs to a linear state-space model in innovation form, with error bars and
a report."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.commands.command_line import Subcommands, typed
from greybox.commands.console import Console, json_option
from greybox.commands.judgement import given_horizons, horizon_options, horizon_steps

if TYPE_CHECKING:
    from greybox.linear.document import ChannelRow, LinearDocument, LogRow
    from greybox.linear.fit import LinearFit
    from greybox.linear.logs import ChannelSpec, Logs
    from greybox.linear.records import Record
    from greybox.linear.validation import Identified

Group = tuple[tuple[int, ...], tuple[int, ...]]
"""Columns of the inputs and of the outputs of one model."""


def add(subparsers: Subcommands) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "linear",
        help="identify a linear state-space model",
        description="Identify x+ = A x + B u + K e, y = C x + D u + e from logs by subspace start "
        "and prediction error polish. Any CSV with a time column `t` works; a vehicle file is only "
        "needed for its column names. A channel is a column, or a sum of columns: "
        "'roll=u4+u3-u2-u1'. Writes fit.json, model.json and report.html. Exit code 0: converged, "
        "1: not converged, 2: bad input.",
    )
    p.add_argument("--train", required=True, nargs="+", metavar="LOG", help="logs to fit")
    p.add_argument(
        "--test", nargs="+", default=[], metavar="LOG", help="logs that only the validation sees"
    )
    p.add_argument(
        "--mapping",
        metavar="MAP.toml",
        help="which fields of the logs are which channels (docs/logs.md)",
    )
    p.add_argument(
        "--inputs", required=True, metavar="u1,u2", help="input channels, comma separated"
    )
    p.add_argument(
        "--outputs", required=True, metavar="p,q,r", help="output channels, comma separated"
    )
    _model_options(p)
    p.add_argument("--vehicle", metavar="V.toml", help="vehicle file, for its column names")
    p.add_argument(
        "--rate", type=float, default=None, metavar="HZ", help="resample the logs to this rate"
    )
    p.add_argument(
        "--adapt",
        type=float,
        default=0.0,
        metavar="S",
        help="fit state and offset of test logs on S seconds",
    )
    horizon_options(p)
    p.add_argument(
        "--profile",
        action="store_true",
        help="profile likelihood intervals of all poles (takes longer)",
    )
    p.add_argument("--out", default="greybox-linear", metavar="DIR", help="folder for the results")
    json_option(p, "fit.json")
    p.set_defaults(run=run)


def _model_options(p: argparse.ArgumentParser) -> None:
    """What the model may be."""
    p.add_argument(
        "--order",
        default="auto",
        metavar="N|auto",
        help="most states; those that the data do not carry are left out (default: auto)",
    )
    p.add_argument(
        "--exact-order", action="store_true", help="keep all N states, also those that hardly pay"
    )
    p.add_argument(
        "--max-order", type=int, default=10, metavar="N", help="largest order that auto tries"
    )
    p.add_argument(
        "--criterion", choices=("aic", "aicc", "bic"), default="bic", help="how auto judges orders"
    )
    p.add_argument(
        "--siso", action="store_true", help="one model per output, input i drives output i"
    )
    p.add_argument(
        "--delay",
        default="0",
        metavar="0,1|auto",
        help="input delays in samples: one, one per input, or auto",
    )
    p.add_argument(
        "--feedthrough",
        action="store_true",
        help="free D (for outputs that answer within the sample)",
    )
    p.add_argument("--output-error", action="store_true", help="no noise model: K = 0")
    p.add_argument("--stable", action="store_true", help="demand |eig A| < 1")
    p.add_argument(
        "--open-loop",
        action="store_true",
        help="the inputs do not depend on the outputs (no feedback)",
    )


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """What is to be identified: channels, order and delays, and `groups` of (inputs, outputs) that
    share a model."""

    inputs: tuple[ChannelSpec, ...]
    outputs: tuple[ChannelSpec, ...]
    order: int | str
    delays: list[int] | str
    groups: tuple[Group, ...]


def run(arguments: argparse.Namespace) -> int:
    """Read, identify, validate, report. Returns 0, or 1 where a fit did not converge."""
    console = Console.of(arguments)
    asked = _asked(arguments)
    train, test = _logs(arguments, asked)
    horizons = horizon_steps(arguments, train.dt)
    results = [
        _identified(arguments, console, asked, group, (train, test), horizons)
        for group in asked.groups
    ]
    content = _content(arguments, asked, (train, test), results)
    written = _write(Path(arguments.out), content, results, test)
    console.result(
        content,
        *(r.format() for r in results),
        *(f"note: {n}" for n in content["notes"]),
        f"wrote {written}",
    )
    bad = [r.fit.model.name for r in results if not r.fit.converged]
    if bad:
        print(f"not converged: {', '.join(bad)}", file=sys.stderr)
    return 1 if bad else 0


def _asked(arguments: argparse.Namespace) -> _Asked:
    """The options, judged before any log is read."""
    from greybox.errors import DataError
    from greybox.linear.logs import parse_channels

    inputs, outputs = (
        parse_channels(arguments.inputs, "inputs"),
        parse_channels(arguments.outputs, "outputs"),
    )
    both = sorted({s.name for s in inputs} & {s.name for s in outputs})
    if both:
        raise DataError(
            f"{', '.join(both)} is both input and output",
            fix="give every channel to one of the two",
        )
    if arguments.siso and len(inputs) != len(outputs):
        raise DataError(
            f"--siso pairs {len(inputs)} inputs with {len(outputs)} outputs",
            expected="equal numbers",
            fix="mix the inputs: --inputs 'roll=u4+u3-u2-u1,...'",
        )
    given_horizons(arguments)
    order = (
        arguments.order
        if arguments.order == "auto"
        else _whole_numbers(arguments.order, "--order", 1)[0]
    )
    if arguments.exact_order and order == "auto":
        raise DataError(
            "--exact-order keeps the states of an order that is given",
            fix="--order 6 --exact-order",
        )
    if arguments.max_order < 1:
        raise DataError(f"--max-order {arguments.max_order}", expected="at least 1")
    whole = (tuple(range(len(inputs))), tuple(range(len(outputs))))
    return _Asked(
        inputs=inputs,
        outputs=outputs,
        order=order,
        delays=_delays(arguments.delay, len(inputs)),
        groups=tuple(((i,), (i,)) for i in range(len(outputs))) if arguments.siso else (whole,),
    )


def _logs(arguments: argparse.Namespace, asked: _Asked) -> tuple[Logs, Logs | None]:
    """(training logs, test logs)."""
    from greybox.linear.logs import demand_alike, read_records
    from greybox.model.vehicle import read_vehicle

    vehicle = read_vehicle(arguments.vehicle) if arguments.vehicle else None
    how = {"rate": arguments.rate, "mapping": arguments.mapping}
    train = read_records(arguments.train, asked.inputs, asked.outputs, vehicle, bridge=0, **how)
    if not arguments.test:
        return train, None
    test = read_records(arguments.test, asked.inputs, asked.outputs, vehicle, **how)
    demand_alike(train, test)
    return train, test


def _identified(
    arguments: argparse.Namespace,
    console: Console,
    asked: _Asked,
    group: Group,
    logs: tuple[Logs, Logs | None],
    horizons: Sequence[int],
) -> Identified:
    """The model of one group, fitted, said and validated."""
    from greybox.linear.pole_profile import pole_intervals
    from greybox.linear.validation import validate_linear

    (columns, rows), (train, test) = group, logs
    own = [r.part(columns, rows) for r in train.records]
    fit = _fit(arguments, own, train, asked, group)
    if not console.quiet:
        said = [
            fit.model.name,
            fit.summary(),
            *([] if fit.order_choice is None else [fit.order_choice.format()]),
        ]
        # In one piece: an interrupt between a text and its end of line would leave half a line.
        print("\n".join([*said, ""]), end="")
    return validate_linear(
        fit,
        train.records,
        () if test is None else test.records,
        columns,
        rows,
        horizons=horizons,
        adapt_seconds=arguments.adapt,
        feedback=not arguments.open_loop,
        intervals=pole_intervals(fit, own) if arguments.profile else (),
    )


def _fit(
    arguments: argparse.Namespace,
    records: Sequence[Record],
    train: Logs,
    asked: _Asked,
    group: Group,
) -> LinearFit:
    from greybox.linear.fit import Options, Settings, fit_linear

    columns, rows = group
    outputs = asked.outputs
    whole = len(rows) == len(outputs) and not arguments.siso
    return fit_linear(
        records,
        asked.order,
        dt=train.dt,
        inputs=[asked.inputs[i].made_of(train.recipes) for i in columns],
        outputs=[outputs[i].made_of(train.recipes) for i in rows],
        delays=asked.delays
        if isinstance(asked.delays, str)
        else [asked.delays[i] for i in columns],
        options=Options(
            noise_model=not arguments.output_error,
            feedthrough=arguments.feedthrough,
            methods=("cva", "ssarx") if arguments.open_loop else ("ssarx", "pbsid"),
            exact_order=arguments.exact_order,
            settings=Settings(stable=arguments.stable or arguments.output_error),
        ),
        largest=arguments.max_order,
        criterion=arguments.criterion,
        cross_validate=asked.order == "auto",
        name="linear" if whole else f"linear-{outputs[rows[0]].name}",
    )


def _content(
    arguments: argparse.Namespace,
    asked: _Asked,
    logs: tuple[Logs, Logs | None],
    results: Sequence[Identified],
) -> LinearDocument:
    """What fit.json holds."""
    train, test = logs

    def channels(of: Sequence[ChannelSpec]) -> list[ChannelRow]:
        return [
            {"name": s.name, "unit": s.signal.unit, "terms": [list(t) for t in s.terms]} for s in of
        ]

    def flights(of: Logs | None) -> list[LogRow]:
        return [] if of is None else [{"name": f.name, "sha256": f.sha256} for f in of.flights]

    return {
        "schema": "greybox.linear_fit/1",
        "command": typed("linear"),
        "sample_time": train.dt,
        "inputs": channels(asked.inputs),
        "outputs": channels(asked.outputs),
        "train": flights(train),
        "test": flights(test),
        "siso": bool(arguments.siso),
        "models": [r.to_dict() for r in results],
        "warnings": [w for r in results for w in r.fit.warnings],
        "notes": list(train.notes) + ([] if test is None else list(test.notes)),
    }


def _write(
    out: Path,
    content: LinearDocument,
    results: Sequence[Identified],
    test: Logs | None,
) -> str:
    """Writes fit.json, model.json and report.html; returns their names."""
    from greybox.files import write_atomic, write_json
    from greybox.report.linear_report import linear_report

    html = linear_report(content, results, () if test is None else test.records)
    models = [r.fit.model.to_dict() for r in results]
    write_json(out / "fit.json", content)
    write_json(
        out / "model.json",
        models[0] if len(models) == 1 else {"schema": "greybox.linear_models/1", "models": models},
    )
    write_atomic(out / "report.html", html)
    return f"{out / 'fit.json'}, {out / 'model.json'}, {out / 'report.html'}"


def _whole_numbers(text: str, what: str, least: int) -> list[int]:
    from greybox.errors import DataError

    try:
        values = [int(v) for v in text.split(",") if v.strip()]
    except ValueError:
        values = []
    if not values or min(values) < least:
        raise DataError(f"{what} '{text}'", expected=f"whole numbers >= {least}")
    return values


def _delays(text: str, count: int) -> list[int] | str:
    from greybox.errors import DataError

    if text == "auto":
        return "auto"
    values = _whole_numbers(text, "--delay", 0)
    if len(values) == 1:
        values = values * count
    if len(values) != count:
        raise DataError(
            f"--delay gives {len(values)} numbers for {count} inputs",
            expected="one, or one per input",
        )
    return values
