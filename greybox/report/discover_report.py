"""The report of `greybox discover`: from discovery.json (greybox.discovery/1) to one HTML page that tells the story.

The file is long because a page is one story: a function per section, in the order in which they are read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from greybox.report import figures
from greybox.report.discover_figures import band_map, evidence, paired_bars, regime_map
from greybox.report.discover_sections import flights_section, sensors_section
from greybox.report.html import Cell, Key, Report, Tag
from greybox.report.svg import SERIES
from greybox.report.words import number, p_value, rounded
from greybox.statistics.chi_square import log_tail
from greybox.statistics.evidence import CLEAR, CLEAR_LOG_RATIO

ANSWERS = {
    "bad_data": "The data have faults that block the search. They would be read as physics, so nothing was searched.",
    "named": "Something was missing, and it has a name.",
    "ambiguous": "Something is missing. These data cannot say which of several effects it is.",
    "unnamed": "Something structured is left that no effect of the catalogue explains.",
    "nothing_missing": "Nothing is missing at the power of these data.",
}
BARS = 14
"""Candidates that a bar chart shows; the table has all."""

CLOCKS = {"command_delay", "sensor_delay", "pose_delay"}
"""Delays that shift one clock against another: of the three a log shows two."""

def discover_report(content: Mapping[str, Any], *, title: str | None = None) -> str:
    """The page of a discovery. `content` follows schemas/discovery.json. Raises `KeyError` where a required field is
    missing."""
    report = Report(title or "What the model misses", _subtitle(content))
    for text in [*(f"data fault: {f}" for f in content["faults"]), *content["warnings"]]:
        report.warning(text)
    _answer(report, content)
    _where(report, content)
    _which(report, content)
    _added(report, content)
    flights_section(report, content)
    _withheld(report, content)
    sensors_section(report, content)
    _gap(report, content)
    _power(report, content)
    _next(report, content)
    _reproduce(report, content)
    return report.html()


def _subtitle(content: Mapping[str, Any]) -> str:
    count = len(content["trained_on"])
    return f"searched in {count} flight{'s' * (count != 1)}" if count else "not searched"


def _list(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)


def _numbers(effect: Mapping[str, Any]) -> str:
    parts = []
    for name, e in effect["parameters"].items():
        value, std = rounded(e["value"], e["std"])
        spread = "" if e["std"] is None else f" \N{PLUS-MINUS SIGN} {std}"
        parts.append(f"{name} = {value}{spread} {e['unit']}")
    return ", ".join(parts)


def _in_other_words(effect: Mapping[str, Any]) -> str:
    same = [_list(n.split("+")) for n in effect["alternatives"]]
    return "".join(f" (or, the same thing here, {n} alike)" for n in same)


def _answer(report: Report, content: Mapping[str, Any]) -> None:
    report.section("The answer")
    verdict = content["verdict"]
    (report.verdict if verdict in ("named", "nothing_missing") else report.paragraph)(ANSWERS[verdict])
    texts = [f"{e['name']}: {_numbers(e)}" + _in_other_words(e) for e in content["effects"]]
    texts += [
        "one of " + ", ".join(f"{c['name']} ({100 * c['weight']:.0f} %)" for c in a["candidates"])
        for a in content["ambiguous"]
    ]
    texts += [
        f"no name, but a law: {u['proposal']} [{u['unit']}]" if u["proposal"] else f"no name and no law: {_lawless(u)}"
        for u in content["unnamed"]
    ]
    best = _closed(content)
    if best:
        texts.append(
            "share of the gap that closed half a second ahead: "
            + ", ".join(f"{g.replace('_', ' ')} {_percent(r['closed'])}" for g, r in best.items())
        )
    report.bullets(texts)


def _lawless(axis: Mapping[str, Any]) -> str:
    lasts = axis.get("lasts_s")
    size = f"{axis['channel']}, {number(axis['rms'], 2)} {axis['unit']}"
    return size + (f" that lasts {number(lasts, 2)} s" if lasts is not None else "")


def _closed(content: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Group -> row of the gap half a second ahead, where there was one to close and something was added."""
    if not content["effects"] and not content["ambiguous"]:
        return {}
    return {r["group"]: r for r in content["gap"] if r["horizon_s"] == 0.5 and r["closed"] is not None}


def _percent(value: float) -> str:
    return f"{number(100 * value, 3)} %"


