"""Segment: an unbroken stretch of samples on one uniform clock. Missing cells are NaN, never a
filled-in number."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from greybox.data.clock import GOES_BACK, STANDS_STILL
from greybox.data.raw import Column, is_numeric
from greybox.errors import DataError, UnknownNameError
from greybox.shown import Cell, Shown

FloatArray = npt.NDArray[np.float64]

START_SECONDS = 0.1
"""First seconds of a segment: the initial state is read off them, and the commands before them,
which nobody knows, still arrive (no `command_delay` is longer). Nothing is predicted from there, or
judged."""
EARLIER = 0.2
"""Seconds before a cut whose samples are remembered: longer than any delay."""
CLOCK_TOLERANCE = 1e-3
"""Largest deviation of a sample from the uniform grid, as a share of the sample time."""


def _numbers(values: npt.ArrayLike, what: str, flight: str) -> FloatArray:
    """A copy as floats. Raises `DataError` for times of day, complex values and what is no
    number."""
    given = np.asarray(values)
    wrong = {"M": "dates", "m": "time differences", "c": "complex numbers"}.get(given.dtype.kind)
    if wrong is None:
        try:
            return np.array(given, dtype=np.float64)
        except (TypeError, ValueError):
            wrong = f"values that are no numbers, as {given.ravel()[:1].tolist()}"
    timed = given.dtype.kind in "Mm"
    fix = "seconds: (t - t[0]) / numpy.timedelta64(1, 's')" if timed else None
    raise DataError(f"{what} has {wrong}", where=f"flight {flight}", expected="numbers", fix=fix)


def floats(values: npt.ArrayLike, n: int, what: str, flight: str) -> FloatArray:
    """A read-only copy (n,) as floats. Raises `DataError` for what is no number and for another
    shape."""
    array = _numbers(values, what, flight)
    if array.shape != (n,):
        raise DataError(
            f"{what} has shape {array.shape}",
            where=f"flight {flight}",
            expected=f"({n},), one per sample",
        )
    array.setflags(write=False)
    return array


def steps_of(t: FloatArray) -> tuple[float, float]:
    """(sample time, largest deviation from the grid that begins and ends with `t` (N,)) [s]."""
    dt = float(t[-1] - t[0]) / (t.size - 1)
    return dt, float(np.abs(t - (t[0] + dt * np.arange(t.size))).max())


def _told_by(t: FloatArray, dt: float) -> float:
    """The sample time `dt` [s] of stamps `t` (N,), rounded to 12 digits; the roundest one, or rate,
    that stamps of this size cannot tell from it (a double holds the time since 1970 to 0.2 us)."""
    sure = float(np.spacing(np.abs(t).max())) / (t.size - 1)
    if sure > 0.5e-12 * dt:
        for figures in range(1, 12):
            for found in (float(f"{dt:.{figures}g}"), 1.0 / float(f"{1.0 / dt:.{figures}g}")):
                if abs(found - dt) <= sure:
                    return float(f"{found:.12g}")
    return float(f"{dt:.12g}")


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Segment(Shown):
    """Samples at t_0 + k dt. All arrays are (N,), read-only copies; NaN = missing.

    `t` [s] is uniform (float64); `channels` are canonical names in SI units (a model of the user's
    own may use any names); `extra` are the log's unknown columns, as they came (float64, or text).
    `earlier` are channels of the samples just before t_0, (M,) each, where the segment was cut out
    of a longer one: commands that a delay still has to deliver. `step` [s] is dt, where it is known
    better than large stamps tell it; what they contradict is not believed. Raises `DataError` where
    shapes do not fit, the clock is not uniform, a value is infinite, or there are fewer than two
    samples.
    """

    t: FloatArray
    channels: Mapping[str, FloatArray]
    flight: str = "flight"
    extra: Mapping[str, Column] = field(default_factory=dict)
    earlier: Mapping[str, FloatArray] = field(default_factory=dict)
    step: float = 0.0

    def __post_init__(self) -> None:
        n = int(np.size(self.t))
        t = floats(self.t, n, "t", self.flight)
        if n < 2:
            raise DataError(
                f"a segment of {n} sample(s)", where=f"flight {self.flight}", expected="at least 2"
            )
        dt, shift = steps_of(t)
        if not np.isfinite(t).all():
            raise DataError(
                f"t has no value at sample {int(np.argmin(np.isfinite(t)))}",
                where=f"flight {self.flight}",
                fix="leave such rows out",
            )
        if dt <= 0:
            raise DataError(
                "t is not increasing",
                where=f"flight {self.flight}",
                fix=STANDS_STILL if dt == 0 else GOES_BACK,
            )
        if shift > CLOCK_TOLERANCE * dt:
            raise DataError(
                f"t is not uniform: off by {shift:.3g} s at a sample time of {dt:.3g} s",
                where=f"flight {self.flight}",
                fix="read_log and dataset_from_arrays put logs on a uniform clock",
            )
        channels = {k: floats(v, n, f"channel {k}", self.flight) for k, v in self.channels.items()}
        for name, values in channels.items():
            if np.isinf(values).any():
                raise DataError(
                    f"channel {name} has an infinite value", where=f"flight {self.flight}"
                )
        extra: dict[str, Column] = {}
        for name, column in self.extra.items():
            array = np.array(column)
            if array.shape != (n,):
                raise DataError(
                    f"extra column {name} has shape {array.shape}", where=f"flight {self.flight}"
                )
            array.setflags(write=False)
            extra[name] = array
        length = min((int(np.size(v)) for v in self.earlier.values()), default=0)
        earlier = {
            k: floats(v, length, f"earlier {k}", self.flight) for k, v in self.earlier.items()
        }
        if not abs(self.step - dt) * (n - 1) <= CLOCK_TOLERANCE * dt:
            object.__setattr__(self, "step", _told_by(t, dt))
        object.__setattr__(self, "earlier", MappingProxyType(earlier))
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "channels", MappingProxyType(channels))
        object.__setattr__(self, "extra", MappingProxyType(extra))

    def __getstate__(self) -> dict[str, object]:
        return {
            "t": self.t,
            "channels": dict(self.channels),
            "flight": self.flight,
            "extra": dict(self.extra),
            "earlier": dict(self.earlier),
            "step": self.step,
        }

    def __setstate__(self, state: dict[str, object]) -> None:
        for name, value in ({"earlier": {}, "step": 0.0} | state).items():
            object.__setattr__(self, name, value)
        self.__post_init__()

    @property
    def n(self) -> int:
        """Number of samples N."""
        return int(self.t.size)

    @property
    def dt(self) -> float:
        """Sample time [s], of 12 digits; segments of one clock agree exactly."""
        return self.step

    @property
    def duration(self) -> float:
        """N dt [s]: the time that the samples stand for."""
        return self.n * self.dt

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(self.channels)

    def _shown_text(self) -> str:
        """What it is, and its channels."""
        what = f"Segment of {self.flight}: {self.n} samples at {1 / self.dt:.6g} Hz"
        return f"{what}, t = {self.t[0]:.6g} to {self.t[-1]:.6g} s\n  {', '.join(self.names)}"

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per channel: smallest, mean and largest value and the share that is missing."""
        rows: list[dict[str, Cell]] = []
        for name, values in self.channels.items():
            known = values[np.isfinite(values)]
            least, mean, most = (
                (float(known.min()), float(known.mean()), float(known.max()))
                if known.size
                else (None, None, None)
            )
            missing = 1.0 - known.size / self.n
            rows.append(
                {"channel": name, "min": least, "mean": mean, "max": most, "missing": missing}
            )
        return rows

    def column(self, name: str) -> FloatArray:
        """One channel (or numeric extra column), (N,), read-only. Raises `UnknownNameError`."""
        if name in self.channels:
            return self.channels[name]
        other = self.extra.get(name)
        if other is not None and is_numeric(other):
            return other
        raise UnknownNameError(
            "channel", name, [*self.channels, *self.extra], where=f"flight {self.flight}"
        )

    def matrix(self, names: Sequence[str], *, missing_ok: bool = False) -> FloatArray:
        """The named columns as (N, len(names)); a fresh array.

        An absent name raises `UnknownNameError`, or is a column of NaN with `missing_ok`.
        """
        out = np.full((self.n, len(names)), np.nan)
        for j, name in enumerate(names):
            if not (missing_ok and name not in self.channels and name not in self.extra):
                out[:, j] = self.column(name)
        return out

    def rows(self, start: int, stop: int) -> Segment:
        """Samples start <= k < stop, with a memory of those before. Raises `DataError` where fewer
        than two are left."""
        start = max(start, 0)
        part, longest = slice(start, max(stop, 0)), max(round(EARLIER / self.dt), 1)
        earlier = self.earlier
        if start:
            known = self.earlier if set(self.channels) <= set(self.earlier) else {}
            past = {k: v[max(start - longest, 0) : start] for k, v in self.channels.items()}
            earlier = {
                k: np.concatenate([known.get(k, v[:0]), v])[-longest:] for k, v in past.items()
            }
        return Segment(
            t=self.t[part],
            channels={k: v[part] for k, v in self.channels.items()},
            flight=self.flight,
            extra={k: v[part] for k, v in self.extra.items()},
            earlier=earlier,
            step=self.step,
        )

    def between(self, t0: float, t1: float) -> Segment:
        """Samples with t0 <= t < t1 [s]. Raises `DataError` where fewer than two are left."""
        start, stop = np.searchsorted(self.t, [t0, t1])
        return self.rows(int(start), int(stop))

    def without(self, names: Collection[str]) -> Segment:
        """A copy without these channels."""
        kept, earlier = (
            {k: v for k, v in d.items() if k not in names} for d in (self.channels, self.earlier)
        )
        return replace(self, channels=kept, earlier=earlier)

    def replace(self, channels: Mapping[str, npt.ArrayLike]) -> Segment:
        """A copy with these channels set or added, (N,) each."""
        merged = {
            **self.channels,
            **{k: np.asarray(v, dtype=np.float64) for k, v in channels.items()},
        }
        return replace(self, channels=merged)
