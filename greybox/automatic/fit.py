"""fit_automatically: a vehicle file and flights in, the best model that they carry out, and why.

Samples that cannot be are taken out, flights are brought to one rate, those of another craft are
left out; then `decide` chooses and the recipe is fitted as the explicit command would. A stage that
fails falls back to less, and says so.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.automatic.decide import Decided
from greybox.automatic.filters import is_endless, without_parts
from greybox.automatic.flights import LeftOut, needed_rate, sound_flights
from greybox.automatic.pieces import first_parts
from greybox.automatic.sets import BASE
from greybox.automatic.setting import Given
from greybox.automatic.trials import QUICK, Say
from greybox.automatic.two_horizons import with_one_step
from greybox.data import Dataset
from greybox.data.checks import Checked, CheckReport
from greybox.data.conditioning import condition
from greybox.data.impossible import without_impossible
from greybox.data.raw import RawLog, Removed
from greybox.data.repeats import without_repeats
from greybox.errors import FitError
from greybox.estimation.conclusion import nearer_warnings
from greybox.estimation.fit import Progress, fit, noise_of
from greybox.estimation.options import FitOptions
from greybox.estimation.recipe import Decision, Recipe
from greybox.estimation.record import sample_time
from greybox.estimation.result import Estimate, Fit
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import own_parameters
from greybox.model.model import build_model
from greybox.model.noise import part_named
from greybox.model.noise_free import REASON, NoiseAdded, said_of_added, with_sensor_noise
from greybox.model.vehicle import Vehicle
from greybox.validation.adapt import adaptation
from greybox.validation.calibration import calibrated
from greybox.validation.sanity import sanity_of


def adaptation_of(recipe: Recipe, test: Dataset, asked: float | None = None) -> float | None:
    """Seconds at the start of `test` flights to adapt on: what was `asked` (0: none), else the
    recipe's own, of a shorter flight a third; None where it has none, and the model tells."""
    if recipe.adapt is None or not test.flights:
        return asked
    return adaptation(test, asked, most=recipe.adapt)


@dataclass(frozen=True, kw_only=True, eq=False)
class Prepared:
    """Flights as they are fitted, and what was done to them. `rate` [Hz] is what they were
    resampled to, None: their own; `names` are those of all flights that were given, in order;
    `added` is noise of sensors that had none."""

    data: Dataset
    report: CheckReport
    removed: tuple[Removed, ...]
    left_out: tuple[LeftOut, ...]
    rate: float | None
    names: tuple[str, ...]
    added: tuple[NoiseAdded, ...] = ()

    def decisions(self) -> tuple[Decision, ...]:
        """What was done, as decisions."""
        out = []
        if self.rate is not None:
            reason = "enough for the response of this craft, and one rate for all flights"
            out.append(
                Decision(about="rate", choice=f"{self.rate:g} Hz", reason=reason, option="--rate")
            )
        out += [
            Decision(
                about="impossible samples",
                choice=f"{r.count} of {', '.join(r.channels)} missing in {r.flight}",
                reason=f"{r.reason}, the first at t = {r.first_time:.2f} s",
                option="--keep-impossible",
            )
            for r in self.removed
        ]
        out += [
            Decision(
                about="flights",
                choice=f"{f.flight} left out",
                reason=f.reason,
                option="--all-flights",
            )
            for f in self.left_out
        ]
        if self.added:
            said, option = said_of_added(self.added), "--keep-noise-free"
            out.append(Decision(about="sensors", choice=said, reason=REASON, option=option))
        return tuple(out)


def read_flights(
    logs: Sequence[RawLog], vehicle: Vehicle, *, rate: float | None = None, trim: bool = True
) -> Dataset:
    """Raw logs on a uniform clock of `rate` [Hz] (None: their own). Raises `DataError`."""
    return Dataset(flights=tuple(condition(r, vehicle, rate=rate, trim=trim) for r in logs))


