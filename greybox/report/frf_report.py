"""The report of `greybox frf`: per response magnitude, phase and coherence, with what they say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from greybox.estimation.frf_result import TRUSTED
from greybox.report.figures import (
    _BOTTOM,
    _LEFT,
    _RIGHT,
    _SHORT,
    _TOP,
    MUTED,
    SERIES,
    WIDTH,
    _axes,
    _figure,
    _label,
)
from greybox.report.html import Cell, Key, Report

MOST = 12
"""Responses that are drawn, at most."""


def frf_report(content: Mapping[str, Any]) -> str:
    """The page for frf.json."""
    flights = content["flights"]
    seconds = sum(flights.values())
    report = Report("Frequency response", f"{seconds:.0f} s of {len(flights)} flight(s)")
    report.first_line(content["line"], good=bool(content["measured"]))
    for warning in content["warnings"]:
        report.warning(warning)
    pairs = [p for p in content["pairs"] if any(p["usable"])]
    report.section("Responses")
    if pairs:
        _gains(report, pairs)
    for p in pairs[:MOST]:
        report.heading(f"{p['output']} over {p['input']}")
        report.bullets(p["lines"][1:])
        key = [Key(text="flights, with 95 % band", colour="c1")]
        if p["model"] is not None:
            key.append(Key(text=f"{content['model']}", colour="c2"))
        alt = (
            f"Magnitude, phase and coherence of {p['output']} over {p['input']} against frequency."
        )
        report.figure(
            _figure_of(content["frequency"], p),
            alt=alt,
            key=key,
            caption="Where coherence is too low for use the curve is pale and without a band. Dashed: coherence "
            f"{TRUSTED:g}.",
        )
    if rest := [p for p in content["pairs"] if not any(p["usable"])]:
        report.heading("Too low a coherence at every frequency")
        rows: list[list[Cell]] = [
            [f"{p['output']} over {p['input']}", max(p["coherence"])] for p in rest
        ]
        report.table(["response", "highest coherence"], rows)
    report.section("How it was estimated")
    references = ", ".join(content["references"])
    windows = content["window"]
    report.facts(
        [
            ("flights", ", ".join(f"{name} ({s:.0f} s)" for name, s in flights.items())),
            (
                "estimate",
                f"joint input-output, by {references}"
                if references
                else "direct: outputs over inputs, all at once",
            ),
            (
                "windows",
                f"Hann, {windows[0]:.3g} s at {content['frequency'][0]:.2g} Hz to {windows[-1]:.3g} s, overlap one half",
            ),
            (
                "averages",
                f"{content['averages'][0]:.0f} at the lowest frequency, {content['averages'][-1]:.0f} at the highest",
            ),
            ("sample time", f"{content['sample_time']:g} s"),
        ]
    )
    report.section("How to get this again")
    report.code(content["command"])
    return report.html()


def _gains(report: Report, pairs: list[Mapping[str, Any]]) -> None:
    rows: list[list[Cell]] = []
    for p in pairs:
        form = p["form"]
        if form is not None:
            span = f"{form['low']:.2g} to {form['high']:.2g} Hz"
            rows.append(
                [
                    f"{p['output']} over {p['input']}",
                    1e3 * form["lag"],
                    1e3 * form["lag_std"],
                    form["gain"],
                    form["gain_std"],
                    form["integrators"],
                    span,
                ]
            )
    if rows:
        report.table(
            ["response", "lag [ms]", "std", "gain", "std", "integrators", "fitted to"],
            rows,
            caption="gain exp(-lag s) / s^integrators, with a corner of the last integrator and part of the lag of first "
            "order. Gain: output unit per second to the number of integrators, per unit of the input.",
        )


def _figure_of(frequency: list[float], p: Mapping[str, Any]) -> Figure:
    """Magnitude (logarithmic), phase and coherence, one above the other."""
    heights, space = (1.5, 1.2, 0.8), 0.14
    figure = _figure(_TOP + _BOTTOM + sum(heights) + 2 * space)
    f, good = np.asarray(frequency), np.asarray(p["usable"], dtype=bool)
    bottom = _BOTTOM + sum(heights) + 2 * space
    for i, (what, unit, height) in enumerate(
        zip(("magnitude", "phase_deg", "coherence"), (p["unit"], "deg", "1"), heights)
    ):
        bottom -= height
        axes = _axes(figure, _LEFT, bottom, WIDTH - _LEFT - _RIGHT, height)
        bottom -= space
        values = np.array(p[what], dtype=float)
        axes.plot(f, values, color=SERIES[0], linewidth=0.8, alpha=1.0 if i == 2 else 0.3)
        if i < 2:
            name, _, end = what.partition("_")
            low, high = (
                np.array(p["_".join(x for x in (name, s, end) if x)], dtype=float)
                for s in ("lower", "upper")
            )
            shown = np.where(good, values, np.nan)
            axes.plot(f, shown, color=SERIES[0], linewidth=1.4, marker="o", markersize=2)
            axes.fill_between(f, low, high, where=good, color=SERIES[0], alpha=0.25, linewidth=0)
            if p["model"] is not None:
                axes.plot(
                    f, np.array(p["model"][what], dtype=float), color=SERIES[1], linewidth=1.3
                )
            if i == 0:
                axes.set_yscale("log")
                axes.yaxis.set_major_locator(LogLocator(numticks=5))
                axes.yaxis.set_minor_formatter(NullFormatter())
            else:
                axes.yaxis.set_major_locator(MaxNLocator(4))
                span = shown[good]
                axes.set_ylim(float(span.min()) - 60, float(span.max()) + 60)
        else:
            axes.axhline(TRUSTED, color=MUTED, linestyle="--", linewidth=0.9)
            axes.set_ylim(0, 1)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
        axes.xaxis.set_major_formatter(_SHORT)
        axes.xaxis.set_minor_formatter(NullFormatter())
        if i < 2:
            axes.tick_params(labelbottom=False)
        label = f"{what.partition('_')[0]} [{unit}]" if unit != "1" or i == 0 else what
        _label(
            axes,
            x="frequency [Hz]" if i == 2 else "",
            y=label,
            title=f"{p['output']} over {p['input']}" if i == 0 else "",
        )
    return figure
