"""Sections of a report that show a validation result (greybox.validate/1): errors against horizon,
residual tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
from matplotlib.figure import Figure

from greybox.data.channel import group_of
from greybox.model.verdict import NOT_JUDGED, Outcome, Verdict, VerdictDocument
from greybox.report import figures
from greybox.report.html import Cell, Key, Report, Tag
from greybox.report.svg import SERIES
from greybox.report.words import cross_verdict, number, p_value, whiteness_verdict
from greybox.shown import in_degrees
from greybox.validation.finding import in_words

if TYPE_CHECKING:
    from greybox.validation.cross_correlation import CrossDocument
    from greybox.validation.horizon_table import HorizonDocument
    from greybox.validation.result import ValidationDocument
    from greybox.validation.whiteness import ChannelWhitenessRow, WhitenessDocument

ROWS = (
    ("model", "model", SERIES[0], "-", Key(text="model", colour="c1")),
    (
        "measured_start",
        "model, from the measured state",
        SERIES[4],
        "--",
        Key(text="model, from the measured state", colour="c5", stroke="dash"),
    ),
    (
        "persistence",
        "persistence (ceiling)",
        SERIES[3],
        "--",
        Key(text="persistence: last value held (ceiling)", colour="c4", stroke="dash"),
    ),
    (
        "dead_reckoning",
        "dead reckoning (floor)",
        SERIES[2],
        ":",
        Key(text="dead reckoning with the measured IMU (floor)", colour="c3", stroke="dots"),
    ),
)


ORDER = (
    Key(text="first channel of a title", colour="c1"),
    Key(text="second", colour="c2"),
    Key(text="third", colour="c3"),
)


BESIDE: tuple[Literal["measured_start", "persistence", "dead_reckoning"], ...]
BESIDE = "measured_start", "persistence", "dead_reckoning"
"""Rows beside that of the model."""


def first_line(report: Report, verdict: VerdictDocument | None) -> None:
    """The verdict on a model (as in model.json) as the first line of its report, with its reasons;
    that there is none where there is none."""
    if verdict is None:
        report.first_line(NOT_JUDGED, good=False)
    else:
        good = verdict["outcome"] == Outcome.USABLE.value
        report.first_line(verdict["line"], verdict.get("why", ()), good=good)


def skill_in_words(report: Report, verdict: VerdictDocument | None) -> None:
    """What the model covers of the way from the last value to the measured IMU, a sentence per
    group."""
    if verdict is not None:
        report.bullets(in_words(Verdict.from_dict(verdict)))


def _tables(validation: ValidationDocument) -> dict[str, HorizonDocument]:
    """Multi-step tables by row name, the model's first."""
    found: dict[str, HorizonDocument] = {"model": validation}
    for row in BESIDE:
        if table := validation.get(row):
            found[row] = table
    return found


def _curve(
    validation: ValidationDocument, row: str, group: str
) -> tuple[list[float], list[float | None]]:
    """(seconds, mean absolute error) of one row: the full curve where it was kept, else the listed
    horizons."""
    table = _tables(validation)[row]
    listed = [
        (h["h"], h["seconds"], h["groups"][group]["mae"])
        for h in table["horizons"]
        if group in h["groups"]
    ]
    curve = validation.get("curves", {}).get(row.replace("_", " "), {}).get(group)
    if curve and listed:
        dt = listed[0][1] / listed[0][0]
        return [dt * (i + 1) for i in range(len(curve))], list(curve)
    return [s for _, s, _ in listed], [m for *_, m in listed]


HEADLINE = (("position", "velocity"), ("rotation",), ("rate",))
"""Of each, the first channel group that was judged stands in the headline."""


def headline_groups(groups: Sequence[str]) -> list[str]:
    """Those of the channel groups that stand in a headline: where a craft is and how it turns; of
    other models the first three."""
    unique = list(dict.fromkeys(groups))
    return [
        g for names in HEADLINE if (g := next((n for n in names if n in unique), None))
    ] or unique[:3]