def _where(report: Report, content: Mapping[str, Any]) -> None:
    rows = content["locations"]
    if not rows:
        return
    report.section("Where simulation and data disagree")
    gain = content["deficiency"]
    before, after = gain["before"], gain["after"]
    if before is not None and before <= CLEAR:
        report.verdict(
            "A force and torque that change slowly, added to the model, explain nothing that white noise does not: there is "
            "no place where the equations are seen to fail."
        )
    else:
        report.paragraph(
            "Where the equations fail, a force or torque that nobody modelled acts on the vehicle. It was estimated along "
            "the flight; the bars are its size on every body axis. "
            f"With it, the model improves by {number(before, 3)} BIC before, and {number(after, 3)} after the additions "
            f"(above {CLEAR:g}: something is there)."
        )
    panels: list[tuple[Figure, str]] = []
    for kind in ("force", "torque"):
        own = [r for r in rows if r["channel"].startswith(kind)]
        if own:
            figure = paired_bars(
                [r["channel"] for r in own],
                [_float(r["rms"]) for r in own],
                [_float(r["rms_after"]) for r in own],
                unit=own[0]["unit"],
                title=f"unmodelled {kind}, body axes",
            )
            panels.append((figure, f"Unmodelled {kind} per body axis before and after the additions"))
    report.figures(
        panels, key=[Key(text="before", colour="c4"), Key(text="after", colour="c1")],
        caption="RMS of the smoothed discrepancy over the training flights.",
    )  # fmt: skip
    seen = [[r["channel"], ", ".join(r["depends_on"]), _percent(r["share"])] for r in rows if r["proposal"]]
    if seen:
        report.table(
            ["axis", "follows", "share"], seen, numeric=(2,),
            caption="Signals that the discrepancy follows before the additions, and the share of its variance that they "
            "explain on flights that were left out.",
        )  # fmt: skip
    _regimes(report, content)
    _bands(report, content)


def _regimes(report: Report, content: Mapping[str, Any]) -> None:
    rows = content.get("regimes", [])
    before = content["deficiency"]["before"]
    if not rows or before is None or before <= CLEAR:
        return
    names = [r["channel"] for r in content["locations"]]
    panels: list[tuple[Figure, str]] = []
    for r in rows:
        figure = regime_map(names, r["edges"], r["ratio"], title=f"{r['signal']} [{r['unit']}]")
        panels.append((figure, f"Unmodelled force and torque per axis in quarters of {r['signal']}"))
    report.figures(
        panels,
        caption="In which regime it lives: each column holds a quarter of the flight, from the lowest to the highest values "
        "of the signal. Coloured: the unmodelled force or torque is larger there than over the whole flight (full colour: "
        "twice as large).",
    )


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _bands(report: Report, content: Mapping[str, Any]) -> None:
    found = content.get("spectrum")
    if not found:
        return
    names = [c["name"] for c in found["channels"]]
    panels: list[tuple[Figure, str]] = []
    for label in ("before", "after"):
        density = np.array([[_float(v) for v in c[label]] for c in found["channels"]])
        panels.append(
            (
                band_map(names, found["frequency_hz"], density, title=f"one-step errors {label}"),
                f"Map of one-step errors per channel and frequency band, {label} the additions",
            )
        )
    report.figures(
        panels,
        caption="Each row is a measured channel, each column a frequency band. Coloured: one-step errors larger than the "
        "mean of that channel's errors after the additions (full colour: 15 dB). A model that misses nothing leaves the map "
        "empty.",
    )


def _strength(score: Mapping[str, Any]) -> float:
    """-log10 p, finite however small p is."""
    return float(-log_tail(score["statistic"], max(score["dof"], 1))[0] / math.log(10))


