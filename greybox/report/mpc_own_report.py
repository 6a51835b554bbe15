"""The page of `greybox mpc` on a model of the user's own: from mpc_own.json (greybox.mpc_own/1) and
the traces of its first run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, TypeAlias

import numpy as np
from matplotlib.figure import Figure

from greybox.report import figures
from greybox.report.html import Cell, Colour, Key, Report
from greybox.report.mpc_documents import OwnDocument, RunTrace
from greybox.report.svg import INK, MUTED, SERIES
from greybox.report.words import number

LOOKS: Mapping[str, tuple[Colour, str]] = {"tube": ("c1", SERIES[0]), "mean": ("c2", SERIES[1])}
"""Colour of a controller, on the page and in figures."""
Traces: TypeAlias = Mapping[str, RunTrace]


def mpc_own_report(content: OwnDocument, traces: Traces) -> str:
    """The page; `traces` of the controllers in one run may be few or none (an interrupted run)."""
    found = content["controllers"]
    best = found.get("tube", found["mean"])
    report = Report(
        f"Predictive control of {content['model']}",
        f"{sum(c['runs'] for c in found.values())} runs of {content['seconds']:g} s, held: "
        f"{', '.join(content['held'])}",
    )
    chance = best["p_value"]
    good = chance is not None and ("tube" not in found or chance >= 0.05)
    report.first_line(content["verdict"], good=good)
    with report.headline():
        if traces:
            report.figures(
                _panels(content, traces),
                key=_key(traces),
                caption="The first run: true outputs and commands. Dotted: what is asked. Dashed: "
                "limits.",
            )
        report.heading("What to do next")
        report.bullets(content["next"])
    _table(report, content)
    _what(report, content)
    facts = [("Model file", content["model_sha256"])]
    report.reproduced_by(content["command"], facts, content["versions"])
    return report.html()


def _key(traces: Traces) -> list[Key]:
    return [
        *(Key(text=n, colour=LOOKS[n][0], stroke="line") for n in traces),
        Key(text="asked", colour="ink", stroke="dots"),
    ]


def _panels(content: OwnDocument, traces: Traces) -> list[tuple[Figure, str]]:
    """One panel per output that is held or limited, and one per input."""
    names = list(content["units"])
    inputs = list(content["ranges"])
    outputs = [n for n in names if n not in inputs]
    any_trace = next(iter(traces.values()))
    times = any_trace["step"] * np.arange(len(any_trace["outputs"]))
    panels = []
    shown: tuple[tuple[Literal["outputs", "commands"], list[str]], ...]
    shown = ("outputs", outputs), ("commands", inputs)
    for what, order in shown:
        for i, name in enumerate(order):
            ends = content["ranges"].get(name) or content["limits"].get(name)
            if ends is None and name not in content["held"]:
                continue
            lines = [
                figures.Line(values=np.full(len(times), e), colour=INK, style="--", width=0.8)
                for e in ends or ()
                if e is not None
            ]
            if name in content["held"]:
                asked = np.array(any_trace["asked"])[:, i]
                lines.append(figures.Line(values=asked, colour=MUTED, style=":", width=1.2))
            for who in sorted(traces, key=lambda n: n == "tube"):
                values = np.array(traces[who][what], dtype=float)[:, i]
                lines.append(figures.Line(values=values, colour=LOOKS[who][1], width=1.3))
            label = f"{name} [{content['units'][name]}]"
            panels.append((figures.time_series(times, {label: lines}), f"{name} over time"))
    return panels


def _table(report: Report, content: OwnDocument) -> None:
    report.section("All runs")
    held, body = list(content["held"]), []
    for name, c in content["controllers"].items():
        low, high = (100 * v for v in c["beyond"]["interval"])
        row: list[Cell] = [name, c["text"], f"{c['beyond']['count']} of {c['runs']}"]
        row += [f"{low:.0f} .. {high:.0f} %", f"{100 * c['samples_beyond']:.1f} %"]
        row += [
            None if size is None else number(size, 3)
            for o in held
            for size in (c["settled"][o], c["rmse"][o])
        ]
        t = c["solve_ms"]
        row.append("" if t["median"] is None else f"{t['median']:.1f} / {t['p99']:.1f}")
        body.append(row)
    report.table(
        ["controller", "what it plans with", "beyond", "95 % interval", "time beyond"]
        + [f"{what} {o} [{content['units'][o]}]" for o in held for what in ("settled", "RMSE")]
        + ["time [ms]"],
        body,
        numeric=tuple(range(2, 6 + 2 * len(held))),
        caption="Beyond: runs in which a true output passed a limit after all were inside. Interval: exact (Clopper and "
        "Pearson). Settled: rms of true outputs against what was asked in the later half of the time "
        "that a value is held; RMSE: all the time. Time: median and 99 % "
        "of one answer, Python included.",
    )


def _what(report: Report, content: OwnDocument) -> None:
    report.section("What was run")
    units, tuning = content["units"], content["tuning"]

    def pair(name: str, ends: Sequence[float | None]) -> str:
        low, high = ("none" if e is None else number(e, 4) for e in ends)
        return f"{name} {low} .. {high} {units[name]}"

    own = content["plant"] == "model"
    report.facts(
        [
            (
                "Machine",
                "the model itself, its parameters drawn for every run from their covariance, noise "
                "as identified"
                if own
                else content["plant"],
            ),
            (
                "Held",
                "; ".join(
                    f"{n} at {', '.join(number(v, 4) for v in values)} {units[n]}"
                    for n, values in content["held"].items()
                ),
            ),
            ("Limits", "; ".join(pair(n, e) for n, e in content["limits"].items()) or "none"),
            ("Inputs", "; ".join(pair(n, e) for n, e in content["ranges"].items())),
            ("Horizon", f"{content['horizon']} samples of {content['dt']:g} s"),
            (
                "Tightening",
                f"{tuning['kappa']:.2f} standard deviations, by Boole's inequality over "
                f"{tuning['touched']:.0f} limits that a run without it touches "
                f"({tuning['runs']} training runs)",
            ),
        ]
    )