def headline_figure(report: Report, validation: ValidationDocument) -> None:
    """Error against horizon between ceiling and floor. Nothing where no group was judged."""
    panels, key = _growth(validation, headline_groups(_groups(validation)))
    if panels:
        report.figures(panels, key=key)


def horizon_section(report: Report, validation: ValidationDocument) -> None:
    """Error against horizon for every group, with persistence as ceiling and dead reckoning as
    floor, and the table."""
    report.section("How far ahead it predicts")
    flights = [f["name"] for f in validation.get("flights", [])]
    adapted = validation.get("adapted_on")
    text = (
        f"Open loop from every sample of {len(flights)} flight{'s' * (len(flights) != 1)} "
        f"({', '.join(flights)}): "
    )
    text += (
        "the recorded commands drive the model, and nothing that was measured after the start "
        "is used."
    )
    if adapted:
        spent = number(adapted["seconds"])
        text += (
            f" Per-flight parameters were adapted on the first {spent} s of each flight and frozen."
        )
    report.paragraph(text)
    skill_in_words(report, validation.get("verdict"))
    groups = _groups(validation)
    panels, key = _growth(validation, groups)
    if panels:
        report.figures(
            panels,
            caption="Mean of the error's vector norm (rotation: geodesic angle) over all origins "
            "that have every step.",
            key=key,
        )
    with report.columns():
        _horizon_tables(report, validation, groups)
    report.paragraph("SimErr is the sum of the mean absolute error over the first 50 steps.")
    _one_step(report, validation)


def _groups(validation: ValidationDocument) -> list[str]:
    """Channel groups that were judged, in order."""
    return list(dict.fromkeys(g for h in validation["horizons"] for g in h["groups"]))


def _units(validation: ValidationDocument) -> dict[str, tuple[str, float]]:
    """Group -> (unit as it is shown, factor to it)."""
    return {
        g: in_degrees(e["unit"]) for h in validation["horizons"] for g, e in h["groups"].items()
    }


def _growth(
    validation: ValidationDocument, groups: Sequence[str]
) -> tuple[list[tuple[Figure, str]], list[Key]]:
    """(panels of error against horizon with their alt texts, their key)."""
    tables, units = _tables(validation), _units(validation)
    rows = [r for r in ROWS if r[0] in tables]
    panels: list[tuple[Figure, str]] = []
    for g in groups:
        seconds: list[float] = []
        curves = {}
        drawn = {name: _curve(validation, name, g) for name, *_ in rows}
        for x, _ in drawn.values():
            seconds = max(seconds, x, key=len)
        for name, label, colour, style, _ in rows:
            x, y = drawn[name]
            if y:
                # A row of which only some horizons are known stands at those, not at the first
                # steps of another.
                shown = [None if v is None else v * units[g][1] for v in y]
                known = dict(zip(np.round(x, 9).tolist(), shown, strict=True))
                curves[label] = (
                    [known.get(s) for s in np.round(seconds, 9).tolist()],
                    colour,
                    style,
                )
        title = g.replace("_", " ")
        alt = (
            f"Mean absolute {title} error against the prediction horizon, logarithmic axes, for "
            f"{', '.join(curves)}"
        )
        panels.append((figures.error_growth(seconds, curves, unit=units[g][0], title=title), alt))
    return panels, [r[4] for r in rows]


def _horizon_tables(report: Report, validation: ValidationDocument, groups: list[str]) -> None:
    tables, units = _tables(validation), _units(validation)
    horizons = [h["h"] for h in validation["horizons"]]
    for g in groups:
        body: list[list[Cell]] = []
        for name, label, *_ in (r for r in ROWS if r[0] in tables):
            listed = {h["h"]: h["groups"].get(g) for h in tables[name]["horizons"]}
            if not any(listed.values()):
                continue
            factor = units[g][1]
            errors = [cell["mae"] if (cell := listed.get(h)) else None for h in horizons]
            cells: list[Cell] = [
                number(None if e is None else factor * e) if listed.get(h) else None
                for h, e in zip(horizons, errors, strict=True)
            ]
            simerr = tables[name]["simerr"].get(g)
            total = number(None if simerr is None else factor * simerr)
            body.append([label, *cells, total if g in tables[name]["simerr"] else None])
        seconds_of = {h["h"]: h["seconds"] for h in validation["horizons"]}
        heads = [
            f"{g.replace('_', ' ')} [{units[g][0]}]",
            *(f"{number(seconds_of[h])} s" for h in horizons),
            "SimErr",
        ]
        report.table(heads, body, numeric=range(1, len(heads)))


