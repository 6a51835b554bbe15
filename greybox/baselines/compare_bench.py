"""Bench: the flights of a comparison, the fits that several methods share, and how a method's
predictions are judged.

All methods are judged on the same samples and origins. A predictor of channels (`Predictor` in
residual/regressors.py) gets its pose from `greybox.baselines.kinematics`; a model of motion is
judged by `validate`, from the same origins.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np

from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.compare_options import CompareOptions
from greybox.baselines.compare_scores import SPACING
from greybox.baselines.decoupled import Terms, combined
from greybox.baselines.filter_predictor import FilterPredictor
from greybox.baselines.kinematics import IMU, black_box_view, motion
from greybox.baselines.linear_predictor import LinearPredictor
from greybox.baselines.regressors import Point, Predictor
from greybox.data import Dataset, Segment
from greybox.data.channel import channel
from greybox.data.drive import drive_names
from greybox.data.segment import START_SECONDS
from greybox.errors import DataError
from greybox.estimation.record import hold_missing
from greybox.journal import apart, spared
from greybox.linear.fit import LinearFit, fit_linear
from greybox.linear.records import Record, split_at_missing
from greybox.linear.validation import RUN_IN
from greybox.model.identified import IdentifiedModel
from greybox.model.known import demand_known
from greybox.model.vehicle import Vehicle
from greybox.symbolic import FloatArray, IntArray, Signal
from greybox.validation.adapt import adaptation
from greybox.validation.baselines import persistence
from greybox.validation.groups import GROUPS
from greybox.validation.horizon import REQUIRED, HorizonAccumulator, spread_origins
from greybox.validation.horizon_table import HorizonTable
from greybox.validation.samples import BoolArray
from greybox.validation.validate import validate

LONGEST = 13
"""Samples after which every black box has its window full."""
ORDER_SAMPLES = 6000
"""Samples on which the order of linear models is chosen; more would only take longer."""
AXES: Mapping[str, str] = {
    "p": "roll",
    "ay": "roll",
    "q": "pitch",
    "ax": "pitch",
    "r": "yaw",
    "az": "collective",
}
"""Output -> its axis in the decoupled linear models."""


Ahead = tuple[Mapping[str, FloatArray], Mapping[str, FloatArray] | None]
"""Group -> predictions (m, H, dimension) and, where they are stated, covariances (m, H, d, d)."""


class OneStep(Protocol):
    """What predicts channels one sample ahead; a `Predictor` that need not run on its own."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the n_y channels that it predicts."""
        ...

    def one_step(self, segment: Segment) -> tuple[FloatArray, FloatArray]:
        """As in `greybox.baselines.regressors.Predictor`."""
        ...


