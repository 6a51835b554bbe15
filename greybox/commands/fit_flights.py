"""What `greybox fit` fits and judges: flights that are read, checked and prepared."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from greybox.automatic.fit import Prepared
    from greybox.data import Dataset
    from greybox.data.checks import CheckReport
    from greybox.data.raw import RawLog
    from greybox.model.identified import IdentifiedModel
    from greybox.model.vehicle import Vehicle
    from greybox.validation.options import HorizonChoices

from greybox.commands.console import Console
from greybox.commands.judgement import accepted, fault_lines, given_horizons


@dataclass(frozen=True, kw_only=True, eq=False)
class Job:
    """What is fitted and judged: training flights as they are fitted, test flights with what their
    checks said, and what is said of all of them in fit.json."""

    arguments: argparse.Namespace
    vehicle: Vehicle
    prepared: Prepared
    test: Dataset
    faults: CheckReport | None
    horizons: HorizonChoices
    warnings: tuple[Sequence[str], Sequence[str]]
    source: IdentifiedModel | None

    @property
    def out(self) -> Path:
        """Folder for the results."""
        return Path(self.arguments.out)


def begun(arguments: argparse.Namespace, vehicle: Vehicle, console: Console) -> Job:
    """What is to be fitted and judged. Raises `BadDataError` where a fault of the vehicle file or
    of all flights blocks."""
    from greybox.commands.model_options import fitted_model
    from greybox.data.checks import check
    from greybox.model.faults import demand_sound, faults_of

    horizons, accept = given_horizons(arguments), accepted(arguments.accept)
    source = fitted_model(arguments, arguments.source)
    demand_sound(faults_of(vehicle, accept=accept, file=arguments.vehicle), "a fit")
    prepared, test, files = _flights(arguments, vehicle)
    if source is not None and arguments.manual:
        vehicle = _like(source, vehicle, prepared, console)
    faults = check(test, vehicle, accept=accept) if test.flights else None
    return Job(
        arguments=arguments,
        vehicle=vehicle,
        prepared=prepared,
        test=test,
        faults=faults,
        horizons=horizons,
        warnings=_warnings(arguments, vehicle, (prepared.report, faults), files),
        source=source,
    )


def _flights(
    arguments: argparse.Namespace, vehicle: Vehicle
) -> tuple[Prepared, Dataset, list[CheckReport]]:
    """(training flights as they are fitted, test flights at their rate, what is wrong with the
    files of both). Raises `GreyboxError` for a flight in both."""
    from greybox.automatic.fit import prepare, read_flights
    from greybox.data import Dataset
    from greybox.data.checks import Checked
    from greybox.data.dataset import demand_names_once
    from greybox.data.halves import demand_disjoint
    from greybox.data.logs import read_possible
    from greybox.estimation.record import sample_time
    from greybox.model.noise_free import with_sensor_noise

    keep = bool(arguments.keep_impossible)

    def read(paths: Sequence[str]) -> list[RawLog]:
        return [
            read_possible(p, vehicle, mapping=arguments.mapping, keep_impossible=keep)
            for p in paths
        ]

    logs, others = read(arguments.train), read(arguments.test)
    demand_names_once([r.flight for r in logs])
    demand_disjoint(*([r.file for r in some] for some in (logs, others)))
    tested = Checked.of(others, vehicle, asked_again=True)
    prepared = prepare(
        vehicle,
        logs,
        rate=arguments.rate,
        keep_impossible=keep,
        all_flights=arguments.all_flights or arguments.manual,
        decide_rate=not arguments.manual,
        keep_noise_free=arguments.keep_noise_free,
        accept=accepted(arguments.accept),
        beside=tested,
    )
    files = [
        some.report(prepared.report.accepted)
        for some in (Checked.of(logs, vehicle), tested)
        if some.views
    ]
    if not others:
        return prepared, Dataset(flights=()), files
    test = read_flights(others, vehicle, rate=prepared.rate)
    dt = sample_time(prepared.data)
    if any(abs(f.dt - dt) > 1e-6 * dt for f in test):
        test = read_flights(others, vehicle, rate=1 / dt)
    if not arguments.keep_noise_free:
        test = with_sensor_noise(test, vehicle)[0]
    return prepared, test, files


def _like(
    source: IdentifiedModel, vehicle: Vehicle, prepared: Prepared, console: Console
) -> Vehicle:
    """The vehicle with the effects of the model that --from names."""
    from greybox.automatic.facts import facts_of
    from greybox.automatic.like import like

    found = like(vehicle, source, facts_of(prepared.data, vehicle, prepared.report))
    new = [n for n in found.effects if n not in vehicle.effects]
    console.say(f"taken from {source.name}: {', '.join(new) or 'nothing new'}")
    return found


def _warnings(
    arguments: argparse.Namespace,
    vehicle: Vehicle,
    flights: Sequence[CheckReport | None],
    files: Sequence[CheckReport],
) -> tuple[list[str], list[str]]:
    """(faults of the flights and of their files and what no model can be fitted to, what the files
    warn of), which are also said. Files show what reading takes out."""
    reports = [r for r in (*flights, *files) if r is not None]
    blocking = [line for r in reports for line in (*fault_lines(r), *r.accepted_lines())]
    first = [*dict.fromkeys(blocking), *_unfit(arguments, vehicle)]
    lines = [line for r in files for line in r.warning_lines()]
    for warning in (*first, *(f"warning: {line}" for line in lines)):
        print(f"greybox fit: {warning}", file=sys.stderr)
    return first, lines


def _unfit(arguments: argparse.Namespace, vehicle: Vehicle) -> list[str]:
    """What `greybox inspect` says first of training logs that no model can be fitted to, and of
    those too slow to tell all of it, before anything is estimated.

    Reads the logs once more: what was read for the fit has not the rates of the log's own streams.
    """
    from greybox.data.inspection import inspect_log

    found = [(p, inspect_log(p, vehicle, mapping=arguments.mapping)) for p in arguments.train]
    slow = [f"{path}: {line}" for path, log in found for line in log.untold]
    return [
        f"greybox inspect calls {path} not usable: {'; '.join(log.unfit)}"
        for path, log in found
        if log.unfit
    ] + slow
