"""The one page of `greybox identify`: from identify.json (greybox.identify/1) to one HTML page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from greybox.model.verdict import Outcome
from greybox.report.html import Cell, Report, Tag
from greybox.report.identify_document import IdentifyDocument, OutcomeRow, StageRow
from greybox.report.validation_sections import headline_figure
from greybox.validation.result import ValidationDocument


def identify_report(
    content: IdentifyDocument,
    about: Mapping[str, str],
    *,
    links: Mapping[str, Sequence[tuple[str, str]]],
    validation: ValidationDocument | None = None,
) -> str:
    """The page. `content` follows schemas/identify.json; `about` says of every stage by name what
    it is for, and `links` which files beside the page belong to it, (text, path) each. `validation`
    (schemas/validate.json) is that of the model that came out."""
    outcome = content["outcome"]
    assert outcome is not None  # it is at its end
    report = Report("From flights to a model", content["command"])
    verdict = outcome["verdict"]
    usable = verdict is not None and verdict["outcome"] == Outcome.USABLE.value
    report.first_line(outcome["line"], verdict.get("why", ()) if verdict else (), good=usable)
    with report.headline():
        if validation:
            headline_figure(report, validation)
        if outcome["model"]:
            facts = [("Model", outcome["model"]), ("Why this one", outcome["why"])]
            if verdict is not None:
                facts.append(("Judged on", verdict["judged_on"]))
            report.facts(facts)
        report.heading("What to do next")
        report.bullets(_next(outcome, content["command"]))
    report.section("Stages")
    report.table(
        ("stage", "what", "ended", "seconds", "CPU seconds"),
        [_row(s, about.get(s["name"], "")) for s in content["stages"]],
    )
    for stage in content["stages"]:
        report.section(stage["folder"].replace("_", " "))
        if stage["skipped"]:
            report.paragraph(f"Skipped: {stage['skipped']}.")
            continue
        report.code("\n".join(stage["lines"]) or "(it said nothing)")
        report.links(links.get(stage["name"], ()))
    report.section("How to reproduce this")
    report.paragraph("Each stage is a plain command; one after the other they give the same files.")
    report.code("\n".join(c for s in content["stages"] if not s["skipped"] for c in s["commands"]))
    report.paragraph("All of them, going on where it was stopped:")
    report.code(content["command"])
    return report.html()


def _next(outcome: OutcomeRow, command: str) -> list[str]:
    verdict = outcome["verdict"]
    if outcome["stopped"]:
        return [
            "Mend what the first line says; then the same command goes on with that stage: "
            f"{command}"
        ]
    texts = []
    if verdict and verdict.get("action"):
        texts.append(
            f"{verdict['reason'][:1].upper()}{verdict['reason'][1:]}. Next: {verdict['action']}."
        )
    texts.append(
        "Every stage below has a page of its own: what is missing stands on that of discover."
    )
    if outcome["exit_code"] == 0:
        texts.append(
            f"On flights that nobody fitted: greybox validate {outcome['model']} --log NEW.csv"
        )
    return texts


def _row(stage: StageRow, about: str) -> tuple[Cell, ...]:
    if stage["skipped"]:
        return stage["name"], about, "skipped", None, None
    code = stage["exit_code"]
    ended: Cell = "done"
    if code != 0:
        ended = Tag(text="the answer is no" if code == 1 else f"failed ({code})")
    return stage["name"], about, ended, float(stage["seconds"]), float(stage["cpu_seconds"])
