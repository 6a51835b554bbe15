"""Validation: the result of `validate`, as a value that prints and saves (schema
"greybox.validate/1")."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypedDict

from greybox.data.dataset import FlightFacts
from greybox.model.verdict import NOT_JUDGED, Verdict, VerdictDocument
from greybox.shown import Cell, Shown
from greybox.validation.adapt import Adaptation, AdaptedRow
from greybox.validation.advice import Hint
from greybox.validation.comparison import standard_of
from greybox.validation.coverage import Coverage, CoverageRow
from greybox.validation.cross_correlation import CrossCorrelation, CrossDocument
from greybox.validation.finding import in_words
from greybox.validation.horizon_table import (
    HorizonDocument,
    HorizonTable,
    format_tables,
    plot_tables,
)
from greybox.validation.metrics import ChannelMetrics, MetricsRow
from greybox.validation.usefulness import judge
from greybox.validation.whiteness import Whiteness, WhitenessDocument

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCHEMA = "greybox.validate/1"
HOLDS = 0.9
"""Share of the errors below which a stated 95 % region is said to be too narrow: twice the misses."""


class AdaptedOn(TypedDict):
    """What was fitted to the first `seconds` of every flight: flight -> parameter -> value."""

    seconds: float
    flights: dict[str, dict[str, AdaptedRow]]


class ValidationDocument(HorizonDocument):
    """validate.json, with the model's own table at its top level."""

    schema: str
    verdict: VerdictDocument | None
    model: dict[str, str | None]
    flights: list[FlightFacts]
    sample_time: float
    persistence: HorizonDocument | None
    dead_reckoning: HorizonDocument | None
    measured_start: HorizonDocument | None
    curves: dict[str, dict[str, list[float]]]
    adapted_on: AdaptedOn | None
    one_step: dict[str, MetricsRow]
    whiteness: WhitenessDocument | None
    cross_correlation: CrossDocument | None
    coverage: dict[str, list[CoverageRow]]
    warnings: list[str]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Validation(Shown):
    """Errors of a model on flights that it was not fitted to.

    `table` holds the model's multi-step errors from the filter's state, `persistence` and
    `dead_reckoning` the rows beside it, `measured_start` the model started from the measured state;
    None where there is nothing to compute. `one_step`, `coverage` per channel; `whiteness` and
    `cross_correlation` of the normalised innovations. `adaptation` per flight, where per-flight
    parameters were fitted on its first `adapted_seconds`. `horizons` are the samples that are
    listed; `verdict` is None where the flights were too short to judge.
    """

    model: str
    file: str | None
    flights: Sequence[FlightFacts]
    sample_time: float
    horizons: tuple[int, ...]
    table: HorizonTable | None
    persistence: HorizonTable | None = None
    dead_reckoning: HorizonTable | None = None
    measured_start: HorizonTable | None = None
    one_step: Mapping[str, ChannelMetrics] = field(default_factory=dict)
    whiteness: Whiteness | None = None
    cross_correlation: CrossCorrelation | None = None
    coverage: Mapping[str, Sequence[Coverage]] = field(default_factory=dict)
    adapted_seconds: float | None = None
    adaptation: Mapping[str, Adaptation] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    verdict: Verdict | None = None

    def _shown_text(self) -> str:
        """The verdict first, then warnings and tables."""
        return self.format()

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per predictor, horizon and channel group: errors of the vector norm."""
        return [row for table in self.tables for row in table._shown_rows(self.horizons)]

    def plot(self, ax: Sequence[Axes] | None = None) -> list[Axes]:
        """Mean absolute error over the horizon, one panel per channel group, a line per predictor;
        matplotlib axes."""
        return plot_tables(self.tables, ax)

    def judged(self, *, hints: Iterable[Hint] = (), judged_on: str | None = None) -> Validation:
        """The same errors, judged again with `hints` and other words for what the flights are to
        the model."""
        if self.verdict is None or self.table is None or self.persistence is None:
            return self
        words = self.verdict.judged_on if judged_on is None else judged_on
        rule = (
            standard_of(self.sample_time) if any(g.own for g in self.table.kinds.values()) else None
        )
        verdict = judge(
            self.table,
            self.persistence,
            self.dead_reckoning,
            judged_on=words,
            hints=hints,
            standard=rule,
        )
        return replace(self, verdict=verdict)

    @property
    def tables(self) -> tuple[HorizonTable, ...]:
        """The rows that are there: model, measured start, persistence, dead reckoning."""
        rows = (self.table, self.measured_start, self.persistence, self.dead_reckoning)
        return tuple(t for t in rows if t is not None)

    def to_dict(self) -> ValidationDocument:
        """Plain values, schema "greybox.validate/1"."""
        own: HorizonDocument = (
            self.table.to_dict(self.horizons)
            if self.table is not None
            else {"horizons": [], "simerr": {}}
        )

        def row(table: HorizonTable | None) -> HorizonDocument | None:
            return None if table is None else table.to_dict(self.horizons)

        adapted: AdaptedOn | None = None
        if self.adapted_seconds is not None:
            adapted = {
                "seconds": self.adapted_seconds,
                "flights": {n: a.to_dict() for n, a in self.adaptation.items()},
            }
        return {
            "schema": SCHEMA,
            "verdict": None if self.verdict is None else self.verdict.to_dict(),
            "model": {"name": self.model, "file": self.file},
            "flights": [f.copy() for f in self.flights],
            "sample_time": self.sample_time,
            **own,
            "persistence": row(self.persistence),
            "dead_reckoning": row(self.dead_reckoning),
            "measured_start": row(self.measured_start),
            "curves": {t.label: t.curve() for t in self.tables},
            "adapted_on": adapted,
            "one_step": {n: m.to_dict() for n, m in self.one_step.items()},
            "whiteness": None if self.whiteness is None else self.whiteness.to_dict(),
            "cross_correlation": None
            if self.cross_correlation is None
            else self.cross_correlation.to_dict(),
            "coverage": {n: [c.to_dict() for c in cs] for n, cs in self.coverage.items()},
            "warnings": list(self.warnings),
        }

    def table_text(self) -> str:
        """The multi-step tables as text, and which stated regions do not hold; "" where there are
        no tables."""
        if not self.tables:
            return ""
        return "\n".join([format_tables(self.tables, self.horizons), *self.too_narrow()])

    def too_narrow(self) -> list[str]:
        """A line, or none, of the groups whose stated 95 % regions hold clearly fewer of the
        errors, each with all horizons where they do."""
        found = []
        for name, errors in () if self.table is None else self.table.groups.items():
            listed = [h for h in self.horizons if errors.lists(h)]
            if errors.coverage is None:
                continue
            share = {h: float(errors.coverage[0.95][h - 1]) for h in listed}
            narrow = {h: s for h, s in share.items() if s < HOLDS}
            if narrow:
                least, most = (f"{100 * f(narrow.values()):.0f}" for f in (min, max))
                held = least if least == most else f"{least} to {most}"
                at = ", ".join(f"{h * self.sample_time:.3g}" for h in narrow)
                found.append(f"{name.replace('_', ' ')} {held} % {at} s ahead")
        return [f"too narrow: the stated 95 % regions hold {'; '.join(found)}"] if found else []

    def format(self) -> str:
        """Text for the terminal: the verdict, warnings, the multi-step tables, one-step errors and
        residual tests."""
        lines = [NOT_JUDGED] if self.verdict is None else self.verdict.lines()
        lines += (
            [f"  {line}" for line in in_words(self.verdict)] if self.verdict is not None else []
        )
        lines += [f"warning: {w}" for w in self.warnings]
        lines.append(
            f"{self.model}: {len(self.flights)} flight(s), "
            f"{sum(f['seconds'] for f in self.flights):.0f} s"
        )
        if self.adapted_seconds is not None:
            lines.append(
                f"per-flight parameters adapted on the first {self.adapted_seconds:g} s of each "
                "flight, then frozen"
            )
        if self.tables:
            lines += ["", self.table_text()]
        if self.one_step:
            lines += [
                "",
                f"{'one step ahead':<14} {'RMSE':>11} {'R2':>13}  {'inside 95 %':>11}",
            ]
            for name, m in self.one_step.items():
                covered = [
                    c.fraction for c in self.coverage.get(name, ()) if abs(c.nominal - 0.95) < 1e-9
                ]
                r2 = f"{m.r2:>7.4f}" if m.r2 is not None else f"{'-':>7}"
                inside = f"{covered[0]:>11.1%}" if covered else f"{'-':>11}"
                lines.append(f"  {name:<12} {m.rmse:>11.4g} {m.unit:<5} {r2}  {inside}")
        if self.whiteness is not None:
            lines += ["", "innovations: are they white?", self.whiteness.format()]
        return "\n".join(lines)
