"""Differences: how the innovations of a fit change with parameters that it does not have, through
the predictor.

The larger model, with every candidate at its null, is run once per parameter with that parameter a
little off: one-sided, away from the bound at which many nulls lie. Nothing but the step itself is
built, where exact sensitivities of the whole catalogue would have to be compiled to be evaluated
once. A parameter that does nothing at first (a limit that no command reaches) is moved further,
until it is felt: the test then looks in that direction.
"""

from __future__ import annotations

import concurrent.futures
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from greybox.cores import cores
from greybox.data import Dataset
from greybox.estimation.engine import engine_for
from greybox.estimation.gain import linearisation_at
from greybox.estimation.predictor import Predictor
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.prior import Prior, unknown_of
from greybox.estimation.problem import Block, Problem
from greybox.estimation.record import make_records
from greybox.estimation.settling import RecordGains, Settling
from greybox.estimation.start import Key
from greybox.model.dynamics import Dynamics
from greybox.model.parameter import Parameter
from greybox.symbolic import FloatArray

STEP = 1e-6
"""Size of a difference in units of the parameter's scale: its error is about as large as that of
exact sensitivities."""
FURTHER = (0.5, 1.0, 2.0, 3.0)
"""Sizes that are tried where nothing is felt of a small difference."""
HALVINGS = 5
"""How often the way from a size that is not felt to one that is felt is halved."""
FELT = 0.005
"""Share of the samples that a step must reach."""
TRACE = 1e-3
"""Part of the largest change below which a sample only remembers one that was reached."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Given(Predictor[None]):
    """A predictor whose blocks are there already."""

    given: Sequence[Block]
    name: str = "given"
    has_noise: ClassVar[bool] = True

    def prepare(self, problem: Problem) -> None:
        """Nothing."""

    def blocks(self, problem: Problem, theta: FloatArray, jacobian: bool) -> Iterable[Block]:
        """What was given."""
        return self.given


@dataclass(frozen=True, kw_only=True, eq=False)
class _Spread:
    """Covariances of a record's innovations: `table` (n_row, n_e, n_e), `row` (n,) which one a
    sample has."""

    table: FloatArray
    row: npt.NDArray[np.int32]

    def at(self, samples: npt.NDArray[np.intp]) -> FloatArray:
        """Those of some samples (m,), (m, n_e, n_e)."""
        return self.table[self.row[samples]]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Passed:
    """Innovations (n, n_e) of one record and their covariances."""

    innovations: FloatArray
    spread: _Spread


@dataclass(frozen=True, kw_only=True, eq=False)
class _Column:
    """Change per unit of one parameter: of the innovations (n, n_e), and of their covariances, (new
    - old) / step."""

    innovations: FloatArray
    new: _Spread
    old: _Spread
    step: float

    def covariance(self, samples: npt.NDArray[np.intp]) -> FloatArray:
        """Change of the covariances of some samples (m,), (m, n_e, n_e)."""
        return (self.new.at(samples) - self.old.at(samples)) / self.step


def with_candidate_sensitivities(
    small: Problem,
    theta: FloatArray,
    large: Dynamics,
    data: Dataset,
    null: Mapping[str, float],
    per_flight: Iterable[str] = (),
    apart: Dynamics | None = None,
) -> tuple[Problem, FloatArray]:
    """(`small` with the parameters `null` of the model `large` as further unknowns, `theta` with
    these at their nulls).

    `small` is a fit in innovation form whose model is `large` with `null` held. Parameters that
    only `apart` has, a larger model still, are moved in that one: a rotor with a lag of no length
    shows its speed a sample later than one without, and whatever acts on the accelerometer would be
    looked for a sample too late next to it. The result can be evaluated at that point only. Raises
    `FitError` where a prediction is not finite.
    """
    common, own = {d.name for d in large.parameters}, set(per_flight)
    runner = _Runner(small, theta, large, data, {n: v for n, v in null.items() if n in common})
    other = runner if apart is None else _Runner(small, theta, apart, data, null)
    candidates = [
        (d, flight, runner if d.name in common else other)
        for d in (apart or large).parameters
        if d.name in null
        for flight in _flights_of(d, small, own)
    ]
    with concurrent.futures.ThreadPoolExecutor(cores()) as pool:
        asked = [pool.submit(r.column, d, null[d.name], f) for d, f, r in candidates]
        columns = [a.result() for a in asked]
    runners = [r for _, _, r in candidates]
    blocks = [
        _widened(block, i, small.n, [c[i] for c in columns], runners)
        for i, block in enumerate(Innovation(piece=sys.maxsize).blocks(small, theta, True))
    ]
    added = [
        unknown_of(d, null[d.name], Prior(d.nominal, d.sigma), flight)
        for d, flight, _ in candidates
    ]
    wide = replace(
        small,
        unknowns=(*small.unknowns, *added),
        predictor=Given(given=blocks),
        thresholds=runner.thresholds | other.thresholds,
    )
    return wide, np.concatenate([theta, [u.start for u in added]])


def _flights_of(d: Parameter, small: Problem, own: Collection[str]) -> tuple[str | None, ...]:
    """The flights that a parameter has one value each for, as those named in `own` have; None: one
    value for all."""
    return tuple(small.flights) if d.scope == "flight" or d.name in own else (None,)


def _widened(
    block: Block,
    i: int,
    n: int,
    columns: Sequence[_Column | None],
    runners: Sequence[_Runner],
) -> Block:
    """The block of record i of a fit of n unknowns with the columns of further ones, each of which
    one of the `runners` has run (None: another flight's)."""
    assert block.jacobian is not None
    assert block.covariance_slope is not None
    # The larger model's filter may take longer to settle: one sample stands for every group.
    groups = range(len(block.covariance_slope))
    alike = {r: np.array([r.example(i, block.pattern == g) for g in groups]) for r in {*runners}}
    moved = [(j, c, runners[j]) for j, c in enumerate(columns) if c is not None]
    added_slopes = [c.covariance(alike[r]) for _, c, r in moved]  # (n_pat, n_e, n_e) each
    return replace(
        block,
        jacobian=np.concatenate(
            [block.jacobian, *(c.innovations[:, :, None] for _, c, _ in moved)], axis=2
        ),
        covariance_slope=tuple(
            np.concatenate(
                [padded(known, block.columns.size), *(new[None, g] for new in added_slopes)]
            )
            for g, known in enumerate(block.covariance_slope)
        ),
        columns=np.concatenate(
            [block.columns, n + np.array([j for j, _, _ in moved], dtype=np.intp)]
        ),
    )


def padded(slopes: FloatArray, n: int) -> FloatArray:
    """Slopes (n_k, n_e, n_e) with zeros for the columns after theirs, (n, n_e, n_e)."""
    return np.concatenate([slopes, np.zeros((n - len(slopes), *slopes.shape[1:]))])


class _Runner:
    """The predictor of the larger model at the smaller one's estimates."""

    def __init__(
        self,
        small: Problem,
        theta: FloatArray,
        large: Dynamics,
        data: Dataset,
        null: Mapping[str, float],
    ) -> None:
        self.small, self.theta, self.large, self.null = small, theta, large, null
        self.engine = engine_for(large, (), use_compiler=small.engine.compiled, sensitive=False)
        self.records = make_records(self.engine, data)
        past, future = large.window
        u = np.array([small.means.get(n, 0.0) for n in large.inputs.names])
        self.window = np.repeat(u[:, None], past + 1 + future, axis=1)
        self.reference = large.reference(small.means)
        elsewhere = large.reference({k: v + 1.0 for k, v in small.means.items()})
        self.linearisation = linearisation_at(large, (), self.reference, elsewhere)
        self.weak = (np.max([r.x0_sigma for r in self.records], axis=0) * 100.0) ** 2
        process, sensor = small.noise_levels(theta)
        self.q, self.r = process**2, sensor**2
        self.names = [d.name for d in large.parameters]
        self.thresholds: dict[Key, float] = {}
        self.starts = [self._start(i) for i in range(len(self.records))]
        self.spreads = [self._spread(i) for i in range(len(self.records))]
        self.common = self.gains(self.parameters(None))
        self.base = [
            self.run(i, self.parameters(r.flight), self.common[i])
            for i, r in enumerate(self.records)
        ]

    def parameters(self, flight: str | None) -> FloatArray:
        """Parameter vector of the larger model, candidates at their nulls."""
        names = [d.name for d in self.small.dynamics.parameters]
        own = dict(zip(names, self.small.parameters_of(self.theta, flight), strict=True))
        return np.array([own[n] if n in own else self.null[n] for n in self.names])

    def _start(self, i: int) -> FloatArray:
        error = self.small.initial_error(self.theta, i)
        moved = dict(zip(self.small.dynamics.error_states.names, error, strict=True))
        d = np.array([moved.get(n, 0.0) for n in self.large.error_states.names])
        return self.engine.moved(self.records[i].x0, d)[0]

    def _spread(self, i: int) -> FloatArray | None:
        """Standard deviations of the start's errors as in the smaller model; what only the larger
        one has is known."""
        found = self.small.spreads
        if found is None:
            return None
        own = dict(zip(self.small.dynamics.error_states.names, found[i], strict=True))
        return np.array([own.get(n, 0.0) for n in self.large.error_states.names])

    def example(self, i: int, chosen: npt.NDArray[np.bool_]) -> int:
        """A sample of record i among `chosen` (n,) with the covariance that most of these have."""
        row = self.base[i].spread.row
        return int(np.flatnonzero(chosen & (row == np.bincount(row[chosen]).argmax()))[0])

    def gains(self, p: FloatArray) -> list[RecordGains]:
        """The filter of every record at the parameters p."""
        values = self.linearisation.values(self.reference, self.window, p, self.small.dt)
        settling = Settling(values=values, q=self.q, r=self.r, weak=self.weak)
        return [
            settling.gains(r, spread) for r, spread in zip(self.records, self.spreads, strict=True)
        ]

    def run(self, i: int, p: FloatArray, found: RecordGains) -> _Passed:
        """Innovations of record i and their covariances."""
        record = self.records[i]
        gains, s, _ = found.tables()
        run = self.engine.run(
            x0=self.starts[i],
            pattern=found.pattern,
            gains=gains,
            p=p,
            **record.samples,
        )
        run.demand_finite(f"the prediction of flight {record.flight}")
        assert run.innovations is not None
        return _Passed(innovations=run.innovations, spread=_Spread(table=s, row=found.pattern))

    def column(self, d: Parameter, null: float, flight: str | None) -> list[_Column | None]:
        """Change of every record with one parameter (of one flight): None where the record is of
        another flight. Where only a larger step is felt, `thresholds` gets where that begins."""
        sign = 1.0 if null + STEP * d.scale <= d.upper else -1.0
        most = (d.upper - null) if sign > 0 else (null - d.lower)

        def moved(size: float) -> list[_Column | None]:
            h = sign * min(size * d.scale, most)
            return self._moved(d.name, null + h, h, flight)

        found, below = moved(STEP), 0.0
        if _felt(found):
            return found
        for size in FURTHER:
            found = moved(size)
            if _felt(found):
                break
            below = size
        for _ in range(HALVINGS if below < size else 0):
            half = 0.5 * (below + size)
            below, size = (below, half) if _felt(moved(half)) else (half, size)
        self.thresholds[d.name, flight] = min(size * d.scale, most)
        return found

    def _moved(self, name: str, value: float, h: float, flight: str | None) -> list[_Column | None]:
        at = self.names.index(name)
        gains = self.common
        if flight is None:
            p = self.parameters(None)
            p[at] = value
            gains = self.gains(p)
        out: list[_Column | None] = []
        for i, record in enumerate(self.records):
            if flight not in (None, record.flight):
                out.append(None)
                continue
            p = self.parameters(record.flight)
            p[at] = value
            new, old = self.run(i, p, gains[i]), self.base[i]
            change = (new.innovations - old.innovations) / h
            out.append(_Column(innovations=change, new=new.spread, old=old.spread, step=h))
        return out


def _felt(found: Sequence[_Column | None]) -> bool:
    """Whether a step reached enough samples."""
    there = [np.abs(c.innovations) for c in found if c is not None]
    change = np.concatenate(there).max(axis=1)
    return float((change > TRACE * change.max()).mean()) > FELT
