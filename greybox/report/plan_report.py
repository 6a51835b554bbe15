"""The report of `greybox plan`: what to fly, what it will tell, and what to do next; and the plan
as one picture."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from greybox.report import figures
from greybox.report.figures import Line
from greybox.report.html import Cell, Key, Report, Tag
from greybox.report.svg import MUTED, SERIES
from greybox.report.words import number
from greybox.statistics.evidence import CLEAR, CLEAR_LOG_RATIO
from greybox.symbolic import FloatArray

if TYPE_CHECKING:
    from greybox.planning.document import FlightRow, PairRow, PlanDocument

Columns = Mapping[str, FloatArray]


def plan_report(content: PlanDocument, flights: Sequence[tuple[Columns, Columns]]) -> str:
    """The page for plan.json and per flight (setpoints, expected log)."""
    report = Report(
        f"Flight plan for {content['vehicle']}",
        f"{content['seconds']:g} s in {len(flights)} flight(s)",
    )
    for w in content["warnings"]:
        report.warning(w)
    report.section("What it is expected to tell")
    text = content["efficiency"]["text"]
    report.verdict(f"{text[0].upper()}{text[1:]}.")
    _parameters(report, content)
    if content["unidentifiable"]:
        report.paragraph("The flights alone do not tell apart (what is known before decides):")
        report.bullets(content["unidentifiable"])
    if content["pairs"]:
        _pairs(report, content["pairs"])
    report.section("What to fly")
    _room(report, content)
    for flight, (sent, seen) in zip(content["flights"], flights, strict=True):
        _flight(report, flight, sent, seen)
    if content["cannot_be_flown"]:
        with report.details("manoeuvres that do not fit into the limits"):
            report.bullets(content["cannot_be_flown"])
    _next(report, content)
    if "command" in content:
        report.section("How to reproduce")
        report.code(str(content["command"]))
    return report.html()


def _parameters(report: Report, content: PlanDocument) -> None:
    """What is known of every parameter before and after."""
    rows: list[list[Cell]] = []
    for n, p in content["parameters"].items():
        alone: Cell = "" if finite(p["std_flights_alone"]) else Tag(text="not by itself")
        errors = p["std_before"], p["std"], p["std_naive"]
        spreads = [e if finite(e) else None for e in errors]
        rows.append([n, p["value"], *spreads, p["unit"], alone])
    report.table(
        ["parameter", "taken for true", "std before", "std after", "std naive", "unit", "seen"],
        rows,
        numeric=(1, 2, 3, 4),
        caption="One standard deviation: what is known before, expected after these flights, and "
        "after hover and figure of eight of the same length. Empty: nothing is known. Cramer-Rao "
        "bound at the values that are taken for true.",
    )


def _pairs(report: Report, pairs: Sequence[PairRow]) -> None:
    report.heading("Which effects it separates")
    table: list[list[Cell]] = []
    for p in pairs:
        verdict: Cell = p["verdict"] if p["separated"] else Tag(text=p["verdict"])
        table.append(
            [
                " and ".join(p["effects"]),
                verdict,
                p["expected_log_likelihood_ratio"],
                p["overlap"],
            ]
        )
    report.table(
        ["effects", "verdict", "log likelihood ratio", "overlap"],
        table,
        caption="Expected when one is true and the other is fitted in its place; "
        f"above {CLEAR_LOG_RATIO:g}, BIC differs by more than {CLEAR:g}.",
    )


def _room(report: Report, content: PlanDocument) -> None:
    """What of the limits the flights use."""
    use, room = content["used"], content["limits"]
    box, tilts = room["box_m"], np.degrees([use["tilt"], room["tilt_rad"]])
    heights = (
        f"height {use['lowest']:.2f} to {use['highest']:.2f} of {room['floor_m']:g} to {box[2]:g} m"
    )
    low, high = room["command"]
    report.facts(
        [
            ("start and end", f"hover at {', '.join(number(v) for v in content['home'])} m"),
            (
                "room",
                f"|x| {use['x']:.2f} of {box[0] / 2:g} m, |y| {use['y']:.2f} of {box[1] / 2:g} m, "
                f"{heights}",
            ),
            ("speed", f"{use['speed']:.2f} of {room['speed_m_s']:g} m/s"),
            ("tilt", f"{tilts[0]:.0f} of {tilts[1]:.0f} degrees"),
            (
                "commands",
                f"{low:.3g} to {high:.3g}; {100 * use['commands_outside']:.1f} % of the samples "
                "outside",
            ),
        ]
    )


def _next(report: Report, content: PlanDocument) -> None:
    report.section("What to do next")
    report.bullets(
        [
            "Look at every flight in simulation, or fly it at half amplitude first. Keep a hand on "
            "the switch.",
            "Send the setpoints of flight_1.csv at its sample rate and hold the last one until the "
            "craft rests. Columns inj_* are added behind the attitude controller; an autopilot "
            "that cannot do that flies a plan made with --setpoints-only.",
            f"Log commands after the mixer and {', '.join(content['sensors'])}, at "
            f"{1 / content['sample_time']:g} Hz.",
            "greybox check the logs, then greybox fit; plan again with --model to see what still "
            "pays.",
        ]
    )


def finite(value: float | None) -> bool:
    """Whether a standard error is there and finite."""
    return value is not None and bool(np.isfinite(value))


def _flight(report: Report, flight: FlightRow, sent: Columns, seen: Columns) -> None:
    report.heading(str(flight["file"]))
    report.table(
        ["start [s]", "seconds", "manoeuvre", "amplitude", "injected"],
        [
            [
                m["start"],
                m["seconds"],
                m["text"],
                f"{100 * m['amplitude']:.0f} %",
                "yes" if m["injected"] else "",
            ]
            for m in flight["manoeuvres"]
        ],
        caption="Amplitude: share of what box, speed, tilt and rotors allow on paper.",
    )
    t = sent["t"]
    speed = np.sqrt(seen["vx"] ** 2 + seen["vy"] ** 2 + seen["vz"] ** 2)
    tilt = np.degrees(np.arccos(np.clip(1 - 2 * (seen["qx"] ** 2 + seen["qy"] ** 2), -1, 1)))
    u = _commands(seen)
    place = {
        f"{a} [m]": [
            Line(values=sent[f"sp_{a}"], colour=MUTED, style="--"),
            Line(values=seen[a], colour=SERIES[0]),
        ]
        for a in "xyz"
    }
    motion = {
        "speed [m/s]": [Line(values=speed, colour=SERIES[0])],
        "tilt [deg]": [Line(values=tilt, colour=SERIES[0])],
        "commands [-]": [
            Line(values=u.min(axis=0), colour=SERIES[0]),
            Line(values=u.max(axis=0), colour=SERIES[1]),
        ],
    }
    report.figures(
        [
            (
                figures.time_series(t, place, title="position"),
                "planned and expected position over time",
            ),
            (
                figures.time_series(t, motion, title="motion"),
                "expected speed, tilt and range of the rotor commands",
            ),
        ],
        key=[
            Key(text="setpoint", colour="muted", stroke="dash"),
            Key(text="expected (lowest command)", colour="c1"),
            Key(text="highest command", colour="c2"),
        ],
        caption="Simulated with the model itself and a plain cascade controller, without noise.",
    )


def _commands(seen: Columns) -> FloatArray:
    return np.stack([v for n, v in seen.items() if n[0] == "u" and n[1:].isdigit()])


def plan_picture(content: PlanDocument, flights: Sequence[tuple[Columns, Columns]]) -> bytes:
    """The plan as a PNG: the path from above, height, injected signals and commands over time, one
    row per flight."""
    figure = Figure(figsize=(11, 2.9 * len(flights) + 0.3), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"{content['vehicle']}: {content['seconds']:g} s of excitation", fontsize=11)
    grid = figure.subplots(len(flights), 3, squeeze=False, width_ratios=(1, 1.5, 1.5))
    for (top, height, signals), flight, (sent, seen) in zip(
        grid, content["flights"], flights, strict=True
    ):
        t = sent["t"]
        top.plot(sent["sp_x"], sent["sp_y"], color="0.6", linewidth=1, linestyle="--")
        top.plot(seen["x"], seen["y"], color="tab:blue", linewidth=1)
        top.set(
            xlabel="x [m]",
            ylabel="y [m]",
            title=flight["file"],
            aspect="equal",
            adjustable="datalim",
        )
        for a, colour in zip("xyz", ("tab:blue", "tab:orange", "tab:green"), strict=True):
            height.plot(t, seen[a], color=colour, linewidth=1, label=a)
        height.set(xlabel="time [s]", ylabel="position [m]")
        height.legend(loc="upper right", fontsize=7, ncols=3)
        u = _commands(seen)
        signals.fill_between(
            t, u.min(axis=0), u.max(axis=0), color="tab:blue", alpha=0.5, linewidth=0
        )
        signals.set(xlabel="time [s]", ylabel="rotor commands, lowest to highest")
        for m in flight["manoeuvres"]:
            for axes in (height, signals):
                axes.axvline(m["start"], color="0.8", linewidth=0.6)
            place = (m["start"], 1.0)
            signals.annotate(
                m["name"],
                place,
                xycoords=("data", "axes fraction"),
                rotation=90,
                fontsize=6,
                va="top",
            )
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()
