"""Problem: the unknowns of a fit and its cost, gradient and Gauss-Newton Hessian. Solvers see only
this.

Unknowns, in this order: shared model parameters; natural logarithms of noise levels; per-flight
model parameters; errors of the initial state of every record that the predictor's filter does not
carry. Priors (`greybox.estimation.prior`) are part of the cost (maximum a posteriori), bounds are hard.
"""

from __future__ import annotations

import concurrent.futures
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import TypeVar, Unpack, cast

import numpy as np

from greybox.cores import cores
from greybox.data import Dataset
from greybox.errors import FitError, ModelError, UnknownNameError
from greybox.estimation.criterion import Criterion
from greybox.estimation.engine import Engine, engine_for
from greybox.estimation.feasible import Body, bodies_of, moved_inside, wall
from greybox.estimation.options import FitChoices, FitOptions
from greybox.estimation.predictor import Block, Predictor
from greybox.estimation.prior import Prior, prior_terms, unknown_of
from greybox.estimation.record import Record, channel_means, make_records, sample_time
from greybox.estimation.settling import start_sigma
from greybox.estimation.solver import IndexArray, Value
from greybox.estimation.start import Key
from greybox.estimation.unknown import SearchSpace, Unknown
from greybox.model.dynamics import Dynamics
from greybox.model.given_values import demand_given
from greybox.model.parameter import Parameter, nominal_values
from greybox.statistics.blocks import block_samples
from greybox.symbolic import BoolArray, FloatArray, Layout

