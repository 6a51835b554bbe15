"""The report of `greybox learn`: from learn.json (greybox.learn/1) to one HTML page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from greybox.report import figures
from greybox.report.html import Cell, Key, Report, Tag
from greybox.report.svg import SERIES
from greybox.report.validation_sections import first_line, headline_groups
from greybox.report.words import number
from greybox.residual.document import HALVES, BeforeAfter, CandidateRow, Half, LearnDocument
from greybox.shown import in_degrees

if TYPE_CHECKING:
    from greybox.validation.horizon_table import HorizonCell
    from greybox.validation.result import ValidationDocument

HONEST = (0.88, 0.99)
"""Coverage of a 95 % region that passes without a mark: few flights, whose errors are alike within
each of them."""
LOUD = 0.5
"""A calibration factor below this or above its inverse is worth a sentence."""

LEARNED = {
    "gp": "A Gaussian process",
    "random-features": "A sum of random features",
    "neural": "The Bayesian last layer of a small network",
    "ensemble": "The mean of an ensemble of small networks",
    "sparse": "A law of few terms",
    "tcn": "The Bayesian last layer of a convolution over earlier commands",
    "lstm": "The Bayesian last layer of a long short-term memory of earlier commands",
}
FAR = "Far from the training flights it fades to nothing and the physics remains."
BEYOND = (
    "Far from the training flights it goes on as its features do: look at its variance and "
    "at the domain there."
)


def learn_report(content: LearnDocument, *, title: str | None = None) -> str:
    """The page of a learned model. `content` follows schemas/learn.json; `validation` may be
    missing, empty or partial.

    Raises `KeyError` where a required field is missing.
    """
    report = Report(title or f"What {content['model']} misses", _subtitle(content))
    first_line(report, content.get("verdict"))
    validation: BeforeAfter = content.get("validation") or {}
    with report.headline():
        beside = content.get("against_physics")
        if beside is not None:
            report.paragraph(f"{beside['line'][0].upper()}{beside['line'][1:]}.")
        _answer(report, content)
        after = _cells(validation.get("after"))
        _curves(report, validation, headline_groups([g for g, _ in after]))
        _next(report, content, validation)
    texts = [*content.get("warnings", [])]
    texts += [
        f"{half}: {w}"
        for half in HALVES
        if (judged := validation.get(half))
        for w in judged.get("warnings", [])
    ]
    texts += [
        f"{t['candidate']}: {w}" for t in content.get("training", []) for w in t.get("warnings", [])
    ]
    for text in dict.fromkeys(texts):
        report.warning(text)
    _learned(report, content)
    _candidates(report, content)
    _ahead(report, validation)
    _uncertainty(report, content, validation)
    _training(report, content)
    _reproduce(report, content)
    return report.html()


def learned_by(learner: str) -> str:
    """The learner of a result, as the beginning of a sentence."""
    return LEARNED.get(learner, f"The learner {learner}")


def _subtitle(content: LearnDocument) -> str:
    count = len(content.get("trained_on", []))
    return (
        f"learned from {count} flight{'s' * (count != 1)}, {content['points']} {_counted(content)}"
    )


def _counted(content: LearnDocument) -> str:
    return "support points" if content.get("learner", "gp") == "gp" else "features"


def _channels(content: LearnDocument, learned: bool) -> list[str]:
    return [o["name"] for o in content["outputs"] if o["learned"] is learned]


def _answer(report: Report, content: LearnDocument) -> None:
    """What was learned, in a sentence or two."""
    if content["null"]:
        report.paragraph(
            "Nothing was learned. No candidate lowers the multi-step errors of flights that it has "
            "not seen, so the model stays the physics alone; only its uncertainty was calibrated."
        )
        return
    silent = _channels(content, False)
    rest = (
        f" Nothing held up for {', '.join(silent)}, which the model leaves to the physics."
        if silent
        else ""
    )
    report.paragraph(
        f"{learned_by(content.get('learner', 'gp'))} of {', '.join(content['features'])} adds to "
        f"{', '.join(_channels(content, True))}. It saves "
        f"{number(100 * content['fit']['held_out_gain'], 3)} % of the squared multi-step errors of "
        f"flights that were left out of its fit.{rest}"
    )


def _learned(report: Report, content: LearnDocument) -> None:
    report.section("What was learned")
    fit, learner = content["fit"], content.get("learner", "gp")
    if not content["null"]:
        report.paragraph(
            "The learned push acts like a force or torque in body axes on top of the physics and "
            "is held over each sample. " + (FAR if learner == "gp" else BEYOND)
        )
    before, after = fit["cost_before"], fit["cost_after"]
    saved = 1 - after / before if before else 0.0
    end = f"{fit['status']}, {fit['iterations']} iteration{'s' * (fit['iterations'] != 1)}"
    report.facts(
        [
            ("Model", content["model"]),
            ("Inputs", ", ".join(content["features"])),
            ("Learned", ", ".join(_channels(content, True)) or "none"),
            (_counted(content).capitalize(), str(content["points"])),
            ("Solver's end", end),
            (
                "Training error saved",
                f"{number(100 * saved, 3)} % of the weighted squared multi-step errors",
            ),
            ("Time", f"{number(content['seconds'], 3)} s"),
        ]
    )


def _candidates(report: Report, content: LearnDocument) -> None:
    report.section("What competed")
    after = (content.get("validation") or BeforeAfter()).get("after")
    dt = after.get("sample_time") if after else None
    ahead = (
        f"{number(2 * dt)} to {number(50 * dt)} s ahead"
        if dt
        else "over the horizon of its training"
    )
    body: list[list[Cell]] = []
    for c in sorted(content["candidates"], key=_rank):
        chosen = c["name"] == content["chosen"] and not content["null"]
        mark = "chosen" if chosen else "its features saw these" if _saw(c) else None
        body.append([c["name"], f"{number(100 * c['held_out_gain'], 3)} %", mark])
    report.table(
        ["candidate", "held-out gain", ""],
        body,
        numeric=(1,),
        caption=f"Share of the squared errors {ahead} that a candidate saves on flights left out "
        "of its fit (one flight after the other; stretches of a flight where there are few). 0 %: "
        "no output was worth switching on.",
    )


def _saw(candidate: CandidateRow) -> bool:
    return candidate.get("features_saw", False)


def _rank(candidate: CandidateRow) -> tuple[bool, float]:
    """By what is saved; what features saved that saw the flights is no rival, and last."""
    return _saw(candidate), -candidate["held_out_gain"]


def _cells(judged: ValidationDocument | None) -> dict[tuple[str, int], HorizonCell]:
    """(group, horizon) -> errors of the model."""
    rows = judged.get("horizons", []) if judged else []
    return {(g, h["h"]): e for h in rows for g, e in h["groups"].items()}


def _ahead(report: Report, validation: BeforeAfter) -> None:
    report.section("How far ahead it predicts, before and after")
    after, before = _cells(validation.get("after")), _cells(validation.get("before"))
    if not after:
        report.paragraph("Not validated. Give flights that were not used here with --test.")
        return
    flights = [f["name"] for f in validation["after"].get("flights", [])]
    adapted = validation["after"].get("adapted_on")
    text = (
        f"Open loop from every sample of {', '.join(flights)}. Before: the physics model as it "
        "was fitted."
    )
    if adapted:
        text += (
            f" Per-flight parameters were adapted on the first {number(adapted['seconds'])} s "
            "and frozen."
        )
    report.paragraph(text)
    groups = list(dict.fromkeys(g for g, _ in after))
    _curves(report, validation, groups)
    seconds = {h["h"]: h["seconds"] for h in validation["after"]["horizons"]}
    heads = [
        "seconds ahead",
        "RMSE before",
        "after",
        "change",
        "NLPD before",
        "after",
        "inside 50 %",
        "inside 95 %",
    ]
    for g in groups:
        body: list[list[Cell]] = []
        unit, factor = in_degrees(next(e["unit"] for (n, _), e in after.items() if n == g))
        for h in (h for name, h in after if name == g):
            new, old = after[g, h], before.get((g, h))
            change = (
                None if old is None or not old["rmse"] else 100 * (new["rmse"] / old["rmse"] - 1)
            )
            body.append(
                [
                    number(seconds[h]),
                    number(factor * old["rmse"]) if old else None,
                    number(factor * new["rmse"]),
                    None if change is None else f"{'+' if change > 0 else ''}{number(change, 2)} %",
                    number(old.get("nlpd"), 3) if old else None,
                    number(new.get("nlpd"), 3),
                    _share(new.get("coverage50"), (0.0, 1.0)),
                    _share(new.get("coverage95"), HONEST),
                ]
            )
        report.heading(f"{g.replace('_', ' ')} [{unit}]")
        report.table(heads, body, numeric=range(len(heads)))
    report.paragraph(
        "NLPD is the mean negative log density of the error vectors in SI units [nat], lower is "
        "better. Inside 50 % and 95 %: share of the error vectors within the region that the "
        f"learned model states; marked outside {100 * HONEST[0]:g} to {100 * HONEST[1]:g} %."
    )


def _curves(report: Report, validation: BeforeAfter, groups: Sequence[str]) -> None:
    looks: tuple[tuple[Half, str, str, str], ...] = (
        ("before", "physics", SERIES[3], "--"),
        ("after", "learned", SERIES[0], "-"),
    )
    if not groups:
        return
    panels: list[tuple[Figure, str]] = []
    dt = validation["after"].get("sample_time")
    for g in groups:
        curves = {}
        for half, name, colour, style in looks:
            judged = validation.get(half)
            own = judged.get("curves", {}).get("model", {}).get(g) if judged else None
            if own:
                curves[name] = (own, colour, style)
        if not curves or not dt:
            continue
        steps = max(len(v) for v, *_ in curves.values())
        unit, factor = in_degrees(
            next(e["unit"] for (n, _), e in _cells(validation.get("after")).items() if n == g)
        )
        shown = {
            n: ([None if v is None else factor * v for v in own], colour, style)
            for n, (own, colour, style) in curves.items()
        }
        figure = figures.error_growth(
            [dt * (i + 1) for i in range(steps)], shown, unit=unit, title=g.replace("_", " ")
        )
        panels.append(
            (
                figure,
                f"Mean {g} error against the horizon, logarithmic axes, for {' and '.join(curves)}",
            )
        )
    if panels:
        key = [
            Key(text="with the learned part", colour="c1"),
            Key(text="physics alone", colour="c4", stroke="dash"),
        ]
        report.figures(
            panels, caption="Mean of the error's vector norm (rotation: geodesic angle).", key=key
        )


def _share(value: float | None, honest: tuple[float, float]) -> Cell:
    if value is None or not math.isfinite(value):
        return None
    text = f"{100 * value:.1f} %"
    return text if honest[0] <= value <= honest[1] else Tag(text=text)


def _uncertainty(report: Report, content: LearnDocument, validation: BeforeAfter) -> None:
    report.section("How sure it says it is")
    factors = content["calibration"]["factors"]
    report.paragraph(
        "Every prediction carries a covariance: of the filter's state, of the physical parameters, "
        "of the learned push (the same error for as long as its features stay alike), of "
        "disturbances that are correlated in time and of white noise. The process noise that a "
        "prediction collects over a horizon was scaled by one factor per group, so that the errors "
        "of the training flights up to half a second ahead are as likely as they can be."
    )
    body: list[list[Cell]] = [[name, number(value, 3)] for name, value in factors.items()]
    report.table(
        ["process noise", "factor"],
        body,
        numeric=(1,),
        caption="1: one-step noise explains the long horizons.",
    )
    large = [n for n, v in factors.items() if v > 1 / LOUD]
    small = [n for n, v in factors.items() if v < LOUD]
    texts = [
        f"Log density gained by the calibration: {number(content['calibration']['gain'], 3)} nat "
        "per error vector."
    ]
    if large:
        texts.append(
            f"Errors of {', '.join(large)} grow faster than one-step errors say: something slow is "
            "still missing."
        )
    if small:
        texts.append(
            f"Errors of {', '.join(small)} grow more slowly than one-step errors say: much of that "
            "noise averages out."
        )
    cells = _cells(validation.get("after"))
    stated = {k: e["coverage95"] for k, e in cells.items() if e.get("coverage95") is not None}
    outside = [
        f"{g} at {h} samples ({100 * v:.0f} %)"
        for (g, h), v in stated.items()
        if not HONEST[0] <= v <= HONEST[1]
    ]
    report.bullets(texts)
    if outside:
        report.paragraph(f"The 95 % regions cover too little or too much for {', '.join(outside)}.")
    elif stated:
        low, high = min(stated.values()), max(stated.values())
        report.verdict(
            f"On the validated flights the stated 95 % regions hold {100 * low:.0f} to "
            f"{100 * high:.0f} % of the errors."
        )


def _training(report: Report, content: LearnDocument) -> None:
    body: list[list[Cell]] = []
    for t in content.get("training", []):
        for o in t["outputs"]:
            gain = None if o.get("gain") is None else number(o["gain"], 3)
            cells: list[Cell] = [
                o["status"],
                number(o["signal_std"], 3),
                number(o["noise_std"], 3),
                gain,
            ]
            body.append([f"{t['candidate']}: {o['name']}", *cells])
    if not body:
        return
    report.section("Marginal likelihood on the smoothed disturbances")
    report.paragraph(
        "These processes give the kernels; their weights were then fitted again by multi-step "
        "errors. Where a held-out gain is stated, above zero means that the smoothed disturbances "
        "of held-out flights are predicted better than by a constant."
    )
    with report.details(f"All outputs of all candidates ({len(body)})"):
        heads = ["candidate and output", "status", "signal std", "noise std", "held-out gain [nat]"]
        report.table(heads, body, numeric=(2, 3, 4))


def _next(report: Report, content: LearnDocument, validation: BeforeAfter) -> None:
    report.heading("What to do next")
    texts = []
    after, beside = _cells(validation.get("after")), content.get("against_physics")
    worse = [
        f"{c['group']} {number(c['seconds'])} s ahead"
        for c in (beside["changes"] if beside is not None and beside["says"] == "worse" else ())
        if c["clear"] and (c["after"] or math.inf) > (c["before"] or math.inf)
    ]
    if not after:
        texts.append(
            "Validate on flights that nobody fitted: greybox validate hybrid.json --log NEW.csv"
        )
    elif worse:
        texts.append(
            f"Errors grew for {', '.join(worse)}: keep the physics model, or learn from more "
            "varied flights."
        )
    elif beside is not None and beside["says"] not in ("better", "worse"):
        texts.append(
            "Keep the physics model: whether what was learned helps is not clear; longer or more "
            "flights that judge would tell."
        )
    if content["null"]:
        texts.append(
            "Where you expected something to learn: fly faster or more varied, give --inputs that "
            "the missing effect depends on, or look for an effect by name with greybox effects."
        )
    else:
        texts.append(
            "What depends smoothly on few inputs may have a name: an effect of the catalogue "
            "extrapolates, a learned push does not. Compare with greybox effects."
        )
        if after and (beside is None or beside["says"] == "better"):
            texts.append("Use hybrid.json wherever a model file is taken.")
    report.bullets(texts)


def _reproduce(report: Report, content: LearnDocument) -> None:
    flights = ", ".join(content.get("trained_on", []))
    report.reproduced_by(
        content.get("command", ""),
        [("Data", content.get("data_hash", "")), ("Flights", flights)],
        content.get("versions") or {},
    )
