"""`greybox linear`: from logs to a linear state-space model in innovation form, with error bars and a report."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path
from typing import Any

from greybox.commands.console import Console, json_option
from greybox.commands.judgement import given_horizons, horizon_options, horizon_steps


def add(subparsers: Any) -> None:
    """Declare the command."""
    p = subparsers.add_parser(
        "linear",
        help="identify a linear state-space model",
        description="Identify x+ = A x + B u + K e, y = C x + D u + e from logs by subspace start and prediction error "
        "polish. Any CSV with a time column `t` works; a vehicle file is only needed for its column names. A channel is a "
        "column, or a sum of columns: 'roll=u4+u3-u2-u1'. Writes fit.json, model.json and report.html. Exit code 0: "
        "converged, 1: not converged, 2: bad input.",
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


def run(arguments: argparse.Namespace) -> int:
    """Read, identify, validate, report. Returns 0, or 1 where a fit did not converge."""
    from greybox.errors import DataError
    from greybox.files import write_atomic, write_json
    from greybox.linear.logs import parse_channels, read_records
    from greybox.linear.validation import Identified, validate_linear
    from greybox.model.vehicle import read_vehicle
    from greybox.report.linear_report import linear_report

    console = Console.of(arguments)
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
    given_horizons(arguments)  # what is wrong with them is said before logs are read
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
    delays = _delays(arguments.delay, len(inputs))
    if arguments.max_order < 1:
        raise DataError(f"--max-order {arguments.max_order}", expected="at least 1")
    vehicle = read_vehicle(arguments.vehicle) if arguments.vehicle else None
    train = read_records(
        arguments.train,
        inputs,
        outputs,
        vehicle,
        rate=arguments.rate,
        bridge=0,
        mapping=arguments.mapping,
    )
    test = (
        read_records(
            arguments.test, inputs, outputs, vehicle, rate=arguments.rate, mapping=arguments.mapping
        )
        if arguments.test
        else None
    )
    if test is not None:
        if abs(test.dt - train.dt) > 1e-6 * train.dt:
            raise DataError(
                f"test logs have sample time {test.dt:g} s",
                expected=f"{train.dt:g} s",
                fix="--rate",
            )
        same = sorted({f.sha256 for f in train.flights} & {f.sha256 for f in test.flights} - {""})
        if same:
            twice = next(f.name for f in test.flights if f.sha256 == same[0])
            raise DataError(
                f"log '{twice}' is both train and test", fix="give every log to one of the two"
            )
    groups = (
        [((i,), (i,)) for i in range(len(outputs))]
        if arguments.siso
        else [(tuple(range(len(inputs))), tuple(range(len(outputs))))]
    )
    horizons = horizon_steps(arguments, train.dt)
    results: list[Identified] = []
    for columns, rows in groups:
        fit = _fit(arguments, train, inputs, outputs, columns, rows, order, delays)
        if not console.quiet:
            said = [
                fit.model.name,
                fit.summary(),
                *([] if fit.order_choice is None else [fit.order_choice.format()]),
            ]
            # In one piece: an interrupt between a text and its end of line would leave half a line.
            print("\n".join([*said, ""]), end="")
        intervals = _intervals(fit, train.records, columns, rows) if arguments.profile else ()
        results.append(
            validate_linear(
                fit,
                train.records,
                () if test is None else test.records,
                columns,
                rows,
                horizons=horizons,
                adapt_seconds=arguments.adapt,
                feedback=not arguments.open_loop,
                intervals=intervals,
            )
        )
    out = Path(arguments.out)
    command = "greybox linear " + " ".join(shlex.quote(a) for a in _shown(arguments))
    content: dict[str, Any] = {
        "schema": "greybox.linear_fit/1",
        "command": command,
        "sample_time": train.dt,
        "inputs": [
            {"name": s.name, "unit": s.signal.unit, "terms": [list(t) for t in s.terms]}
            for s in inputs
        ],
        "outputs": [
            {"name": s.name, "unit": s.signal.unit, "terms": [list(t) for t in s.terms]}
            for s in outputs
        ],
        "train": [{"name": f.name, "sha256": f.sha256} for f in train.flights],
        "test": []
        if test is None
        else [{"name": f.name, "sha256": f.sha256} for f in test.flights],
        "siso": bool(arguments.siso),
        "models": [r.to_dict() for r in results],
        "warnings": [w for r in results for w in r.fit.warnings],
        "notes": list(train.notes) + ([] if test is None else list(test.notes)),
    }
    html = linear_report(content, results, train.records, () if test is None else test.records)
    models = [r.fit.model.to_dict() for r in results]
    write_json(out / "fit.json", content)
    write_json(
        out / "model.json",
        models[0] if len(models) == 1 else {"schema": "greybox.linear_models/1", "models": models},
    )
    write_atomic(out / "report.html", html)
    console.result(
        content,
        *(r.format() for r in results),
        *(f"note: {n}" for n in content["notes"]),
        f"wrote {out / 'fit.json'}, {out / 'model.json'}, {out / 'report.html'}",
    )
    bad = [r.fit.model.name for r in results if not r.fit.converged]
    if bad:
        print(f"not converged: {', '.join(bad)}", file=sys.stderr)
    return 1 if bad else 0


def _fit(
    arguments: argparse.Namespace,
    train: Any,
    inputs: Any,
    outputs: Any,
    columns: tuple[int, ...],
    rows: tuple[int, ...],
    order: int | str,
    delays: list[int] | str,
) -> Any:
    from greybox.linear.fit import Options, Record, Settings, fit_linear

    records = [
        Record(u=r.u[:, list(columns)], y=r.y[:, list(rows)], name=r.name) for r in train.records
    ]
    methods: Any = ("cva", "ssarx") if arguments.open_loop else ("ssarx", "pbsid")
    options = Options(
        noise_model=not arguments.output_error,
        feedthrough=arguments.feedthrough,
        methods=methods,
        exact_order=arguments.exact_order,
        settings=Settings(stable=arguments.stable or arguments.output_error),
    )
    name = (
        "linear"
        if len(rows) == len(outputs) and not arguments.siso
        else f"linear-{outputs[rows[0]].name}"
    )
    return fit_linear(
        records,
        order,
        dt=train.dt,
        inputs=[inputs[i].signal for i in columns],
        outputs=[outputs[i].signal for i in rows],
        delays=delays if isinstance(delays, str) else [delays[i] for i in columns],
        options=options,
        largest=arguments.max_order,
        criterion=arguments.criterion,
        cross_validate=order == "auto",
        name=name,
    )


def _intervals(
    fit: Any, records: Any, columns: tuple[int, ...], rows: tuple[int, ...]
) -> tuple[Any, ...]:
    """Profile likelihood intervals of every pole: real part, and imaginary part of the complex ones above the axis."""
    from greybox.linear.fit import Record
    from greybox.linear.pole_profile import pole_profile

    own = [Record(u=r.u[:, list(columns)], y=r.y[:, list(rows)], name=r.name) for r in records]
    profile = pole_profile(fit, own)
    out = []
    for i, pole in enumerate(fit.uncertainty.poles().value):
        if pole.imag >= 0:
            out.append(profile.interval(i, "real"))
        if pole.imag > 0:
            out.append(profile.interval(i, "imag"))
    return tuple(out)


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


def _shown(arguments: argparse.Namespace) -> list[str]:
    """The options of this run as they would be typed, for the report."""
    out: list[str] = []
    for key in ("train", "test"):
        if getattr(arguments, key):
            out += [f"--{key}", *getattr(arguments, key)]
    for key in (
        "inputs",
        "outputs",
        "order",
        "max_order",
        "criterion",
        "delay",
        "vehicle",
        "rate",
        "adapt",
        "horizons",
        "out",
    ):
        value = getattr(arguments, key)
        if value is not None:
            out += [f"--{key.replace('_', '-')}", str(value)]
    for key in (
        "exact_order",
        "siso",
        "feedthrough",
        "output_error",
        "stable",
        "open_loop",
        "profile",
    ):
        if getattr(arguments, key):
            out.append(f"--{key.replace('_', '-')}")
    return out
