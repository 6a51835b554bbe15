"""The report of a fit: from fit.json (greybox.fit/1), time series and a validation result to one
HTML page."""

from __future__ import annotations

import math
from collections.abc import Mapping

from greybox.estimation.document import FitDocument, NoiseRow, ParameterRow
from greybox.report import figures
from greybox.report.flight_section import FlightSeries, flight_section
from greybox.report.html import Cell, Key, Report, Share, Span, Tag
from greybox.report.response_section import Responses, response_section
from greybox.report.validation_sections import (
    first_line,
    headline_figure,
    horizon_section,
    residual_section,
)
from greybox.report.words import interval, number, rounded, strong_correlations, whiteness_verdict
from greybox.validation.result import ValidationDocument

_SHOWN = 40
_BESIDE = 4
"""Flights in one table of per-flight parameters: names are long, and more would be cut off on a
desk."""


def fit_report(
    fit: FitDocument,
    flights: Mapping[str, FlightSeries] | None = None,
    validation: ValidationDocument | None = None,
    *,
    responses: Responses | None = None,
    title: str | None = None,
) -> str:
    """The page of a fit. `fit` follows schemas/fit.json, `validation` schemas/validate.json; both
    may lack options.

    `flights` maps flight names to their time series; `responses` is how outputs follow commands.
    Raises `KeyError` where a required field of `fit` is missing.
    """
    model, status = fit["model"], fit["status"]
    seconds = sum(f.get("seconds") or 0.0 for f in fit["flights"])
    count = len(fit["flights"])
    subtitle = (
        f"{count} flight{'s' * (count != 1)}, {number(seconds, 3)} s of data, "
        f"{len(fit['parameters'])} parameters"
    )
    report = Report(title or f"Fit of {model['name']}", subtitle)
    first_line(report, fit.get("verdict"))
    with report.headline():
        if validation:
            headline_figure(report, validation)
            if whiteness := validation.get("whiteness"):
                report.paragraph(f"What is missing: {whiteness_verdict(whiteness)}")
        _next(report, fit, validation)
    if not status["converged"]:
        report.warning(f"The fit did not converge: {status['advice']}")
    texts = [
        *fit.get("warnings", []),
        *fit.get("unidentifiable", []),
        *(validation.get("warnings", []) if validation else []),
    ]
    for text in dict.fromkeys(texts):
        report.warning(text)
    if validation:
        horizon_section(report, validation)
    _parameters(report, fit)
    _per_flight(report, fit)
    flight_section(report, flights or {})
    response_section(report, responses)
    if validation:
        residual_section(report, validation)
    _identifiability(report, fit)
    _what(report, fit)
    _reproduce(report, fit)
    return report.html()


def _what(report: Report, fit: FitDocument) -> None:
    model, status, cost = fit["model"], fit["status"], fit.get("cost", {})
    report.section("What was fitted")
    if status["converged"]:
        report.verdict(status["advice"])
    else:
        report.paragraph(status["advice"])
    settings = fit.get("settings", {})
    names = {
        "predictor": "Predictor",
        "criterion": "Criterion",
        "solver": "Solver",
        "initialisation": "Started from",
    }
    rows = [("Model", model["name"]), ("Effects", ", ".join(model.get("effects", [])) or "none")]
    for label, signals in (
        ("States", model.get("states")),
        ("Inputs", model.get("inputs")),
        ("Outputs", model.get("outputs")),
    ):
        if signals:
            rows.append((label, ", ".join(signals)))
    rows += [
        (names.get(k, k.replace("_", " ").capitalize()), _plain(v)) for k, v in settings.items()
    ]
    effort = [f"{status['iterations']} iterations" if status.get("iterations") is not None else ""]
    effort.append(f"{number(status['seconds'], 3)} s" if status.get("seconds") is not None else "")
    rows.append(("Solver's end", ", ".join(t for t in [str(status.get("code", "")), *effort] if t)))
    if cost:
        labels = {
            "loglik": "log likelihood",
            "n_samples": "samples",
            "n_parameters": "free parameters",
        }
        labels |= {"aic": "AIC", "bic": "BIC"}
        known = {
            labels.get(k, k.replace("_", " ")): v
            for k, v in cost.items()
            if isinstance(v, (int, float))
        }
        rows.append(("Cost", ", ".join(f"{k} {number(v, 7)}" for k, v in known.items())))
    report.facts(rows)
    body: list[list[Cell]] = [
        [f["name"], f.get("samples"), number(f.get("seconds"), 4), "; ".join(f.get("notes", []))]
        for f in fit["flights"]
    ]
    report.table(["flight", "samples", "seconds", "notes"], body, numeric=(1, 2))


