"""The section that shows how outputs follow commands: Bode figures with coherence, and step
responses of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from greybox.linear.frf_result import TRUSTED, PairDocument, ResponseDocument
from greybox.report.figures import (
    _BOTTOM,
    _LEFT,
    _RIGHT,
    _SHORT,
    _TOP,
    MUTED,
    SERIES,
    WIDTH,
    Line,
    _axes,
    _figure,
    _label,
    time_series,
)
from greybox.report.html import Key, Report
from greybox.report.words import number
from greybox.symbolic import FloatArray

PALE = (
    "Where coherence is too low, or the loop is closed, the curve is of no use: pale and without a "
    f"band. Dashed: coherence {TRUSTED:g}."
)
MEASURED = Key(text="flights, with 95 % band", colour="c1")


@dataclass(frozen=True, kw_only=True)
class Step:
    """What a model answers to a step of `size` [unit of the input] at zero: `values` (N,) in `unit`
    at `t` (N,) [s]."""

    input: str
    output: str
    size: float
    t: FloatArray
    values: FloatArray
    unit: str


@dataclass(frozen=True, kw_only=True)
class Responses:
    """`measured`: the pairs that are drawn, in the form of frf.json; None where the flights tell
    none, and `why` not."""

    steps: Sequence[Step]
    measured: ResponseDocument | None = None
    why: str = ""


def drawn(content: ResponseDocument) -> list[PairDocument]:
    """The pairs of frf.json that have something to show: usable frequencies, or in a closed loop,
    where none is, coherent ones."""
    closed = bool(content["closed_by"])
    return [
        p
        for p in content["pairs"]
        if any(p["usable"]) or (closed and max(p["coherence"]) > TRUSTED)
    ]


def response_section(report: Report, responses: Responses | None) -> None:
    """Bode figures with coherence, model over flights, and step responses; nothing where there is
    no response."""
    if responses is None:
        return
    report.section("How it answers to commands")
    if responses.measured is None:
        report.paragraph(f"The flights tell no frequency response: {responses.why}.")
    else:
        _measured(report, responses.measured)
    if responses.steps:
        report.heading("Step response of the model")
        panels = []
        for s in responses.steps:
            figure = time_series(
                s.t,
                {f"{s.output} [{s.unit}]": [Line(values=s.values, colour=SERIES[1], width=1.4)]},
                title=f"{s.output} after a step of {s.input} by {number(s.size, 2)}",
            )
            panels.append(
                (figure, f"{s.output} of the model after a step of {s.input} at time zero")
            )
        report.figures(
            panels,
            caption="Deviation from the mean state of the flights, by the model linearised there; "
            "each step is as large as the command's standard deviation in the flights. The flat "
            "beginning is delay, the bend lag of the motors.",
        )


def _measured(report: Report, content: ResponseDocument) -> None:
    pairs = drawn(content)
    seconds = sum(content["flights"].values())
    count = len(content["flights"])
    report.paragraph(
        f"From {number(seconds, 3)} s of {count} flight{'s' * (count != 1)}, without a model; the "
        "model's own response lies over it."
    )
    # What must be known before the figures are believed.
    report.bullets([f"{w[:1].upper()}{w[1:]}." for w in content["warnings"]])
    if pairs:
        alt = "Magnitude, phase and coherence of"
        report.figures(
            [
                (
                    bode_with_coherence(content["frequency"], p),
                    f"{alt} {p['output']} over {p['input']}",
                )
                for p in pairs
            ],
            key=[MEASURED, Key(text="model", colour="c2")],
            caption=PALE,
        )
        with report.details("In words"):
            report.bullets(
                [
                    f"{p['output']} over {p['input']}: {line}"
                    for p in pairs
                    for line in p["lines"][1:]
                ]
            )
    pale = [p for p in content["pairs"] if p not in pairs]
    if rest := [f"{p['output']} over {p['input']} ({max(p['coherence']):.2f})" for p in pale]:
        report.paragraph(f"Too low a coherence at every frequency (highest): {', '.join(rest)}.")


@dataclass(frozen=True, kw_only=True)
class _Row:
    """A quantity over frequency (K,), the ends of its band and the model's, where there are any."""

    label: str
    values: Sequence[float]
    band: tuple[Sequence[float], Sequence[float]] | None = None
    model: Sequence[float] | None = None


def _rows(p: PairDocument) -> tuple[_Row, _Row, _Row]:
    model = p["model"]
    return (
        _Row(
            label=f"magnitude [{p['unit']}]",
            values=p["magnitude"],
            band=(p["magnitude_lower"], p["magnitude_upper"]),
            model=None if model is None else model["magnitude"],
        ),
        _Row(
            label="phase [deg]",
            values=p["phase_deg"],
            band=(p["phase_lower_deg"], p["phase_upper_deg"]),
            model=None if model is None else model["phase_deg"],
        ),
        _Row(label="coherence", values=p["coherence"]),
    )


def bode_with_coherence(frequency: Sequence[float], p: PairDocument) -> Figure:
    """Magnitude (logarithmic), phase and coherence of a pair of frf.json over `frequency` [Hz], one
    above the other."""
    heights, space = (1.5, 1.2, 0.8), 0.14
    figure = _figure(_TOP + _BOTTOM + sum(heights) + 2 * space)
    f, good = np.asarray(frequency), np.asarray(p["usable"], dtype=bool)
    bottom = _BOTTOM + sum(heights) + 2 * space
    for i, (row, height) in enumerate(zip(_rows(p), heights, strict=True)):
        bottom -= height
        axes = _axes(figure, _LEFT, bottom, WIDTH - _LEFT - _RIGHT, height)
        bottom -= space
        values = np.array(row.values, dtype=float)
        axes.plot(f, values, color=SERIES[0], linewidth=0.8, alpha=1.0 if i == 2 else 0.3)
        if row.band is not None:
            low, high = (np.array(end, dtype=float) for end in row.band)
            shown = np.where(good, values, np.nan)
            axes.plot(f, shown, color=SERIES[0], linewidth=1.4, marker="o", markersize=2)
            axes.fill_between(f, low, high, where=good, color=SERIES[0], alpha=0.25, linewidth=0)
            if row.model is not None:
                axes.plot(f, np.array(row.model, dtype=float), color=SERIES[1], linewidth=1.3)
            if i == 0:
                axes.set_yscale("log")
                axes.yaxis.set_major_locator(LogLocator(numticks=5))
                axes.yaxis.set_minor_formatter(NullFormatter())
            else:
                axes.yaxis.set_major_locator(MaxNLocator(4))
                span = shown[good] if good.any() else values
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
        _label(
            axes,
            x="frequency [Hz]" if i == 2 else "",
            y=row.label,
            title=f"{p['output']} over {p['input']}" if i == 0 else "",
        )
    return figure
