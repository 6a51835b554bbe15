"""The report of an output residual: from learn.json (greybox.output_residual/1) to one HTML
page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from greybox.files import to_plain
from greybox.report.compare_report import pit_histogram
from greybox.report.html import Cell, Report
from greybox.report.learn_report import learned_by
from greybox.report.words import number

if TYPE_CHECKING:
    from greybox.baselines.document import OutputDocument
    from greybox.baselines.output_judge import BothJudged


def output_report(content: OutputDocument) -> str:
    """The page. `content` follows schemas/output_residual.json. Raises `KeyError` where a required
    field is missing."""
    content = to_plain(dict(content))
    count = len(content["trained_on"])
    report = Report(
        f"What {content['model'].split(' + ')[0]} misses",
        f"learned from {count} flight{'s' * (count != 1)}",
    )
    for w in content["warnings"]:
        report.warning(w)
    report.section("What was learned")
    learned = [o["name"] for o in content["outputs"] if o["learned"]]
    if learned:
        report.verdict(
            f"{learned_by(content.get('learner', 'gp'))} of {', '.join(content['features'])} "
            f"foretells the one-step errors of {', '.join(learned)}."
        )
    else:
        report.paragraph(
            "Nothing was learned: on held-out flights no output prefers a learned part to the "
            "model alone."
        )
    report.paragraph(
        "It looks at what is known before the predicted sample: the model's own prediction, and "
        "log columns at least one sample old. What it foretells moves the model's state as a "
        "measured error would, so that it works in free runs too."
    )
    report.facts(
        [
            ("Kernel", f"{content['kernel']}, {content['points']} support points")
            if content["kernel"]
            else ("Features", str(content["points"])),
            ("Samples", str(content["samples"])),
            ("Time", f"{number(content['seconds'], 3)} s"),
            ("Parameters", str(content["parameters"])),
        ]
    )
    if validation := content["validation"]:
        report.section("Before and after")
        report.paragraph(f"Judged on {', '.join(content['judged_on'])}.")
        _one_step(report, validation)
        _free_runs(report, validation)
    facts = [("Data", content["data_hash"]), ("Flights", ", ".join(content["trained_on"]))]
    report.reproduced_by(content["command"], facts, content["versions"])
    return report.html()


def _one_step(report: Report, validation: BothJudged) -> None:
    before, after = validation["before"], validation["after"]
    body: list[list[Cell]] = []
    for name, new in after["one_step"]["channels"].items():
        old = before["one_step"]["channels"][name]
        pair: list[Cell] = [number(v) for c in (old, new) for v in (c["mse"] ** 0.5, c["nlpd"])]
        shares = new["coverage50"], new["coverage68"], new["coverage95"]
        inside: list[Cell] = [f"{share:.1%}" for share in shares]
        body.append(
            [
                f"{name} [{new['unit']}]",
                pair[0],
                pair[2],
                number(new["r2"]),
                pair[1],
                pair[3],
                *inside,
            ]
        )
    report.table(
        [
            "one step ahead",
            "RMSE before",
            "after",
            "R\N{SUPERSCRIPT TWO}",
            "NLPD before",
            "after",
            "in 50 %",
            "in 68 %",
            "in 95 %",
        ],
        body,
        numeric=range(1, 9),
    )


def _free_runs(report: Report, validation: BothJudged) -> None:
    before, after = validation["before"], validation["after"]
    rows: list[list[Cell]] = []
    for old, new in zip(before["horizons"], after["horizons"], strict=True):
        for name, cell in new["channels"].items():
            was = old["channels"][name]
            rows.append(
                [
                    f"{name} [{cell['unit']}]",
                    number(new["seconds"]),
                    number(was["rmse"]),
                    number(cell["rmse"]),
                    number(was["nlpd"]),
                    number(cell["nlpd"]),
                    f"{cell['coverage95']:.0%}",
                ]
            )
    report.table(
        ["free run", "seconds ahead", "RMSE before", "after", "NLPD before", "after", "in 95 %"],
        rows,
        numeric=range(1, 7),
        caption="Recorded commands, no measurement after the origin.",
    )
    panels = [
        (pit_histogram(np.array(c["pit"]), title=n), f"PIT histogram of {n}")
        for n, c in after["one_step"]["channels"].items()
    ]
    report.figures(
        panels,
        caption="Probability integral transform, one step ahead: flat where the stated spread is "
        "right.",
    )
