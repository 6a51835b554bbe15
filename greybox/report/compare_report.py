"""The report of `greybox compare`: from compare.json (greybox.compare/1) to one HTML page, and the
table as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from greybox.files import to_plain
from greybox.report import figures
from greybox.report.figures import _TOP, MUTED, SERIES, WIDTH, _axes, _figure, _label, _panel
from greybox.report.html import Cell, Colour, Key, Report, Stroke
from greybox.report.svg import INK
from greybox.report.words import number

if TYPE_CHECKING:
    from greybox.baselines.compare_scores import Mean
    from greybox.baselines.document import CompareDocument, MethodRow

GROUPS = ("position", "velocity", "rotation", "rate")
LOOK: Mapping[str, tuple[str, str, Colour, Stroke]] = {
    "persistence": (MUTED, ":", "muted", "dots"),
    "linear SISO PEM": (SERIES[3], "--", "c4", "dash"),
    "linear PEM + GP": (SERIES[3], "-", "c4", "line"),
    "nonlinear PEM": (SERIES[0], "--", "c1", "dash"),
    "nonlinear PEM + GP": (SERIES[0], "-", "c1", "line"),
    "GP alone": (SERIES[1], "-", "c2", "line"),
    "LSTM": (SERIES[4], "-", "c5", "line"),
    "TCN": (SERIES[4], "--", "c5", "dash"),
    "dead reckoning": (SERIES[2], ":", "c3", "dots"),
}
"""Colour and stroke of the rows that the figures of error growth show."""
BANDS = (
    "nonlinear PEM + GP",
    "nonlinear PEM + output GP",
    "linear PEM + GP",
    "GP alone",
    "LSTM",
    "TCN",
)
"""Rows whose intervals are drawn."""
FOLLOWS: tuple[Literal["sigma_error", "sigma_manoeuvre"], ...] = ("sigma_error", "sigma_manoeuvre")
WIDEST = 4.0
"""What is shown of the stated deviation, and where histograms of errors end
(schemas/compare.json)."""
PER_CHANNEL: tuple[tuple[Mean, str], ...] = (
    ("mse", "MSE"),
    ("r2", "R\N{SUPERSCRIPT TWO}"),
    ("nlpd", "NLPD [nat]"),
    ("coverage95", "share inside 95 %"),
)
"""What is shown of every channel."""
COLUMNS: tuple[tuple[Mean, str, str], ...] = (
    ("mse", "MSE, standardised", ".4g"),
    ("r2", "R\N{SUPERSCRIPT TWO}", ".4f"),
    ("spectral_error", "spectral error", ".4f"),
    ("nlpd", "NLPD", ".3f"),
    ("crps", "CRPS", ".4f"),
    ("coverage50", "in 50 %", ".1%"),
    ("coverage68", "in 68 %", ".1%"),
    ("coverage95", "in 95 %", ".1%"),
)


def format_table(content: CompareDocument) -> str:
    """The one-step and multi-step tables as text."""
    width = max(len(m["method"]) for m in content["methods"])
    heads = "".join(f"{title.split(',')[0]:>15}" for _, title, _ in COLUMNS)
    lines = [
        f"one step ahead, means over {', '.join(content['channels'])} in units of their training "
        "spread"
    ]
    lines.append(f"{'':{width}}{heads}{'train [s]':>11}{'us/sample':>11}{'parameters':>12}")
    for m in content["methods"]:
        if m["status"] != "done":
            lines.append(f"{m['method']:{width}}  {m['status']}: {m['error']}")
            continue
        cells = "".join(f"{format(m['mean'][key], form):>15}" for key, _, form in COLUMNS)
        cost = f"{m['train_seconds']:>11.1f}{m['microseconds_per_sample']:>11.1f}{m['parameters']:>12d}"
        lines.append(f"{m['method']:{width}}{cells}{cost}")
    dt = content["sample_time"]
    seconds = "".join(f"{f'{dt * h:.3g} s':>10}" for h in content["horizons"])
    for g, unit, rows in _ahead(content):
        lines += ["", f"{g} [{unit}], mean absolute error{seconds}"]
        lines += [
            f"  {name:{width + 26}}"[: width + 28]
            + "".join(f"{'-' if v is None else f'{v:.4f}':>10}" for v in cells)
            for name, cells in rows
        ]
    return "\n".join(lines)


def _ahead(
    content: CompareDocument,
) -> list[tuple[str, str, list[tuple[str, list[float | None]]]]]:
    """(group, unit, [(row, mean absolute error at every horizon)]) of the multi-step tables."""
    tables = {m["method"]: t for m in content["methods"] if (t := m.get("multi_step"))}
    if floor := content.get("dead_reckoning"):
        tables["dead reckoning"] = floor
    out = []
    for g in GROUPS:
        rows, unit = [], ""
        for name, table in tables.items():
            cells = {h["h"]: h["groups"].get(g) for h in table["horizons"]}
            if any(cells.values()):
                rows.append(
                    (name, [c["mae"] if (c := cells.get(h)) else None for h in content["horizons"]])
                )
                unit = next(c["unit"] for c in cells.values() if c)
        if rows:
            out.append((g, unit, rows))
    return out


def compare_report(content: CompareDocument) -> str:
    """The page. `content` follows schemas/compare.json. Raises `KeyError` where a required field is
    missing."""
    content = to_plain(dict(content))
    count = len(content["train"]), len(content["test"])
    report = Report(
        "Methods compared", f"{content['vehicle']}, {count[0]} training and {count[1]} test flights"
    )
    for m in content["methods"]:
        if m["status"] != "done":
            report.warning(f"{m['method']}: {m['status']}: {m['error']}")
    if content["not_run"]:
        report.warning(f"not run (yet): {', '.join(content['not_run'])}")
    done = [m for m in content["methods"] if m["status"] == "done"]
    if done:
        _one_step(report, content, done)
        _multi_step(report, content, done)
        _uncertainty(report, content, done)
        _search(report, content, done)
    _how(report, content)
    return report.html()


def _one_step(report: Report, content: CompareDocument, done: Sequence[MethodRow]) -> None:
    report.section("One step ahead")
    body: list[list[Cell]] = []
    for m in done:
        cells: list[Cell] = [
            None if m["mean"][k] is None else format(m["mean"][k], form) for k, _, form in COLUMNS
        ]
        cost: list[Cell] = [
            number(m["train_seconds"], 3),
            number(m["microseconds_per_sample"], 3),
            _rate(m),
            m["parameters"],
        ]
        body.append([m["method"], *cells, *cost])
    report.table(
        [
            "method",
            *(t for _, t, _ in COLUMNS),
            "training [s]",
            "\N{MICRO SIGN}s per sample",
            "samples per ms",
            "parameters",
        ],
        body,
        numeric=range(1, 13),
        caption=f"Means over {', '.join(content['channels'])}, in units of their standard "
        "deviation on the training flights. Spectral error: share of the signal's power at 0.1-20 "
        "Hz that is left. Training includes every candidate. Time in Python over a whole flight, "
        "many samples at once; exported C has its own.",
    )
    _per_channel(report, content, done)


def _per_channel(report: Report, content: CompareDocument, done: Sequence[MethodRow]) -> None:
    names = content["channels"]
    for key, title in PER_CHANNEL:
        with report.details(f"{title} per channel", open=key == "mse"):
            heads = [f"{n} [{content['units'][n]}]" for n in names]
            rows: list[list[Cell]] = [
                [m["method"], *(number(m["channels"][n][key]) for n in names)] for m in done
            ]
            report.table(["method", *heads], rows, numeric=range(1, len(names) + 1))
    with report.details("what is left in the errors: correlation in time, and with past commands"):
        rows = [
            [
                m["method"],
                *(number(m["channels"][n]["whiteness"], 2) for n in names),
                *(number(m["channels"][n]["input_correlation"], 2) for n in names),
            ]
            for m in done
        ]
        heads = [*(f"{n}, time" for n in names), *(f"{n}, commands" for n in names)]
        report.table(
            ["method", *heads],
            rows,
            numeric=range(1, 2 * len(names) + 1),
            caption="Share of lags whose correlation lies outside the band of independence (5 % "
            "and 1 % by chance).",
        )


def _multi_step(report: Report, content: CompareDocument, done: Sequence[MethodRow]) -> None:
    tables = _ahead(content)
    if not tables:
        return
    report.section("Further ahead")
    report.paragraph(
        "Recorded commands, no measurement after the origin. Methods that predict channels get "
        "attitude by integrating their rates, velocity from their body velocity or specific force, "
        "position by integrating that."
    )
    curves = {m["method"]: curve for m in done if (curve := m["curve"])}
    if floor := content["dead_reckoning_curve"]:
        curves["dead reckoning"] = floor
    shown = [n for n in LOOK if n in curves]
    panels: list[tuple[Figure, str]] = []
    for g, unit, _ in tables:
        lines = {n: (curves[n][g], LOOK[n][0], LOOK[n][1]) for n in shown if g in curves[n]}
        if lines:
            steps = max(len(v) for v, _, _ in lines.values())
            seconds = content["sample_time"] * np.arange(1, steps + 1)
            panels.append(
                (
                    figures.error_growth(seconds, lines, unit=unit, title=g),
                    f"{g} error against the horizon for {', '.join(lines)}",
                )
            )
    if panels:
        report.figures(
            panels, key=[Key(text=n, colour=LOOK[n][2], stroke=LOOK[n][3]) for n in shown]
        )
    seconds_of = [number(content["sample_time"] * h) for h in content["horizons"]]
    with report.columns():
        for g, unit, rows in tables:
            body: list[list[Cell]] = [
                [name, *(number(v) if v is not None else None for v in cells)]
                for name, cells in rows
            ]
            report.table(
                [f"{g} [{unit}]", *(f"{s} s" for s in seconds_of)],
                body,
                numeric=range(1, len(seconds_of) + 1),
            )
    _stated(report, content, done)


def _stated(report: Report, content: CompareDocument, done: Sequence[MethodRow]) -> None:
    """Coverage and density of the stated uncertainty ahead."""
    rows: list[list[Cell]] = []
    for m in done:
        table = m["multi_step"]
        for h in table["horizons"] if table else []:
            for g, cell in h["groups"].items():
                if cell.get("coverage95") is not None:
                    inside: list[Cell] = [
                        f"{share:.0%}"
                        for share in (cell["coverage50"], cell["coverage68"], cell["coverage95"])
                    ]
                    rows.append(
                        [
                            m["method"],
                            g,
                            number(content["sample_time"] * h["h"]),
                            *inside,
                            number(cell["nlpd"]),
                        ]
                    )
    if rows:
        with report.details("what the methods say about their own uncertainty ahead"):
            report.table(
                ["method", "group", "ahead [s]", "in 50 %", "in 68 %", "in 95 %", "NLPD"],
                rows,
                numeric=range(2, 7),
            )


def _uncertainty(report: Report, content: CompareDocument, done: Sequence[MethodRow]) -> None:
    report.section("Can the stated uncertainty be trusted?")
    panels = []
    for m in done:
        bars = np.mean([c["pit"] for c in m["channels"].values()], axis=0)
        panels.append((pit_histogram(bars, title=m["method"]), f"PIT histogram of {m['method']}"))
    report.figures(
        panels,
        caption="Probability integral transform one step ahead, mean over channels: flat where the "
        "stated distribution is right, a hump where it is too wide, a bowl where it is too narrow.",
    )
    _errors(report, done)
    measured = content["measured"]
    t = np.asarray(measured["t"], dtype=np.float64)
    bands = []
    for m in (m for m in done if m["method"] in BANDS):
        rows = {
            n: (_floats(measured["channels"][n]), _floats(s["mean"]), _floats(s["std"]))
            for n, s in m["series"].items()
        }
        bands.append(
            (
                band_figure(t, rows, title=m["method"]),
                f"predictions of {m['method']} with 2-sigma bands",
            )
        )
    if bands:
        with report.details("predictions with 2-sigma bands", open=True):
            report.figures(
                bands,
                caption=f"One step ahead, first seconds of {measured['flight']}.",
                key=[
                    Key(text="measured", colour="ink"),
                    Key(text="predicted, with 2 sigma", colour="c1"),
                ],
            )


def _errors(report: Report, done: Sequence[MethodRow]) -> None:
    """Histograms of the errors, and whether the stated deviation follows them; of results that have
    them."""
    done = [m for m in done if all("histogram" in c for c in m["channels"].values())]
    if not done:
        return
    bars = [
        (m["method"], np.mean([c["histogram"] for c in m["channels"].values()], axis=0))
        for m in done
    ]
    report.figures(
        [(error_histogram(b, title=n), f"histogram of the errors of {n}") for n, b in bars],
        caption="Errors one step ahead over their root mean square, mean over channels; dashed: "
        "normal distribution.",
    )
    names = list(done[0]["channels"])
    rows: list[list[Cell]] = [
        [
            m["method"],
            *(
                None if (v := m["channels"][n][k]) is None else f"{v:+.2f}"
                for k in FOLLOWS
                for n in names
            ),
        ]
        for m in done
    ]
    heads = [*(f"{n}, error" for n in names), *(f"{n}, manoeuvre" for n in names)]
    with report.details("does the stated deviation follow the error, and the manoeuvre?"):
        report.table(
            ["method", *heads],
            rows,
            numeric=range(1, 2 * len(names) + 1),
            caption="Rank correlation with the size of the error and with the distance of the "
            "commands from their mean. Empty: one deviation for all samples. It is weak where most "
            "of the deviation is sensor noise, which is the same everywhere.",
        )


def _rate(m: MethodRow) -> Cell:
    """Predicted samples per millisecond."""
    return number(1e3 / m["microseconds_per_sample"], 3) if m["microseconds_per_sample"] else None


def _search(report: Report, content: CompareDocument, done: Sequence[MethodRow]) -> None:
    report.section("What was tried")
    report.paragraph(
        f"Every method with choices had {content['budget']} candidates, judged on the training "
        f"flights {', '.join(content['held_back'])}; the nonlinear hybrid judges its own on each "
        "training flight left out."
    )
    for m in done:
        if not (m["search"] or m["settings"]):
            continue
        with report.details(m["method"]):
            report.bullets(
                [", ".join(f"{k}: {_text(v)}" for k, v in one.items()) for one in m["search"]]
            )
            if m["settings"]:
                report.paragraph(
                    "used: " + ", ".join(f"{k}: {_text(v)}" for k, v in m["settings"].items())
                )


def _how(report: Report, content: CompareDocument) -> None:
    report.section("How to reproduce")
    adapt = content["adapt"]
    report.facts(
        [
            ("training", ", ".join(content["train"])),
            ("test", ", ".join(content["test"])),
            (
                "adapted on",
                "nothing" if adapt is None else f"the first {adapt:g} s of every test flight",
            ),
            ("seed", str(content["seed"])),
            ("origins", f"every {content['origin_spacing']:g} s"),
        ]
    )
    if "command" in content:
        report.code(content["command"])


def _text(value: object) -> str:
    if isinstance(value, float):
        return number(value)
    if isinstance(value, dict):
        return ", ".join(f"{k} {_text(v)}" for k, v in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _floats(values: Sequence[float | None]) -> npt.NDArray[np.float64]:
    return np.array([np.nan if v is None else v for v in values], dtype=np.float64)


def pit_histogram(shares: npt.ArrayLike, *, title: str) -> Figure:
    """Shares (bins,) as bars over 0..1; the dashed line is where all would be."""
    figure, axes = _panel(1.7)
    values = np.asarray(shares, dtype=np.float64)
    width = 1.0 / len(values)
    axes.bar(
        (np.arange(len(values)) + 0.5) * width, values / width, width=0.9 * width, color=SERIES[0]
    )
    axes.axhline(1.0, color=MUTED, linewidth=1.0, linestyle="--")
    axes.set_xlim(0.0, 1.0)
    _label(axes, x="probability below the measurement", y="density", title=title)
    return figure


def error_histogram(shares: npt.ArrayLike, *, title: str) -> Figure:
    """Shares (BINS,) as a density over errors in units of their root mean square, with the normal
    one."""
    figure, axes = _panel(1.7)
    values = np.asarray(shares, dtype=np.float64)
    width = 2 * WIDEST / len(values)
    middle = -WIDEST + (np.arange(len(values)) + 0.5) * width
    axes.bar(middle, values / width, width=0.9 * width, color=SERIES[0])
    x = np.linspace(-WIDEST, WIDEST, 100)
    axes.plot(
        x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color=MUTED, linewidth=1.0, linestyle="--"
    )
    axes.set_xlim(-WIDEST, WIDEST)
    _label(axes, x="error / its root mean square", y="density", title=title)
    return figure


def band_figure(
    t: npt.NDArray[np.float64],
    rows: Mapping[
        str, tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]
    ],
    *,
    title: str,
) -> Figure:
    """Per channel measured (n,), predicted (n,) and two standard deviations (n,) around it, against
    t (n,) [s]."""
    each, space, left, right, bottom = 0.85, 0.1, 0.74, 0.14, 0.46
    figure = _figure(_TOP + bottom + len(rows) * each + (len(rows) - 1) * space)
    last = len(rows) - 1
    for i, (name, (measured, mean, std)) in enumerate(rows.items()):
        axes = _axes(figure, left, bottom + (last - i) * (each + space), WIDTH - left - right, each)
        axes.fill_between(
            t, mean - 2 * std, mean + 2 * std, color=SERIES[0], alpha=0.3, linewidth=0
        )
        axes.plot(t, measured, color=INK, linewidth=0.7)
        axes.plot(t, mean, color=SERIES[0], linewidth=0.9)
        axes.set_xlim(float(t[0]), float(t[-1]))
        if i < last:
            axes.tick_params(labelbottom=False)
        _label(axes, x="time [s]" if i == last else "", y=name, title=title if i == 0 else "")
    return figure
