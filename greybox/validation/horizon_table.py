"""The result of a multi-step evaluation: errors per group and horizon, pooled and per flight, as
JSON and as text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NotRequired, TypedDict

import numpy as np

from greybox.errors import DataError
from greybox.plots import Curve, panels
from greybox.shown import Cell, Shown
from greybox.symbolic import FloatArray, IntArray
from greybox.validation.groups import GROUPS, Groups

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class HorizonCell(TypedDict):
    """Errors of one group at one horizon in a result file; `coverage50`, ...: shares of the error
    vectors in the regions that were stated."""

    mae: float
    rmse: float
    unit: str
    n: int
    diverged: NotRequired[int]
    coverage50: NotRequired[float]
    coverage68: NotRequired[float]
    coverage95: NotRequired[float]
    nlpd: NotRequired[float]


class HorizonRow(TypedDict):
    """One horizon in a result file."""

    h: int
    seconds: float
    groups: dict[str, HorizonCell]


class HorizonDocument(TypedDict):
    """A table in a result file; only its rows and sums where nothing could be predicted."""

    label: NotRequired[str]
    origins: NotRequired[dict[str, dict[str, int]]]
    horizons: list[HorizonRow]
    simerr: dict[str, float]
    per_flight: NotRequired[dict[str, HorizonDocument]]


@dataclass(frozen=True, kw_only=True)
class GroupErrors:
    """Errors of one group at h = 1..H, arrays (H,): index h - 1.

    `mae` and `rmse` [unit of the group] are of the vector norm, `n` the errors behind them,
    `diverged` how many of these predictions were not finite. NaN stands where n = 0. `origins` were
    used and `left_out` lacked reference samples. `block_sums` (B, H) are sums of the error norm
    over the origins of one block of consecutive time, with `block_counts` errors behind them: what
    a standard error is made of. Predictors that were given the same origins have the same blocks.
    `coverage` maps a level to the fraction of error vectors inside the ellipsoid that the stated
    covariance gives to that level, (H,); `nlpd` (H,) is the mean negative log density of the error
    vectors [nat]. None: nothing stated. References are mostly `interval` samples apart: tables list
    no horizon below that, where an error is that of the last reference's age. `axes` are the errors
    of each component of the vector alone, () where it has one.
    """

    mae: FloatArray
    rmse: FloatArray
    n: IntArray
    diverged: IntArray
    origins: int
    left_out: int
    block_sums: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    block_counts: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    coverage: Mapping[float, FloatArray] | None = None
    nlpd: FloatArray | None = None
    interval: int = 1
    axes: tuple[GroupErrors, ...] = ()

    def lists(self, h: int) -> bool:
        """Whether a table has something to say `h` samples ahead."""
        return self.interval <= h <= len(self.mae)


@dataclass(frozen=True, kw_only=True, repr=False)
class HorizonTable(Shown):
    """Multi-step errors of one predictor: `groups` pooled over all flights, `flights` the same for
    each of them.

    `unjudged` groups were measured, but no origin had the references that it needs. `kinds` says of
    every group its unit and columns.
    """

    label: str
    sample_time: float
    required: int
    groups: Mapping[str, GroupErrors]
    flights: Mapping[str, Mapping[str, GroupErrors]] = field(default_factory=dict)
    unjudged: tuple[str, ...] = ()
    kinds: Groups = field(default_factory=lambda: GROUPS)

    @property
    def steps(self) -> int:
        """The longest horizon H."""
        return len(next(iter(self.groups.values())).mae)

    def simerr(self, flight: str | None = None) -> dict[str, float]:
        """Sum over h = 1..required of the mean absolute error, per group [its unit]; of one flight
        if named."""
        groups = self.groups if flight is None else self.flights[flight]
        return {g: float(e.mae[: self.required].sum()) for g, e in groups.items()}

    def _shown_text(self) -> str:
        """The table at some horizons."""
        origins = max((e.origins for e in self.groups.values()), default=0)
        first = (
            f"{self.label}: errors up to {self.steps * self.sample_time:.3g} s ahead, "
            f"{origins} origins"
        )
        return f"{first}\n{format_tables([self])}" if self.groups else first

    def _shown_rows(self, horizons: Iterable[int] | None = None) -> list[dict[str, Cell]]:
        """One row per horizon (default: all) and channel group: errors of the vector norm."""
        steps = range(1, self.steps + 1) if horizons is None else horizons
        return [
            {
                "predictor": self.label,
                "seconds": float(f"{h * self.sample_time:.9g}"),
                "group": name,
                "unit": self.kinds[name].unit if name in self.kinds else "",
                "mae": float(e.mae[h - 1]),
                "rmse": float(e.rmse[h - 1]),
                "n": int(e.n[h - 1]),
            }
            for h in steps
            if h <= self.steps
            for name, e in self.groups.items()
            if e.lists(h)
        ]

    def plot(self, ax: Sequence[Axes] | None = None) -> list[Axes]:
        """Mean absolute error over the horizon, one panel per channel group; matplotlib axes."""
        return plot_tables([self], ax)

    def curve(self) -> dict[str, list[float]]:
        """Mean absolute error at h = 1..H per group [unit of the group], for plots."""
        return {g: e.mae.tolist() for g, e in self.groups.items()}

    def _rows(self, groups: Mapping[str, GroupErrors], horizons: Iterable[int]) -> list[HorizonRow]:
        return [
            {
                "h": int(h),
                "seconds": float(f"{h * self.sample_time:.9g}"),
                "groups": {
                    g: _cell(self.kinds[g].unit, e, h - 1)
                    for g, e in groups.items()
                    if e.n[h - 1] > 0 and e.lists(h)
                },
            }
            for h in horizons
        ]

    def to_dict(self, horizons: Sequence[int] | None = None) -> HorizonDocument:
        """Plain values: label, origins, horizons, simerr, per_flight {name: {horizons, simerr}}.

        `horizons` are the steps to list (default 1, 10, 50 as far as they are there; the whole
        curve with `range(1, table.steps + 1)`). Raises `DataError` for a horizon that was not
        computed.
        """
        wanted = self._check(horizons)
        return {
            "label": self.label,
            "origins": {
                g: {"used": e.origins, "left_out": e.left_out} for g, e in self.groups.items()
            },
            "horizons": self._rows(self.groups, wanted),
            "simerr": self.simerr(),
            "per_flight": {
                name: {"horizons": self._rows(groups, wanted), "simerr": self.simerr(name)}
                for name, groups in self.flights.items()
            },
        }

    def _check(self, horizons: Sequence[int] | None) -> list[int]:
        wanted = (
            [h for h in (1, 10, 50) if h <= self.steps]
            if horizons is None
            else [int(h) for h in horizons]
        )
        bad = [h for h in wanted if not 1 <= h <= self.steps]
        if bad:
            raise DataError(
                f"horizon {bad[0]} was not computed", expected=f"1 .. {self.steps}", got=str(bad[0])
            )
        return wanted

    @property
    def diverged(self) -> int:
        """How many predictions were not finite, over all groups and horizons."""
        return int(sum(e.diverged.sum() for e in self.groups.values()))

    def format(self, horizons: Sequence[int] | None = None, *others: HorizonTable) -> str:
        """A text table of the mean absolute error and SimErr; `others` (baselines) become rows
        below."""
        return format_tables([self, *others], horizons)


def _cell(unit: str, errors: GroupErrors, i: int) -> HorizonCell:
    cell: HorizonCell = {
        "mae": float(errors.mae[i]),
        "rmse": float(errors.rmse[i]),
        "unit": unit,
        "n": int(errors.n[i]),
    }
    if errors.diverged[i]:
        cell["diverged"] = int(errors.diverged[i])
    if errors.coverage is not None and errors.nlpd is not None and np.isfinite(errors.nlpd[i]):
        cell["coverage50"] = float(errors.coverage[0.50][i])
        cell["coverage68"] = float(errors.coverage[0.68][i])
        cell["coverage95"] = float(errors.coverage[0.95][i])
        cell["nlpd"] = float(errors.nlpd[i])
    return cell


def plot_tables(tables: Sequence[HorizonTable], ax: Sequence[Axes] | None = None) -> list[Axes]:
    """Mean absolute error over the horizon, one panel per channel group, a line per predictor."""
    rows: dict[str, list[Curve]] = {}
    for table in tables:
        seconds = table.sample_time * np.arange(1, table.steps + 1, dtype=np.float64)
        for name, errors in table.groups.items():
            label = f"{name} [{table.kinds[name].unit}]" if name in table.kinds else name
            rows.setdefault(label, []).append(Curve(label=table.label, x=seconds, y=errors.mae))
    return panels(rows, x="horizon [s]", ax=ax)


def format_tables(tables: Sequence[HorizonTable], horizons: Sequence[int] | None = None) -> str:
    """Several predictors under each other: mean absolute error at each horizon and SimErr, a block
    per group.

    Raises `DataError` for no table, or a horizon that was not computed.
    """
    if not tables:
        raise DataError("no multi-step table to print")
    wanted = tables[0]._check(horizons)
    width = max(len(t.label) for t in tables)
    lines = []
    for g in tables[0].groups:
        head = "".join(f"{f'{h * tables[0].sample_time:.3g} s':>10}" for h in wanted)
        lines.append(f"{g} [{tables[0].kinds[g].unit}], mean absolute error")
        lines.append(f"  {'':<{width}}{head}{'SimErr':>10}")
        for t in tables:
            if g not in t.groups:
                continue
            cells = "".join(
                f"{t.groups[g].mae[h - 1]:>10.4f}" if t.groups[g].lists(h) else f"{'-':>10}"
                for h in wanted
            )
            lines.append(f"  {t.label:<{width}}{cells}{t.simerr()[g]:>10.3f}")
    return "\n".join(lines)