def prepare(
    vehicle: Vehicle,
    logs: Sequence[RawLog] | Dataset,
    *,
    rate: float | None = None,
    keep_impossible: bool = False,
    all_flights: bool = False,
    decide_rate: bool = True,
    keep_noise_free: bool = False,
    accept: Iterable[str] = (),
    beside: Checked | None = None,
) -> Prepared:
    """Clean, choose and resample. `rate` [Hz] is what the user asked for (None: open, or the logs'
    own where it is not to be decided). Findings of the checks in `accept` leave no flight out. Sensors
    without noise get some (`greybox.model.noise_free`), if it is not to `keep_noise_free`. Flights
    `beside` these (test flights) are checked with them, as they are of one craft.

    Raises `DataError` for logs that are no flights, `BadDataError` where no flight is left.
    """
    trim = not isinstance(logs, Dataset)
    raws = [f.as_log() for f in logs] if isinstance(logs, Dataset) else list(logs)
    whole = raws
    raws = [without_repeats(r) for r in whole]
    slow = any(a is not b for a, b in zip(raws, whole, strict=True))
    if not keep_impossible:  # a log that was read with this vehicle has nothing left to remove
        raws = [r if r.removed else without_impossible(r, vehicle) for r in raws]
    removed = tuple(x for r in raws for x in r.removed)
    if isinstance(logs, Dataset) and removed == logs.removed and not slow:
        data = logs
    else:
        own_rate = rate if not decide_rate else None
        data = read_flights(raws, vehicle, rate=own_rate, trim=trim)
    accept, report, kept = tuple(accept), None, data
    left_out: tuple[LeftOut, ...] = ()
    if not all_flights:
        report = Checked.of(data, vehicle).report(accept, beside=beside)
        kept, left_out = sound_flights(data, vehicle, report)
    wanted = rate if rate is not None or not decide_rate else needed_rate(kept)
    if wanted is not None and (decide_rate or isinstance(logs, Dataset)):
        chosen = [r for r in raws if r.flight in kept.names]
        kept, report = read_flights(chosen, vehicle, rate=wanted, trim=trim), None
    if report is None:  # offsets in samples are those of the rate that the flights have now
        report = Checked.of(kept, vehicle).report(accept, beside=beside)
    kept, added = (kept, ()) if keep_noise_free else with_sensor_noise(kept, vehicle)
    return Prepared(
        data=kept,
        report=report,
        removed=removed,
        left_out=left_out,
        rate=wanted,
        names=data.names,
        added=added,
    )


def fit_recipe(
    vehicle: Vehicle, data: Dataset, recipe: Recipe, progress: Progress | None = None
) -> Fit:
    """The explicit fit that a recipe describes, to flights that have its rate already."""
    model = build_model(
        vehicle,
        data.channels,
        recipe.effects,
        input=recipe.input,
        sample_time=sample_time(data),
        noncausal=data.noncausal,
        kinematic_noise=recipe.kinematic_noise,
    )
    return fit(model, data, recipe.options, progress=progress)


def fit_decided(
    vehicle: Vehicle,
    prepared: Prepared,
    decided: Decided,
    *,
    say: Say = lambda text: None,
    progress: Progress | None = None,
) -> Fit:
    """Fit the recipe to all flights. An effect that runs to a bound goes; a fit that fails falls
    back to the likelihood, then to the base set; what the user said stays. Every step down is a
    decision with its reason.

    Raises `FitError` where nothing can be fitted.
    """
    said = decided.given
    decisions = [*prepared.decisions(), *decided.decisions]
    recipe: Recipe = replace(decided.recipe, rate=prepared.rate)
    found, recipe = _carried_out(vehicle, prepared.data, recipe, decisions, said, say, progress)
    found = _with_what_flights_tell(
        vehicle, prepared.data, found, recipe, decisions, said, say, progress
    )
    return with_one_step(found, decided.candidate)


