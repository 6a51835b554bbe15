"""Plan: what to fly, what it is expected to tell, and how much better that is than flying without a
plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from greybox.data import Dataset
from greybox.estimation.identifiability import Combination
from greybox.model.identified import library_versions
from greybox.planning.document import FlightRow, PlanDocument, PlannedRow
from greybox.planning.excitation_blocks import ExcitationBlock
from greybox.planning.information import Information, Pair
from greybox.planning.limits import Limits
from greybox.planning.planning_case import PlanningCase
from greybox.shown import Cell, Shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCHEMA = "greybox.plan/1"
Step = tuple[ExcitationBlock, float]


@dataclass(frozen=True, kw_only=True, repr=False)
class Plan(Shown):
    """What to fly and what it is expected to tell. `flights` are lists of (piece, amplitude), `log`
    their noise-free logs.

    `errors` and `naive` map parameters to (standard error, the same without what is known before)
    of the plan and of hover plus figure of eight of the same length; `efficiency` compares the two
    (`information.efficiency`).
    """

    subject: PlanningCase
    limits: Limits
    flights: tuple[tuple[Step, ...], ...]
    log: Dataset
    information: Information
    errors: Mapping[str, tuple[float, float]]
    naive: Mapping[str, tuple[float, float]]
    efficiency: float
    pairs: tuple[Pair, ...]
    unidentified: tuple[Combination, ...]
    left_out: tuple[str, ...]
    warnings: tuple[str, ...]
    seed: int

    @property
    def seconds(self) -> float:
        """Length of all flights [s]."""
        return sum(p.seconds for f in self.flights for p, _ in f)

    def to_dict(self) -> PlanDocument:
        """The content of plan.json (schema "greybox.plan/1")."""
        s = self.subject
        return {
            "schema": SCHEMA,
            "vehicle": s.physics.vehicle.name,
            "effects": [e.name for e in s.physics.effects],
            "sensors": [x.name for x in s.physics.sensors],
            "sample_time": s.sample_time,
            "seconds": self.seconds,
            "seed": self.seed,
            "limits": self.limits.to_dict(),
            "used": self.limits.used(self.log),
            "home": list(self.limits.home),
            "flights": self._flights(),
            "parameters": self._parameters(),
            "efficiency": {
                "against": "hover and figure of eight of the same length",
                "as_long": None if self.naive_blind else self.efficiency,
                "median_std_ratio": None if self.naive_blind else self.median_ratio,
                "not_seen_by_it": list(self.naive_blind),
                "text": self.comparison,
            },
            "pairs": [
                {
                    "effects": list(p.effects),
                    "overlap": p.overlap,
                    "expected_log_likelihood_ratio": p.expected,
                    "separated": p.separated,
                    "verdict": p.verdict,
                }
                for p in self.pairs
            ],
            "unidentifiable": [c.text for c in self.unidentified],
            "cannot_be_flown": list(self.left_out),
            "warnings": list(self.warnings),
            "noise": dict(s.noise),
            "versions": library_versions(),
        }

    def _parameters(self) -> dict[str, PlannedRow]:
        """What is known of every parameter, before and after."""
        s = self.subject
        declared, known = s.declared, s.known_before
        rows: dict[str, PlannedRow] = {}
        for n, (std, alone) in self.errors.items():
            d = declared[n]
            rows[n] = {
                "value": s.values[n],
                "unit": d.unit,
                "scope": d.scope,
                "wanted": n in s.wanted,
                "std": std,
                "std_before": known.get(n),
                "std_flights_alone": alone,
                "std_naive": self.naive[n][0],
            }
        return rows

    def _flights(self) -> list[FlightRow]:
        """The manoeuvres of every flight, with their times."""
        flights: list[FlightRow] = []
        for k, steps in enumerate(self.flights):
            starts = np.cumsum([0.0, *(p.seconds for p, _ in steps)])
            flights.append(
                {
                    "file": f"flight_{k + 1}.csv",
                    "seconds": float(starts[-1]),
                    "manoeuvres": [
                        {
                            "name": p.name,
                            "text": p.text,
                            "kind": p.kind,
                            "start": float(t),
                            "seconds": p.seconds,
                            "amplitude": a,
                            "injected": p.injected,
                        }
                        for (p, a), t in zip(steps, starts, strict=False)
                    ],
                }
            )
        return flights

    @property
    def median_ratio(self) -> float:
        """Median over the wanted parameters that the flights see of the naive flight's standard
        error over the plan's."""
        seen = [n for n in self.subject.wanted if np.isfinite(self.errors[n][1])] or list(
            self.subject.wanted
        )
        return float(np.median([self.naive[n][0] / self.errors[n][0] for n in seen]))

    @property
    def naive_blind(self) -> tuple[str, ...]:
        """Wanted parameters that the plan sees and the naive flight does not see at all."""
        return tuple(
            n
            for n in self.subject.wanted
            if np.isfinite(self.errors[n][1]) and not np.isfinite(self.naive[n][1])
        )

    def _shown_text(self) -> str:
        """The summary."""
        return self.summary()

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per parameter: standard errors before, after and by a naive flight."""
        s = self.subject
        return [
            {
                "parameter": n,
                "value": s.values[n],
                "unit": s.declared[n].unit,
                "std before": s.known_before.get(n),
                "std after": std,
                "std of a naive flight": self.naive[n][0],
            }
            for n, (std, _) in self.errors.items()
        ]

    def plot(self, flight: int = 0, ax: Sequence[Axes] | None = None) -> list[Axes]:
        """The planned flight number `flight` (from 0) as it would be logged without noise;
        matplotlib axes."""
        return self.log.plot(flight=self.log.names[flight], ax=ax)

    def summary(self) -> str:
        """The plan as text."""
        s, lines = self.subject, []
        declared, known = s.declared, s.known_before
        for k, steps in enumerate(self.flights):
            lines.append(
                f"flight {k + 1}, {sum(p.seconds for p, _ in steps):g} s from hover at "
                f"{self.limits.home[2]:.2f} m:"
            )
            t = 0.0
            for p, a in steps:
                lines.append(f"  {t:5.1f} s  {p.text}  ({100 * a:.0f} %)")
                t += p.seconds
        width = max(len(n) for n in self.errors)
        lines += [
            "",
            f"{'':{width}}  {'value':>12} {'std before':>10} {'std after':>10} {'naive':>10}",
        ]
        for n, (std, alone) in self.errors.items():
            mark = "" if np.isfinite(alone) else "  (not seen by itself)"
            spread = f"{known.get(n, np.inf):10.2g} {std:10.2g} {self.naive[n][0]:10.2g}"
            lines.append(f"{n:{width}}  {s.values[n]:12.5g} {spread} {declared[n].unit}{mark}")
        lines.append(self.comparison)
        for two in self.pairs:
            detail = f"log likelihood ratio {two.expected:.3g}, overlap {two.overlap:.2f}"
            lines.append(f"{two.effects[0]} and {two.effects[1]}: {two.verdict} ({detail})")
        lines += [f"not identified by the flights alone: {c.text}" for c in self.unidentified]
        lines += [f"warning: {w}" for w in self.warnings]
        return "\n".join(lines)

    @property
    def comparison(self) -> str:
        """The plan against hover and figure of eight, in words."""
        if self.naive_blind:
            return (
                "hover and figure of eight of the same length say nothing about "
                f"{', '.join(self.naive_blind)}"
            )
        return (
            f"hover and figure of eight would have to last {self.efficiency:.1f} times as long for "
            "the same confidence region; of the same length their standard errors are "
            f"{self.median_ratio:.1f} times as large (median)"
        )