def _which(report: Report, content: Mapping[str, Any]) -> None:
    steps = content["steps"]
    if not steps:
        return
    report.section("Which effect it is")
    alpha = float(content["settings"].get("alpha", 0.05))
    report.paragraph(
        "Every effect of the catalogue was tested at the model without it: would the prediction errors shrink if it were "
        f"there? The dashed line is what the strongest of all candidates passes by chance in {100 * alpha:g} % of flights "
        "that miss nothing. Those that pass compete in a joint refit; the one that wins clearly is added, and everything is "
        "tested again."
    )
    panels: list[tuple[Figure, str]] = []
    for step in steps:
        scores = sorted(step["scores"], key=lambda s: s["gain"], reverse=True)[:BARS]
        if not scores:
            continue
        limit = step["p_limit"]
        added = " + ".join(step["added"]) or "nothing"
        figure = evidence(
            [s["name"] for s in scores],
            [_strength(s) for s in scores],
            ["c3" if s["name"] in step["added"] else "c1" if s["p_family"] <= alpha else "muted" for s in scores],
            -math.log10(limit) if limit else None,
            title=f"step {step['step']}: {added} added",
        )
        panels.append((figure, f"Evidence for each candidate at step {step['step']}, {added} added"))
    report.figures(
        panels,
        key=[
            Key(text="added", colour="c3"),
            Key(text="passes", colour="c1"),
            Key(text="does not", colour="muted"),
        ],
        caption="From the top by the gain in likelihood that the test expects. A large effect makes many others pass; which "
        "of them explains it best, the refits say.",
    )
    rows: list[list[Cell]] = [
        [
            s["name"],
            str(step["step"]),
            number(s["gain"], 4),
            number(s["statistic"], 4),
            s["dof"],
            p_value(s["p_family"]),
        ]
        for step in steps
        for s in step["scores"]
    ]
    with report.details(f"All tests ({len(rows)})"):
        report.table(["candidate", "step", "expected gain", "statistic", "degrees of freedom", "p of the largest of all"],
                     rows, numeric=(1, 2, 3, 4, 5))  # fmt: skip


def _added(report: Report, content: Mapping[str, Any]) -> None:
    if not content["effects"] and not content["ambiguous"]:
        return
    report.section("What was added")
    rows: list[list[Cell]] = []
    for e in content["effects"]:
        for name, p in e["parameters"].items():
            value, std = rounded(p["value"], p["std"])
            rival = e["delta_bic_rival"]
            rows.append(
                [
                    f"{e['name']}.{name}", value, Tag(text="at bound") if p["std"] is None else std, p["unit"],
                    str(e["step"]), p_value(e["p_value"]), number(e["delta_bic"], 3),
                    "no rival" if rival is None else number(rival, 3),
                ]
            )  # fmt: skip
    if rows:
        report.table(
            ["parameter", "value", "std", "unit", "step", "p", "BIC gained", "BIC to the next"], rows,
            numeric=(1, 2, 4, 5, 6, 7),
            caption="Estimates of the last joint fit. p: of the largest of all candidates, of its step. BIC to the next: "
            f"how much worse the best other candidate fits (above {CLEAR:g}: the name is clear).",
        )  # fmt: skip
    panels: list[tuple[Figure, str]] = []
    for e in content["effects"]:
        for unit in dict.fromkeys(p["unit"] for p in e["parameters"].values()):
            own = {n: p for n, p in e["parameters"].items() if p["unit"] == unit}
            figure = figures.dot_plot(
                list(own), [_float(p["value"]) for p in own.values()], [_float(p["std"]) for p in own.values()],
                title=e["name"], unit=unit, mark=0.0,
            )  # fmt: skip
            panels.append((figure, f"Estimates of {e['name']} with 95 % intervals"))
    if panels:
        report.figures(
            panels, caption="95 % intervals; the dashed line is no effect (accurate estimates: no bar is seen)."
        )
    for a in content["ambiguous"]:
        report.paragraph(
            f"One of these, within {CLEAR:g} BIC of each other; the weights are their probabilities if it is one of them:"
        )
        report.table(
            ["candidate", "weight"], [[c["name"], _percent(c["weight"])] for c in a["candidates"]], numeric=(1,)
        )
        fly = a["separating_manoeuvre"]
        if isinstance(fly, Mapping):
            _manoeuvre(report, fly)


def _manoeuvre(report: Report, fly: Mapping[str, Any]) -> None:
    """What to fly so that the candidates part."""
    report.paragraph(
        "What tells them apart: every manoeuvre below was flown in simulation with each candidate as the truth. Listed is "
        "the log likelihood ratio that the other candidates are expected to lose, after the manoeuvre, whatever they bend "
        f"within what these flights allow ({CLEAR_LOG_RATIO:g} is BIC {CLEAR:g}), and the time to get there at that rate."
    )
    rows: list[list[Cell]] = [
        [
            m["text"], f"{number(m['amplitude'], 3)} {m['unit']}" if m["unit"] else "", number(m["seconds"], 3),
            number(m["expected_log_likelihood_ratio"], 3),
            "never" if m["seconds_to_bic_10"] is None else number(m["seconds_to_bic_10"], 2),
        ]
        for m in (fly, *fly.get("runners_up", ()))
    ]  # fmt: skip
    heads = ["manoeuvre", "amplitude", "seconds", "expected ratio", f"seconds to BIC {CLEAR:g}"]
    report.table(heads, rows, numeric=(2, 3, 4))