def _carried_out(
    vehicle: Vehicle,
    data: Dataset,
    recipe: Recipe,
    decisions: list[Decision],
    said: Given,
    say: Say,
    progress: Progress | None = None,
    *,
    falls_back: bool = True,
) -> tuple[Fit, Recipe]:
    """The fit of a recipe, and what is left of that: what runs to a bound goes; where it
    `falls_back`, smaller recipes stand in for one that fails. Every step down is added to
    `decisions`. Raises `FitError`."""

    def step_down(what: str, reason: str) -> None:
        decisions.append(Decision(about="fallback", choice=what, reason=reason, option="--manual"))
        say(f"  {what}: {reason}")

    while True:
        less = _less(recipe, said) if falls_back else None
        try:
            found = fit_recipe(vehicle, data, recipe, progress)
        except FitError as error:
            if less is None:
                raise
            step_down(less[1], str(error))
            recipe = less[0]
            continue
        bent = [n for n, e in found.parameters.items() if _at_bound(e)]
        null = {d.name: d.null for d in found.model.dynamics.parameters}
        absent = tuple(n for n in bent if found.parameters[n].value == null.get(n))
        if absent:
            step_down(
                f"{', '.join(absent)} held at nothing", "where the search ended, at the bound"
            )
            options = continued(recipe.options, found)
            recipe = replace(recipe, options=options.but(fixed=(*options.fixed, *absent)))
            continue
        open_effects = recipe.effects if said.effects is None else ()
        gone = [e for e in open_effects if any(n.startswith(f"{_name(e)}.") for n in bent)]
        if gone:
            bent = [n for n in bent if n.split(".")[0] in map(_name, gone)]
            step_down(f"without {', '.join(map(_name, gone))}", f"{', '.join(bent)} ran to a bound")
            recipe = without_effects(recipe, gone)
            continue
        filters = () if "noise_parts" in said.choices else recipe.options.noise_parts
        short = [f for f in filters if not is_endless(part_named(f), found)]
        if lost := tuple(f for f in short if any(n.startswith(f"{f}.") for n in bent)):
            step_down(f"without {', '.join(lost)}", "its time constant ran to a bound")
            recipe = replace(recipe, options=without_parts(recipe.options, lost))
            continue
        if not found.converged and less is not None:
            step_down(less[1], found.status.advice)
            recipe = less[0]
            continue
        return found, recipe


def _with_what_flights_tell(
    vehicle: Vehicle,
    data: Dataset,
    found: Fit,
    recipe: Recipe,
    decisions: Sequence[Decision],
    said: Given,
    say: Say,
    progress: Progress | None = None,
) -> Fit:
    """The fit, with the parameters estimated that were held for a ratio and that the flights tell
    better than they are stated; as it was where nothing is told, such a fit does not end well, or
    it denies what was stated, which are said."""
    choices = said.choices
    own = {*choices.get("fixed", ()), *choices.get("considered", ())}
    told = {n: e for n, e in found.estimates.told.items() if n not in own}
    if "free" in choices:
        told = {}
    denied: dict[str, str] = {}
    while told:
        freed, new = _freed(recipe, found, told)
        for decision in new:
            say(f"  {decision.about}: {decision.choice} ({decision.reason})")
        decided = [*(d for d in decisions if d.about not in told), *new]
        again = None
        with contextlib.suppress(FitError):
            again, freed = _carried_out(
                vehicle, data, freed, decided, said, say, progress, falls_back=False
            )
        if again is None or (failed := _no_minimum(again, found)):
            why = "that fit fails" if again is None else failed
            say(f"  {', '.join(told)}: held after all, as {why}")
            denied |= {n: _stays_held(n, e, why) for n, e in told.items()}
            break
        against = _denied(again, told)
        if not against:
            return _said_of(again, denied).with_history(freed, tuple(decided))
        for line in against.values():
            say(f"  {line}")
        denied |= against
        told = {n: e for n, e in told.items() if n not in against}
    return _said_of(found, denied).with_history(recipe, tuple(decisions))


def _no_minimum(again: Fit, found: Fit) -> str:
    """Why a fit with more estimated than in `found` is no minimum for its physics, "" where it is
    one. The time constant of a noise may end at its bound: it is held there, as there is no such
    noise, and that has no part in where a parameter of the craft is."""
    if not again.converged:
        return "that fit did not converge"
    craft = own_parameters(again.model.dynamics)
    stuck = {n for n, e in found.parameters.items() if _at_bound(e)}
    new = [n for n, e in again.parameters.items() if n in craft - stuck and _at_bound(e)]
    return f"that fit ends with {', '.join(new)} at a bound" if new else ""


def _stays_held(name: str, told: tuple[float, float], why: str) -> str:
    error, stated = told
    return (
        f"{name} is held, although these flights tell it to {error:.2g}, nearer than its stated "
        f"error of {stated:.2g}: {why}; --fixed none estimates all that is not exact"
    )


