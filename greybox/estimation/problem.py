"""Problem: the unknowns of a fit and its cost, gradient and Gauss-Newton Hessian. Solvers see only this.

Unknowns, in this order: shared model parameters; natural logarithms of noise levels; per-flight model parameters;
initial error state of every record. Priors are Gaussian and part of the cost (maximum a posteriori), bounds are hard.
"""

from __future__ import annotations

import concurrent.futures
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
import numpy.typing as npt

from greybox.cores import cores
from greybox.data import Dataset
from greybox.errors import FitError, ModelError, UnknownNameError
from greybox.estimation.engine import Engine, engine_for
from greybox.estimation.record import Record, channel_means, make_records, sample_time
from greybox.model.dynamics import Dynamics
from greybox.model.parameter import Parameter, ParameterValues
from greybox.symbolic import BoolArray, FloatArray

IndexArray = npt.NDArray[np.intp]
_S = TypeVar("_S")
_T = TypeVar("_T")
FEW = 60_000
"""Samples below which sensitivities are compiled without optimisation: a dozen passes over them cost less than it takes."""


@dataclass(frozen=True, kw_only=True)
class Unknown:
    """One scalar of the search space. `name` is the parameter's; `flight` is set for a per-flight copy."""

    name: str
    kind: str  # "parameter", "noise" or "initial"
    flight: str | None
    start: float
    lower: float
    upper: float
    mean: float
    sigma: float
    scale: float
    unit: str


@dataclass(frozen=True, kw_only=True)
class Block:
    """What one record adds to the criterion: residuals and how they depend on the unknowns.

    e (n, n_e) with zeros where mask (n, n_e) is 0; jacobian (n, n_e, n_s) or None; columns (n_s,) their places among the
    unknowns; covariance (n_pat, n_e, n_e) with unit diagonal for missing channels and its derivative (n_pat, n_s, n_e,
    n_e), or None where the criterion estimates the weights itself; pattern (n,). A time-varying predictor gives
    decorrelated residuals instead, with `variance` (n, n_e; 1 where missing) and its derivative (n, n_e, n_s). Rows of one
    `group` (n,) share a variance of their own per channel; `weight` is what one row counts, `spacing`
    how many samples lie between two rows of one group.
    """

    record: Record
    e: FloatArray
    mask: FloatArray
    jacobian: FloatArray | None
    columns: IndexArray
    covariance: FloatArray | None
    covariance_slope: FloatArray | None
    pattern: npt.NDArray[np.int32]
    variance: FloatArray | None = None
    variance_slope: FloatArray | None = None
    group: npt.NDArray[np.int32] | None = None
    weight: float = 1.0
    spacing: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Value:
    """Cost (negative log posterior up to nothing: constants included), gradient, Gauss-Newton Hessian, block scores.

    `scores` (n_blocks, n): gradient of consecutive stretches, for the sandwich covariance. `likelihood` is the cost
    without priors. `valid` False: the model's numbers stopped being finite.
    """

    cost: float
    likelihood: float
    gradient: FloatArray | None = None
    hessian: FloatArray | None = None
    data_hessian: FloatArray | None = None
    scores: FloatArray | None = None
    valid: bool = True


class Predictor(Protocol):
    """Turns unknowns into residuals. `has_noise`: whether noise levels are unknowns of the fit.

    A predictor whose attribute `has_initial` is False takes the initial states as prior only: they are no unknowns.
    """

    @property
    def name(self) -> str:
        """Catalogue name."""

    @property
    def has_noise(self) -> bool:
        """Whether noise levels are unknowns of the fit."""

    def prepare(self, problem: Problem) -> Mapping[str, object]:
        """Work that is done once per problem."""

    def blocks(self, problem: Problem, theta: FloatArray, jacobian: bool) -> Iterable[Block]:
        """Residuals of every record at `theta`, in the order of the records."""


@runtime_checkable
class Integrating(Protocol):
    """A predictor whose filter starts with the covariance of the start, as far as it can tell that."""

    def told(self, problem: Problem) -> list[BoolArray] | None:
        """Which initial errors (n_d,) of every record are integrated out; the others, or all of None, are unknowns."""


