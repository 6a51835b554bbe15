"""Multi-step errors: open-loop predictions h = 1..H from every origin, in the IDSIA metric.

From origin k the model predicts samples k+1..k+H with the recorded commands; the error is the norm
per group (`groups`), pooled over all origins that have all `required` steps; origins never cross a
gap. SimErr of a group is the sum over h = 1..required of its mean absolute error (R. Busetto et
al., nano-drone benchmark, 2026).

Errors are summed while they are computed: one stretch of one flight at a time is in memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from greybox.errors import DataError, UnknownNameError
from greybox.statistics.distributions import chi_square_quantile
from greybox.symbolic import BoolArray, FloatArray, IntArray
from greybox.validation.coverage import mahalanobis_squared
from greybox.validation.groups import GROUPS, Group, Groups, error_vectors
from greybox.validation.horizon_table import GroupErrors, HorizonTable
from greybox.validation.predictive import LEVELS, gaussian_nlpd
from greybox.validation.samples import complete_rows

REQUIRED = 50
"""Steps that an origin must have ahead of it, and over which SimErr sums."""
BLOCK_SECONDS = 2.0
"""Origins of so many seconds make one block: twice the longest horizon (1 s) that is judged by
blocks, so that most errors of one block share no sample with those of the next but one, and a
flight of 40 s still has twenty."""

GOLDEN = (5.0**0.5 - 1.0) / 2.0
"""The golden section: its multiples fill an interval evenly, and in step with no other number."""


def spread_origins(rows: IntArray, every: int) -> IntArray:
    """One of every `every` consecutive `rows` (n,).

    Its place among them moves on by the golden section: a fixed stride would keep step with a
    sensor that is slower than the rows, and meet its samples at all origins or at none.
    """
    cell = np.arange(-(-len(rows) // every), dtype=np.int64)
    at = every * cell + (every * (cell * GOLDEN % 1.0)).astype(np.int64)
    return rows[at[at < len(rows)]]


def strided(rows: IntArray, every: int, references: Iterable[FloatArray]) -> IntArray:
    """Every `every`-th of the `rows`, spread where one of the `references` (N, dimension) is slower
    than the rows."""
    measured = [complete_rows(r) for r in references]
    slow = any(m.any() and not m.all() for m in measured)
    return spread_origins(rows, every) if slow else rows[::every]


def complete_origins(
    present: BoolArray, origins: IntArray, *, required: int = REQUIRED
) -> BoolArray:
    """Which origins k (n,) have a reference at each of k..k+required, (n,), where `present` (N,)
    says what is there."""
    total = np.concatenate([[0], np.cumsum(present)])
    complete: BoolArray = total[origins + required + 1] - total[origins] == required + 1
    return complete


@dataclass(kw_only=True)
class _Sums:
    """Running sums of one group in one flight, (H,) each."""

    count: FloatArray
    absolute: FloatArray
    square: FloatArray
    diverged: FloatArray
    covered: dict[float, FloatArray]
    judged: FloatArray
    density: FloatArray
    blocks: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)
    origins: int = 0
    left_out: int = 0
    interval: int = 1
    axes: tuple[_Sums, ...] = ()

    @classmethod
    def zeros(cls, steps: int, axes: int = 0) -> _Sums:
        return cls(
            axes=tuple(cls.zeros(steps) for _ in range(axes)),
            count=np.zeros(steps),
            absolute=np.zeros(steps),
            square=np.zeros(steps),
            diverged=np.zeros(steps),
            covered={level: np.zeros(steps) for level in LEVELS},
            judged=np.zeros(steps),
            density=np.zeros(steps),
        )

    def sum(self, errors: FloatArray, wanted: BoolArray, edges: IntArray) -> None:
        """Add the absolute `errors` (n, H) of those origins and horizons that are `wanted`; blocks
        begin at `edges`."""
        diverged = wanted & ~np.isfinite(errors)
        sizes = np.where(diverged, np.inf, np.where(wanted, errors, 0.0))
        self.origins += len(sizes)
        self.count += wanted.sum(axis=0)
        self.diverged += diverged.sum(axis=0)
        self.absolute += sizes.sum(axis=0)
        self.square += (sizes * sizes).sum(axis=0)
        for part, seen in zip(np.split(sizes, edges), np.split(wanted, edges), strict=True):
            self.blocks.append((part.sum(axis=0), seen.sum(axis=0).astype(np.float64)))


@dataclass(kw_only=True)
class HorizonAccumulator:
    """Sums up multi-step errors stretch by stretch; `table()` gives the result so far.

    `steps` H is the longest horizon, `required` the steps that an origin must have (SimErr sums
    over these); horizons beyond `required` are pooled over the origins that reach that far.
    `missing="origin"` drops an origin from a group where any reference sample of k..k+required is
    missing; `"step"` drops only the missing samples (for references that are sampled more slowly
    than the model). `groups` are those that predictions may have; `block_seconds` [s] is the length
    of the blocks that standard errors are made of.
    """

    label: str
    sample_time: float
    steps: int = REQUIRED
    required: int = REQUIRED
    missing: str = "origin"
    groups: Groups = field(default_factory=lambda: GROUPS)
    block_seconds: float = BLOCK_SECONDS
    _flights: dict[str, dict[str, _Sums]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if not 1 <= self.required <= self.steps or not self.sample_time > 0:
            raise DataError("horizon: 1 <= required <= steps and sample_time > 0 are needed")
        if self.missing not in ("origin", "step"):
            raise DataError(f"horizon: missing = '{self.missing}'", expected="'origin' or 'step'")

    def add(
        self,
        flight: str,
        predictions: Mapping[str, FloatArray],
        references: Mapping[str, FloatArray],
        origins: npt.ArrayLike,
        *,
        covariances: Mapping[str, FloatArray] | None = None,
    ) -> None:
        """Add one stretch without gap.

        `references[group]` (N, dimension), NaN = missing; `origins` (n,) indices into it;
        `predictions[group]` (n, H, dimension) with [:, h - 1] the prediction of sample origin + h;
        `covariances[group]` (n, H, d, d) of the prediction error including the reference's own
        noise (rotation: body axes), NaN where none is stated: those samples take no part in
        coverage and density. Groups without reference are omitted. A prediction that is not finite
        counts as diverged: its error is infinite. Raises `DataError` for arrays that do not match
        and for origins without all their steps, `UnknownNameError` for an unknown group.
        """
        starts = np.asarray(origins, dtype=np.int64).ravel()
        sums = self._flights.setdefault(flight, {})
        for name in predictions:
            if name not in self.groups:
                raise UnknownNameError("channel group", name, self.groups)
        for name in (g for g in self.groups if g in predictions and g in references):
            reference, predicted = np.asarray(references[name]), np.asarray(predictions[name])
            expected = (len(starts), self.steps, self.groups[name].dimension)
            if (
                predicted.shape != expected
                or reference.ndim != 2
                or reference.shape[1] != expected[2]
            ):
                raise DataError(
                    f"{flight}, {name}: arrays do not match",
                    expected=f"predictions {expected} and references (N, {expected[2]})",
                    got=f"{predicted.shape} and {reference.shape}",
                )
            if len(starts) and not (
                starts.min() >= 0 and starts.max() + self.required < len(reference)
            ):
                raise DataError(
                    f"{flight}: an origin lacks its {self.required} steps",
                    expected=f"0 <= origin < {len(reference) - self.required}",
                    got=f"{starts.min()} .. {starts.max()}",
                )
            present = complete_rows(reference)
            if not present.any():
                continue
            axes = self.groups[name].error_dimension
            own = sums.setdefault(name, _Sums.zeros(self.steps, axes if axes > 1 else 0))
            apart = np.diff(np.flatnonzero(present))
            own.interval = max(own.interval, int(np.median(apart)) if apart.size else 1)
            keep = self._usable(present, starts)
            own.left_out += int(len(starts) - keep.sum())
            if not keep.any():
                continue
            covariance = (
                None if covariances is None or name not in covariances else covariances[name][keep]
            )
            self._sum(own, self.groups[name], predicted[keep], reference, starts[keep], covariance)

    def _usable(self, present: BoolArray, starts: IntArray) -> BoolArray:
        """Which origins count: the same ones for every predictor, so that rows of a table
        compare."""
        if self.missing == "step":
            return np.logical_or.accumulate(present)[starts]
        return complete_origins(present, starts, required=self.required)

    def _sum(
        self,
        own: _Sums,
        kind: Group,
        predicted: FloatArray,
        reference: FloatArray,
        starts: IntArray,
        covariance: FloatArray | None,
    ) -> None:
        index = starts[:, None] + np.arange(1, self.steps + 1)
        inside = index < len(reference)
        target = np.where(
            inside[..., None], reference[np.minimum(index, len(reference) - 1)], np.nan
        )
        wanted: BoolArray = np.all(np.isfinite(target), axis=2)
        errors = error_vectors(kind, predicted, target)
        norms = np.linalg.norm(errors, axis=2)
        diverged = wanted & ~np.isfinite(norms)
        length = max(1, round(self.block_seconds / self.sample_time))
        edges = np.flatnonzero(np.diff(starts // length)) + 1
        own.sum(norms, wanted, edges)
        for i, axis in enumerate(own.axes):
            axis.sum(np.abs(errors[..., i]), wanted, edges)
        if covariance is not None:
            stated = wanted & np.isfinite(covariance).all(axis=(2, 3))
            judged = stated & ~diverged
            distance, density = (
                np.full(norms.shape, np.inf),
                np.where(stated & diverged, np.inf, 0.0),
            )
            distance[judged] = mahalanobis_squared(errors[judged], covariance[judged])
            density[judged] = gaussian_nlpd(errors[judged], covariance[judged])
            own.judged += stated.sum(axis=0)
            own.density += density.sum(axis=0)
            for level in LEVELS:
                limit = chi_square_quantile(level, kind.error_dimension)
                own.covered[level] += (stated & (distance <= limit)).sum(axis=0)

    def table(self) -> HorizonTable:
        """The table so far. Raises `DataError` where no origin was usable in any group."""
        flights = {
            name: {g: _finish([s]) for g, s in groups.items() if s.origins}
            for name, groups in self._flights.items()
        }
        if not any(flights.values()):
            raise DataError(
                f"{self.label}: no origin has {self.required} steps ahead of it with a reference",
                fix="a longer flight, fewer adaptation seconds, or a finer look at what was logged",
            )
        pooled: dict[str, GroupErrors] = {}
        for g in self.groups:
            parts: Sequence[_Sums] = [
                f[g] for f in self._flights.values() if g in f and f[g].origins
            ]
            if parts:
                pooled[g] = _finish(parts)
        measured = {g for f in self._flights.values() for g in f}
        return HorizonTable(
            label=self.label,
            sample_time=self.sample_time,
            required=self.required,
            groups=pooled,
            flights=flights,
            unjudged=tuple(g for g in self.groups if g in measured and g not in pooled),
            kinds=self.groups,
        )


def _finish(parts: Sequence[_Sums]) -> GroupErrors:
    count = np.asarray(sum(p.count for p in parts))
    judged = np.asarray(sum(p.judged for p in parts))
    safe = np.maximum(count, 1.0)
    coverage, nlpd = None, None
    if judged.any():
        nlpd = np.where(judged > 0, sum(p.density for p in parts) / np.maximum(judged, 1.0), np.nan)
        coverage = {
            level: np.where(
                judged > 0, sum(p.covered[level] for p in parts) / np.maximum(judged, 1.0), np.nan
            )
            for level in LEVELS
        }
    return GroupErrors(
        mae=np.where(count > 0, sum(p.absolute for p in parts) / safe, np.nan),
        rmse=np.where(count > 0, np.sqrt(sum(p.square for p in parts) / safe), np.nan),
        n=count.astype(np.int64),
        diverged=np.asarray(sum(p.diverged for p in parts)).astype(np.int64),
        origins=sum(p.origins for p in parts),
        left_out=sum(p.left_out for p in parts),
        block_sums=np.array([total for p in parts for total, _ in p.blocks]),
        block_counts=np.array([count for p in parts for _, count in p.blocks]),
        coverage=coverage,
        nlpd=nlpd,
        interval=min(p.interval for p in parts),
        axes=tuple(_finish(same) for same in zip(*(p.axes for p in parts), strict=True)),
    )