def _plain(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return number(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{k} = {_plain(v)}" for k, v in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_plain(v) for v in value) or "none"
    return "none" if value is None else str(value)


def _prior(parameter: ParameterRow) -> str:
    prior = parameter.get("prior")
    if not prior:
        return "none"
    sigma = prior.get("sigma")
    if sigma is None or not math.isfinite(sigma):
        return f"{number(prior['value'])}, free"
    return (
        f"{number(prior['value'])} ± {number(sigma, 2)}"
        if sigma > 0
        else f"{number(prior['value'])}, exact"
    )


def _span(parameter: ParameterRow, std: float | None) -> Cell:
    """Estimate and prior on one scale; nothing where either has no spread."""
    prior = parameter.get("prior")
    if std is None or not prior:
        return None
    value, middle, sigma = parameter["value"], prior.get("value"), prior.get("sigma")
    if middle is None or sigma is None or not sigma > 0:
        return None
    if not all(math.isfinite(v) for v in (value, std, middle, sigma)):
        return None
    low, high = value - 1.96 * std, value + 1.96 * std
    away = (value - middle) / sigma
    text = f"{number(away, 2)} standard deviations of the prior from its middle"
    return Span(low=low, high=high, prior=(middle - 1.96 * sigma, middle + 1.96 * sigma), text=text)


def _prior_decides(parameter: ParameterRow) -> bool:
    """Whether at least half of what is known of it was known before."""
    return (parameter.get("prior_influence") or 0.0) >= 0.5


def _notes(parameter: ParameterRow) -> Cell:
    if parameter.get("at_bound"):
        return Tag(text="at bound")
    if _prior_decides(parameter):
        return Tag(text="prior decides")
    return "per flight" if parameter.get("per_flight") else None


def _parameters(report: Report, fit: FitDocument) -> None:
    report.section("Parameters")
    body: list[list[Cell]] = []
    for name, p in fit["parameters"].items():
        std = None if p.get("at_bound") else p.get("std")
        value, spread = rounded(p["value"], std)
        influence = p.get("prior_influence")
        share: Cell = None if influence is None else Share(value=float(influence))
        t = number(p["value"] / std, 3) if std else None
        within = interval(p["value"], std)
        body.append(
            [
                name,
                value,
                spread,
                t,
                within,
                p.get("unit", ""),
                _prior(p),
                _span(p, std),
                share,
                _notes(p),
            ]
        )
    heads = [
        "parameter",
        "estimate",
        "std",
        "t",
        "95 % interval",
        "unit",
        "prior",
        "prior, estimate",
        "by prior",
        "",
    ]
    report.table(
        heads,
        body,
        numeric=(1, 2, 3, 4, 8),
        caption="t: the estimate over its standard deviation; where zero means that an effect is "
        "not there, below 2 the flights hardly show it. Bars: grey, what the vehicle file allows "
        "(95 %); blue, what the flights leave of it. By prior: the share of the estimate's "
        "precision that the prior brought, 0 % = the data alone. A parameter at its bound has no "
        "standard deviation: its interval is one-sided. Of per-flight parameters the mean over "
        "flights is shown.",
    )
    if lag := fit.get("effective_lag"):
        report.paragraph(f"As one number: {lag['line']}.")
    if noise := fit.get("noise"):
        _noise(report, noise)


def _noise(report: Report, noise: Mapping[str, NoiseRow]) -> None:
    with report.details(f"Noise levels ({len(noise)})"):
        rows: list[list[Cell]] = []
        for name, p in noise.items():
            value, spread = rounded(p["value"], p.get("std"))
            rows.append(
                [name, value, spread, interval(p["value"], p.get("std")), p.get("unit", "")]
            )
        report.table(["noise", "estimate", "std", "95 % interval", "unit"], rows, numeric=(1, 2, 3))


def _per_flight(report: Report, fit: FitDocument) -> None:
    chosen = {n: p for n, p in fit["parameters"].items() if p.get("per_flight")}
    flights = list(dict.fromkeys(f for p in chosen.values() for f in p["per_flight"]))
    if len(flights) < 2:  # of one flight the table of all parameters says the same
        return
    report.section("Per-flight parameters")
    panels = []
    for name, p in list(chosen.items())[:_SHOWN]:
        names = list(p["per_flight"])
        values = [v["value"] for v in p["per_flight"].values()]
        errors = [v.get("std") for v in p["per_flight"].values()]
        stds = [math.nan if std is None else std for std in errors]
        prior = p.get("prior")
        mark = prior["value"] if prior else None
        figure = figures.dot_plot(
            names, values, stds, title=name, unit=p.get("unit", ""), mark=mark
        )
        panels.append((figure, f"{name} of each flight with 95 % intervals"))
    key = [
        Key(text="estimate with 95 % interval", colour="c1"),
        Key(text="prior", colour="muted", stroke="dash"),
    ]
    report.figures(
        panels,
        caption="One value per flight; a spread beyond the bars is a real difference.",
        key=key,
    )
    with report.details("The numbers"):
        for first in range(0, len(flights), _BESIDE):
            part = flights[first : first + _BESIDE]
            rows: list[list[Cell]] = []
            for name, p in chosen.items():
                own = [p["per_flight"].get(flight) for flight in part]
                cells = [
                    None if v is None else " ± ".join(rounded(v["value"], v.get("std")))
                    for v in own
                ]
                rows.append([f"{name} [{p.get('unit', '')}]", *cells])
            report.table(["parameter", *part], rows, numeric=range(1, len(part) + 1))


def _at_bounds(fit: FitDocument) -> list[str]:
    """Parameters of the model at a bound. How long noise lasts is none of them: nothing else
    depends on it, as a warning of the fit says."""
    parts = [*fit["settings"].get("noise_parts", []), "disturbance"]
    noise = tuple(f"{part}." for part in parts)
    return [
        n for n, p in fit["parameters"].items() if p.get("at_bound") and not n.startswith(noise)
    ]


def _identifiability(report: Report, fit: FitDocument) -> None:
    report.section("What the data can and cannot tell")
    texts = list(fit.get("unidentifiable", []))
    bound = _at_bounds(fit)
    if bound:
        texts.append(
            f"At a bound: {', '.join(bound)}. The data would move it further than its bounds allow."
        )
    prior = [n for n, p in fit["parameters"].items() if _prior_decides(p)]
    if prior:
        texts.append(f"Mostly decided by the prior, not by these flights: {', '.join(prior)}.")
    correlations = fit.get("correlations") or {}
    names, matrix = correlations.get("names", []), correlations.get("matrix", [])
    pairs = strong_correlations(names, matrix)
    texts += pairs[:10]
    if len(pairs) > 10:
        texts.append(f"{len(pairs) - 10} more pairs are correlated by 0.9 or more; see the figure.")
    if texts:
        report.bullets(texts)
    else:
        report.verdict(
            "Every free parameter is determined by the data, and no two are hard to tell apart."
        )
    if len(names) > 1:
        filled = [[math.nan if v is None else v for v in row] for row in matrix]
        report.figure(
            figures.heat_map(names, filled),
            caption="Correlations of the estimates; blue positive, orange negative, numbers from "
            "0.3 upward.",
            alt="Matrix of the correlations between parameter estimates",
        )


def _next(report: Report, fit: FitDocument, validation: ValidationDocument | None) -> None:
    report.heading("What to do next")
    parameters = fit["parameters"]
    bound = _at_bounds(fit)
    prior = [n for n, p in parameters.items() if _prior_decides(p) and not p.get("at_bound")]
    texts = []
    verdict = fit.get("verdict")
    if verdict and verdict.get("action"):
        reason = verdict["reason"]
        texts.append(
            f"{reason[:1].upper()}{reason[1:]}. Next: {verdict['action']} ({verdict['anchor']})."
        )
    if not fit["status"]["converged"]:
        texts.append(
            "Do not use these numbers yet: follow the advice above until the fit converges."
        )
    if bound:
        texts.append(
            f"At a bound: {', '.join(bound)}. Leave the effect out, or ask greybox discover what "
            "else the data may mean."
        )
    if prior:
        texts.append(
            f"Decided by the vehicle file rather than by the flights: {', '.join(prior)}. Measure "
            "them, or let greybox plan propose a flight that shows them."
        )
    if not validation:
        texts.append(
            "Give flights of their own with --test: errors on the flights of the fit look too good."
        )
    texts.append(
        "What the model still misses has a name or none: greybox discover says which. What has "
        "none can be learned: greybox learn model.json --train LOG ..."
    )
    texts.append(
        "For a controller: greybox export model.json --out DIR writes C and CasADi with a verifier."
    )
    report.bullets(texts)


def _reproduce(report: Report, fit: FitDocument) -> None:
    report.reproduced_by(
        fit.get("command", ""),
        [
            ("Data", fit.get("data_hash", "")),
            *((f"File {f['name']}", f.get("sha256", "")) for f in fit["flights"]),
        ],
        fit.get("versions") or {},
    )