class Criterion(Protocol):
    """Turns residuals into a cost."""

    @property
    def name(self) -> str:
        """Catalogue name."""

    def evaluate(self, problem: Problem, blocks: Iterable[Block], order: int, scores: int | None) -> Value:
        """Cost without priors (order 0), with gradient and Gauss-Newton Hessian (order 1)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """A fit as a minimisation. Build it with `make_problem`."""

    dynamics: Dynamics
    engine: Engine
    predictor: Predictor
    criterion: Criterion
    records: Sequence[Record]
    unknowns: tuple[Unknown, ...]
    base: FloatArray  # values of all model parameters (n_p) where they are not unknowns
    dt: float
    means: Mapping[str, float]
    flights: tuple[str, ...]
    state: dict[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.state.update(self.predictor.prepare(self))

    # ------------------------------------------------------------ vectors

    @property
    def n(self) -> int:
        """Number of unknowns."""
        return len(self.unknowns)

    @property
    def start(self) -> FloatArray:
        """Start values."""
        return np.array([u.start for u in self.unknowns])

    @property
    def lower(self) -> FloatArray:
        """Lower bounds."""
        return np.array([u.lower for u in self.unknowns])

    @property
    def upper(self) -> FloatArray:
        """Upper bounds."""
        return np.array([u.upper for u in self.unknowns])

    @property
    def scale(self) -> FloatArray:
        """Typical sizes, for conditioning."""
        return np.array([u.scale for u in self.unknowns])

    def _index(self) -> dict[tuple[str, str | None], int]:
        table = self.state.get("index")
        if table is None:
            table = {(u.name, u.flight): i for i, u in enumerate(self.unknowns)}
            self.state["index"] = table
        return table  # type: ignore[return-value]

    def place(self, name: str, flight: str | None = None) -> int | None:
        """Index of an unknown (the flight's own copy, else the shared one), or None where it is fixed."""
        table = self._index()
        return table.get((name, flight), table.get((name, None)))

    def parameters_of(self, theta: FloatArray, flight: str | None) -> FloatArray:
        """The model's parameter vector p (n_p) for one flight; None: per-flight parameters at their base values."""
        p = self.base.copy()
        for i, d in enumerate(self.dynamics.parameters):
            at = self._index().get((d.name, flight)) if flight is not None else None
            if at is None:
                at = self._index().get((d.name, None))
            if at is not None:
                p[i] = theta[at]
        return p

    def noise_levels(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(process (n_w), sensor (n_e)) standard deviations per sample."""
        process = self.dynamics.noise_scale(self.dt)
        sensor = self.dynamics.sensor_scale()
        fixed_w, fixed_v = self.state.get("process_level"), self.state.get("sensor_level")
        process = np.asarray(fixed_w) if fixed_w is not None else process
        sensor = np.asarray(fixed_v) if fixed_v is not None else sensor
        process, sensor = process.copy(), sensor.copy()
        for i, n in enumerate(self.dynamics.noises.names):
            at = self._index().get((f"noise.process.{n}", None))
            if at is not None:
                process[i] = np.exp(theta[at])
        for i, n in enumerate(self.dynamics.innovations.names):
            at = self._index().get((f"noise.sensor.{n}", None))
            if at is not None:
                sensor[i] = np.exp(theta[at])
        return process, sensor

    def local_columns(self, flight: str) -> IndexArray:
        """Places of the engine's active parameters for one flight."""
        return np.array([self.place(a, flight) for a in self.engine.active], dtype=np.intp)

    def initial_rows(self, record_index: int) -> IndexArray:
        """Entries of the initial error state of one record that are unknowns, (n_0,)."""
        tag, table = f"record {record_index}", self._index()
        names = self.dynamics.error_states.names
        return np.array([i for i, n in enumerate(names) if (n, tag) in table], dtype=np.intp)

    def initial_columns(self, record_index: int) -> IndexArray:
        """Places of these among the unknowns, (n_0,)."""
        tag, names = f"record {record_index}", self.dynamics.error_states.names
        return np.array([self._index()[(names[i], tag)] for i in self.initial_rows(record_index)], dtype=np.intp)

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
        moved, slope = self.engine.moved(self.records[record_index].x0, self.initial_error(theta, record_index))
        return moved, slope[:, rows]

    # ------------------------------------------------------------ cost

    def evaluate(self, theta: FloatArray, order: int = 1, scores: int | None = None) -> Value:
        """Cost at `theta`; order 1 adds gradient and Hessian, `scores` the block scores of that many samples."""
        try:
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                value = self.criterion.evaluate(self, self.predictor.blocks(self, theta, order > 0), order, scores)
        except (FitError, np.linalg.LinAlgError):
            return Value(cost=np.inf, likelihood=np.inf, valid=False)
        numbers = [v for v in (value.cost, value.gradient, value.hessian) if v is not None]
        if not all(np.isfinite(v).all() for v in numbers):
            return Value(cost=np.inf, likelihood=np.inf, valid=False)
        mean = np.array([u.mean for u in self.unknowns])
        precision = np.array([0.0 if not np.isfinite(u.sigma) else u.sigma**-2 for u in self.unknowns])
        off = np.where(precision > 0, theta - mean, 0.0)
        cost = value.cost + 0.5 * float((precision * off * off).sum())
        if order == 0:
            return Value(cost=cost, likelihood=value.cost)
        assert value.gradient is not None and value.hessian is not None
        return Value(
            cost=cost, likelihood=value.cost, gradient=value.gradient + precision * off,
            hessian=value.hessian + np.diag(precision), data_hessian=value.hessian, scores=value.scores,
        )  # fmt: skip

    def map_records(self, work: Callable[[int], Block]) -> Iterator[Block]:
        """`work(i)` for every record, in order, on all cores when the engine is compiled; a few ahead of who asks."""
        return self._ahead(work, range(len(self.records)))

    def map_blocks(self, work: Callable[[Block], _T], blocks: Iterable[Block]) -> Iterator[_T]:
        """`work(block)` for every block, in order, on all cores when the engine is compiled; few blocks are kept."""
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


def few_samples(dataset: Dataset) -> bool:
    """Whether a fit takes less time than the compiler needs to make it faster."""
    return sum(s.n for f in dataset.flights for s in f.segments) < FEW


def make_problem(
    dynamics: Dynamics,
    dataset: Dataset,
    *,
    predictor: Predictor,
    criterion: Criterion,
    free: Iterable[str] | None = None,
    fixed: Iterable[str] = (),
    per_flight: Iterable[str] = (),
    shared: Iterable[str] = (),
    values: Mapping[str, float] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    flight_priors: Mapping[str, tuple[float, float]] | None = None,
    noise: Mapping[str, float] | None = None,
    estimate_noise: bool | Literal["process"] = True,
    estimate_initial: bool = True,
    build: Iterable[str] | None = None,
    use_compiler: bool = True,
) -> Problem:
    """Set up the unknowns of a fit.

    Free are the parameters with a prior or without a stated value (sigma > 0), or exactly `free`, less `fixed`; those
    whose declared scope is flight, or that `per_flight` names, get one copy per flight (`shared` takes it back).
    `values` are start values (and the values of fixed parameters), `priors` name -> (mean, sigma) replace declared ones,
    `flight_priors` hold for every per-flight copy. `noise` gives levels by name, in SI units, for one component
    ("noise.sensor.p") or a whole group ("noise.sensor.position", "noise.process.torque"); the longer name wins.
    `estimate_noise="process"` holds the sensors' levels (a data sheet's, or what the time stamps allow). `build` names
    the parameters that sensitivities are built for, at least the free ones: fits of many subsets share one build.
    Raises `UnknownNameError`, `DataError`, `ModelError`.
    """
    declared = {d.name: d for d in dynamics.parameters}
    starts = estimate_initial
    estimate_initial = estimate_initial and bool(getattr(predictor, "has_initial", True))

    def known(names: Iterable[str]) -> list[str]:
        names = list(names)
        for n in names:
            if n not in declared:
                raise UnknownNameError("parameter", n, declared)
        return names

    values = ParameterValues({d.name: d.nominal for d in dynamics.parameters}).replace(dict(values or {}))
    held = set(known(fixed))
    chosen = (
        [d.name for d in dynamics.parameters if d.sigma > 0 and d.name not in held]
        if free is None
        else [d.name for d in dynamics.parameters if d.name in set(known(free)) - held]
    )
    own = {d.name for d in dynamics.parameters if d.scope == "flight"} | set(known(per_flight))
    own -= set(known(shared))
    dt = sample_time(dataset)
    wanted = set(chosen if build is None else known(build))
    built = tuple(d.name for d in dynamics.parameters if d.name in wanted)
    engine = engine_for(dynamics, built, use_compiler=use_compiler, quick=few_samples(dataset)).select(tuple(chosen))
    records = make_records(engine, dataset)
    flights = tuple(f.name for f in dataset.flights)
    priors, flight_priors = dict(priors or {}), dict(flight_priors or {})
    unknowns = [_declared(declared[n], values[n], None, priors.get(n)) for n in chosen if n not in own]
    noise = dict(noise or {})
    levels_known = [f"noise.process.{n}" for n in dynamics.noises.names]
    levels_known += [f"noise.sensor.{n}" for n in dynamics.innovations.names]
    for n in noise:
        if not any(_within(k, n) for k in levels_known):
            raise UnknownNameError("noise level", n, levels_known)
    process, sensor = dynamics.noise_scale(dt), dynamics.sensor_scale()
    for names, levels, prefix, units, spread in (
        (dynamics.noises.names, process, "noise.process.", dynamics.noises.units, 3.0),
        (dynamics.innovations.names, sensor, "noise.sensor.", dynamics.innovations.units, 2.0),
    ):
        for i, n in enumerate(names):
            named = [k for k in noise if _within(prefix + n, k)]
            levels[i] = noise[max(named, key=len)] if named else levels[i]
            if not levels[i] > 0:
                raise ModelError(f"noise level {prefix + n} must be positive", got=f"{levels[i]:g}")
            held_here = estimate_noise == "process" and prefix == "noise.sensor."
            if estimate_noise and predictor.has_noise and not held_here:
                c = float(np.log(levels[i]))
                unknowns.append(
                    Unknown(
                        name=prefix + n, kind="noise", flight=None, start=c, lower=c - 12, upper=c + 8, mean=c,
                        sigma=spread, scale=1.0, unit=units[i],
                    )
                )  # fmt: skip
    for f in flights:
        unknowns += [
            _declared(declared[n], values[n], f, flight_priors.get(n, priors.get(n))) for n in chosen if n in own
        ]
    state: dict[str, object] = {"process_level": process, "sensor_level": sensor}
    problem = Problem(
        dynamics=dynamics, engine=engine, predictor=predictor, criterion=criterion, records=records,
        unknowns=tuple(unknowns), base=np.array([values[d.name] for d in dynamics.parameters]), dt=dt,
        means=channel_means(dataset), flights=flights, state=state | {"estimate_initial": False, "spreads": None},
    )  # fmt: skip
    if not starts:
        return problem
    told = predictor.told(problem) if isinstance(predictor, Integrating) else None
    if told is None and not estimate_initial:
        return problem
    integrated = told or [np.zeros(engine.nd, dtype=bool)] * len(records)
    initial = [
        Unknown(
            name=n, kind="initial", flight=f"record {k}", start=0.0, lower=-np.inf, upper=np.inf, mean=0.0,
            sigma=float(s), scale=float(s), unit=u,
        )
        for k, r in enumerate(records)
        for n, u, s, known_later in zip(
            dynamics.error_states.names, dynamics.error_states.units, r.x0_sigma, integrated[k], strict=True
        )
        if not known_later
    ]  # fmt: skip
    spreads = None if told is None else [np.where(t, r.x0_sigma, 0.0) for t, r in zip(told, records, strict=True)]
    return replace(
        problem, unknowns=(*unknowns, *initial),
        state=state | {"estimate_initial": bool(initial), "spreads": spreads},
    )  # fmt: skip


def _within(level: str, name: str) -> bool:
    """Whether a noise level is the named one or a member of the named group."""
    return level == name or level.startswith(name + ".")


def _declared(d: Parameter, value: float, flight: str | None, prior: tuple[float, float] | None) -> Unknown:
    mean, sigma = prior if prior is not None else (d.nominal, d.sigma)
    start = min(max(value, d.lower), d.upper)
    return Unknown(
        name=d.name, kind="parameter", flight=flight, start=start, lower=d.lower, upper=d.upper, mean=mean,
        sigma=sigma if sigma > 0 else np.inf, scale=d.scale, unit=d.unit,
    )  # fmt: skip
