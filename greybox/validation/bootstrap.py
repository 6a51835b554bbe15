"""Confidence intervals of a statistic of flight data by resampling flights, then blocks of
consecutive samples.

Samples of one flight are correlated and flights differ, so that an interval that counts samples is
far too narrow. Blocks keep the correlation in time (H. R. Kuensch, "The jackknife and the bootstrap
for general stationary observations", Annals of Statistics 17(3), 1989); drawing whole flights first
keeps the difference between flights (A. C. Davison and D. V. Hinkley, "Bootstrap Methods and their
Application", 1997, section 3.8). Drawing both counts the variation inside a flight twice, which
errs on the wide side; with one flight only blocks are drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
import numpy.typing as npt

from greybox.errors import DataError
from greybox.symbolic import FloatArray
from greybox.validation.samples import stretches


class IntervalRow(TypedDict):
    """An `Interval` in a result file."""

    low: float
    high: float
    level: float
    method: str


@dataclass(frozen=True, kw_only=True)
class Interval:
    """A confidence interval low .. high at `level` (0.95 = 95 %), and how it was made."""

    low: float
    high: float
    level: float
    method: str

    def to_dict(self) -> IntervalRow:
        """Plain values under the names of the fields."""
        return {"low": self.low, "high": self.high, "level": self.level, "method": self.method}


def _mean(rows: FloatArray) -> float:
    return float(rows.mean())


def block_bootstrap(
    flights: Sequence[npt.ArrayLike],
    statistic: Callable[[FloatArray], float] = _mean,
    *,
    block: int,
    draws: int = 1000,
    level: float = 0.95,
    seed: int = 0,
) -> Interval:
    """Percentile interval of `statistic` of the rows of all flights together.

    `flights`: one array (N_f,) or (N_f, d) each; rows with NaN are left out. `statistic` takes rows
    (n, d). `block` is the number of consecutive samples that stay together: several times the
    correlation time. Raises `DataError` for a block that is no positive number, a level outside (0,
    1), or flights without data.
    """
    if block < 1 or draws < 20 or not 0.0 < level < 1.0:
        raise DataError("block bootstrap: block >= 1, draws >= 20 and 0 < level < 1 are needed")
    parts = [p[np.isfinite(p).all(axis=1)] for p in stretches(flights, what="bootstrap")]
    parts = [p for p in parts if len(p)]
    if not parts:
        raise DataError("block bootstrap: no sample is left", fix="check the mask")
    rng = np.random.default_rng(seed)
    offset = np.arange(block)
    if statistic is _mean and all(len(p) >= block for p in parts):
        values = _drawn_means(parts, block, draws, rng)
    else:
        values = np.empty(draws)
        for i in range(draws):
            rows = []
            for f in rng.integers(len(parts), size=len(parts)):
                part = parts[f]
                # Circular blocks: every sample is drawn equally often, also those at the ends.
                start = rng.integers(len(part), size=-(-len(part) // block))
                rows.append(part[((start[:, None] + offset).ravel() % len(part))[: len(part)]])
            values[i] = statistic(np.concatenate(rows))
    low, high = np.quantile(values, [0.5 - level / 2, 0.5 + level / 2])
    kind = "flights and blocks" if len(parts) > 1 else "blocks of one flight"
    method = f"bootstrap over {kind}, {block} samples each"
    return Interval(low=float(low), high=float(high), level=level, method=method)


def _drawn_means(
    parts: Sequence[FloatArray], block: int, draws: int, rng: np.random.Generator
) -> FloatArray:
    """Means of draws as in `block_bootstrap`, (draws,), from running sums instead of the drawn
    rows."""
    total, count = np.zeros(draws), np.zeros(draws)
    times = rng.multinomial(len(parts), np.full(len(parts), 1.0 / len(parts)), size=draws)
    for part, often in zip(parts, times.T, strict=True):
        n = len(part)
        sums = np.concatenate([[0.0], np.cumsum(np.concatenate([part, part[:block]]).sum(axis=1))])
        start = rng.integers(n, size=(int(often.sum()), -(-n // block)))
        end = start + block
        end[:, -1] = start[:, -1] + n - (start.shape[1] - 1) * block
        np.add.at(total, np.repeat(np.arange(draws), often), (sums[end] - sums[start]).sum(axis=1))
        count += often * part.size
    return total / count
