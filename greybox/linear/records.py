"""Record: uniformly sampled inputs and outputs. `prepare` checks them and brings them to unit
scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from greybox.errors import DataError
from greybox.runs import runs
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class Record:
    """One record: u (N, m) and y (N, p), uniform in time, in SI units. NaN in y is a missing
    sample; u has none.

    Raises `DataError` for shapes that do not fit, infinite values, or missing inputs.
    """

    u: FloatArray
    y: FloatArray
    name: str = "record"

    def __post_init__(self) -> None:
        u, y = (_two_dimensional(v, w, self.name) for v, w in ((self.u, "u"), (self.y, "y")))
        object.__setattr__(self, "u", u)
        object.__setattr__(self, "y", y)
        if len(u) != len(y):
            raise DataError(f"inputs have {len(u)} samples, outputs {len(y)}", where=self.name)
        if not np.isfinite(u).all():
            k = int(np.argwhere(~np.isfinite(u))[0, 0])
            raise DataError(
                f"input missing or infinite at sample {k}",
                where=self.name,
                fix="cut the record there (split_at_missing)",
            )
        if np.isinf(y).any():
            raise DataError("infinite output", where=self.name, fix="mark bad samples as nan")

    def __len__(self) -> int:
        return len(self.u)

    def part(self, columns: Sequence[int], outputs: Sequence[int]) -> Record:
        """Some `columns` of the inputs and some of the outputs."""
        return Record(u=self.u[:, list(columns)], y=self.y[:, list(outputs)], name=self.name)

    @cached_property
    def missing(self) -> int:
        """Number of samples at which at least one output is missing."""
        return int((~np.isfinite(self.y)).any(axis=1).sum())


@dataclass(frozen=True, kw_only=True)
class Scaling:
    """Offsets and scales (u (m,), y (p,)) between a user's records and the unit-variance records
    the fit works on."""

    input_offset: FloatArray
    output_offset: FloatArray
    input_scale: FloatArray
    output_scale: FloatArray

    def apply(self, record: Record) -> Record:
        """(u - offset) / scale and (y - offset) / scale."""
        return Record(
            u=(record.u - self.input_offset) / self.input_scale,
            y=(record.y - self.output_offset) / self.output_scale,
            name=record.name,
        )


def prepare(
    records: Sequence[Record],
    *,
    delays: Sequence[int] | None = None,
    center: bool = True,
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
) -> tuple[list[Record], Scaling]:
    """Check the records, apply the input delays (whole samples per channel), and scale every
    channel to unit variance.

    The first `delay` samples of a record are cut where the delayed input is unknown; all channels
    are cut alike. With `center` the pooled means are taken off. Raises `DataError` for no records,
    channels that differ between records, a constant channel, a channel without samples, or inputs
    that are linearly dependent (the message names them).
    """
    if not records:
        raise DataError("no records", fix="pass at least one log to train on")
    m, p = records[0].u.shape[1], records[0].y.shape[1]
    if p == 0:
        raise DataError("no output channel", fix="name at least one output")
    for r in records:
        if r.u.shape[1] != m or r.y.shape[1] != p:
            raise DataError(
                f"{r.u.shape[1]} inputs and {r.y.shape[1]} outputs",
                where=r.name,
                expected=f"{m} and {p}",
            )
    names_u = list(input_names or [f"input {i + 1}" for i in range(m)])
    names_y = list(output_names or [f"output {i + 1}" for i in range(p)])
    shifted = [delayed(r, delays) for r in records]
    u, y = np.vstack([r.u for r in shifted]), np.vstack([r.y for r in shifted])
    seen = np.isfinite(y).sum(axis=0)
    for i in range(p):
        if seen[i] < 2:
            raise DataError(f"output '{names_y[i]}' has {seen[i]} samples", fix="drop that output")
    su, sy = u.std(axis=0), np.nanstd(y, axis=0)
    for scale, size, names, what in (
        (su, np.abs(u).max(axis=0), names_u, "input"),
        (sy, np.nanmax(np.abs(y), axis=0), names_y, "output"),
    ):
        for i, name in enumerate(names):
            if scale[i] <= 1e-12 * max(float(size[i]), 1e-300):
                raise DataError(
                    f"{what} '{name}' is constant",
                    fix=f"leave it out, or record a log in which that {what} moves",
                )
    u0, y0 = (u.mean(axis=0), np.nanmean(y, axis=0)) if center else (np.zeros(m), np.zeros(p))
    scaling = Scaling(input_offset=u0, output_offset=y0, input_scale=su, output_scale=sy)
    if m > 1:
        _check_rank((u - u.mean(axis=0)) / su, names_u)
    return [scaling.apply(r) for r in shifted], scaling


def delayed(record: Record, delays: Sequence[int] | None) -> Record:
    """The record with input i taken `delays[i]` samples earlier; the first max(delays) samples are
    cut.

    Raises `DataError` for a negative delay, a wrong count, or a record shorter than the delay.
    """
    if delays is None or not any(delays):
        return record
    if len(delays) != record.u.shape[1] or any(d < 0 for d in delays):
        raise DataError(
            f"delays {list(delays)} do not fit {record.u.shape[1]} inputs",
            expected="one whole number >= 0 per input",
        )
    cut = max(delays)
    if len(record) <= cut:
        raise DataError(
            f"{len(record)} samples are fewer than the delay of {cut}", where=record.name
        )
    u = np.column_stack([record.u[cut - d : len(record) - d, i] for i, d in enumerate(delays)])
    return Record(u=u, y=record.y[cut:], name=record.name)


def split_at_missing(
    u: FloatArray, y: FloatArray, *, name: str = "record", longest: int = 50
) -> list[Record]:
    """Records from arrays with holes: cut where an input is missing and where all outputs miss for
    over `longest`.

    Shorter holes in y stay as NaN and are bridged by the Kalman filter. Pieces of fewer than 2
    samples are dropped.
    """
    bad = np.asarray(~np.isfinite(u).all(axis=1))
    dark = np.asarray(~np.isfinite(y).any(axis=1))
    for start, end in runs(dark):
        if end - start > longest:
            bad[start:end] = True
    pairs = runs(~bad)
    whole = len(pairs) == 1
    return [
        Record(u=u[a:b], y=y[a:b], name=name if whole else f"{name}[{a}:{b}]")
        for a, b in pairs
        if b - a >= 2
    ]


def _check_rank(u: FloatArray, names: Sequence[str]) -> None:
    """Raise where some inputs are a linear combination of others over all records."""
    _, values, right = np.linalg.svd(np.linalg.qr(u, mode="r"))
    if values[-1] < 1e-9 * values[0]:
        weights = right[-1]
        involved = [n for n, w in zip(names, weights) if abs(w) > 1e-3 * np.abs(weights).max()]
        raise DataError(
            f"inputs {', '.join(involved)} are linearly dependent, so that their effects cannot be "
            "told apart",
            fix="leave one out, or combine them into one input",
        )


def _two_dimensional(value: FloatArray, what: str, where: str) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise DataError(
            f"{what} must be (samples, channels)", where=where, got=f"shape {array.shape}"
        )
    return array