def _one_step(report: Report, validation: ValidationDocument) -> None:
    metrics = validation.get("one_step") or {}
    coverage = validation.get("coverage") or {}
    if not metrics:
        return
    report.heading("One step ahead")
    levels = sorted({c["nominal"] for cs in coverage.values() for c in cs})
    body: list[list[Cell]] = []
    for name, m in metrics.items():
        inside = {c["nominal"]: c for c in coverage.get(name, [])}
        cells: list[Cell] = []
        for level in levels:
            c = inside.get(level)
            text = None if c is None else f"{100 * c['fraction']:.1f} %"
            cells.append(
                Tag(text=text) if c is not None and text and not c.get("honest", True) else text
            )
        unit = m.get("unit") or ""
        body.append(
            [
                name,
                unit,
                number(m["rmse"]),
                number(m["r2"]),
                number(m["fit"], 3),
                number(m["vaf"], 3),
                *cells,
            ]
        )
    heads = ["channel", "unit", "RMSE", "R\N{SUPERSCRIPT TWO}", "fit [%]", "VAF [%]"]
    heads += [f"inside {100 * level:g} %" for level in levels]
    caption = (
        "Marked where the stated interval covers more or fewer samples than chance allows."
        if levels
        else ""
    )
    report.table(heads, body, numeric=range(2, len(heads)), caption=caption)


def residual_section(report: Report, validation: ValidationDocument, *, worst: int = 6) -> None:
    """Autocorrelation with bands, correlation with past inputs, and the tests; nothing where none
    was computed."""
    whiteness, cross = validation.get("whiteness"), validation.get("cross_correlation")
    if not whiteness and not cross:
        return
    report.section("What is left in the innovations")
    if whiteness:
        text = whiteness_verdict(whiteness)
        (report.verdict if text.startswith("No ") else report.paragraph)(text)
        lags, channels = list(range(1, whiteness["max_lag"] + 1)), whiteness["channels"]
        panels = []
        for title, names in _together(channels).items():
            curves = {n: channels[n]["r"] for n in names}
            outside = ", ".join(f"{100 * channels[n]['outside']:.0f} %" for n in names)
            panels.append(
                (
                    figures.autocorrelations(lags, curves, channels[names[0]]["band"], title=title),
                    f"Autocorrelation of the innovations {title}; of their lags {outside} lie "
                    "outside the band",
                )
            )
        report.figures(
            panels,
            caption=f"Autocorrelation of the innovations; grey: where {100 * whiteness['level']:g} "
            "% of the lags of white noise lie.",
            key=ORDER,
        )
        _spectra(report, whiteness, validation.get("sample_time"))
        _whiteness_table(report, whiteness)
    if cross:
        _cross(report, cross, worst)


def _whiteness_table(report: Report, whiteness: WhitenessDocument) -> None:
    body: list[list[Cell]] = [
        [
            name,
            c["n"],
            f"{c['std']:.2f}" if "std" in c else None,
            f"{100 * c['outside']:.0f} %",
            f"{100 * c['predictable']:.1f} %",
            number(c["q"]),
            c["dof"],
            p_value(c["p_value"]),
        ]
        for name, c in whiteness["channels"].items()
    ]
    joint = whiteness.get("multivariate")
    if joint:
        joint_cells: list[Cell] = [number(joint["q"]), joint["dof"], p_value(joint["p_value"])]
        body.append(["all together", joint["n"], None, None, None, *joint_cells])
    heads = [
        "innovation",
        "samples",
        "normalised std",
        "lags outside",
        "predictable",
        "Q",
        "dof",
        "p",
    ]
    report.table(
        heads,
        body,
        numeric=range(1, len(heads)),
        caption="Ljung-Box test per channel, Hosking's for all channels. The normalised standard "
        "deviation is 1 for the right noise model; 'predictable' is the share of variance that the "
        "past of the channel explains.",
    )