def _withheld(report: Report, content: Mapping[str, Any]) -> None:
    rows = content.get("withheld", [])
    if not rows:
        return
    report.section("What was not given a name")
    report.paragraph("These effects passed the tests and the refit, but not what a name must stand up to afterwards.")
    report.table(["effect", "why"], [[_list(w["effects"]), w["reason"]] for w in rows])


def _states_alone(content: Mapping[str, Any]) -> str:
    """Errors half a second ahead with these states and no further name, and with the last name."""
    rows = [r["errors"] for r in content["held_out_errors"] if r["carried"]]
    if len(rows) < 2:
        return ""
    there = {e["group"]: e["rmse"] for e in rows[0] if e["horizon_s"] == 0.5}
    last = {e["group"]: e["rmse"] for e in rows[-1] if e["horizon_s"] == 0.5}
    parts = [f"{g.replace('_', ' ')} {there[g]:.3g} -> {last[g]:.3g}" for g in there if g in last]
    return f" From the states alone to all names, half a second ahead: {', '.join(parts)}." if parts else ""


def _gap(report: Report, content: Mapping[str, Any]) -> None:
    rows = content["gap"]
    if not rows:
        return
    report.section("How far the gap closed")
    where = "flights that were not searched in" if content["gap_on"] == "test" else "the training flights themselves"
    report.paragraph(
        f"Open-loop prediction from the filtered state, on {where}. The floor is dead reckoning with the measured gyro and "
        "accelerometer. It feels gusts as they come, which no model of commands can foresee, so a complete model may stay "
        "above it; and it has the noise of its sensors, so that a model can also lie below. Rates have no floor."
    )
    if content["settings"].get("carried"):
        report.paragraph(
            "The model after the additions carries what is left along as states of force and torque: it also predicts "
            "better by what they know of the next tenths of a second." + _states_alone(content)
        )
    first = float(content["settings"].get("sample_time", 0.01))
    looks = (("before", SERIES[3], "--"), ("after", SERIES[0], "-"), ("floor", SERIES[2], ":"))
    panels: list[tuple[Figure, str]] = []
    for g in dict.fromkeys(r["group"] for r in rows):
        own = [r for r in rows if r["group"] == g]
        seconds = [r["horizon_s"] or first for r in own]
        curves = {n: ([r[n] for r in own], colour, style) for n, colour, style in looks}
        curves = {n: c for n, c in curves.items() if any(v is not None for v in c[0])}
        figure = figures.error_growth(
            seconds, curves, unit=own[0]["unit"], title=g.replace("_", " "), measure="RMS error"
        )
        panels.append((figure, f"RMS {g} error against the horizon before and after the additions, with the floor"))
    report.figures(
        panels,
        key=[
            Key(text="after", colour="c1"),
            Key(text="before", colour="c4", stroke="dash"),
            Key(text="floor", colour="c3", stroke="dots"),
        ],
        caption="RMS of the error's vector norm (rotation: geodesic angle).",
    )
    body: list[list[Cell]] = []
    more = {"with_proposals": "closed with the proposed laws", "attainable": "closed by a learned part alone"}
    more = {k: text for k, text in more.items() if any(r.get(k) is not None for r in rows)}
    for r in rows:
        interval = "" if r["ci95"] is None else " .. ".join(_percent(v) for v in r["ci95"])
        body.append(
            [
                r["group"].replace("_", " "), "1 sample" if r["horizon_s"] == 0 else f"{r['horizon_s']:g} s",
                number(r["before"]), number(r["after"]), number(r["floor"]), r["unit"],
                None if r["closed"] is None else _percent(r["closed"]), interval,
                *(None if r.get(k) is None else _percent(r[k]) for k in more),
            ]
        )  # fmt: skip
    heads = ["group", "ahead", "before", "after", "floor", "unit", "closed", "95 % interval", *more.values()]
    report.table(
        heads, body, numeric=(1, 2, 3, 4, *range(6, len(heads))),
        caption="closed = 1 - (after\N{SUPERSCRIPT TWO} - floor\N{SUPERSCRIPT TWO}) / (before\N{SUPERSCRIPT TWO} - "
        "floor\N{SUPERSCRIPT TWO}); empty where the model was at the floor before. Block bootstrap.",
    )  # fmt: skip


