"""The report of `greybox discover`: from discovery.json (greybox.discovery/2) to one HTML page that
tells the story, a function per section, in the order in which they are read."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

from matplotlib.figure import Figure

from greybox.discovery.document import DiscoveryDocument, LeftRow, NamedRow, WorthRow
from greybox.planning.experiment import Manoeuvres
from greybox.report import figures
from greybox.report.discover_figures import evidence, paired_bars
from greybox.report.discover_sections import sensors_section
from greybox.report.html import Cell, Key, Report, Tag
from greybox.report.svg import SERIES
from greybox.report.validation_sections import headline_groups
from greybox.report.words import number, rounded
from greybox.shown import in_degrees
from greybox.validation.gap import GapDocument, closed_in_words

ANSWERS = {
    "bad_data": "The data have faults that block the search. They would be read as physics, so "
    "nothing was searched.",
    "stopped": "The search was stopped before its end. What it had found until then is not judged.",
    "named": "Something was missing, and it has a name.",
    "ambiguous": "Something is missing. These data cannot say which of several effects it is.",
    "unnamed": "Something is left that no effect on offer explains.",
    "nothing_missing": "Nothing is missing at the power of these data.",
}
WRENCH = ("force", "torque")
BARS = 14
"""Candidates that a bar chart shows; the table has all."""


def discover_report(content: DiscoveryDocument, *, title: str | None = None) -> str:
    """The page of a discovery. `content` follows schemas/discovery.json. Raises `KeyError` where a
    required field is missing."""
    report = Report(title or "What the model misses", _subtitle(content))
    report.first_line(content["line"], good=content["verdict"] in ("named", "nothing_missing"))
    with report.headline():
        report.paragraph(ANSWERS[content["verdict"]])
        _closing(report, content, headline_groups([r["group"] for r in content["gap"]]))
        _answer(report, content)
        _next(report, content)
    for text in content["warnings"]:
        report.warning(text)
    _names(report, content)
    _alike(report, content)
    _no_name(report, content)
    _where(report, content)
    _which(report, content)
    sensors_section(report, content)
    _gap(report, content)
    _power(report, content)
    _reproduce(report, content)
    return report.html()


def _subtitle(content: DiscoveryDocument) -> str:
    count = len(content["trained_on"])
    return f"searched in {count} flight{'s' * (count != 1)}" if count else "not searched"


def _list(names: Sequence[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)


def _numbers(effect: NamedRow) -> str:
    parts = []
    for name, e in effect["parameters"].items():
        value, std = rounded(e["value"], e["std"])
        spread = "" if e["std"] is None else f" \N{PLUS-MINUS SIGN} {std}"
        parts.append(f"{name} = {value}{spread} {e['unit']}")
    return ", ".join(parts)


def _answer(report: Report, content: DiscoveryDocument) -> None:
    texts = [f"data fault: {f}" for f in content["faults"]]
    texts += [f"{e['name']}: {_numbers(e)}, {e['status']}" for e in content["effects"]]
    texts += [
        "one of " + ", ".join(f"{c['name']} ({100 * c['weight']:.0f} %)" for c in a["candidates"])
        for a in content["ambiguous"]
    ]
    texts += [
        f"no name, but a law: {u['proposal']} [{u['unit']}]"
        if u["proposal"]
        else f"no name and no law: {_lawless(u)}"
        for u in content["unnamed"]
    ]
    best = _closed(content)
    if best:
        texts.append(
            "share of the gap that closed half a second ahead: "
            + ", ".join(f"{r['group'].replace('_', ' ')} {_in_words(r, r['closed'])}" for r in best)
        )
    report.bullets(texts)


def _lawless(axis: LeftRow) -> str:
    size = f"{axis['channel']}, {number(axis['rms'], 2)} {axis['unit']}"
    lasts = axis.get("lasts_s")
    return size + (f" that lasts {number(lasts, 2)} s" if lasts is not None else "")


def _closed(content: DiscoveryDocument) -> list[GapDocument]:
    """The rows half a second ahead of groups with a gap to close."""
    if not content["effects"] and not content["ambiguous"]:
        return []
    return [r for r in content["gap"] if r["horizon_s"] == 0.5 and r["closed"] is not None]


def _in_words(row: GapDocument, share: float | None) -> str | None:
    """A share of the gap of a row; None where there is none."""
    if share is None:
        return None
    factor = in_degrees(row["unit"])[1]
    floor = row["floor"]
    return closed_in_words(share, factor * row["before"], None if floor is None else factor * floor)


def _percent(value: float) -> str:
    return f"{number(100 * value, 3)} %"


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _worth(worth: WorthRow | None) -> str:
    if worth is None:
        return "not known"
    ahead = f"{worth['horizon_s']:g} s" if worth["horizon_s"] else "one sample"
    group = str(worth["group"]).replace("_", " ")
    return f"{_percent(worth['share'])} of {group}, {ahead} ahead"


def _grounds(content: DiscoveryDocument) -> str:
    """What the e-values of the names say."""
    if content.get("by_errors_ahead"):
        return (
            "The likelihood bends every model of these flights: fitted by errors ahead, what was "
            "found foretells those that judge clearly better. So the causes were fitted by errors "
            "ahead, and a name stands on what it is worth to that fit: its e-value says how "
            "steadily, second by second, errors fall with it. It refutes no other cause."
        )
    where = (
        "flights that did not propose it"
        if content["gap_on"] == "test"
        else ("halves of the flights, each judging what the other taught")
    )
    return (
        f"Each name stands on {where}: its e-value says how much likelier they are with the name "
        "than with the strongest thing that could stand in its place, everything else free. If it "
        "were not there, an e-value of 100 or more would come up in one search of a hundred at "
        "most."
    )


def _names(report: Report, content: DiscoveryDocument) -> None:
    if not content["effects"]:
        return
    report.section("What has a name")
    report.paragraph(
        f"{_grounds(content)} A name needs 10 to the power of "
        f"{number(content['bar_log10_e'], 2)}: as many were offered, and as many have it."
    )
    rows: list[list[Cell]] = []
    for e in content["effects"]:
        for name, p in e["parameters"].items():
            value, std = rounded(p["value"], p["std"])
            spread: Cell = Tag(text="at bound") if p["std"] is None else std
            status = ", rather than ".join(
                [e["status"], *(u["name"] for u in e.get("unlikely", ()))]
            )
            evidence_of = [number(e["log10_e"], 3), e["against"], _worth(e["worth"]), status]
            rows.append([f"{e['name']}.{name}", value, spread, p["unit"], *evidence_of])
    heads = ["parameter", "value", "std", "unit", "log10 e", "against", "removes", "status"]
    report.table(
        heads,
        rows,
        numeric=(1, 2, 4),
        caption="Removes: share of the squared error, in the channels and at the horizon where the "
        "name is worth most. Supported: certain only in that it foretells better on average. Rather "
        "than: the e-value does not refute this rival, all flights do.",
    )
    panels: list[tuple[Figure, str]] = []
    for e in content["effects"]:
        for unit in dict.fromkeys(p["unit"] for p in e["parameters"].values()):
            own = {n: p for n, p in e["parameters"].items() if p["unit"] == unit}
            values, errors = zip(*((p["value"], p["std"]) for p in own.values()), strict=True)
            figure = figures.dot_plot(
                list(own),
                [*map(_float, values)],
                [*map(_float, errors)],
                title=e["name"],
                unit=unit,
                mark=0.0,
            )
            panels.append((figure, f"Estimates of {e['name']} with 95 % intervals"))
    if panels:
        report.figures(panels, caption="95 % intervals; the dashed line is no effect.")


def _alike(report: Report, content: DiscoveryDocument) -> None:
    for a in content["ambiguous"]:
        report.section(f"One of {len(a['candidates'])}")
        report.paragraph(
            "Something of these is there; the flights that judged cannot say which. Shares are the "
            "probabilities if it is one of them."
        )
        rows: list[list[Cell]] = [
            [
                c["name"],
                _percent(c["weight"]),
                ", ".join(f"{n} = {v:.4g}" for n, v in c.get("elsewhere", {}).items()),
            ]
            for c in a["candidates"]
        ]
        report.table(["candidate", "share", "numbers that it would move"], rows, numeric=(1,))
        fly = a["separating_manoeuvre"]
        if isinstance(fly, Mapping):
            _manoeuvre(report, fly)


def _manoeuvre(report: Report, fly: Manoeuvres) -> None:
    """What to fly so that the candidates part."""
    report.paragraph(
        "None of these manoeuvres tells all of them apart: some are one model in other words. "
        * (fly["seconds_to_bic_10"] is None)
        + "Every manoeuvre below was flown in simulation with each candidate as the truth. "
        "Listed is the log likelihood ratio that the other candidates are expected to lose, "
        "whatever they bend within what these flights allow."
    )
    rows: list[list[Cell]] = [
        [
            m["text"],
            f"{number(m['amplitude'], 3)} {m['unit']}" if m["unit"] else "",
            number(m["seconds"], 3),
            number(m["expected_log_likelihood_ratio"], 3),
            "never" if m["seconds_to_bic_10"] is None else number(m["seconds_to_bic_10"], 2),
        ]
        for m in (fly, *fly.get("runners_up", ()))
    ]
    heads = ["manoeuvre", "amplitude", "seconds", "expected ratio", "seconds to a ratio of 5"]
    report.table(heads, rows, numeric=(2, 3, 4))


def _no_name(report: Report, content: DiscoveryDocument) -> None:
    rows: list[list[Cell]] = [
        [
            r["name"],
            r["status"] + ", in the model" * r.get("in_model", False),
            number(r["log10_e"], 3),
            r["reason"],
        ]
        for r in (*content["traces"], *content["not_certified"])
    ]
    if rows:
        report.section("What was asked and has no name")
        report.table(["effect", "status", "log10 e", "why"], rows, numeric=(2,))


def _where(report: Report, content: DiscoveryDocument) -> None:
    rows = content["locations"]
    if not rows:
        return
    report.section("Where simulation and data disagree")
    flown = all(r["channel"].split(".")[0] in WRENCH for r in rows)
    report.paragraph(
        f"Every model of the search carries {'a force and a torque' if flown else 'pushes'} that "
        "nobody modelled. They were estimated along the record; the bars are their size on every "
        f"{'body axis' if flown else 'state that has process noise'}."
    )
    panels: list[tuple[Figure, str]] = []
    for unit in dict.fromkeys(r["unit"] for r in rows):
        own = [r for r in rows if r["unit"] == unit]
        kind = own[0]["channel"].split(".")[0] if flown else "push"
        figure = paired_bars(
            [r["channel"] for r in own],
            [_float(r["rms"]) for r in own],
            [_float(r["rms_after"]) for r in own],
            unit=unit,
            title=f"unmodelled {kind}" + (", body axes" if flown else ""),
        )
        panels.append((figure, f"Unmodelled {kind} before and after the additions"))
    report.figures(
        panels,
        key=[Key(text="before", colour="c4"), Key(text="after", colour="c1")],
        caption="RMS of the smoothed discrepancy over the training flights.",
    )


def _which(report: Report, content: DiscoveryDocument) -> None:
    steps = [
        s for s in content["steps"] if any(v > 0 for v in s["predicted"].values()) or s["tried"]
    ]
    if not steps:
        return
    report.section("How the search went")
    report.paragraph(
        "At every step each absent cause says what the flights would gain in log evidence by it, "
        "to second order. Those that promise most are fitted; what gains most is taken."
    )
    panels: list[tuple[Figure, str]] = []
    for k, step in enumerate(steps, 1):
        gains = {n: v for n, v in step["predicted"].items() if v > 0}
        best = sorted(gains, key=lambda n: -gains[n])[:BARS]
        if not best:
            continue
        added = " + ".join(step["added"]) or "nothing"
        looks = ["c3" if n in step["added"] else "c1" for n in best]
        figure = evidence(best, [gains[n] for n in best], looks, title=f"step {k}: {added} added")
        panels.append((figure, f"Predicted gain of each candidate at step {k}, {added} added"))
    if panels:
        key = [Key(text="added", colour="c3"), Key(text="not added", colour="c1")]
        report.figures(panels, key=key, caption="Predicted gain in log evidence.")
    rows: list[list[Cell]] = [
        [str(k), " + ".join(t["added"]), number(t["gain"], 4)]
        for k, step in enumerate(steps, 1)
        for t in step["tried"]
    ]
    if rows:
        with report.details(f"All fits ({len(rows)})"):
            report.table(["step", "added", "gain in log evidence"], rows, numeric=(0, 2))


def _gap(report: Report, content: DiscoveryDocument) -> None:
    rows = content["gap"]
    if not rows:
        return
    report.section("How far the gap closed")
    where = (
        "flights that were not searched in"
        if content["gap_on"] == "test"
        else "the training flights themselves"
    )
    floored = any(r["floor"] is not None for r in rows)
    report.paragraph(
        f"Open-loop prediction from the filtered state, on {where}, by the equations alone: what "
        "nobody modelled is zero from the start of every prediction."
        + (
            " The floor is dead reckoning with the measured gyro and accelerometer. It feels gusts "
            "as they come, which no model of commands can foresee, so a complete model may stay "
            "above it; and it has the noise of its sensors, so that a model can also lie below. "
            "Rates have no floor."
            if floored
            else ""
        )
    )
    caption = "RMS of the error's vector norm (rotation: geodesic angle)."
    _closing(report, content, list(dict.fromkeys(r["group"] for r in rows)), caption)
    _gap_table(report, rows)


def _closing(
    report: Report, content: DiscoveryDocument, groups: Sequence[str], caption: str = ""
) -> None:
    """Error against horizon of some groups: before, after, floor. Nothing where there is no
    group."""
    rows = content["gap"]
    first = float(content["settings"].get("sample_time", 0.01))
    looks: tuple[tuple[Literal["before", "after", "floor"], str, str], ...] = (
        ("before", SERIES[3], "--"),
        ("after", SERIES[0], "-"),
        ("floor", SERIES[2], ":"),
    )
    panels: list[tuple[Figure, str]] = []
    for g in groups:
        own = [r for r in rows if r["group"] == g]
        unit, factor = in_degrees(own[0]["unit"])
        seconds = [r["horizon_s"] or first for r in own]
        curves: dict[str, tuple[list[float | None], str, str]] = {
            n: ([None if v is None else factor * v for v in (r[n] for r in own)], colour, style)
            for n, colour, style in looks
        }
        curves = {n: c for n, c in curves.items() if any(v is not None for v in c[0])}
        figure = figures.error_growth(
            seconds, curves, unit=unit, title=g.replace("_", " "), measure="RMS error"
        )
        panels.append(
            (
                figure,
                f"RMS {g} error against the horizon before and after the additions, with the floor",
            )
        )
    if not panels:
        return
    report.figures(
        panels,
        key=[
            Key(text="after", colour="c1"),
            Key(text="before", colour="c4", stroke="dash"),
            Key(text="floor", colour="c3", stroke="dots"),
        ],
        caption=caption,
    )


def _gap_table(report: Report, rows: Sequence[GapDocument]) -> None:
    body: list[list[Cell]] = []
    more: dict[Literal["with_proposals", "attainable"], str] = {
        "with_proposals": "closed with the proposed laws",
        "attainable": "closed by a learned part alone",
    }
    more = {k: text for k, text in more.items() if any(r.get(k) is not None for r in rows)}
    for r in rows:
        unit, factor = in_degrees(r["unit"])
        before, after, floor = (
            number(None if v is None else factor * v) for v in (r["before"], r["after"], r["floor"])
        )
        interval = "" if r["ci95"] is None else " .. ".join(_percent(v) for v in r["ci95"])
        body.append(
            [
                r["group"].replace("_", " "),
                "1 sample" if r["horizon_s"] == 0 else f"{r['horizon_s']:g} s",
                before,
                after,
                floor,
                unit,
                _in_words(r, r["closed"]),
                interval,
                *(_in_words(r, r.get(k)) for k in more),
            ]
        )
    heads = [
        "group",
        "ahead",
        "before",
        "after",
        "floor",
        "unit",
        "closed",
        "95 % interval",
        *more.values(),
    ]
    report.table(
        heads,
        body,
        numeric=(1, 2, 3, 4, *range(6, len(heads))),
        caption="closed = 1 - (after\N{SUPERSCRIPT TWO} - floor\N{SUPERSCRIPT TWO}) / "
        "(before\N{SUPERSCRIPT TWO} - "
        "floor\N{SUPERSCRIPT TWO}); empty where the model was at the floor before. Block "
        "bootstrap.",
    )


def _power(report: Report, content: DiscoveryDocument) -> None:
    sizes = [(n, p, v) for n, ps in content["minimum_detectable"].items() for p, v in ps.items()]
    if sizes:
        report.section("What would have been seen")
        report.paragraph(
            "The smallest size of every parameter, alone, that is expected to be certified on "
            "flights like these. What is smaller may be there."
        )
        rows: list[list[Cell]] = [[f"{n}.{p}", number(v, 3)] for n, p, v in sorted(sizes)]
        with report.details(f"Smallest sizes ({len(rows)} parameters)", open=len(rows) < 20):
            report.table(["parameter [SI]", "size"], rows, numeric=(1,))
    if content["not_judged"]:
        report.section("What could not be judged")
        report.paragraph("These effects may be there; the flights cannot say.")
        report.table(["effect", "why"], [[n, why] for n, why in content["not_judged"].items()])


def _next(report: Report, content: DiscoveryDocument) -> None:
    report.heading("What to do next")
    verdict, texts = content["verdict"], []
    if verdict == "bad_data":
        texts.append(
            "Mend the faults above; greybox check LOG --vehicle V.toml lists every finding with "
            "its fix."
        )
    if content["effects"]:
        texts.append(
            "Use model.json wherever a model file is taken: greybox validate model.json --log "
            "NEW.csv"
        )
        texts.append(
            f"If you can, measure {_list([e['name'] for e in content['effects']])} by other means: "
            "a name with a number can be wrong, and then it can be shown to be wrong."
        )
    for a in content["ambiguous"]:
        names = " or ".join(c["name"] for c in a["candidates"])
        fly = a["separating_manoeuvre"]
        if isinstance(fly, Mapping):
            texts.append(f"Fly what tells the candidates apart: {fly['text']}.")
        else:
            texts.append(
                f"No flight of the library tells {names} apart: measure one of them by itself (a "
                "delay from a command to the rotor speed, a bias at rest, a mass on a scale) and "
                "put it into the vehicle file."
            )
    texts += _next_with_laws(content)
    if content["gap_on"] == "train":
        texts.append(
            "Give flights of their own with --test: errors on the flights searched in look too "
            "good."
        )
    if verdict == "nothing_missing":
        texts.append(
            "For a sharper answer fly longer, faster and more varied: sizes shrink with the root "
            "of the time."
        )
    report.bullets(texts)


def _next_with_laws(content: DiscoveryDocument) -> list[str]:
    """What to do with the laws that were found, and with what follows none."""
    texts: list[str] = []
    own = list(content.get("effects_files", ()))
    files = [file for u in content["unnamed"] if (file := u.get("file"))]
    flown = all(r["channel"].split(".")[0] in WRENCH for r in content["locations"])
    if files and not flown:
        texts.append(
            "The laws that were found are proposals, programs beside this page "
            f"({', '.join(files)}): keep the terms that make sense and fit again, greybox fit "
            f"--model-file {files[0]}:build --train LOGS."
        )
        if content.get("model_with_laws"):
            texts.append(
                f"What laws leave can be learned: greybox learn {content['model_with_laws']} "
                "--train LOGS"
            )
    elif files:
        texts.append(
            "The laws that were found are proposals, effect files beside this page "
            f"({', '.join(files)}): copy one, edit what makes sense (docs/own_effect.md), and run "
            "again with --effects-file and another --out."
        )
    if files and flown and content.get("model_with_laws"):
        command = (
            f"greybox learn {content['model_with_laws']} --train LOGS --effects-file "
            f"{' '.join([*own, *files])}"
        )
        texts.append(f"What laws leave can be learned: {command}")
    if lawless := [u["channel"] for u in content["unnamed"] if not u.get("file")]:
        more = f" --effects-file {' '.join(own)}" if own else ""
        command = f"greybox learn model.json --train LOGS{more}"
        texts.append(
            f"No law was found for {_list(lawless)}: no signal of the log explains it, as with "
            f"{'gusts, noise of force and torque that lasts' if flown else 'noise that lasts'}, or "
            f"a state that nobody measured. {command} learns what can be learned of it."
        )
    return texts


def _reproduce(report: Report, content: DiscoveryDocument) -> None:
    report.reproduced_by(
        content.get("command", ""),
        [
            ("Data", str(content["data_hash"] or "")),
            ("Searched in", ", ".join(content["trained_on"])),
            ("Gap judged on", ", ".join(content["tested_on"])),
            *((k, str(v)) for k, v in content["settings"].items()),
            ("seconds", number(content["seconds"], 3)),
        ],
        content["versions"],
    )
