"""validate: a model against flights that it was not fitted to.

From every origin k the state uses measurements up to k only; recorded commands drive k .. k+h;
errors are norms of the vector (rotation: geodesic angle), pooled over all origins that have all
their steps; origins never cross a gap (metric of the nano-drone benchmark of R. Busetto et al.,
2026). Channels that were smoothed with later samples may be a reference, never a measurement. The
rows beside each table are persistence (ceiling) and dead reckoning (floor).
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Unpack

import numpy as np

from greybox.data import Dataset, Flight, Segment, group_names
from greybox.data.dataset import FlightFacts
from greybox.data.fingerprint import of_one_flight
from greybox.errors import DataError, FitError, GreyboxError, ModelError
from greybox.estimation.engine import unfelt_place
from greybox.estimation.filtering import Filter, Filtered
from greybox.estimation.options import says_choices
from greybox.estimation.propagation import Propagator
from greybox.estimation.turning import turning_states
from greybox.frames import GRAVITY
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.noise import disturbances
from greybox.model.verdict import Verdict
from greybox.symbolic import FloatArray
from greybox.takes import FLIGHTS, MODEL, takes
from greybox.validation.adapt import (
    SECONDS,
    Adaptation,
    adapt_to_flight,
    adaptation,
    strangers,
)
from greybox.validation.advice import Hint, Symptom, hints_of_model, impossible, lacking
from greybox.validation.baselines import ImuBias, bias_at_start, has_groups, persistence
from greybox.validation.comparison import Standard, standard_of
from greybox.validation.floor import reckoned_from
from greybox.validation.horizon import (
    BLOCK_SECONDS,
    REQUIRED,
    HorizonAccumulator,
    complete_origins,
    spread_origins,
    strided,
)
from greybox.validation.horizon_table import HorizonTable
from greybox.validation.horizons import HORIZONS, LONGEST, SAMPLES, horizons_of
from greybox.validation.one_step import OneStep
from greybox.validation.open_loop import GroupReader, IntArray, predict_from
from greybox.validation.options import ValidateChoices, ValidateOptions
from greybox.validation.result import Validation
from greybox.validation.samples import BoolArray, complete_rows
from greybox.validation.stated import stated_covariances
from greybox.validation.usefulness import FITTED_FLIGHTS, PARTLY_FITTED, TEST_FLIGHTS, judge

Progress = Callable[[str], None]
CHUNK = 200_000
"""Steps ahead, over all origins, that are rolled out at once (bounds the memory)."""
SPACING = 0.01
"""Seconds between origins unless told otherwise: every sample at 100 Hz, as the benchmark counts;
at higher rates neighbours tell the same."""
STATED = 0.1
"""Seconds between the origins whose uncertainty is propagated and judged (neighbours tell the
same)."""
SURVIVING = 0.5
"""Below this share of origins with every reference sample, in any group, horizons without a
reference drop out instead of origins: lost samples that lie here and there empty the table (2 %
leave a third of the origins of 51 samples, 10 % none)."""


@says_choices(ValidateOptions)
@takes(model=MODEL, dataset=FLIGHTS)
def validate(
    model: IdentifiedModel,
    dataset: Dataset | Flight,
    options: ValidateOptions | None = None,
    *,
    progress: Progress | None = None,
    **choices: Unpack[ValidateChoices],
) -> Validation:
    """Multi-step and one-step errors of `model` on all flights of `dataset`, with residual tests,
    baselines and a verdict.

    The choices are keywords, fields of `ValidateOptions` with its defaults, or `options` as a
    whole.

    `horizons` [s] are listed (`horizon_samples` instead: numbers of samples; default: `HORIZONS`,
    of a model that is not a vehicle's `SAMPLES`). `adapt` [s]: per flight, the parameters with a
    value per flight and the initial state are fitted on its first seconds with everything else
    fixed (prior: the training flights), then frozen; origins start after them, and dead reckoning
    takes its IMU biases from the same seconds (0: not; default: on the first 5 s, at most a third, of
    flights whose own values the model lacks). `measured_start` adds the row that starts from the
    measured state, smoothed velocities included, as the benchmark does. Of every
    `every` samples (default: of `SPACING` seconds) one is an origin, `skip` seconds after the start
    of a segment at the earliest. `judged_on` says in words what the flights are to the model (default:
    from the names of its training flights) and `hints` what else was seen; the verdict uses both,
    and what the model keeps of what its fit knew.
    `progress` gets a line per flight. Raises `DataError` (no usable flight, another sample time),
    `ModelError` (a smoothed channel is a measurement of the filter), `FitError`,
    `UnknownNameError` (a choice that there is not).
    """
    o = ValidateOptions.of(options, choices)
    dataset = Dataset.of(dataset)
    dt = model.sample_time
    own = physics_of(model.dynamics) is None
    samples = o.horizon_samples
    if own and o.horizons is None and samples is None:
        samples = SAMPLES
    wanted = horizons_of(
        HORIZONS if o.horizons is None else o.horizons,
        samples=samples,
        sample_time=dt,
        longest=np.inf if own else LONGEST,
    )
    _demand_causal(model, dataset)
    work = _Work(
        model=model,
        dataset=dataset,
        options=o,
        wanted=wanted.steps,
        every=max(1, round(SPACING / dt)) if o.every is None else o.every,
        judged_on=o.judged_on,
        warnings=list(wanted.notes),
    )
    for flight in dataset:
        if progress:
            progress(f"validate: {flight.name}")
        work.add(flight)
    return work.result()


def _demand_causal(model: IdentifiedModel, dataset: Dataset) -> None:
    wrong = sorted(dataset.noncausal & set(model.dynamics.outputs.names))
    if wrong:
        raise ModelError(
            f"the filter measures {', '.join(wrong)}, which are smoothed with later samples",
            fix="fit without these columns, or remove causal = false where it is wrong",
        )


def verdict_on(model: IdentifiedModel, data: Dataset, adapt: float | None) -> Verdict | None:
    """What flights say of a model that was made to name, its own values adapted on their first
    `adapt` s; None where they cannot tell."""
    hints, some = (Hint(symptom=Symptom.FOR_NAMES),), 5  # neighbours tell the same
    with contextlib.suppress(GreyboxError):
        return validate(model, data, adapt=adapt, hints=hints, every=some).verdict
    return None


@dataclass(kw_only=True)
class _Work:
    """The state of one call: accumulators that every flight adds to."""

    model: IdentifiedModel
    dataset: Dataset
    options: ValidateOptions
    wanted: tuple[int, ...]
    every: int
    judged_on: str | None
    warnings: list[str] = field(default_factory=list)
    flights: list[FlightFacts] = field(default_factory=list)
    adaptation: dict[str, Adaptation] = field(default_factory=dict)

    def __post_init__(self) -> None:
        new = strangers(self.model, self.dataset)
        self.strange = [f.name for f in new]
        self.adapted_seconds = adaptation(new, self.options.adapt)
        self.filter = Filter(self.model, use_compiler=self.options.use_compiler)
        self.reader = GroupReader(self.model)
        self.groups = self.reader.judged(self.dataset.any_channels)
        dt = self.model.sample_time
        own = physics_of(self.model.dynamics) is None
        self.standard = standard_of(dt) if own else Standard()
        self.steps = max(REQUIRED, self.wanted[-1], round(self.standard.longest / dt))
        share = min((self._surviving(g) for g in self.groups), default=1.0)
        missing = "origin" if share >= SURVIVING else "step"
        if missing == "step":
            self.warnings.append(
                f"only {share:.0%} of the origins have a reference at every sample of "
                f"{REQUIRED * dt:.3g} s: horizons without one are left out"
            )
        self.rows = {
            label: HorizonAccumulator(
                label=label,
                sample_time=dt,
                steps=self.steps,
                missing=missing,
                groups=self.reader.table,
                block_seconds=2 * self.standard.longest if own else BLOCK_SECONDS,
            )
            for label in ("model", "measured start", "persistence", "dead reckoning")
        }
        self.one_step = OneStep(dynamics=self.model.dynamics)
        known = self.model.trained_samples
        used = sorted(
            f.name
            for f in self.dataset
            if f.name in self.model.trained_on or of_one_flight(f.known_by, known)
        )
        if self.judged_on is None:
            fitted = set(self.dataset.names) <= set(used)
            self.judged_on = FITTED_FLIGHTS if fitted else PARTLY_FITTED if used else TEST_FLIGHTS
            if used:
                self.warnings.append(
                    f"the model was fitted on {', '.join(used)}: errors there are not held-out "
                    "errors"
                )

    # ------------------------------------------------------------ one flight

    def add(self, flight: Flight) -> None:
        """Filter, roll out and judge one flight."""
        dt = self.model.sample_time
        if abs(flight.dt - dt) > 1e-6 * dt:
            raise DataError(
                f"sampled every {flight.dt:g} s, the model every {dt:g} s",
                where=f"flight {flight.name}",
                fix=f"read the log with --rate {1 / dt:g}",
            )
        adapted = self._adapted(flight)
        known = self.model.flight_vector(flight.name)
        p = known if adapted is None else self.model.parameter_vector(adapted.values)
        bias = self._imu_bias(flight)
        spread = {} if adapted is None else adapted.std
        for i, segment in enumerate(flight.segments):
            x0, sigma = (
                (adapted.x0, adapted.x0_sigma) if adapted is not None and i == 0 else (None, None)
            )
            filtered = self.filter.run(
                segment.without(flight.noncausal), p=p, x0=x0, x0_sigma=sigma
            )
            late = self._late(flight, segment)
            self.one_step.add(flight.name, filtered, late)
            self._roll_out(flight.name, segment, filtered, late, bias, spread)
        self.flights.append(flight.facts())
        self._extrapolation(flight)

    def _late(self, flight: Flight, segment: Segment) -> BoolArray:
        """Samples after the seconds of adaptation and the start of the segment, (N,)."""
        late: BoolArray = segment.t >= float(flight.segments[0].t[0]) + self._seconds(flight) - 1e-9
        late[: max(3, round(self.options.skip / segment.dt)) - 1] = False
        return late

    def _matrix(self, segment: Segment, group: str) -> FloatArray:
        """Values (N, dimension) of a group of the model, NaN where not measured."""
        return segment.matrix(self.reader.table[group].columns, missing_ok=True)

    def _origins(self, late: BoolArray) -> IntArray:
        """The origins of a segment: late enough, and with all required steps ahead."""
        origins = np.flatnonzero(late)
        return spread_origins(origins[origins < len(late) - REQUIRED], self.every)

    def _surviving(self, group: str) -> float:
        """Share of the origins with a reference at each required step, where the group was measured
        at all."""
        complete, count = 0, 0
        for flight in self.dataset:
            for segment in flight.segments:
                there = complete_rows(self._matrix(segment, group))
                if there.any():
                    origins = self._origins(self._late(flight, segment))
                    complete += int(complete_origins(there, origins, required=REQUIRED).sum())
                    count += len(origins)
        return complete / count if count else 1.0

    def _seconds(self, flight: Flight) -> float:
        """Those at the beginning of a flight that it adapts on."""
        new = self.options.adapt is not None or flight.name in self.strange
        return self.adapted_seconds if new else 0.0

    def _adapted(self, flight: Flight) -> Adaptation | None:
        if not self._seconds(flight):
            return None
        found = adapt_to_flight(
            self.model,
            flight,
            self._seconds(flight),
            riccati=self.filter.riccati,
            use_compiler=self.options.use_compiler,
        )
        self.adaptation[flight.name] = found
        self.warnings += found.warnings
        return found

    def _imu_bias(self, flight: Flight) -> ImuBias:
        """Biases of dead reckoning from the adaptation seconds; none without them."""
        try:
            return bias_at_start(flight, self._seconds(flight), self._gravity)
        except DataError as error:
            self.warnings.append(f"{flight.name}: dead reckoning without IMU biases ({error})")
            return ImuBias.zero()

    @property
    def _gravity(self) -> float:
        physics = physics_of(self.model.dynamics)
        return float(physics.vehicle.gravity) if physics is not None else GRAVITY

    def _roll_out(
        self,
        name: str,
        segment: Segment,
        filtered: Filtered,
        late: BoolArray,
        bias: ImuBias,
        spread: Mapping[str, float],
    ) -> None:
        origins = self._origins(late)
        references = {g: self._matrix(segment, g) for g in self.groups}
        references = {g: r for g, r in references.items() if np.isfinite(r).all(axis=1).any()}
        if not references:
            return
        engine = self.filter.engine
        propagator = Propagator(self.filter, extra=spread, use_compiler=self.options.use_compiler)
        chunk = max(1, CHUNK // self.steps)
        for at in range(0, len(origins), chunk):
            part = origins[at : at + chunk]
            predicted = predict_from(engine, self.reader, filtered, part, steps=self.steps)
            self._row(
                "model",
                name,
                predicted,
                references,
                part,
                self._stated(propagator, filtered, part, predicted, references),
            )
            if self.options.measured_start:
                predicted = predict_from(
                    engine,
                    self.reader,
                    filtered,
                    part,
                    steps=self.steps,
                    measured_start=True,
                    references=references,
                )
                self._row("measured start", name, predicted, references, part)
            self._row(
                "persistence",
                name,
                persistence(references, part, steps=self.steps),
                references,
                part,
            )
            posed = "rotation" in references and not self.reader.table["rotation"].own
            if posed and has_groups(segment.names, "rate", "specific_force"):
                floor = reckoned_from(
                    segment,
                    filtered,
                    self.reader,
                    references,
                    part,
                    past=engine.past,
                    steps=self.steps,
                    bias=bias,
                    gravity=self._gravity,
                )
                self._row("dead reckoning", name, floor, references, part)

    def _row(
        self,
        label: str,
        flight: str,
        predicted: Mapping[str, FloatArray],
        references: Mapping[str, FloatArray],
        origins: IntArray,
        covariances: Mapping[str, FloatArray] | None = None,
    ) -> None:
        kept = {g: v for g, v in predicted.items() if g in references}
        self.rows[label].add(flight, kept, references, origins, covariances=covariances)

    def _stated(
        self,
        propagator: Propagator,
        filtered: Filtered,
        origins: IntArray,
        predicted: Mapping[str, FloatArray],
        references: Mapping[str, FloatArray],
    ) -> dict[str, FloatArray]:
        """Covariances of the errors ahead of every so many origins, NaN for the others."""
        every = max(1, round(STATED / self.model.sample_time / self.every))
        chosen = strided(np.arange(len(origins)), every, references.values())
        try:
            some = stated_covariances(
                propagator, filtered, origins[chosen], steps=self.steps, groups=predicted
            )
        except FitError as error:
            self.warnings.append(f"uncertainty ahead not computed: {error}")
            return {}
        out = {g: np.full((len(origins), *value.shape[1:]), np.nan) for g, value in some.items()}
        for g, value in some.items():
            out[g][chosen] = value
        return out

    def _extrapolation(self, flight: Flight) -> None:
        """Say where a flight leaves the range that the training flights covered; another place is
        none, unless something depends on the place."""
        out = []
        for name, (low, high) in self.model.domain.items():
            width = high - low
            for segment in flight.segments:
                if name not in segment.channels or not width > 0:
                    continue
                values = segment.channels[name]
                beyond = np.nanmean((values < low - 0.1 * width) | (values > high + 0.1 * width))
                if beyond > 0.01 and name not in self._unfelt:
                    out.append(f"{name} ({beyond:.0%})")
        if out:
            self.warnings.append(
                f"{flight.name}: outside the training range: {', '.join(dict.fromkeys(out))}"
            )

    @functools.cached_property
    def _unfelt(self) -> frozenset[str]:
        """Channels that no prediction depends on; setpoints are none's input."""
        return unfelt_place(self.model.dynamics).union(group_names("setpoint"))

    # ------------------------------------------------------------ result

    def result(self) -> Validation:
        """Everything that was added up."""
        tables = {label: self._table(label) for label in self.rows}
        own, held, floor = (tables[k] for k in ("model", "persistence", "dead reckoning"))
        if own is not None:
            own = replace(own, unjudged=tuple(g for g in self._measured() if g not in own.groups))
            if own.diverged:
                self.warnings.append(
                    f"{own.diverged} open-loop predictions were not finite: their error is infinite"
                )
        if not self.adapted_seconds:
            self.warnings += self._own_values_unknown()
        verdict = None
        if own is not None and held is not None:
            verdict = self._verdict(own, held, floor)
        whiteness, cross, said = self.one_step.tests()
        self.warnings += said
        return Validation(
            model=self.model.name,
            file=self.model.source or None,
            flights=self.flights,
            sample_time=self.model.sample_time,
            horizons=self.wanted,
            table=own,
            persistence=held,
            dead_reckoning=floor,
            measured_start=tables["measured start"],
            one_step=self.one_step.metrics(),
            whiteness=whiteness,
            cross_correlation=cross,
            coverage=self.one_step.coverage(),
            adapted_seconds=self.adapted_seconds or None,
            adaptation=self.adaptation,
            warnings=tuple(self.warnings),
            verdict=verdict,
        )

    def _own_values_unknown(self) -> list[str]:
        """That stated regions leave out what flights have of their own, where it is not known. The
        filter errs by it from the start, which no propagation ahead holds."""
        own = [n for n, (_, s) in self.model.flight_spread.items() if s > 0]
        if not self.strange:
            return []
        parts = ", ".join(dict.fromkeys(n.split(".")[0] for n in own))
        return [
            f"95 % regions do not hold on {', '.join(self.strange)} without --adapt {SECONDS:g} "
            f"(adapt={SECONDS:g}): {parts} of a flight are taken as the training flights' mean, and as "
            "exact"
        ]

    def _table(self, label: str) -> HorizonTable | None:
        """One row's errors by horizon, None without an origin. Raises `DataError` where the model's
        own table is empty though there is something to judge."""
        try:
            return self.rows[label].table()
        except DataError as error:
            if label == "model":
                if self.groups:
                    raise
                self.warnings.append(f"no multi-step table: {error}")
            return None

    def _measured(self) -> list[str]:
        """The groups that some sample has whole."""
        return [
            g
            for g in self.groups
            if any(complete_rows(self._matrix(s, g)).any() for s in self.dataset.segments)
        ]

    def _verdict(
        self, own: HorizonTable, held: HorizonTable, floor: HorizonTable | None
    ) -> Verdict | None:
        """What the errors `own` say beside those of persistence (`held`) and dead reckoning
        (`floor`); None where the tables do not allow one."""
        assert self.judged_on is not None
        hints = [*hints_of_model(self.model), *self.options.hints]
        # Offsets of sensors differ from flight to flight too, but spoil no model by much.
        own_values = [n for n in self.model.flight_spread if "_bias." not in n]
        long = max((f.duration for f in self.dataset), default=0.0) > SECONDS
        unknown = not self.adapted_seconds and own_values and long
        differs = {n: d for n, a in self.adaptation.items() if (d := a.beyond(self.model))}
        # What was seen comes before what may be.
        if unknown and self.judged_on == TEST_FLIGHTS and not (hints or differs):
            differs[""] = "its own values were not adapted"
        hints += [
            Hint(symptom=Symptom.FLIGHT_DIFFERS, detail=d, flight=n) for n, d in differs.items()
        ]
        if turned := turning_states(self.model, self.dataset.segments):
            hints.append(
                Hint(
                    symptom=Symptom.TURNING, detail=f"errors of {', '.join(turned)} grow on the way"
                )
            )
        try:
            found = judge(
                own, held, floor, judged_on=self.judged_on, hints=hints, standard=self.standard
            )
        except DataError as error:
            self.warnings.append(str(error))
            return None
        physics = physics_of(self.model.dynamics)
        there = {e.name for e in physics.effects} if physics is not None else set()
        there |= {d.group for d in disturbances(self.model.dynamics)}
        if physics is not None:
            there |= impossible(found.action, physics, self.dataset.channels)
        action = lacking(found.action, there)
        why = found.why
        if found.action:
            why = tuple(w.replace(found.action, action) for w in why)
        return replace(found, action=action, why=why)