__all__ = ["Block", "IndexArray", "Problem", "Unknown", "Value", "make_problem"]
_S = TypeVar("_S")
_T = TypeVar("_T")
_P = TypeVar("_P")


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem(SearchSpace):
    """A fit as a minimisation. Build it with `make_problem`. Nothing in it changes;
    `dataclasses.replace` makes another.

    `base` (n_p) are the values of all model parameters where they are not unknowns, `process_level`
    (n_w) and `sensor_level` (n_e) the noise levels where they are not. `thresholds` are steps of
    parameters of which nothing smaller is felt (greybox.estimation.differences). `spreads` (n_d) per
    record are the standard deviations of the initial errors that the predictor's filter carries, zero
    where they are unknowns; None: its filter runs as if it always had.
    """

    dynamics: Dynamics
    engine: Engine
    predictor: Predictor[object]
    criterion: Criterion
    records: Sequence[Record]
    base: FloatArray
    process_level: FloatArray
    sensor_level: FloatArray
    estimate_initial: bool
    dt: float
    means: Mapping[str, float]
    flights: tuple[str, ...]
    thresholds: Mapping[Key, float] = field(default_factory=dict)
    spreads: tuple[FloatArray, ...] | None = None
    _prepared: dict[Predictor[object], object] = field(init=False, repr=False, default_factory=dict)
    _best: list[tuple[bytes, Value]] = field(init=False, repr=False, default_factory=list)

    def __post_init__(self) -> None:
        object.__setattr__(self, "records", tuple(self.records))
        object.__setattr__(self, "means", MappingProxyType(dict(self.means)))
        for name in ("base", "process_level", "sensor_level"):
            own = np.array(getattr(self, name), dtype=np.float64)
            own.flags.writeable = False
            object.__setattr__(self, name, own)
        self.prepared(self.predictor)  # now: threads that ask for it later find it

    def __setstate__(self, state: Mapping[str, object]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "_prepared", {})
        object.__setattr__(self, "_best", [])
        self.__post_init__()

    def prepared(self, predictor: Predictor[_P]) -> _P:
        """What `predictor` prepares for this problem: worked out once, and shared by equal
        predictors.

        Raises `ModelError` for a predictor that cannot be hashed.
        """
        try:
            known = predictor in self._prepared
        except TypeError:
            raise ModelError(
                f"predictor {predictor.name} cannot be hashed",
                fix="@dataclass(frozen=True), and eq=False where it holds arrays",
            ) from None
        if not known:
            self._prepared[predictor] = predictor.prepare(self)
        # Only `prepare` of an equal predictor wrote there.
        return cast(_P, self._prepared[predictor])

    # ------------------------------------------------------------ vectors

    @property
    def start(self) -> FloatArray:
        """Start values, with inertia that a body can have."""
        return moved_inside(
            self.bodies, np.array([u.start for u in self.unknowns]), self.lower, self.upper
        )

    def place(self, name: str, flight: str | None = None) -> int | None:
        """Index of an unknown (the flight's own copy, else the shared one), or None where it is
        fixed."""
        return self.index.get((name, flight), self.index.get((name, None)))

    def parameters_of(self, theta: FloatArray, flight: str | None) -> FloatArray:
        """The model's parameter vector p (n_p) for one flight; None: per-flight parameters at their
        base values."""
        p = self.base.copy()
        for i, d in enumerate(self.dynamics.parameters):
            at = self.index.get((d.name, flight)) if flight is not None else None
            if at is None:
                at = self.index.get((d.name, None))
            if at is not None:
                p[i] = theta[at]
        return p

    def noise_levels(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(process (n_w), sensor (n_e)) standard deviations per sample."""
        process, sensor = self.process_level.copy(), self.sensor_level.copy()
        for i, n in enumerate(self.dynamics.noises.names):
            at = self.index.get((f"noise.process.{n}", None))
            if at is not None:
                process[i] = np.exp(theta[at])
        for i, n in enumerate(self.dynamics.innovations.names):
            at = self.index.get((f"noise.sensor.{n}", None))
            if at is not None:
                sensor[i] = np.exp(theta[at])
        return process, sensor

    def local_columns(self, flight: str) -> IndexArray:
        """Places of the engine's active parameters for one flight."""
        return np.array([self.place(a, flight) for a in self.engine.active], dtype=np.intp)

    def initial_rows(self, record_index: int) -> IndexArray:
        """Entries of the initial error state of one record that are unknowns, (n_0,)."""
        tag, names = f"record {record_index}", self.dynamics.error_states.names
        return np.array([i for i, n in enumerate(names) if (n, tag) in self.index], dtype=np.intp)

    def initial_columns(self, record_index: int) -> IndexArray:
        """Places of these among the unknowns, (n_0,)."""
        tag, names = f"record {record_index}", self.dynamics.error_states.names
        return np.array(
            [self.index[(names[i], tag)] for i in self.initial_rows(record_index)], dtype=np.intp
        )

    def start_sigma(self, record_index: int) -> FloatArray:
        """Standard deviations (n_d,) of the errors of a record's start before it was flown, at the
        start values of parameters and noise levels."""
        record = self.records[record_index]
        return start_sigma(self.dynamics, record, self.base, self.process_level)

    def initial_error(self, theta: FloatArray, record_index: int) -> FloatArray:
        """Initial error state (n_d,) of a record, zero where it is no unknown."""
        d = np.zeros(len(self.dynamics.error_states))
        d[self.initial_rows(record_index)] = theta[self.initial_columns(record_index)]
        return d

    def initial_state(self, theta: FloatArray, record_index: int) -> FloatArray:
        """x0 of a record: its measured start moved by the initial error state."""
        return self.start_of(theta, record_index)[0]

    def start_of(self, theta: FloatArray, record_index: int) -> tuple[FloatArray, FloatArray]:
        """(x0 (n_x,), its derivative in the initial errors that are unknowns (n_d, n_0))."""
        rows = self.initial_rows(record_index)
        if not rows.size:
            return self.records[record_index].x0, np.zeros((self.engine.nd, 0))
        moved, slope = self.engine.moved(
            self.records[record_index].x0, self.initial_error(theta, record_index)
        )
        return moved, slope[:, rows]

    # ------------------------------------------------------------ cost

    @cached_property
    def score_block(self) -> int:
        """Samples that scores are summed over, longer than the errors' correlation: half a second,
        twice the window of a predictor that looks further ahead."""
        ahead = max(self.predictor.horizons)
        return max(
            block_samples(self.dt),
            min(r.n for r in self.records) // 200,
            2 * ahead if ahead > 1 else 1,
        )

    @cached_property
    def bodies(self) -> tuple[Body, ...]:
        """The bodies whose inertia is estimated."""
        return bodies_of(self)

    def inside(self, theta: FloatArray) -> FloatArray:
        """`theta` (n,) moved to where it can be: within its bounds, with inertia that a body can
        have."""
        return moved_inside(self.bodies, theta, self.lower, self.upper)

    def evaluate(self, theta: FloatArray, order: int = 1, scores: int | None = None) -> Value:
        """Cost at `theta`; order 1 adds gradient and Hessian, `scores` the block scores of that
        many samples. The best point with a gradient is kept: where a search ended is asked
        again. A criterion that sums scores anyway brings those of `score_block` unasked."""
        for at, value in self._best:
            scored = scores is None or (scores == self.score_block and value.scores is not None)
            if scored and at == theta.tobytes():
                return value
        value = self._evaluated(theta, order, scores)
        better = not self._best or value.cost < self._best[0][1].cost
        if better and value.valid and value.gradient is not None:
            self._best[:] = [(theta.tobytes(), value)]
        return value

    def _evaluated(self, theta: FloatArray, order: int, scores: int | None) -> Value:
        limit = wall(self.bodies, theta)
        if not np.isfinite(limit.cost):
            return Value(cost=np.inf, likelihood=np.inf, valid=False)
        try:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                value = self.criterion.evaluate(
                    self, self.predictor.blocks(self, theta, order > 0), order, scores
                )
        except (FitError, np.linalg.LinAlgError):
            return Value(cost=np.inf, likelihood=np.inf, valid=False)
        numbers = [v for v in (value.cost, value.gradient, value.hessian) if v is not None]
        if not all(np.isfinite(v).all() for v in numbers):
            return Value(cost=np.inf, likelihood=np.inf, valid=False)
        believed, pull, curvature = prior_terms(self.unknowns, theta)
        cost = value.cost + limit.cost + believed
        if order == 0:
            return Value(cost=cost, likelihood=value.cost)
        assert value.gradient is not None and value.hessian is not None
        return Value(
            cost=cost,
            likelihood=value.cost,
            gradient=value.gradient + limit.gradient + pull,
            hessian=value.hessian + limit.hessian + np.diag(curvature),
            data_hessian=value.hessian,
            scores=value.scores,
        )

    def map_records(self, work: Callable[[int], Block]) -> Iterator[Block]:
        """`work(i)` for every record, in order, on all cores when the engine is compiled; a few
        ahead of who asks."""
        return self._ahead(work, range(len(self.records)))

    def map_blocks(self, work: Callable[[Block], _T], blocks: Iterable[Block]) -> Iterator[_T]:
        """`work(block)` for every block, in order, on all cores when the engine is compiled; few
        blocks are kept."""
        return self._ahead(work, blocks)

    def _ahead(self, work: Callable[[_S], _T], items: Iterable[_S]) -> Iterator[_T]:
        workers = min(len(self.records), cores())
        if workers == 1 or not self.engine.compiled:
            yield from map(work, items)
            return
        with concurrent.futures.ThreadPoolExecutor(workers) as pool:
            ahead: deque[concurrent.futures.Future[_T]] = deque()
            for item in items:
                ahead.append(pool.submit(work, item))
                if len(ahead) > workers:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()


def make_problem(
    dynamics: Dynamics,
    dataset: Dataset,
    options: FitOptions | None = None,
    **choices: Unpack[FitChoices],
) -> Problem:
    """Set up the unknowns of a fit from `options`, or from `choices` (its fields as keywords) on
    top of them.

    Free are the parameters with a prior or without a stated value (sigma > 0, or among `priors`),
    or exactly `free`, less `fixed`; those whose declared scope is flight, or that `per_flight`
    names, get one copy per flight (`shared` takes it back). `values` are start values (and the values of fixed parameters),
    `priors` name -> (mean, sigma) replace declared ones (what is held is at their mean unless
    `values` says where), `flight_priors` hold for every per-flight copy. `noise` gives levels by
    name, in SI units, for one component ("noise.sensor.p") or a whole group
    ("noise.sensor.position", "noise.process.torque"); the longer name wins.
    `estimate_noise="process"` holds the sensors' levels (a data sheet's, or what the time stamps
    allow). `build` names parameters that sensitivities are built for besides the free ones: fits of
    many subsets share one build. Solver, initialisation and `disturbance` are matters of
    `fit` and not looked at here. Raises `UnknownNameError`, `DataError`, `ModelError`.
    """
    o = FitOptions.of(options, choices)
    predictor, criterion = o.chosen_predictor(), o.chosen_criterion()
    choice = _choice(dynamics.parameters, o)
    means = {n: float(p[0]) for n, p in o.priors.items() if n not in choice.free}
    demand_given(dynamics, means)
    values = nominal_values(dynamics.parameters).replace({**means, **o.values})
    dt = sample_time(dataset)
    engine = engine_for(dynamics, choice.built, use_compiler=o.use_compiler).select(choice.free)
    records = make_records(engine, dataset)
    flights = tuple(f.name for f in dataset.flights)
    process, sensor = _levels(dynamics, dt, o.noise, o.held_noise)
    levels = _free_levels(dynamics, o, process, sensor) if predictor.has_noise else []
    shared, per_flight = _parameter_unknowns(dynamics.parameters, choice, o, values, flights)
    base = np.array([values[d.name] for d in dynamics.parameters])
    starts = o.estimate_initial and predictor.has_initial
    initial: list[Unknown] = []
    if starts and not predictor.carries_starts:
        every = [np.ones(engine.nd, dtype=bool)] * len(records)
        initial = _initial_unknowns(dynamics, records, every, base, process)
    problem = Problem(
        dynamics=dynamics,
        engine=engine,
        predictor=predictor,
        criterion=criterion,
        records=records,
        unknowns=(*shared, *levels, *per_flight, *initial),
        base=base,
        dt=dt,
        means=channel_means(dataset),
        flights=flights,
        process_level=process,
        sensor_level=sensor,
        estimate_initial=bool(initial),
    )
    return _with_carried_starts(problem) if starts and predictor.carries_starts else problem


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """The free parameters in the model's order, those with a value per flight, and those that
    sensitivities are built for."""

    free: tuple[str, ...]
    own: frozenset[str]
    built: tuple[str, ...]


def _choice(parameters: Sequence[Parameter], o: FitOptions) -> _Choice:
    """Raises `UnknownNameError` for a name that is no parameter, `ModelError` for a prior of every
    flight's own value of what has none."""
    declared = {d.name for d in parameters}

    def known(names: Iterable[str]) -> set[str]:
        names = list(names)
        for n in names:
            if n not in declared:
                raise UnknownNameError("parameter", n, [d.name for d in parameters])
        return set(names)

    held = known(o.fixed)
    believed = known(o.priors)
    stated = {d.name for d in parameters if d.sigma > 0}
    wanted = stated | believed if o.free is None else known(o.free)
    free = tuple(d.name for d in parameters if d.name in wanted - held)
    own = {d.name for d in parameters if d.scope == "flight"} | known(o.per_flight)
    own -= known(o.shared)
    if common := known(o.flight_priors) - own - believed:
        raise ModelError(
            f"flight_priors of {min(common)}: it has one value for all flights",
            fix=f"priors, or per_flight=['{min(common)}']",
        )
    sensitive = {*free, *known(o.build or ()), *known(o.considered)}
    built = tuple(d.name for d in parameters if d.name in sensitive)
    return _Choice(free=free, own=frozenset(own), built=built)


def _parameter_unknowns(
    parameters: Sequence[Parameter],
    choice: _Choice,
    o: FitOptions,
    values: Mapping[str, float],
    flights: Sequence[str],
) -> tuple[list[Unknown], list[Unknown]]:
    """(those of all flights together, those of every flight)."""
    declared = {d.name: d for d in parameters}
    shared = [
        _declared(declared[n], values[n], None, o.priors.get(n))
        for n in choice.free
        if n not in choice.own
    ]
    per_flight = [
        _declared(declared[n], values[n], f, o.flight_priors.get(n, o.priors.get(n)))
        for f in flights
        for n in choice.free
        if n in choice.own
    ]
    return shared, per_flight


def _initial_unknowns(
    dynamics: Dynamics,
    records: Sequence[Record],
    chosen: Sequence[BoolArray],
    base: FloatArray,
    process: FloatArray,
) -> list[Unknown]:
    """The initial errors `chosen` (n_d,) of every record as unknowns, with their spread at the
    parameters `base` and noise levels `process` as prior."""
    d = dynamics.error_states
    unknowns = []
    for k, (r, c) in enumerate(zip(records, chosen, strict=True)):
        # The prior of lasting noise stays that of the start values while time constant and level
        # move: predictors that estimate levels carry these starts.
        known = not (r.lasting & c).any()
        sigma = r.x0_sigma if known else start_sigma(dynamics, r, base, process)
        unknowns += [
            Unknown(
                name=d.names[i],
                kind="initial",
                flight=f"record {k}",
                start=0.0,
                lower=-np.inf,
                upper=np.inf,
                mean=0.0,
                sigma=float(sigma[i]),
                scale=float(sigma[i]),
                unit=d.units[i],
            )
            for i in np.flatnonzero(c)
        ]
    return unknowns


def _with_carried_starts(problem: Problem) -> Problem:
    """The initial errors that the predictor's filter carries with their spreads, the others as
    unknowns."""
    p = problem
    told = p.predictor.told(p)
    free = [~t for t in told]
    initial = _initial_unknowns(p.dynamics, p.records, free, p.base, p.process_level)
    spreads = tuple(np.where(t, r.spread, 0.0) for t, r in zip(told, p.records, strict=True))
    return replace(
        p, unknowns=(*p.unknowns, *initial), estimate_initial=bool(initial), spreads=spreads
    )


def _levels(
    dynamics: Dynamics, dt: float, noise: Mapping[str, float], held: Iterable[str] = ()
) -> tuple[FloatArray, FloatArray]:
    """(process (n_w), sensor (n_e)) levels: the model's, those in `noise` in their place. Raises
    `UnknownNameError` for a name among `noise` or `held` that is none."""
    process, sensor = dynamics.noise_scale(dt), dynamics.sensor_scale()
    known = [f"noise.process.{n}" for n in dynamics.noises.names]
    known += [f"noise.sensor.{n}" for n in dynamics.innovations.names]
    for n in (*noise, *held):
        if not any(_within(k, n) for k in known):
            raise UnknownNameError("noise level", n, known)
    for names, levels, prefix in (
        (dynamics.noises.names, process, "noise.process."),
        (dynamics.innovations.names, sensor, "noise.sensor."),
    ):
        for i, n in enumerate(names):
            named = [k for k in noise if _within(prefix + n, k)]
            levels[i] = noise[max(named, key=len)] if named else levels[i]
            if not levels[i] > 0:
                raise ModelError(f"noise level {prefix + n} must be positive", got=f"{levels[i]:g}")
    return process, sensor


def _free_levels(
    dynamics: Dynamics, o: FitOptions, process: FloatArray, sensor: FloatArray
) -> list[Unknown]:
    """The noise levels that are estimated, as unknowns."""
    if not o.estimate_noise:
        return []
    levels = _noise_unknowns("noise.process.", dynamics.noises, process, 3.0)
    if o.estimate_noise != "process":
        levels += _noise_unknowns("noise.sensor.", dynamics.innovations, sensor, 2.0)
    return [u for u in levels if not any(_within(u.name, n) for n in o.held_noise)]


def _noise_unknowns(
    prefix: str, signals: Layout, levels: FloatArray, spread: float
) -> list[Unknown]:
    """Logarithms of noise levels as unknowns; `spread` is the sigma of their prior."""
    return [
        Unknown(
            name=prefix + n,
            kind="noise",
            flight=None,
            start=c,
            lower=c - 12,
            upper=c + 8,
            mean=c,
            sigma=spread,
            scale=1.0,
            unit=unit,
        )
        for n, unit, c in zip(
            signals.names, signals.units, (float(np.log(v)) for v in levels), strict=True
        )
    ]


def _within(level: str, name: str) -> bool:
    """Whether a noise level is the named one or a member of the named group."""
    return level == name or level.startswith(name + ".")


def _declared(
    d: Parameter, value: float, flight: str | None, given: tuple[float, float] | Prior | None
) -> Unknown:
    prior = Prior(*(d.believed if given is None else given))
    return unknown_of(d, min(max(value, d.lower), d.upper), prior, flight)