def _spectra(report: Report, whiteness: WhitenessDocument, sample_time: float | None) -> None:
    """Cumulated periodograms; nothing where they were not kept."""
    kept = {
        n: c
        for n, c in whiteness["channels"].items()
        if c.get("periodogram") and c.get("periodogram_band")
    }
    if not kept or not sample_time:
        return
    panels = []
    for title, names in _together(kept).items():
        shares, band = {n: kept[n]["periodogram"] for n in names}, kept[names[0]]
        figure = figures.cumulated(
            shares, band["periodogram_band"], sample_time=sample_time, title=title
        )
        alt = f"Share of the variance of the innovations {title} below each frequency"
        panels.append((figure, f"{alt}, with the band of white noise"))
    report.figures(
        panels,
        caption="Cumulated periodograms: white noise rises straight and stays between the dashed "
        f"lines {100 * whiteness['level']:g} % of the time. Early rise: slow errors are left, as "
        "of drag or wind; late rise: vibration or noise that a sensor adds.",
        key=ORDER,
    )


def _together(channels: Mapping[str, ChannelWhitenessRow]) -> dict[str, list[str]]:
    """Title -> channels that one figure shows: those of one sensor with the same bands, at most
    three."""
    found: list[list[str]] = []
    for name, own in channels.items():
        group = name.rpartition(".")[0] or group_of(name)
        last = found[-1][-1] if found else ""
        same = group is not None and group == (last.rpartition(".")[0] or group_of(last))
        same = same and (not last or _bands(own) == _bands(channels[last]))
        if same and len(found[-1]) < len(ORDER):
            found[-1].append(name)
        else:
            found.append([name])
    return {", ".join(some): some for some in found}


def _bands(channel: ChannelWhitenessRow) -> tuple[list[float] | None, float | None]:
    return channel.get("band"), channel.get("periodogram_band")


def _cross(report: Report, cross: CrossDocument, worst: int) -> None:
    report.heading("Innovations against inputs")
    text = cross_verdict(cross)
    (report.verdict if text.startswith("Past inputs explain no") else report.paragraph)(text)
    shown = sorted(cross["pairs"], key=lambda p: p["p_value"])[:worst]
    panels = [
        (
            figures.correlogram(
                cross["lags"], p["r"], p["band"], title=f"{p['innovation']} and {p['input']}"
            ),
            f"Correlation of innovation {p['innovation']} with input {p['input']} over lags",
        )
        for p in shown
    ]
    more = (
        f" The {len(shown)} most suspicious of {len(cross['pairs'])} pairs."
        if len(cross["pairs"]) > worst
        else ""
    )
    caption = (
        f"Input before innovation at positive lags; grey: {100 * cross['level']:g} % band "
        f"if independent.{more} "
    )
    report.figures(panels, caption=caption + cross["note"])
    inputs = list(dict.fromkeys(p["input"] for p in cross["pairs"]))
    table = {(p["innovation"], p["input"]): p["p_value"] for p in cross["pairs"]}
    rows: list[list[Cell]] = []
    for name in dict.fromkeys(p["innovation"] for p in cross["pairs"]):
        values = [table.get((name, i)) for i in inputs]
        limit = 0.01 / len(cross["pairs"])
        rows.append(
            [
                name,
                *(
                    Tag(text=p_value(v)) if v is not None and v < limit else p_value(v)
                    for v in values
                ),
            ]
        )
    report.table(
        ["innovation", *inputs],
        rows,
        numeric=range(1, len(inputs) + 1),
        caption="p-values over all positive lags; marked where significant after correction for "
        "the number of pairs.",
    )
