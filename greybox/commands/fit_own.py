"""`greybox fit --model-file own.py:build`: fit a model of the user's own, judge it, report."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from greybox.commands.command_line import typed
from greybox.commands.console import Console

if TYPE_CHECKING:
    from greybox.data import Dataset
    from greybox.estimation.document import FitDocument
    from greybox.estimation.result import Fit
    from greybox.validation.options import HorizonChoices
    from greybox.validation.result import Validation

COMMAND = "command.sh"
"""The explicit command of a fit that was decided, as a script."""
RESULTS = ("report.html", "validate.json", "fit.json", "model.json", COMMAND)
"""Files of the command."""
OF_VEHICLES: dict[str, object] = {
    "effects": None,
    "effects_file": [],
    "kinematic_noise": None,
    "keep_impossible": False,
    "keep_noise_free": False,
    "all_flights": False,
    "accept": "",
}
"""Options that only a vehicle has, with the value that says nothing."""


def run(arguments: argparse.Namespace) -> int:
    """Read, fit, validate, report. Returns 1 where the model is not usable or did not converge."""
    from greybox.commands.judgement import exit_code, given_horizons
    from greybox.commands.mcap_option import write_if_asked
    from greybox.commands.model_options import fit_options
    from greybox.commands.own_model import read_flights_of
    from greybox.data.halves import demand_disjoint
    from greybox.errors import GreyboxError
    from greybox.estimation.fit import fit
    from greybox.estimation.record import sample_time
    from greybox.estimation.status import Interrupted
    from greybox.files import withdraw, write_atomic, write_json
    from greybox.model.own_model import load_own_model
    from greybox.model.verdict import UNFINISHED

    _refuse_vehicles(arguments)
    console = Console.of(arguments)
    horizons = given_horizons(arguments, own=True)
    model = load_own_model(arguments.model_file)
    train = read_flights_of(arguments, model, arguments.train, rate=arguments.rate)
    test = read_flights_of(arguments, model, arguments.test, rate=1 / sample_time(train))
    demand_disjoint(train.files, test.files)
    out = Path(arguments.out)

    try:
        found = fit(model, train, fit_options(arguments), progress=console.solver)
    except Interrupted as stop:
        withdraw(out, *RESULTS)
        _save(stop.kept.judged(UNFINISHED), [], out)
        arguments.kept = f"{interrupted(out)}; the same command starts again"
        raise
    warnings = (
        [] if test.flights else ["validated on the flights that were fitted: give --test flights"]
    )
    withdraw(out, *RESULTS)
    # The fit is safe before anything else can go wrong.
    _save(found.judged(UNFINISHED), warnings, out)
    seen: Validation | None = None
    try:
        seen = _judged(found, test if test.flights else train, arguments.adapt, horizons)
        found = found.judged(seen.verdict)
        write_json(out / "validate.json", seen.to_dict())
    except GreyboxError as error:
        warnings.insert(0, f"no validation: {error}")
    content = _save(found, warnings, out)
    title = f"Fit of {model.name}"
    write_atomic(out / "report.html", _page(found, content, seen, train, test, title))
    write_if_asked(arguments.mcap, found.model, train, test)
    table = [seen.table_text()] if seen is not None and seen.tables else []
    written = (
        f"wrote {', '.join(p.name for p in sorted(out.glob('*.json')))} and report.html in {out}"
    )
    console.result(content, found.summary(), *(f"warning: {w}" for w in warnings), *table, written)
    return exit_code(found.verdict) if found.verdict is not None or found.converged else 1


def interrupted(out: Path) -> str:
    """What an interrupted fit has left in `out`, in words."""
    return (
        f"the best values so far are in {out / 'fit.json'} and {out / 'model.json'}, marked as not "
        "converged"
    )


def _refuse_vehicles(arguments: argparse.Namespace) -> None:
    from greybox.errors import GreyboxError

    for name, silent in OF_VEHICLES.items():
        if getattr(arguments, name) != silent:
            raise GreyboxError(
                f"--{name.replace('_', '-')} is for vehicles",
                got="--model-file",
                fix="leave it out",
            )


def _save(found: Fit, warnings: list[str], out: Path) -> FitDocument:
    """Write fit.json and model.json; the content of the first."""
    from greybox.files import write_json

    content: FitDocument = {**found.to_dict(), "command": typed("fit")}
    content["warnings"] = [*warnings, *content["warnings"]]
    write_json(out / "fit.json", content)
    found.model.save(out / "model.json")
    return content


def _page(
    found: Fit,
    content: FitDocument,
    seen: Validation | None,
    train: Dataset,
    test: Dataset,
    title: str,
) -> str:
    from greybox.commands.flight_series import series
    from greybox.commands.responses import responses
    from greybox.report.fit_report import fit_report

    return fit_report(
        content,
        series(found.model, train, test),
        None if seen is None else seen.to_dict(),
        responses=responses(found.model, train, test),
        title=title,
    )


def _judged(found: Fit, data: Dataset, adapt: float | None, horizons: HorizonChoices) -> Validation:
    from greybox.validation.advice import Hint, Symptom
    from greybox.validation.validate import validate

    bound = [n for n, e in found.parameters.items() if e.at_bound]
    hints = [] if found.converged else [Hint(symptom=Symptom.NOT_CONVERGED)]
    hints += (
        [Hint(symptom=Symptom.OWN_OUTPUT, detail=f"{', '.join(bound)} at a bound")] if bound else []
    )
    return validate(found.model, data, **horizons, adapt=adapt, hints=hints)
