"""The report of `greybox frf`: per response magnitude, phase and coherence, with what they say."""

from __future__ import annotations

from collections.abc import Sequence

from greybox.linear.frf_result import PairDocument, ResponseDocument
from greybox.report.html import Cell, Key, Report
from greybox.report.response_section import MEASURED, PALE, bode_with_coherence, drawn

MOST = 12
"""Responses that are drawn, at most."""


def frf_report(content: ResponseDocument) -> str:
    """The page for frf.json."""
    flights = content["flights"]
    seconds = sum(flights.values())
    report = Report("Frequency response", f"{seconds:.0f} s of {len(flights)} flight(s)")
    report.first_line(content["line"], good=bool(content["measured"]))
    for warning in content["warnings"]:
        report.warning(warning)
    pairs = drawn(content)
    report.section("Responses")
    if pairs:
        _gains(report, pairs)
    for p in pairs[:MOST]:
        report.heading(f"{p['output']} over {p['input']}")
        report.bullets(p["lines"][1:])
        key = [MEASURED]
        if p["model"] is not None:
            key.append(Key(text=f"{content['model']}", colour="c2"))
        alt = (
            f"Magnitude, phase and coherence of {p['output']} over {p['input']} against frequency."
        )
        report.figure(
            bode_with_coherence(content["frequency"], p),
            alt=alt,
            key=key,
            caption=PALE,
        )
    if rest := [p for p in content["pairs"] if p not in pairs]:
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
                f"Hann, {windows[0]:.3g} s at {content['frequency'][0]:.2g} Hz to "
                f"{windows[-1]:.3g} s, overlap one half",
            ),
            (
                "averages",
                f"{content['averages'][0]:.0f} at the lowest frequency, "
                f"{content['averages'][-1]:.0f} at the highest",
            ),
            ("sample time", f"{content['sample_time']:g} s"),
        ]
    )
    report.section("How to get this again")
    report.code(content["command"])
    return report.html()


def _gains(report: Report, pairs: Sequence[PairDocument]) -> None:
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
            caption="gain exp(-lag s) / s^integrators, with a corner of the last integrator and "
            "part of the lag of first order. Gain: output unit per second to the number of "
            "integrators, per unit of the input.",
        )
