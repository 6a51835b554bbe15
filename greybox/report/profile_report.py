"""The report of `greybox profile`: per unknown the rise of the likelihood ratio and the interval
that it gives."""

from __future__ import annotations

from typing import TypedDict

import numpy as np

from greybox.report import figures
from greybox.report.html import Cell, Report, Tag


class ProfileRow(TypedDict):
    """The profile of one unknown: estimate with standard error, ends of its interval (not finite, or
    null in the file, where there is none), the likelihood ratio there (`limit`), which of them are
    its bounds, and the cost (K,) over a grid (K,)."""

    name: str
    unit: str
    estimate: float
    std: float | None
    limit: float
    lower: float | None
    upper: float | None
    at_bound: list[str]
    grid: list[float]
    cost: list[float]
    converged: list[bool]


class ProfileDocument(TypedDict):
    """profile.json."""

    schema: str
    command: str
    model: str
    level: float
    profiles: list[ProfileRow]


def profile_report(content: ProfileDocument) -> str:
    """The page for profile.json."""
    report = Report(
        f"Profile likelihood of {content['model']}", f"{len(content['profiles'])} unknown(s)"
    )
    _intervals(report, content)
    _curves(report, content)
    report.section("How to get this again")
    report.code(content["command"])
    return report.html()


def _intervals(report: Report, content: ProfileDocument) -> None:
    report.section("Intervals")
    rows: list[list[Cell]] = []
    for p in content["profiles"]:
        std = p["std"]
        symmetric = (
            None
            if std is None
            else f"{p['estimate'] - 1.96 * std:.4g} .. {p['estimate'] + 1.96 * std:.4g}"
        )
        notes = [f"{side} end is its bound" for side in p["at_bound"]]
        ends = ("lower", p["lower"]), ("upper", p["upper"])
        notes += [f"no {side} end" for side, end in ends if end is None or not np.isfinite(end)]
        note: Cell = Tag(text=", ".join(notes)) if notes else ""
        rows.append(
            [
                p["name"],
                p["estimate"],
                _end(p["lower"]),
                _end(p["upper"]),
                p["unit"],
                symmetric,
                note,
            ]
        )
    report.table(
        ["unknown", "estimate", "lower", "upper", "unit", "estimate ± 1.96 std", ""],
        rows,
        numeric=(1, 2, 3),
        caption=f"The {100 * content['level']:g} % interval: values at which twice the negative "
        "log likelihood, all other unknowns fitted again, lies less than a quantile of chi-square "
        "above its minimum, times what the variance of the fit is over that by the likelihood alone. "
        "Where it differs from the symmetric one, it is the one to believe.",
    )


def _curves(report: Report, content: ProfileDocument) -> None:
    panels = []
    for p in content["profiles"]:
        cost = np.asarray(p["cost"], dtype=np.float64)
        ratio = 2 * (cost - cost.min())
        marks = [
            p["estimate"],
            *(v for v in (p["lower"], p["upper"]) if v is not None and np.isfinite(v)),
        ]
        figure = figures.rise(
            p["grid"],
            ratio,
            limit=p["limit"],
            marks=marks,
            label="likelihood ratio",
            unit=p["unit"],
            title=p["name"],
        )
        panels.append(
            (
                figure,
                f"Likelihood ratio of {p['name']}: a parabola where the symmetric interval is "
                "right.",
            )
        )
    report.figures(panels, caption="Dashed: the level. Dotted: estimate and ends of the interval.")


def _end(value: float | None) -> Cell:
    return None if value is None or not np.isfinite(value) else value
