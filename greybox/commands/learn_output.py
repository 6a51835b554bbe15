"""`greybox learn LINEAR_MODEL.json`: the output residual of a linear model, the paper's hybrid."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.commands.command_line import typed
from greybox.commands.console import Console

if TYPE_CHECKING:
    from greybox.baselines.compare_scores import StepScores
    from greybox.baselines.document import OutputDocument
    from greybox.baselines.output_residual import OutputHybrid
    from greybox.data import Dataset
    from greybox.linear.logs import ChannelSpec
    from greybox.model.vehicle import Vehicle

RESULTS = ("report.html", "learn.json", "hybrid.json")
"""Files of the command."""
GREW = 1.01
"""Ratio of a squared error to that of the model alone above which it is called worse."""


def is_linear(path: str) -> bool:
    """Whether a file is one that `greybox linear` wrote."""
    from greybox.baselines.output_residual import LINEAR_SCHEMAS
    from greybox.files import read_json

    return read_json(path).get("schema") in LINEAR_SCHEMAS


def run_output(arguments: argparse.Namespace) -> int:
    """Read the linear model and the logs, learn its one-step errors, judge before and after,
    report."""
    from greybox.baselines.decoupled import combined
    from greybox.baselines.output_residual import fit_output_residual, read_linear
    from greybox.commands.judgement import given_horizons, horizon_steps
    from greybox.data import Dataset
    from greybox.data.halves import demand_disjoint
    from greybox.model.vehicle import read_vehicle

    console = Console.of(arguments)
    given_horizons(arguments)  # what is wrong with them is said before logs are read
    models, inputs, outputs, trained_on = read_linear(arguments.model, channels=arguments.channels)
    vehicle = read_vehicle(arguments.vehicle) if arguments.vehicle else None
    horizons = horizon_steps(arguments, models[0].dt)

    def flights(paths: Sequence[str]) -> Dataset:
        return _flights(paths, inputs, outputs, vehicle, 1.0 / models[0].dt, arguments.mapping)

    train = flights(arguments.train)
    test = flights(arguments.test) if arguments.test else Dataset(flights=())
    demand_disjoint(train.files, test.files)
    base, channels = combined(models, {s.name: s.terms for s in inputs})
    hybrid = fit_output_residual(
        base,
        train,
        channels=channels,
        features=feature_names(arguments.inputs),
        kernel=arguments.kernel,
        points=arguments.points if arguments.points == "auto" else int(arguments.points),
        adapt=arguments.adapt or None,
        learner=arguments.learner,
        seed=arguments.seed,
        guard=arguments.guard,
        progress=console.share,
    )
    warnings = _warnings(hybrid, trained_on, train, test)
    _judge_and_report(arguments, console, hybrid, train, test, horizons, warnings)
    return 0


def _judge_and_report(
    arguments: argparse.Namespace,
    console: Console,
    hybrid: OutputHybrid,
    train: Dataset,
    test: Dataset,
    horizons: Sequence[int],
    warnings: list[str],
) -> None:
    """Write what was learned, judge it, write that."""
    import numpy as np

    from greybox.baselines.output_judge import judge
    from greybox.errors import GreyboxError
    from greybox.files import withdraw, write_atomic, write_json
    from greybox.report.output_report import output_report

    out = Path(arguments.out)
    withdraw(out, *RESULTS)
    hybrid.save(out / "hybrid.json")
    spread = np.nanstd(np.concatenate([s.matrix(hybrid.outputs) for s in train.segments]), axis=0)
    judged = test if test.flights else train
    content = _content(arguments, hybrid, train, judged, warnings)
    write_json(out / "learn.json", content)
    console.share("validate", 1.0)
    try:
        content["validation"] = checked = judge(hybrid, judged, spread=spread, horizons=horizons)
        if test.flights:
            warnings.extend(_worse(checked["before"]["one_step"], checked["after"]["one_step"]))
    except GreyboxError as error:
        warnings.append(f"no validation: {error}")
    write_json(out / "learn.json", content)
    report = write_atomic(out / "report.html", output_report(content))
    console.result(
        content,
        *(f"warning: {w}" for w in warnings),
        _summary(content),
        f"wrote hybrid.json, learn.json and {report.name} in {out}",
    )


def feature_names(text: str | None) -> tuple[str, ...] | None:
    """The features of --inputs; None: the usual ones."""
    return tuple(n.strip() for n in text.split(",") if n.strip()) if text else None


def _warnings(
    hybrid: OutputHybrid, trained_on: Sequence[str], train: Dataset, test: Dataset
) -> list[str]:
    """What training said, and which flights were not given."""
    warnings = list(hybrid.report["training"].get("warnings", []))
    unseen = sorted(set(trained_on) - set(train.names))
    if unseen:
        warnings.append(f"the model was also fitted to {', '.join(unseen)}, which were not given")
    if not test.flights:
        warnings.append("validated on the flights that were learned from: give --test flights")
    return warnings


def _worse(before: StepScores, after: StepScores) -> list[str]:
    """Which channels are foretold worse one step ahead with what was learned."""
    pairs = [(n, before["channels"][n]["mse"], e) for n, e in after["channels"].items()]
    return [
        f"{n} is worse one step ahead on the test flights with what was learned (RMSE "
        f"{old**0.5:.4g} -> {new['mse'] ** 0.5:.4g} {new['unit']}): keep the linear model, or learn "
        "from flights like these"
        for n, old, new in pairs
        if new["mse"] > GREW * old
    ]


def _content(
    arguments: argparse.Namespace,
    hybrid: OutputHybrid,
    train: Dataset,
    judged: Dataset,
    warnings: list[str],
) -> OutputDocument:
    """learn.json without its validation, schema "greybox.output_residual/1"."""
    from greybox.model.identified import library_versions
    from greybox.residual.learners import GP

    return {
        "schema": "greybox.output_residual/1",
        "kind": "output",
        "command": typed("learn"),
        "model": hybrid.name,
        "features": list(hybrid.features),
        "outputs": [
            {"name": n, "unit": s.unit, "learned": active}
            for n, s, active in zip(
                hybrid.outputs, hybrid.posterior.outputs, hybrid.posterior.active, strict=True
            )
        ],
        "null": not any(hybrid.posterior.active),
        "learner": str(hybrid.report["settings"]["learner"]),
        "kernel": arguments.kernel if arguments.learner == GP else None,
        "points": hybrid.posterior.points,
        "adapt": arguments.adapt,
        "parameters": hybrid.parameters,
        "seconds": hybrid.train_seconds,
        "seed": arguments.seed,
        "samples": hybrid.report["samples"],
        "training": hybrid.report["training"],
        "trained_on": list(train.names),
        "judged_on": list(judged.names),
        "data_hash": train.hash,
        "validation": None,
        "warnings": warnings,
        "versions": library_versions(),
    }


def _flights(
    paths: Sequence[str],
    inputs: Sequence[ChannelSpec],
    outputs: Sequence[ChannelSpec],
    vehicle: Vehicle | None,
    rate: float,
    mapping: str | None,
) -> Dataset:
    """The logs as flights that hold every output under its name."""
    from greybox.data import Dataset
    from greybox.errors import DataError, UnknownNameError
    from greybox.linear.logs import read_records

    try:
        found = read_records(paths, inputs, outputs, vehicle, rate=rate, mapping=mapping)
    except UnknownNameError as error:
        if vehicle is not None:
            raise
        wanted = ", ".join(dict.fromkeys(c for s in (*inputs, *outputs) for _, c in s.terms))
        raise DataError(
            f"the log lacks columns of the model: {str(error).partition('. Usual fix')[0]}",
            expected=wanted,
            fix="--vehicle V.toml, where the model was fitted with a vehicle file that names the "
            "columns",
        ) from None
    flights = []
    for flight in found.flights:
        segments = tuple(
            s.replace({o.name: sum(w * s.column(c) for w, c in o.terms) for o in outputs})
            for s in flight.segments
        )
        flights.append(replace(flight, segments=segments))
    return Dataset(flights=tuple(flights))


def _summary(content: OutputDocument) -> str:
    learned = [o["name"] for o in content["outputs"] if o["learned"]]
    lines = [
        f"learned the one-step errors of {', '.join(learned)} from {', '.join(content['features'])}"
        if learned
        else "nothing was learned: held-out flights do not prefer a learned part to the model alone"
    ]
    checked = content["validation"]
    if checked:
        for name, new in checked["after"]["one_step"]["channels"].items():
            old = checked["before"]["one_step"]["channels"][name]
            lines.append(
                f"  {name}: RMSE {old['mse'] ** 0.5:.4g} -> {new['mse'] ** 0.5:.4g} {new['unit']}, "
                f"NLPD {old['nlpd']:.3f} -> {new['nlpd']:.3f}, {new['coverage95']:.1%} inside 95 %"
            )
    return "\n".join(lines)
