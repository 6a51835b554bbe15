"""The report of `greybox linear`: one self-contained page, warnings first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from greybox.linear.document import LinearDocument
from greybox.linear.fit import LinearFit
from greybox.linear.order import OrderChoice
from greybox.linear.prediction import adapt, simulate
from greybox.linear.records import Record, delayed
from greybox.linear.spectrum import SpectralError
from greybox.linear.validation import Identified
from greybox.model.matrices import spectral_radius
from greybox.report import figures, linear_figures
from greybox.report.html import Cell, Key, Report
from greybox.report.words import p_value


def linear_report(
    content: LinearDocument, results: Sequence[Identified], test: Sequence[Record]
) -> str:
    """The page for the content of fit.json, the fits behind it and the `test` records they were
    scored on."""
    names = ", ".join(s["name"] for s in content["outputs"])
    report = Report(
        "Linear model",
        f"{names} from {', '.join(s['name'] for s in content['inputs']) or 'nothing'}",
    )
    for r in results:
        for w in r.fit.warnings:
            report.warning(f"{r.fit.model.name}: {w}" if len(results) > 1 else w)
        if r.whiteness is not None and any(c.test.p_value < 0.01 for c in r.whiteness.channels):
            bad = ", ".join(c.name for c in r.whiteness.channels if c.test.p_value < 0.01)
            kind = (
                "robust standard errors are given"
                if r.fit.robust is not None
                else "standard errors are too small"
            )
            report.warning(
                f"innovations of {bad} are not white: something is not linear, not constant or not "
                f"measured; {kind}"
            )
    report.section("What was fitted")
    report.facts(
        [
            ("training", ", ".join(f["name"] for f in content["train"])),
            ("test", ", ".join(f["name"] for f in content["test"]) or "none"),
            ("sample time", f"{content['sample_time']:g} s"),
            ("models", ", ".join(f"{r.fit.model.name} (order {r.fit.order})" for r in results)),
        ]
    )
    for r in results:
        _model(report, r)
        _residuals(report, r)
        if test:
            _test(report, r, test)
    report.section("How to reproduce")
    report.code(str(content["command"]))
    if content["notes"]:
        with report.details("what was done to the logs"):
            report.bullets(list(content["notes"]))
    return report.html()


def _model(report: Report, r: Identified) -> None:
    fit = r.fit
    report.section(f"Model {fit.model.name}")
    report.paragraph(
        "x[k+1] = A x[k] + B (u[k] - u0) + K e[k],  y[k] = y0 + C x[k] + D (u[k] - u0) + e[k]; "
        f"order {fit.order}, {fit.parameters} free parameters, {fit.samples} samples. "
        f"{fit.status.value}."
    )
    if any(fit.model.delays):
        pairs = ", ".join(f"{n} {d}" for n, d in zip(fit.model.inputs.names, fit.model.delays))
        report.paragraph(f"Input delays in samples: {pairs}.")
    if fit.order_choice is not None:
        _order(report, fit, fit.order_choice)
    _poles(report, r)
    if len(fit.model.inputs):
        _bode(report, fit)
    with report.details("matrices"):
        parts = [
            f"{w} =\n{np.array2string(v, precision=6)}" for w, v in zip("ABCDK", fit.model.matrices)
        ]
        report.code(
            "\n".join([*parts, f"Lambda =\n{np.array2string(fit.model.noise, precision=6)}"])
        )


def _order(report: Report, fit: LinearFit, choice: OrderChoice) -> None:
    report.heading("Why this order")
    report.bullets(list(choice.reasons))
    report.table(
        [
            "order",
            "\N{MINUS SIGN}2 log L",
            "parameters",
            "AIC",
            "AICc",
            "BIC",
            "whiteness p",
            "held-out",
        ],
        [
            [
                f"{row.order}" + (" (chosen)" if row.order == choice.order else ""),
                row.criterion,
                row.parameters,
                row.aic,
                row.aicc,
                row.bic,
                p_value(_none(row.whiteness)),
                _none(row.held_out),
            ]
            for row in choice.rows
        ],
        caption="held-out: e' Lambda^-1 e + log det Lambda on data that the compared fit did "
        "not see (trimmed mean)",
    )
    report.figures(
        [
            (linear_figures.singular_values(fit.singular_values, fit.order), "singular values"),
            (linear_figures.criteria(choice.rows, choice.order), "criteria against order"),
        ],
        key=[
            Key(text="BIC", colour="c1"),
            Key(text="AIC", colour="c2"),
            Key(text="AICc", colour="c3"),
        ],
    )


def _poles(report: Report, r: Identified) -> None:
    fit = r.fit
    report.heading("Poles and zeros")
    poles, zeros = fit.uncertainty.poles(), fit.uncertainty.zeros()
    rows: list[list[Cell]] = []
    strengths, sure = fit.uncertainty.pole_strengths(), fit.uncertainty.well_determined()
    for value, cov, strength, believed in zip(poles.value, poles.covariance, strengths, sure):
        if value.imag < 0:
            continue
        rate = -np.log(max(abs(value), 1e-12)) / fit.model.dt
        hertz = np.abs(np.log(value if value != 0 else 1e-12)) / (2 * np.pi * fit.model.dt)
        text = f"{value.real:.5f}" + (
            f" \N{PLUS-MINUS SIGN} {value.imag:.5f}j" if value.imag > 0 else ""
        )
        rows.append(
            [
                text,
                float(np.sqrt(cov[0, 0])),
                float(np.sqrt(cov[1, 1])),
                float(hertz),
                float(1 / rate) if rate > 0 else None,
                f"{strength:.3g}" + ("" if believed else " (weak or crowded)"),
            ]
        )
    report.table(
        ["pole", "std real", "std imaginary", "frequency [Hz]", "time constant [s]", "strength"],
        rows,
        caption=f"{fit.errors} standard errors; strength: Wald statistic of the mode per degree of "
        "freedom (1 is noise); the error of a weak mode, or of one with a close neighbour, is "
        "larger than its standard error",
    )
    if r.intervals:
        report.table(
            ["pole", "quantity", "lower", "upper"],
            [
                [
                    f"{i.pole.real:.5f} {i.pole.imag:+.5f}j",
                    i.quantity,
                    _none(i.lower),
                    _none(i.upper),
                ]
                for i in r.intervals
            ],
            caption="95 % profile likelihood intervals; an empty end is open",
        )
    report.figure(
        linear_figures.pole_map(poles, zeros),
        alt="poles and zeros in the complex plane",
        key=[Key(text="pole", colour="c1"), Key(text="zero (square systems)", colour="c2")],
    )


def _bode(report: Report, fit: LinearFit) -> None:
    """Every pair of input and output, as far as a page holds them."""
    nyquist = 0.5 / fit.model.dt
    f = np.geomspace(nyquist / 500, 0.99 * nyquist, 120)
    data = fit.uncertainty.bode(f, fit.model.dt)
    panels: list[tuple[Figure, str]] = []
    for i, output in enumerate(fit.model.outputs.names):
        for j, name in enumerate(fit.model.inputs.names):
            if len(panels) < 12:
                panels.append(
                    (
                        linear_figures.bode(f, data, i, j, title=f"{name} to {output}"),
                        f"Bode {name} to {output}",
                    )
                )
    with report.details("Bode diagrams with 95 % bands", open=len(panels) <= 4):
        report.figures(panels)


def _residuals(report: Report, r: Identified) -> None:
    report.heading(f"Residual tests of {r.fit.model.name} (training data)")
    if r.whiteness is not None:
        report.table(
            ["output", "lags outside the 99 % band", "predictable share", "Ljung-Box p"],
            [
                [c.name, c.outside, c.predictable, p_value(c.test.p_value)]
                for c in r.whiteness.channels
            ],
        )
        report.figures(
            [
                (
                    figures.correlogram(
                        np.arange(1, len(c.r) + 1), c.r, c.band, title=f"e of {c.name}"
                    ),
                    f"autocorrelation {c.name}",
                )
                for c in r.whiteness.channels
            ]
        )
    if r.cross is not None:
        report.paragraph(r.cross.note)
        lags = np.arange(-r.cross.max_lag, r.cross.max_lag + 1)
        worst = sorted(r.cross.pairs, key=lambda p: p.p_value)
        report.table(
            ["innovation", "input", "lags > 0 outside", "p (positive lags)"],
            [[p.innovation, p.input, p.outside, p_value(p.p_value)] for p in worst],
        )
        with report.details("cross-correlations, worst first"):
            report.figures(
                [
                    (
                        figures.correlogram(
                            lags, p.r, p.band, title=f"e of {p.innovation} after {p.input}"
                        ),
                        "cross-correlation",
                    )
                    for p in worst[:6]
                ]
            )
    if r.spectral is not None:
        _spectra(report, r.spectral, r.fit.model.outputs.names)


def _spectra(report: Report, s: SpectralError, names: Sequence[str]) -> None:
    report.table(
        ["output", f"spectral error {s.low:g}-{s.high:g} Hz [%]"],
        [[n, 100 * float(v)] for n, v in zip(names, s.share)],
        caption="integral of |S_ee| over integral of |S_yy| (Welch)",
    )
    report.figures(
        [
            (
                linear_figures.spectra(
                    s.frequency,
                    s.output_spectrum[:, i],
                    s.error_spectrum[:, i],
                    low=s.low,
                    high=s.high,
                    title=n,
                ),
                f"spectra {n}",
            )
            for i, n in enumerate(names)
        ],
        key=[Key(text="output", colour="muted"), Key(text="innovation", colour="c1")],
    )


def _test(report: Report, r: Identified, test: Sequence[Record]) -> None:
    fit = r.fit
    report.heading(f"Test of {fit.model.name} on logs that it never saw")
    headers = ["log", "horizon"]
    for n in fit.model.outputs.names:
        headers += [f"{n} RMSE", "fit [%]", "persistence"]
    rows: list[list[Cell]] = []
    for t in r.rows:
        cells: list[Cell] = [t.record, f"{t.horizon}" if t.horizon else "free run"]
        for i in range(len(fit.model.outputs)):
            cells += [float(t.rmse[i]), float(t.fit[i]), float(t.persistence[i])]
        rows.append(cells)
    report.table(headers, rows, caption="horizon in samples; RMSE in the unit of the channel")
    if spectral_radius(fit.model.matrices.a) >= 1.0:
        report.paragraph("The model is unstable, so that there is no free run.")
        return
    record = Record(
        u=test[0].u[:, list(r.columns)], y=test[0].y[:, list(r.outputs)], name=test[0].name
    )
    known = adapt(fit.model, record, r.adapted_on)
    moved = delayed(record, fit.model.delays)
    y = (
        simulate(fit.model, record.u, x0=known.x0)[len(record) - len(moved) :]
        + known.offset
        - fit.model.output_offset
    )
    time = np.arange(len(moved)) * fit.model.dt
    lines = {
        n: [
            figures.Line(values=moved.y[:, i], colour=figures.MUTED, style="-", width=1.0),
            figures.Line(values=y[:, i], colour=figures.SERIES[0], style="-", width=1.2),
        ]
        for i, n in enumerate(fit.model.outputs.names)
    }
    report.figure(
        figures.time_series(time, lines, title=f"free run on {record.name}"),
        alt="measured and free run",
        key=[Key(text="measured", colour="muted"), Key(text="free run", colour="c1")],
    )


def _none(value: float) -> float | None:
    return None if not np.isfinite(value) else float(value)