def _freed(
    recipe: Recipe, found: Fit, told: Mapping[str, tuple[float, float]]
) -> tuple[Recipe, list[Decision]]:
    """The recipe with what is `told` (its error by the flights, the stated one) estimated from
    where a fit ended, and why."""
    unit = {d.name: d.unit for d in found.model.dynamics.parameters}
    new = [
        Decision(
            about=name,
            choice="estimated",
            reason=f"the flights tell more than a ratio: to {error:.2g} {unit[name]}, stated "
            f"to {stated:.2g}",
            option="--fixed, --considered",
        )
        for name, (error, stated) in told.items()
    ]
    options = continued(recipe.options, found)
    fixed, considered = (
        tuple(n for n in names if n not in told) for names in (options.fixed, options.considered)
    )
    return replace(recipe, options=options.but(fixed=fixed, considered=considered)), new


def _denied(found: Fit, told: Collection[str]) -> dict[str, str]:
    """Name -> in words, where estimates of those in `told` deny what was stated of them. Either the
    statement is wrong, or the model lacks something that moves them; nobody knows which."""
    return {
        name: f"{finding.statement}; it is held: measure it again, and where it is right look for "
        "what the model lacks (`greybox discover`)"
        for finding in sanity_of(found).findings
        if finding.kind == "overruled"
        for name in finding.parameters
        if name in told
    }


def _said_of(found: Fit, denied: Mapping[str, str]) -> Fit:
    """The fit with a warning of every parameter that stays held although flights tell it."""
    old = nearer_warnings({n: found.estimates.told[n] for n in denied})
    warnings = (*denied.values(), *(w for w in found.diagnostics.warnings if w not in old))
    return replace(found, diagnostics=replace(found.diagnostics, warnings=warnings))


def on_pieces(
    vehicle: Vehicle, data: Dataset, recipe: Recipe
) -> tuple[IdentifiedModel, Dataset] | None:
    """(the recipe fitted to the first parts of the flights, the pieces left out), for a verdict
    that no test flight has a part in; None where the flights are too short to leave any out.

    Raises `FitError` where the first parts cannot be fitted.
    """
    parts = first_parts(data)
    if parts is None:
        return None
    options = recipe.options.but(solver=QUICK, considered=())
    found = calibrated(fit_recipe(vehicle, parts[0], replace(recipe, options=options)), parts[0])
    return found.model, parts[1]


def continued(options: FitOptions, found: Fit) -> FitOptions:
    """The options of a fit that starts where another one ended, as far as their parts agree."""
    values = {n: e.value for n, e in found.parameters.items() if e.scope == "shared"}
    return options.but(
        values={**options.values, **values},
        noise={**options.noise, **noise_of(found.model)},
        initialisation="nominal",
    )


def _at_bound(estimate: Estimate) -> bool:
    """Whether a parameter is at its bound, in most flights where each has its own."""
    if not estimate.per_flight:
        return estimate.at_bound
    held = sum(not np.isfinite(std) for _, std in estimate.per_flight.values())
    return 2 * held > len(estimate.per_flight)


def _name(effect: str | Effect) -> str:
    return effect if isinstance(effect, str) else effect.name


def without_effects(recipe: Recipe, effects: Sequence[str | Effect]) -> Recipe:
    """The recipe without some effects and what was said of their parameters."""
    names = {_name(e) for e in effects}
    options = recipe.options
    return replace(
        recipe,
        effects=tuple(e for e in recipe.effects if _name(e) not in names),
        options=options.but(
            per_flight=tuple(n for n in options.per_flight if n.split(".")[0] not in names),
            fixed=tuple(n for n in options.fixed if n.split(".")[0] not in names),
            shared=tuple(n for n in options.shared if n.split(".")[0] not in names),
            values={n: v for n, v in options.values.items() if n.split(".")[0] not in names},
            priors={n: p for n, p in options.priors.items() if n.split(".")[0] not in names},
            flight_priors={
                n: p for n, p in options.flight_priors.items() if n.split(".")[0] not in names
            },
            considered=tuple(n for n in options.considered if n.split(".")[0] not in names),
            free=None
            if options.free is None
            else [n for n in options.free if n.split(".")[0] not in names],
        ),
    )


def _less(recipe: Recipe, said: Given) -> tuple[Recipe, str] | None:
    """The next smaller recipe and what it is called; None below the base set and below what was
    said."""
    options = recipe.options
    if options.predictor != "innovation" and "predictor" not in said.choices:
        plain = options.but(predictor="innovation", initialisation="equation-error")
        return replace(recipe, options=plain), "likelihood one step ahead"
    if said.effects is not None:
        return None
    more = [e for e in recipe.effects if _name(e) not in BASE.effects]
    return (without_effects(recipe, more), "rotors and sensors alone") if more else None
