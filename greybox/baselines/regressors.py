"""Black-box predictors: the interface that all share, and the past samples that they see.

Of the sample at t_k a predictor may know measurements up to t_(k-1) and inputs up to
t_(k-`newest`). `newest` is 1 unless the user says 0: the command that begins at t_k cannot have
moved a plant whose actuators take time, and a flight controller computes it from the measurements
of t_k, so that in closed loop it gives their noise away.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypedDict

import numpy as np
import numpy.typing as npt

from greybox.data import Dataset, Segment
from greybox.data.channel import channel, is_canonical
from greybox.errors import DataError
from greybox.symbolic import FloatArray, IntArray, Layout, Signal

Data = Dataset | Segment | Sequence[Segment]
"""Flights that a black box is trained on, or judged."""
Choice = bool | int | float | str
Space = Mapping[str, Sequence[Choice]]
"""What a search draws from: keyword of a training -> its values."""
Point = Mapping[str, Any]
"""What it drew: keywords of a training, as they are handed on, and how well they did."""


class NotMeasured(DataError):
    """A method learns from channel groups (`needs`) that the flights do not have."""

    def __init__(self, message: str, *, needs: Sequence[str], where: str, fix: str) -> None:
        super().__init__(message, where=where, fix=fix)
        self.needs = tuple(needs)


class Descent(TypedDict):
    """What happened while a network was trained: lowest validation error, epochs, why it ended,
    errors of all epochs."""

    validation: float
    epochs: int
    ended: str
    history: list[float]


class NetworkReport(TypedDict, total=False):
    """`Descent` with what it began with and, of a search, all candidates; empty where nobody
    said."""

    validation: float
    epochs: int
    ended: str
    history: list[float]
    settings: dict[str, Choice]
    seed: int
    samples: int
    seconds: float
    search: list[dict[str, Choice]]


class Predictor(Protocol):
    """What predicts measured channels, mean and variance, from the past of a segment; arrays have
    time first.

    `parameters` is how many numbers the training chose, `train_seconds` what it took.
    """

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the n_y channels that it predicts."""
        ...

    @property
    def parameters(self) -> int:
        """How many numbers were trained."""
        ...

    @property
    def train_seconds(self) -> float:
        """Time that training took [s]."""
        ...

    def one_step(self, segment: Segment) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (n, n_y) of every sample from what is known before it; NaN where too
        little is."""
        ...

    def free_run(
        self, segment: Segment, origins: npt.ArrayLike, horizon: int
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, horizon, n_y) of the samples k+1 .. k+horizon from every origin k.

        Measurements up to k are known, and the recorded inputs. NaN where the past has a hole, and
        past the end.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class Lags:
    """`n_a` past samples of every output and `n_b` of every input, the newest input `newest`
    samples old.

    A row of regressors is (y[t-1], ..., y[t-n_a], u[t-newest], ..., u[t-newest-n_b+1]), all
    channels of one instant together. Raises `DataError` for lags that are not positive.
    """

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    n_a: int = 4
    n_b: int = 4
    newest: int = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "outputs", tuple(self.outputs))
        object.__setattr__(self, "inputs", tuple(self.inputs))
        if self.n_a < 1 or self.n_b < 1 or self.newest not in (0, 1):
            raise DataError(
                f"lags n_a = {self.n_a}, n_b = {self.n_b}, newest = {self.newest}",
                expected="n_a and n_b at least 1, newest 1 (or 0, which sees the command of the "
                "same instant)",
            )
        if not self.outputs:
            raise DataError("no output channel", fix="name at least one")

    @property
    def width(self) -> int:
        """Number of regressors n_z."""
        return self.n_a * len(self.outputs) + self.n_b * len(self.inputs)

    @property
    def history(self) -> int:
        """Number of samples before the predicted one that are needed."""
        return max(self.n_a, self.n_b + self.newest - 1)

    @property
    def layout(self) -> Layout:
        """Names p[t-1] and so on, with units."""
        past = [(n, i + 1) for i in range(self.n_a) for n in self.outputs]
        moved = [(n, i + self.newest) for i in range(self.n_b) for n in self.inputs]
        return Layout(
            [Signal(name=f"{n}[t-{i}]" if i else f"{n}[t]", unit=_unit(n)) for n, i in past + moved]
        )

    @property
    def output_layout(self) -> Layout:
        """The outputs with units."""
        return Layout([Signal(name=n, unit=_unit(n)) for n in self.outputs])

    def measured(self, segment: Segment) -> FloatArray:
        """The outputs (n, n_y) of a segment, quaternions without jumps of sign, the first with w >=
        0."""
        y = segment.matrix(self.outputs)
        at = [self.outputs.index(n) for n in ("qw", "qx", "qy", "qz") if n in self.outputs]
        if len(at) == 4:
            q = np.where(np.isfinite(y[:, at]), y[:, at], 0.0)
            flips = np.sign(np.sum(q[1:] * q[:-1], axis=1))
            y[1:, at] *= np.cumprod(np.where(flips < 0, -1.0, 1.0))[:, None]
            if q[0, 0] < 0:
                y[:, at] *= -1.0
        return y

    def rows(self, segment: Segment) -> FloatArray:
        """Regressors (n, n_z) of every sample; NaN where the past has a hole or begins too late."""
        return self.joined(self.past_outputs(self.measured(segment)), self.past_inputs(segment))

    def past_outputs(self, y: FloatArray) -> FloatArray:
        """(n, n_a n_y) from outputs (n, n_y)."""
        return _lagged(y, range(1, self.n_a + 1))

    def past_inputs(self, segment: Segment) -> FloatArray:
        """(n, n_b n_u)."""
        return _lagged(segment.matrix(self.inputs), range(self.newest, self.newest + self.n_b))

    @staticmethod
    def joined(past: FloatArray, moved: FloatArray) -> FloatArray:
        """Regressors from past outputs and past inputs."""
        return np.concatenate([past, moved], axis=-1)

    def pushed(self, past: FloatArray, new: FloatArray) -> FloatArray:
        """Past outputs (m, n_a n_y) one sample later, `new` (m, n_y) the latest."""
        return np.concatenate([new, past[:, : (self.n_a - 1) * len(self.outputs)]], axis=1)

    def starts(
        self, segment: Segment, origins: npt.ArrayLike, horizon: int
    ) -> tuple[FloatArray, FloatArray]:
        """Past outputs (m, n_a n_y) at k+1 for every origin k, and past inputs (m, horizon, n_b
        n_u), NaN past the end.

        Raises `DataError` for origins outside the segment.
        """
        k = inside(segment, origins)
        y = self.measured(segment)
        past = self.past_outputs(np.vstack([y, np.full((1, y.shape[1]), np.nan)]))[k + 1]
        u = segment.matrix(self.inputs)
        # Past the end nothing is recorded, but the sample right after it needs only what came
        # before.
        longer = np.vstack([u, np.full((horizon, u.shape[1]), np.nan)])
        moved = _lagged(longer, range(self.newest, self.newest + self.n_b))
        return past, moved[k[:, None] + 1 + np.arange(horizon)]

    def pairs(
        self, segments: Iterable[Segment]
    ) -> tuple[FloatArray, FloatArray, npt.NDArray[np.str_]]:
        """Complete regressors (N, n_z), outputs (N, n_y) and flight names (N,) of all segments.
        Raises `DataError`."""
        z, y, names = [], [], []
        for s in segments:
            rows, values = self.rows(s), self.measured(s)
            whole = np.isfinite(rows).all(axis=1) & np.isfinite(values).all(axis=1)
            z.append(rows[whole])
            y.append(values[whole])
            names.append(np.full(int(whole.sum()), s.flight))
        if not z or not sum(len(part) for part in z):
            raise DataError(
                "no sample has a complete past",
                expected=f"{self.history + 1} samples in a row without missing cells",
            )
        return np.concatenate(z), np.concatenate(y), np.concatenate(names)


def segments_of(data: Data) -> tuple[Segment, ...]:
    """The segments of a data set, a segment, or several."""
    if isinstance(data, Segment):
        return (data,)
    return data.segments if isinstance(data, Dataset) else tuple(data)


def inside(segment: Segment, origins: npt.ArrayLike) -> IntArray:
    """Origins (m,) of a free run. Raises `DataError` for one outside the segment."""
    k = np.asarray(origins, dtype=np.int64).ravel()
    if k.size and (k.min() < 0 or k.max() >= segment.n):
        raise DataError("an origin lies outside the segment", expected=f"0 .. {segment.n - 1}")
    return k


def _lagged(values: FloatArray, lags: Iterable[int]) -> FloatArray:
    """Columns of `values` (n, d) delayed by every lag, (n, d times number of lags); NaN before the
    start."""
    n, d = values.shape
    parts = []
    for lag in lags:
        part = np.full((n, d), np.nan)
        if lag < n:
            part[lag:] = values[: n - lag]
        parts.append(part)
    return np.concatenate(parts, axis=1)


def _unit(name: str) -> str:
    return channel(name).unit if is_canonical(name) else "1"