def _power(report: Report, content: Mapping[str, Any]) -> None:
    sizes = [(n, p, v) for n, ps in content["minimum_detectable"].items() for p, v in ps.items()]
    if sizes:
        report.section("What would have been seen")
        report.paragraph(
            "The smallest size of every parameter that these flights would have shown with a probability of 90 %, next to "
            "what was added. An effect that is smaller may be there."
        )
        rows: list[list[Cell]] = [[f"{n}.{p}", number(v, 3)] for n, p, v in sorted(sizes)]
        with report.details(f"Smallest sizes ({len(rows)} parameters)", open=len(rows) < 20):
            report.table(["parameter [SI]", "size"], rows, numeric=(1,))
    if content["not_judged"]:
        report.section("What could not be judged")
        report.paragraph("These effects may be there; the flights cannot say.")
        report.table(["effect", "why"], [[n, why] for n, why in content["not_judged"].items()])


def _next(report: Report, content: Mapping[str, Any]) -> None:
    report.section("What to do next")
    verdict, texts = content["verdict"], []
    if verdict == "bad_data":
        texts.append("Mend the faults above; greybox check LOG --vehicle V.toml lists every finding with its fix.")
    if content["effects"]:
        texts.append("Use model.json wherever a model file is taken: greybox validate model.json --log NEW.csv")
        texts.append(
            f"If you can, measure {_list([e['name'] for e in content['effects']])} by other means: a name with a number can "
            "be wrong, and then it can be shown to be wrong."
        )
    if content["ambiguous"]:
        told = [
            a["separating_manoeuvre"] for a in content["ambiguous"] if isinstance(a["separating_manoeuvre"], Mapping)
        ]
        texts += [f"Fly what tells the candidates apart: {m['text']}." for m in told]
        clocks = [
            a for a in content["ambiguous"]
            if {c["name"] for c in a["candidates"]} <= CLOCKS and a["separating_manoeuvre"] is None
        ]  # fmt: skip
        if clocks:
            names = " or ".join(c["name"] for c in clocks[0]["candidates"])
            texts.append(
                f"No flight tells {names}: they only shift the clock. Measure one delay by itself, as from a command to the "
                "rotor speed, or of a filter of the IMU from its settings, and put it into the vehicle file."
            )
        if len(told) + len(clocks) < len(content["ambiguous"]):
            texts.append("Fly what tells the candidates apart: see the table of look-alikes in docs/discovery.md.")
    own = list(content.get("effects_files", ()))
    files = [u["file"] for u in content["unnamed"] if u.get("file")]
    if files:
        texts.append(
            f"The laws that were found are proposals, effect files beside this page ({', '.join(files)}): copy one, "
            "edit what makes sense (docs/own_effect.md), and run again with --effects-file and another --out."
        )
    if files and content.get("model_with_laws"):
        command = f"greybox learn {content['model_with_laws']} --train LOGS --effects-file {' '.join([*own, *files])}"
        texts.append(f"What laws leave can be learned: {command}")
    if lawless := [u["channel"] for u in content["unnamed"] if not u.get("file")]:
        more = f" --effects-file {' '.join(own)}" if own else ""
        command = f"greybox learn model.json --train LOGS{more}"
        texts.append(
            f"No law was found for {_list(lawless)}: no signal of the log explains it, as with gusts, noise of force and "
            f"torque that lasts, or a state that nobody measured. {command} learns what can be learned of it."
        )
    after = content["deficiency"]["after"]
    if after is not None and after > CLEAR and not content["unnamed"]:
        texts.append(
            f"Something slow is left (BIC {number(after, 3)}) that follows no signal of the model: gusts, coloured sensor "
            "noise or a state that is not measured. Fit with --disturbance force,torque to carry it."
        )
    if content["gap_on"] == "train":
        texts.append("Give flights of their own with --test: errors on the flights searched in look too good.")
    if any("collinear" in why for why in content["not_judged"].values()):
        texts.append(
            "What is collinear with free parameters can be judged once those are known: weigh, measure thrust."
        )
    if verdict == "nothing_missing":
        texts.append("For a sharper answer fly longer, faster and more varied: sizes shrink with the root of the time.")
    report.bullets(texts)


def _reproduce(report: Report, content: Mapping[str, Any]) -> None:
    report.section("How to reproduce this")
    if content.get("command"):
        report.code(str(content["command"]))
    rows = [("Data", str(content["data_hash"]))] if content["data_hash"] else []
    if content["trained_on"]:
        rows.append(("Searched in", ", ".join(content["trained_on"])))
    if content["tested_on"]:
        rows.append(("Gap judged on", ", ".join(content["tested_on"])))
    rows += [(str(k), str(v)) for k, v in content["settings"].items()]
    rows.append(("seconds", number(content["seconds"], 3)))
    rows += [(str(k), str(v)) for k, v in content["versions"].items()]
    report.facts(rows)
