"""The page of `greybox mpc rates`: from mpc_rates.json (greybox.mpc_rates/1), rows of flights and
their traces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias, TypedDict

import numpy as np
from matplotlib.figure import Figure

from greybox.report import figures
from greybox.report.html import Cell, Key, Report, embedded_json, script
from greybox.report.mpc_animation import CSS, ControllerShown, Look, which_flight, who_flies
from greybox.report.mpc_documents import RatesDocument, RatesPlan, RatesTrace
from greybox.report.mpc_figures import COLOURS

LOOKS: Mapping[str, Look] = {
    "tube": ("c1", "line"),
    "hybrid": ("c2", "line"),
    "linear-tube": ("c3", "line"),
    "linear": ("c5", "dash"),
    "pid": ("ink", "dots"),
}
"""Colour and stroke of every controller."""
STYLES = {"line": "-", "dash": "--", "dots": ":"}
AHEAD = 15
"""Stages of a plan."""
Traces: TypeAlias = Mapping[int, Mapping[str, RatesTrace]]


class RunShown(TypedDict):
    """A flight of one controller: rates (n, 3), what was asked [rad/s], and the plans of the
    tube."""

    rates: list[list[float]]
    asked: list[list[float]]
    plans: list[RatesPlan]


class FlightShown(TypedDict):
    """A flight of every controller."""

    seed: int
    runs: dict[str, RunShown]


class Animation(TypedDict):
    """What rates_animation.js reads: seconds between samples and between stages, and of a plan."""

    limit: float
    axes: list[str]
    step: float
    stage: float
    ahead: float
    controllers: list[ControllerShown]
    flights: list[FlightShown]


def rates_report(content: RatesDocument, traces: Traces, *, stage: float) -> str:
    """The page; `stage` [s] lies between the stages of a plan. Traces may be few or none (an
    interrupted run)."""
    found = content["controllers"]
    tube = found["tube"]
    report = Report(
        "A rate controller on a linear model with a Gaussian process",
        f"{sum(c['flights'] for c in found.values())} flights, {len(found)} controllers, body "
        f"rates within {content['limit']:g} rad/s",
    )
    report.first_line(
        content["verdict"],
        good=tube["p_value"] is not None and tube["p_value"] >= 0.05 and not tube["crashed"],
    )
    with report.headline():
        panels = _panels(content, traces)
        if panels:
            report.figures(
                panels,
                key=_key(content),
                caption="Body rates of the first flight where they are highest. "
                "Dashed lines: the limits.",
            )
        report.heading("What to do next")
        report.bullets(content["next"])
    data = _packed(content, traces, stage)
    if data["flights"]:
        report.section("One flight, and what the tube planned")
        report.paragraph(
            "Every controller flies the same path in the same gusts, below the same outer loops. "
            "The blue band is the plan of the moment: where the rates will be in 95 of 100 cases. "
            "A plan keeps the limits by its tightening, not by its middle. Dotted: what the outer "
            "loops ask of the tube."
        )
        report.live(_markup(data), script("rates_animation"), CSS)
    _table(report, content)
    _what(report, content)
    facts = [("Model file", content["model_sha256"])]
    report.reproduced_by(content["command"], facts, content["versions"])
    return report.html()


def _key(content: RatesDocument) -> list[Key]:
    names = [n for n, c in content["controllers"].items() if c["flights"]]
    return [Key(text=n, colour=LOOKS[n][0], stroke=LOOKS[n][1]) for n in names]


def _panels(content: RatesDocument, traces: Traces) -> list[tuple[Figure, str]]:
    """Rates about x and y of the first flight, two seconds about the highest of any controller."""
    runs = next((r for r in traces.values() if r), {})
    if not runs:
        return []
    step = next(iter(runs.values()))["step"]
    most = max(runs.values(), key=lambda t: float(np.abs(t["rates"]).max()))["rates"]
    middle = int(np.abs(np.array(most)).max(axis=1).argmax())
    half = round(1.0 / step)
    first = max(0, middle - half)
    panels = []
    for axis in (0, 1):
        name = content["outputs"][axis]
        lines, width = [], min(len(t["rates"]) for t in runs.values()) - first
        width = min(width, 2 * half)
        for n in sorted(runs, key=lambda n: n == "tube"):
            colour, stroke = LOOKS[n]
            values = np.array(runs[n]["rates"])[first : first + width, axis]
            lines.append(
                figures.Line(values=values, colour=COLOURS[colour], style=STYLES[stroke], width=1.3)
            )
        for sign in (-1.0, 1.0):
            edge = np.full(width, sign * content["limit"])
            lines.append(figures.Line(values=edge, colour=COLOURS["ink"], style="--", width=0.8))
        times = step * (first + np.arange(width))
        panels.append(
            (
                figures.time_series(times, {f"{name} [rad/s]": lines}),
                f"Rate {name} of every controller",
            )
        )
    return panels


def _packed(content: RatesDocument, traces: Traces, stage: float) -> Animation:
    flights = {seed: runs for seed, runs in traces.items() if runs}
    step = next((t["step"] for runs in flights.values() for t in runs.values()), 1.0)
    stages = next(
        (len(t["plans"][0]["y"]) for runs in flights.values() for t in runs.values() if t["plans"]),
        AHEAD,
    )
    return {
        "limit": content["limit"],
        "axes": content["outputs"],
        "step": step,
        "stage": stage,
        "ahead": round(stages * stage, 3),
        "controllers": [
            {"name": n, "text": c["text"], "colour": LOOKS[n][0], "stroke": LOOKS[n][1]}
            for n, c in content["controllers"].items()
            if any(n in runs for runs in flights.values())
        ],
        "flights": [
            {
                "seed": seed,
                "runs": {
                    n: {
                        "rates": t["rates"],
                        "asked": t["asked"],
                        "plans": t["plans"] if n == "tube" else [],
                    }
                    for n, t in runs.items()
                },
            }
            for seed, runs in flights.items()
        ],
    }


def _markup(data: Animation) -> str:
    """The frame with its data; the script shows it, so that without one the figure above stands for
    it."""
    text = embedded_json(data)
    who = who_flies(data["controllers"], "rates-said")
    choices = which_flight(f["seed"] for f in data["flights"])
    strips = "".join(
        f'<h4>{n} [rad/s]</h4><svg id="rates-{n}" role="img" aria-label="Rate {n} over time, its '
        'limits and the plan"></svg>'
        for n in data["axes"]
    )
    paces = "".join(
        f'<option value="{v}"{" selected=" + chr(34) + "selected" + chr(34) if v == 0.25 else ""}>{t}</option>'
        for v, t in ((0.1, "1/10 speed"), (0.25, "1/4 speed"), (1, "full speed"))
    )
    return (
        '<div class="flight" id="rates" hidden="hidden"><div class="controls">'
        '<button type="button" id="rates-play" aria-pressed="false">Play</button>'
        '<input type="range" id="rates-time" min="0" max="1" step="0.02" value="0" '
        'aria-label="Time in the flight"/>'
        f'<select id="rates-pace" aria-label="Speed of the animation">{paces}</select>'
        f'<select id="rates-choice" aria-label="Flight">{choices}</select>'
        '<output id="rates-readout" for="rates-time"></output>'
        '<span id="rates-still" hidden="hidden">Your system asks for less motion: move the '
        "slider.</span></div>"
        f'<ul class="who" aria-label="Controllers">{who}</ul>{strips}</div>'
        f'<script type="application/json" id="rates-data">{text}</script>'
    )


def _table(report: Report, content: RatesDocument) -> None:
    report.section("All flights")
    body: list[list[Cell]] = []
    for name, c in content["controllers"].items():
        if not c["flights"]:
            body.append([name, c["text"], "0 of 0", None, None, None, None, None, None])
            continue
        low, high = (100 * v for v in c["beyond"]["interval"])
        body.append(
            [
                name,
                c["text"],
                f"{c['beyond']['count']} of {c['flights']}",
                f"{low:.0f} .. {high:.0f} %",
                f"{100 * c['samples_beyond']:.1f} %",
                f"{c['worst']:.2f}",
                f"{c['rmse']:.3f}",
                f"{c['away']:.2f}",
                f"{c['solve_ms']['median']:.1f} / {c['solve_ms']['p99']:.1f}",
            ]
        )
    report.table(
        [
            "controller",
            "what it flies with",
            "beyond",
            "95 % interval",
            "time beyond",
            "worst [rad/s]",
            "RMSE [rad/s]",
            "off path [m]",
            "time [ms]",
        ],
        body,
        numeric=(2, 3, 4, 5, 6, 7, 8),
        caption="Beyond: flights in which a true body rate passed the limit, or the craft was "
        "lost. Interval: exact (Clopper and Pearson). RMSE: true rates against what the outer "
        "loops asked. Time: median and 99 % of one answer, Python included.",
    )


def _what(report: Report, content: RatesDocument) -> None:
    report.section("What was flown")
    report.paragraph(
        "The plant is an independent simulated vehicle: thrust with the square of rotor speed, "
        "motor lag, rotor drag, a centre of mass beside the middle, gusts and sensor noise. A "
        "linear model of p, q, r was identified from flights of it, and a Gaussian process learned "
        "what it leaves, as in the paper."
    )
    rows = [("Model", content["model"]), ("Inputs of the process", ", ".join(content["features"]))]
    rows += [
        (
            f"Tightening of {n}",
            f"{t['kappa']:.2f} standard deviations, by Boole's inequality over {t['touched']:.0f} "
            f"limits that a flight without it touches ({t['flights']} training flights)",
        )
        for n, t in content["tuning"].items()
    ]
    report.facts(
        [
            *rows,
            (
                "Flight",
                f"{content['seconds']:g} s between random waypoints, another path for every seed",
            ),
        ]
    )
