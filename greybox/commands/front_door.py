"""In Python what some commands do: read a file of any kind, export, compare methods, profile an
unknown, a frequency response."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from greybox.baselines.compare_options import CompareChoices, CompareOptions
from greybox.estimation.options import says_choices
from greybox.progress import in_notebooks
from greybox.takes import (
    FIT,
    FLIGHTS,
    FUNCTION,
    NAMES,
    NUMBERS,
    OWN_EFFECTS,
    OWN_SENSORS,
    PATH,
    RESPONDING,
    SHARE,
    TEXT,
    VEHICLE,
    numbers_of,
    takes,
)

if TYPE_CHECKING:
    from greybox.baselines.document import CompareDocument
    from greybox.baselines.output_residual import OutputHybrid
    from greybox.data import Dataset
    from greybox.data.airframe import Airframe
    from greybox.estimation.profile import Profile
    from greybox.estimation.result import Fit
    from greybox.linear.frf_result import FrequencyResponse
    from greybox.model.effect import Effect
    from greybox.model.identified import IdentifiedModel
    from greybox.model.linear import LinearModel
    from greybox.model.sensor import Sensor
    from greybox.model.vehicle import Vehicle
    from mpc_export.options import ExportChoices


@takes(path=PATH, effects=OWN_EFFECTS, sensors=OWN_SENSORS)
def load(
    path: str | os.PathLike[str], *, effects: Iterable[Effect] = (), sensors: Iterable[Sensor] = ()
) -> IdentifiedModel | LinearModel | OutputHybrid:
    """Read a model file of any kind: of `fit`, `learn`, `discover` (`IdentifiedModel`), of `linear`
    (`LinearModel`; decoupled ones as one, block by block), of `learn` on a linear model
    (`OutputHybrid`).

    `effects` and `sensors` are those of the user's own (`load_effects`). Raises `FileFormatError`,
    `UnknownNameError`.
    """
    from greybox.baselines.decoupled import combined
    from greybox.baselines.output_residual import KIND, LINEAR_SCHEMAS, OutputHybrid, read_linear
    from greybox.files import read_json
    from greybox.residual.files import load_model

    data = read_json(path)
    if data.get("schema") in LINEAR_SCHEMAS:
        return combined(read_linear(path)[0], {})[0]
    if data.get("kind") == KIND:
        return OutputHybrid.load(path, effects=effects)
    return load_model(path, effects=effects, sensors=sensors)


@takes(folder=PATH)
def export(
    model: IdentifiedModel | LinearModel,
    folder: str | os.PathLike[str],
    **choices: Unpack[ExportChoices],
) -> Path:
    """Write a fitted model to `folder` for a controller, as `greybox export` does; returns the
    folder.

    The keywords (`targets`, C and CasADi where it is not said, `name`, `dt`, `real`, `with_`,
    `runtime_parameters`, `points`, `even_so`, ...) are those of `mpc_export.bundle.write_bundle`,
    which says what they mean and what is raised. A model that was judged NOT USABLE is refused
    (`ModelError`); `even_so=True` overrules.
    """
    from mpc_export.bundle import write_bundle

    return write_bundle(model, folder, **choices).folder


@in_notebooks(say="say")
@says_choices(CompareOptions)
@takes(vehicle=VEHICLE, train=FLIGHTS, test=FLIGHTS, methods=NAMES, accept=NAMES)
@takes(fit=FUNCTION, say=FUNCTION)
def compare(
    vehicle: Vehicle,
    train: Dataset,
    test: Dataset,
    options: CompareOptions | None = None,
    *,
    methods: Sequence[str] | None = None,
    fit: Callable[[], Fit] | None = None,
    accept: Iterable[str] = (),
    say: Callable[[str], None] = lambda text: None,
    **choices: Unpack[CompareChoices],
) -> CompareDocument:
    """Run methods on the same flights and judge them on the same samples, as `greybox compare`
    does.

    The choices are keywords, fields of `CompareOptions` with its defaults, or `options` as a whole.
    `fit` makes the nonlinear model (default: `gb.fit(vehicle, train)`), `adapt` are seconds at the
    start of a test flight, `budget` the candidates of every method that is tuned, `horizons`
    samples. Findings of the checks named in `accept` do not block. Returns the content of
    compare.json; a method that fails has its error in its row. Raises `UnknownNameError`,
    `DataError` (`BadDataError` for faults that block).
    """
    from greybox.automatic import fit as automatic
    from greybox.baselines.compare import compare as run
    from greybox.baselines.compare_bench import Bench
    from greybox.data import Dataset
    from greybox.data.halves import demand_disjoint
    from greybox.model.faults import demand_sound, faults_of

    accept, train, test = tuple(accept), Dataset.of(train), Dataset.of(test)
    demand_disjoint(train.files, test.files)
    both = train + test
    demand_sound(faults_of(vehicle, both, accept=accept), "a comparison")
    bench = Bench(
        vehicle=vehicle,
        train=train,
        test=test,
        fit=lambda: (fit() if fit else automatic(vehicle, train, accept=accept)).model,
        options=CompareOptions.of(options, choices),
        say=say,
    )
    return list(run(bench, methods))[-1]


@takes(fit=FIT, name=TEXT, flight=TEXT, grid=NUMBERS, level=SHARE)
def profile(
    fit: Fit,
    name: str,
    *,
    flight: str | None = None,
    grid: Sequence[float] | None = None,
    level: float = 0.95,
) -> Profile:
    """The profile likelihood of one estimated number of a fit: the others re-optimised along a
    grid.

    `name` is a parameter or a noise level ("noise.sensor.p"), `flight` the flight where each has
    its own value. The interval at `level` ends where the likelihood ratio says so; the
    standard error of the fit tells how much that ratio is worth. An end is the bound where the
    profile reaches that first, and infinite where the data do not end it. Raises `UnknownNameError`, and
    `ModelError` for the fit of a model with a learned part.
    """
    from greybox.estimation.profile import profile as along
    from greybox.estimation.solvers import SOLVERS
    from greybox.model.known import demand_known

    demand_known(fit.model)
    solver = SOLVERS[str(fit.settings["solver"])]()
    error = _error_of(fit, name, flight)
    given = fit.problem, solver, fit.theta, name
    return along(*given, flight=flight, grid=grid, level=level, error=error)


def _error_of(fit: Fit, name: str, flight: str | None) -> float:
    """Standard error of an estimated number, of a noise level that of its logarithm; 0 of another
    unknown."""
    if name in fit.noise:
        level, error, _ = fit.noise[name]
        return error / level
    found = fit.parameters.get(name)
    if found is None:
        return 0.0
    own = None if flight is None else found.per_flight.get(flight)
    return found.std if own is None else own[1]


@takes(data=FLIGHTS, inputs=NAMES, outputs=NAMES, references=NAMES, vehicle=VEHICLE)
@takes(band=numbers_of(2), model=RESPONDING)
def frf(
    data: Dataset,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    references: Sequence[str] = (),
    vehicle: Airframe | None = None,
    model: IdentifiedModel | LinearModel | None = None,
    band: tuple[float, float] | None = None,
    window: float | None = None,
) -> FrequencyResponse:
    """The frequency response of flights, without a model: magnitude, phase, coherence, 95 % bands,
    gain and lag.

    A channel is a column, a sum of columns ("a=u1+u2") or, with a `vehicle` (that of the `model`,
    where one is given), a mixed command: roll, pitch, yaw, thrust. Name all inputs that move at
    once: each response is that with the others held. `references` are signals that excite the loop
    from outside (set points, a chirp), at least as many as inputs: only what they explain counts,
    which is right where inputs are fed back. `band` [Hz] and `window` (the longest, [s]) are chosen
    where they are not given. The response of a `model` is put beside it. Raises `DataError` for
    flights that are too short and channels that do not move, `UnknownNameError`, `ModelError`.
    """
    from greybox.linear.frf import frf as measured

    return measured(
        data,
        inputs,
        outputs,
        references=references,
        vehicle=vehicle,
        model=model,
        band=band,
        window=window,
    )