@runtime_checkable
class Adapts(OneStep, Protocol):
    """What may adapt to a flight before it predicts it."""

    def unadapted(self) -> OneStep:
        """The same without that."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """What a method predicted on the test flights: per segment mean and variance (n, n_c), and its
    multi-step table.

    parameters: how many numbers were trained; seconds: training with all candidates and what it
    builds on; microseconds per predicted sample; search: every candidate with its error on the
    held-back flights.
    """

    mean: Sequence[FloatArray]
    variance: Sequence[FloatArray]
    table: HorizonTable | None
    parameters: int
    seconds: float
    microseconds: float
    search: Sequence[Point] = ()
    settings: Point = field(default_factory=dict)


@dataclass(kw_only=True, eq=False)
class Bench:
    """The flights, and the fits that several methods share.

    `fit` gives the nonlinear model of the training flights; `fitted`: at no cost.
    """

    vehicle: Vehicle
    train: Dataset
    test: Dataset
    fit: Callable[[], IdentifiedModel]
    options: CompareOptions = field(default_factory=CompareOptions)
    say: Callable[[str], None] = lambda _text: None
    fitted: bool = False

    def __post_init__(self) -> None:
        seconds = adaptation(self.test, self.options.adapt)
        self.options = replace(self.options, adapt=seconds or None)
        there = set(self.train.channels) & set(self.test.channels)
        self.outputs = tuple(n for n in IMU if n in there)
        self.commands = drive_names(self.train.channels, self.vehicle.n_rotors)
        self.inputs = (*self.commands, *(n for n in ("vbat",) if n in there))
        if not self.outputs:
            raise DataError("no IMU channel in all flights", expected=", ".join(IMU))
        self.dt = self.train.flights[0].dt
        self.steps = max(REQUIRED, *self.options.horizons)
        self.every = max(1, round(SPACING / self.dt))
        self.train_segments = tuple(s.without(self.train.noncausal) for s in self.train.segments)
        self.segments = tuple(s.without(self.test.noncausal) for s in self.test.segments)
        self.views = tuple(black_box_view(s) for s in self.segments)
        self.extra_tables: dict[str, HorizonTable] = {}
        rows = np.concatenate([s.matrix(self.outputs) for s in self.train_segments])
        self.spread = np.nanstd(rows, axis=0)

    # --------------------------------------------------------------------------------- the samples

    @property
    def skip(self) -> float:
        """Seconds at the start of every segment without judged samples."""
        return max(START_SECONDS, LONGEST * self.dt) if self.options.adapt is not None else RUN_IN

    @cached_property
    def late(self) -> tuple[BoolArray, ...]:
        """Per test segment the samples that are judged: after adaptation or run-in, as `validate`
        takes them."""
        out = []
        for flight in self.test:
            begin = float(flight.segments[0].t[0]) + (self.options.adapt or 0.0)
            for s in flight.segments:
                rows = np.asarray(s.t >= begin - 1e-9)
                rows[: max(3, round(self.skip / s.dt)) - 1] = False
                out.append(rows)
        return tuple(out)

    @cached_property
    def split(self) -> tuple[tuple[Segment, ...], tuple[Segment, ...]]:
        """(segments to train candidates on, segments to judge them on): about a quarter of the
        flights, or of the time."""
        own, judge = self.parts
        return (
            tuple(s.without(self.train.noncausal) for s in own.segments),
            tuple(s.without(self.train.noncausal) for s in judge.segments),
        )

    @cached_property
    def parts(self) -> tuple[Dataset, Dataset]:
        """What `split` is made of, with the channels that were smoothed with later samples."""
        if len(self.train) == 1:
            return self.train.split_by_time(0.75)
        count = max(1, round(0.25 * len(self.train)))
        chosen = np.random.default_rng(self.options.seed).permutation(len(self.train))[:count]
        return self.train.split_by_flight([self.train.names[i] for i in sorted(chosen)])

    # --------------------------------------------------------------------------------- shared fits

    @cached_property
    def mixes(self) -> dict[str, Terms]:
        """Axis -> weighted sum of rotor commands, signed as the torque that they make, largest
        weight 1."""
        rotors = self.vehicle.rotors
        rows = {
            "roll": [r.position[1] for r in rotors],
            "pitch": [-r.position[0] for r in rotors],
            "yaw": [-float(r.spin) for r in rotors],
            "collective": [1.0] * len(rotors),
        }
        out = {}
        for axis, weights in rows.items():
            largest = max(map(abs, weights)) or 1.0
            out[axis] = tuple(
                (w / largest, c) for w, c in zip(weights, self.commands, strict=True) if w
            )
        return out

    def linear(
        self, inputs: Mapping[str, Terms], outputs: Sequence[str], largest: int
    ) -> LinearFit:
        """A linear model of mixed commands with one sample of delay; order by BIC on the first
        `ORDER_SAMPLES` samples."""
        records: list[Record] = []
        for s in self.train_segments:
            u = np.column_stack(
                [sum(w * s.column(c) for w, c in terms) for terms in inputs.values()]
            )
            parts = split_at_missing(
                hold_missing(u)[0], s.matrix(outputs), name=s.flight, longest=0
            )
            records += [r for r in parts if len(r) >= 50]
        signals = [Signal(name=n, unit=channel(n).unit) for n in outputs]

        def found(order: int | str, some: Sequence[Record]) -> LinearFit:
            return fit_linear(
                some,
                order,
                dt=self.dt,
                inputs=list(inputs),
                outputs=signals,
                delays=(1,) * len(inputs),
                largest=largest,
                name="linear " + ",".join(outputs),
            )

        lengths = np.cumsum([len(r) for r in records])
        few = records[: int(np.searchsorted(lengths, ORDER_SAMPLES)) + 1]
        first = found("auto", few)
        return first if len(few) == len(records) else found(first.order, records)

    @cached_property
    def siso(self) -> tuple[LinearPredictor, list[LinearFit]]:
        """The decoupled linear models as one predictor."""
        began = time.perf_counter()
        fits = [self.linear({AXES[n]: self.mixes[AXES[n]]}, (n,), 6) for n in self.outputs]
        model, channels = combined([f.model for f in fits], self.mixes)
        seconds = time.perf_counter() - began
        return LinearPredictor(
            model=model, channels=channels, adapt=self.options.adapt, train_seconds=seconds
        ), fits

    @cached_property
    def mimo(self) -> tuple[LinearPredictor, int]:
        """The linear model from rotor commands to all outputs, and its order."""
        began = time.perf_counter()
        found = self.linear({c: ((1.0, c),) for c in self.commands}, self.outputs, 8)
        seconds = time.perf_counter() - began
        return LinearPredictor(
            model=found.model, adapt=self.options.adapt, train_seconds=seconds
        ), found.order

    @cached_property
    def physics(self) -> tuple[IdentifiedModel, float]:
        """The fitted nonlinear model and the seconds that it took. Raises `ModelError` for one with
        a learned part."""
        began = time.perf_counter() + spared()
        with apart("the nonlinear model"):  # whichever method needs it first
            model = self.fit()
        demand_known(model)
        return model, time.perf_counter() + spared() - began

    # ------------------------------------------------------------------------------------ outcomes

    def channels_of(
        self, predictor: OneStep, views: Sequence[Segment]
    ) -> tuple[list[FloatArray], list[FloatArray], float]:
        """(means, variances) of the judged channels on `views`, and microseconds per sample."""
        both = [predictor.one_step(s) for s in views]
        # Adaptation to the flight and compilation are no part of a prediction.
        bare = predictor.unadapted() if isinstance(predictor, Adapts) else predictor
        bare.one_step(views[0])
        began = time.perf_counter()
        bare.one_step(views[0])
        spent = time.perf_counter() - began
        at = [predictor.outputs.index(n) for n in self.outputs]
        means, variances = [m[:, at] for m, _ in both], [v[:, at] for _, v in both]
        return means, variances, 1e6 * spent / views[0].n

    def rolled(
        self, label: str, ahead: Callable[[int, IntArray], Ahead] | None
    ) -> HorizonTable | None:
        """The multi-step table of what `ahead(segment number, origins)` gives: groups, and
        covariances or None. Without it every reference is held."""
        total = HorizonAccumulator(label=label, sample_time=self.dt, steps=self.steps)
        numbers = itertools.count()
        for flight in self.test:
            for segment in flight.segments:
                i = next(numbers)
                origins = np.flatnonzero(self.late[i])
                origins = spread_origins(origins[origins < segment.n - REQUIRED], self.every)
                references = {
                    g: segment.matrix(d.columns, missing_ok=True) for g, d in GROUPS.items()
                }
                references = {
                    g: r
                    for g, r in references.items()
                    if np.isfinite(r).any() and g != "specific_force"
                }
                if not origins.size or not references:
                    continue
                groups, stated = (
                    ahead(i, origins)
                    if ahead is not None
                    else (persistence(references, origins, steps=self.steps), None)
                )
                kept = {g: v for g, v in groups.items() if g in references}
                total.add(flight.name, kept, references, origins, covariances=stated)
        try:
            return total.table()
        except DataError:
            return None

    def outcome(
        self,
        label: str,
        predictor: Predictor,
        *,
        views: bool,
        seconds: float,
        search: Sequence[Point] = (),
        settings: Point | None = None,
    ) -> Outcome:
        """Everything of a predictor of channels; `views`: it sees those of black boxes."""
        seen = self.views if views else self.segments
        mean, variance, microseconds = self.channels_of(predictor, seen)
        gravity = float(self.vehicle.gravity)

        def ahead(i: int, origins: IntArray) -> Ahead:
            m, v = predictor.free_run(seen[i], origins, self.steps)
            # A free run that diverges can lose the sign of its variance; it is never surer than one
            # step ahead.
            v = np.fmax(v, v[:, :1])
            return motion(self.views[i], origins, predictor.outputs, m, v, gravity=gravity)

        return Outcome(
            mean=mean,
            variance=variance,
            table=self.rolled(label, ahead),
            parameters=predictor.parameters,
            seconds=seconds,
            microseconds=microseconds,
            search=search,
            settings=settings or {},
        )

    def physical(
        self,
        model: IdentifiedModel,
        seconds: float,
        *,
        search: Sequence[Point] = (),
        settings: Point | None = None,
    ) -> Outcome:
        """Everything of a model of motion: its filter one step ahead, `validate` further on."""
        base = FilterPredictor(model=model, outputs=self.outputs, adapt=self.options.adapt)
        mean, variance, microseconds = self.channels_of(base, self.segments)
        level = self.level(base)
        checked = validate(
            model,
            self.test,
            horizon_samples=self.options.horizons,
            adapt=self.options.adapt or 0.0,
            every=self.every,
            skip=self.skip,
        )
        if checked.dead_reckoning is not None:
            self.extra_tables["dead reckoning"] = checked.dead_reckoning
        return Outcome(
            mean=mean,
            variance=[level * v for v in variance],
            table=checked.table,
            parameters=base.parameters,
            seconds=seconds,
            microseconds=microseconds,
            search=search,
            settings=settings or {},
        )

    def level(self, base: BasePredictor) -> FloatArray:
        """Mean squared error over stated variance (n_c,) on the training flights."""
        ratios = []
        for s in self.train_segments:
            mean, variance = base.one_step(s)
            ratios.append((s.matrix(self.outputs) - mean) ** 2 / variance)
        return np.asarray(np.nanmean(np.concatenate(ratios), axis=0))
