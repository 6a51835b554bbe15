"""fit: a vehicle or a model and flights in, a judged fit out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Unpack

from greybox.automatic.borrow import decide_for
from greybox.automatic.fit import Prepared, fit_decided, prepare
from greybox.automatic.judged import judged
from greybox.automatic.lasting import with_lasting
from greybox.automatic.setting import Given
from greybox.automatic.trials import Say
from greybox.automatic.wanted import with_rivals
from greybox.data import Dataset, Flight
from greybox.data.checks import Checked
from greybox.data.halves import demand_disjoint
from greybox.errors import DataError, GreyboxError, ModelError
from greybox.estimation.fit import fit as explicit_fit
from greybox.estimation.options import FitChoices, FitOptions, says_choices
from greybox.estimation.record import sample_time
from greybox.estimation.result import Fit
from greybox.estimation.solver import Progress
from greybox.model.dynamics import Dynamics
from greybox.model.faults import demand_sound, faults_of
from greybox.model.identified import IdentifiedModel
from greybox.model.known import demand_known
from greybox.model.vehicle import Vehicle
from greybox.progress import in_notebooks
from greybox.takes import FLIGHTS, FUNCTION, MODEL, NAMES, SUBJECT, takes
from greybox.validation.calibration import calibrated
from greybox.validation.validate import validate


def _quiet(text: str) -> None:
    pass


@in_notebooks(progress="solver", say="say")
@says_choices(FitOptions)
@takes(subject=SUBJECT, data=FLIGHTS, test=FLIGHTS, source=MODEL, accept=NAMES)
@takes(progress=FUNCTION, say=FUNCTION)
def fit(
    subject: Vehicle | Dynamics,
    data: Dataset | Flight,
    options: FitOptions | None = None,
    *,
    test: Dataset | Flight | None = None,
    source: IdentifiedModel | None = None,
    accept: Iterable[str] = (),
    progress: Progress | None = None,
    say: Callable[[str], None] = _quiet,
    **choices: Unpack[FitChoices],
) -> Fit:
    """Fit a vehicle or a model to flights.

    A `Vehicle`: everything that no keyword says is decided from the flights (as plain `greybox fit`
    does), and the result is judged on `test`, or on pieces of `data` that were left out. `say` gets
    a line per decision; `source` is a model of a craft like this one, whose effects are where these
    begin (`greybox fit --from`). Flights with a fault that blocks (`gb.check`) do not take part;
    those of the checks named in `accept` ("motors", "vehicle", ...) do not block. A model
    (`build_model`, `StateSpaceModel`): exactly the fit that `options` and the keywords describe,
    nothing is decided or checked; it is judged on `test` where there is any.

    The choices are keywords, fields of `FitOptions` with its defaults: predictor, criterion,
    solver, initialisation, disturbance, noise_parts, free, fixed, considered, per_flight, shared,
    values, priors, flight_priors, noise, estimate_noise, estimate_initial, seed, starts, build,
    use_compiler. Raises what `greybox.estimation.fit.fit` raises, and `ModelError` for a `source`
    that was not finished or has a learned part. Raises `BadDataError` where the vehicle or all
    flights have faults that block, `DataError` for a flight that is both to train and to test.
    """
    demand_known(source)
    data = Dataset.of(data)
    held_out = Dataset(flights=(test,)) if isinstance(test, Flight) else test
    demand_disjoint(data.files, () if held_out is None else held_out.files)
    if isinstance(subject, Vehicle):
        said: FitChoices = (
            choices if options is None else {**_said(FitOptions.of(options, {})), **choices}
        )
        given = Given(choices=said, source=source)
        return _automatic(subject, data, held_out, given, tuple(accept), say, progress)
    if source is not None:
        raise ModelError(
            "source is where the effects of a vehicle's automatic fit begin",
            got="a model, whose effects are decided",
            fix="fit(vehicle, ..., source=...), or values= and priors=",
        )
    return _explicit(subject, data, held_out, FitOptions.of(options, choices), say, progress)


def _explicit(
    model: Dynamics,
    data: Dataset,
    test: Dataset | None,
    options: FitOptions,
    say: Say,
    progress: Progress | None,
) -> Fit:
    """The fit that the options describe, judged on the `test` flights."""
    if test is None or not len(test):
        return explicit_fit(model, data, options, progress=progress)
    dt, other = sample_time(data), sample_time(test)
    if abs(other - dt) > 1e-6 * dt:
        raise DataError(
            f"test flights are sampled every {other:g} s",
            expected=f"{dt:g} s, as those of the fit",
            fix=f"read them with rate={1 / dt:g}",
        )
    found = explicit_fit(model, data, options, progress=progress)
    try:
        return found.judged(validate(found.model, test).verdict)
    except GreyboxError as error:  # the fit is not lost: it was not judged, and says so
        say(f"not judged: {error}")
        return found.warned([f"not judged: {error}"])


def _said(options: FitOptions) -> FitChoices:
    plain = FitOptions()
    return {n: v for n, v in vars(options).items() if v != vars(plain)[n]}  # type: ignore[return-value]


def _automatic(
    vehicle: Vehicle,
    data: Dataset,
    test: Dataset | None,
    given: Given,
    accept: Sequence[str],
    say: Say,
    progress: Progress | None,
) -> Fit:
    FitOptions.of(None, given.choices)  # an unknown keyword is said before any work is done
    demand_sound(faults_of(vehicle, accept=accept), "a fit")
    beside = None if test is None else Checked.of(test, vehicle, asked_again=True)
    prepared = prepare(vehicle, data, accept=accept, beside=beside)
    unchecked = prepared.report.unchecked_order
    for line in (*prepared.report.accepted_lines(), *unchecked):
        say(line)
    found = fit_prepared(vehicle, prepared, given, say, progress).warned(unchecked)
    recipe = found.provenance.recipe
    assert recipe is not None
    held_out, reports = Dataset(flights=()), []
    try:
        if test is not None and len(test):
            dt = sample_time(prepared.data)
            rate = prepared.rate if all(abs(f.dt - dt) <= 1e-6 * dt for f in test) else 1 / dt
            tested = prepare(
                vehicle, test, rate=rate, all_flights=True, decide_rate=False, accept=accept
            )
            for fault in tested.report.blocking:
                say(f"data fault in {fault.flight}: {fault.message}")
            held_out, reports = tested.data, [tested.report]
        seen, _ = judged(
            found, prepared, recipe, held_out, reports=reports, left_out=not held_out.flights
        )
    except GreyboxError as error:  # the fit is not lost: it was not judged, and says so
        say(f"not judged: {error}")
        return found.warned([f"not judged: {error}"])
    return found.judged(seen.verdict)


def fit_prepared(
    vehicle: Vehicle,
    prepared: Prepared,
    given: Given,
    say: Say = _quiet,
    progress: Progress | None = None,
) -> Fit:
    """The automatic fit to flights that are prepared, with its errors, not judged yet. Raises
    `DataError`, `ModelError`, `FitError`."""
    vehicle, decided = decide_for(vehicle, prepared, given, say=say)
    found = fit_decided(vehicle, prepared, decided, say=say, progress=progress)
    found = with_lasting(with_rivals(found, prepared.data), prepared.data)
    return calibrated(found, prepared.data)
