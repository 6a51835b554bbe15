"""Record: one unbroken segment in the shape that the engine wants, with its patterns of missing
channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from greybox.data import Dataset, Segment
from greybox.data.raw import is_numeric
from greybox.data.segment import START_SECONDS
from greybox.errors import DataError
from greybox.estimation.channel_pattern import Pattern, pattern_of
from greybox.estimation.engine import Engine, Samples
from greybox.estimation.recursion import IntArray
from greybox.model.noise import lasting_errors
from greybox.model.state_blocks import usual_of
from greybox.symbolic import BoolArray, FloatArray

ALIKE = 10.0
"""Factor between two spreads of a start up to which they are of one kind."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Record:
    """Arrays of one segment. `patterns` (n_pat, n_e) lists which innovation components are there,
    `pattern` (n,) which: 0 missing, 1 there."""

    flight: str
    segment: Segment
    inputs: FloatArray  # padded, (n + past + future, n_u)
    outputs: FloatArray  # (n, n_y), NaN = missing
    mask: FloatArray  # (n, n_e)
    pattern: IntArray  # (n,)
    patterns: FloatArray  # (n_pat, n_e)
    dt: float
    x0: FloatArray  # start of the initial state
    x0_sigma: FloatArray
    held: int  # command cells that were missing and held from the sample before
    lasting: BoolArray  # (n_d,) error states that are noise in its stationary state

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.outputs.shape[0]

    @property
    def samples(self) -> Samples:
        """What the engine takes of it as keywords."""
        return {
            "inputs": self.inputs,
            "outputs": self.outputs,
            "mask": self.mask,
            "dt": self.dt,
        }

    @property
    def spread(self) -> FloatArray:
        """Standard deviations (n_d,) of the start's errors; infinite: as large as the noise of that
        state keeps it."""
        return np.where(self.lasting, np.inf, self.x0_sigma)

    @cached_property
    def usual(self) -> Pattern:
        """The channels that are usually there, in a pattern where some come at a lower rate."""
        return pattern_of(self.mask)


def hold_missing(values: FloatArray) -> tuple[FloatArray, int]:
    """Missing cells take the last value before them (the first value where nothing is before); how
    many there were."""
    out = np.array(values, dtype=np.float64)
    missing = ~np.isfinite(out)
    count = int(missing.sum())
    if count:
        index = np.where(missing, 0, np.arange(out.shape[0])[:, None])
        np.maximum.accumulate(index, axis=0, out=index)
        out = np.take_along_axis(out, index, axis=0)
        for j in range(out.shape[1]):
            good = np.flatnonzero(np.isfinite(out[:, j]))
            if good.size:
                out[: good[0], j] = out[good[0], j]
    return out, count


def make_record(engine: Engine, segment: Segment, start_seconds: float = START_SECONDS) -> Record:
    """Arrays of `segment` for the engine's model. Raises `DataError` where a command column is
    absent or empty."""
    dynamics = engine.dynamics
    for name in dynamics.inputs.names:
        if name not in segment.channels and name not in segment.extra:
            raise DataError(
                f"no column {name}, which the model needs as input",
                where=f"flight {segment.flight}",
                fix="name it in [columns] of the vehicle file, or leave out the effect that needs "
                "it",
            )
    u, held = hold_missing(segment.matrix(dynamics.inputs.names))
    if not np.isfinite(u).all():
        empty = [
            n for n, v in zip(dynamics.inputs.names, u.T, strict=True) if not np.isfinite(v).any()
        ]
        raise DataError(
            f"input column {', '.join(empty)} has no values", where=f"flight {segment.flight}"
        )
    y = segment.matrix(dynamics.outputs.names, missing_ok=True)
    there = np.isfinite(y)
    at = {n: i for i, n in enumerate(dynamics.outputs.names)}
    mask = np.column_stack(
        [there[:, [at[c] for c in cols]].all(axis=1) for cols in dynamics.innovation_columns]
    )
    patterns, pattern = np.unique(mask.astype(np.float64), axis=0, return_inverse=True)
    few = max(3, round(start_seconds / segment.dt))
    numbers = {n: v for n, v in segment.extra.items() if is_numeric(v)} | dict(segment.channels)
    start = {n: v[:few] for n, v in numbers.items()}
    start["t"] = segment.t[:few]
    start |= {usual_of(n): u[:, i].mean(keepdims=True) for i, n in enumerate(dynamics.inputs.names)}
    x0, sigma = dynamics.initial_state(start)
    return Record(
        flight=segment.flight,
        segment=segment,
        outputs=y,
        inputs=engine.padded_inputs(u, _earlier(segment, dynamics.inputs.names)),
        mask=mask.astype(np.float64),
        pattern=pattern.ravel().astype(np.int32),
        patterns=patterns,
        dt=segment.dt,
        x0=x0,
        x0_sigma=sigma,
        held=held,
        lasting=lasting_errors(dynamics),
    )


def _earlier(segment: Segment, names: tuple[str, ...]) -> FloatArray | None:
    """(m, n_u) inputs of the samples before the segment, None where they are not all known."""
    if not names or not all(n in segment.earlier for n in names):
        return None
    u = hold_missing(np.column_stack([segment.earlier[n] for n in names]))[0]
    return u if np.isfinite(u).all() else None


def make_records(engine: Engine, dataset: Dataset) -> list[Record]:
    """Records of all segments, in the order of the data set. Raises `DataError` for a set without
    samples."""
    records = [make_record(engine, s) for f in dataset.flights for s in f.segments]
    if not records:
        raise DataError("no flight in the data set")
    if not any(r.mask.any() for r in records):
        raise DataError(
            "no measured sample of any output",
            expected=", ".join(engine.dynamics.outputs.names),
            fix="check the column names of the log",
        )
    return _with_common_spreads(records)


def _with_common_spreads(records: Sequence[Record]) -> list[Record]:
    """Records whose starts are known alike, every error to a factor `ALIKE`, with one spread, the
    widest of them: they share how their filter settles."""
    shared = list[Record]()
    for r in records:
        alike = [
            o.x0_sigma
            for o in records
            if (np.abs(np.log(o.x0_sigma / r.x0_sigma)) <= np.log(ALIKE)).all()
        ]
        shared.append(replace(r, x0_sigma=np.max(alike, axis=0)))
    return shared


def channel_means(dataset: Dataset) -> dict[str, float]:
    """Mean of every channel over all flights (missing cells left out)."""
    sums: dict[str, list[float]] = {}
    for f in dataset.flights:
        for s in f.segments:
            for n, v in s.channels.items():
                good = v[np.isfinite(v)]
                if good.size:
                    total = sums.setdefault(n, [0.0, 0.0])
                    total[0] += float(good.sum())
                    total[1] += good.size
    return {n: a / b for n, (a, b) in sums.items()}


def sample_time(dataset: Dataset) -> float:
    """The one sample time of all flights [s]. Raises `DataError` where they differ."""
    steps = sorted({f.dt for f in dataset.flights})
    if not steps:
        raise DataError("no flight in the data set")
    if steps[-1] - steps[0] > 1e-6 * steps[0]:
        raise DataError(
            f"flights with different sample times {', '.join(f'{s:g}' for s in steps)} s",
            fix="read them with one rate",
        )
    return steps[0]
