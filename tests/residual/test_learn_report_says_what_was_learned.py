"""The page of greybox learn: words, before and after, honest marks; complete or not, it is one
well-formed safe page."""

from __future__ import annotations

import copy
import re
import xml.etree.ElementTree as ET
from typing import Any

import pytest

from greybox.report.learn_report import learn_report
from tests.report.scripts import foreign_scripts
from tests.report.synthetic_fit import make_validation


def content() -> dict[str, Any]:
    after = make_validation()
    for i, row in enumerate(after["horizons"]):
        for e in row["groups"].values():
            e.update(
                coverage50=0.5, coverage68=0.7, coverage95=0.95 if i < 2 else 0.71, nlpd=-3.0 + i
            )
    before = make_validation()
    for row in before["horizons"]:
        for e in row["groups"].values():
            e["rmse"] *= 1.25
    outputs = [{"name": f"force.{a}", "unit": "N", "learned": True} for a in "xyz"]
    outputs += [{"name": f"torque.{a}", "unit": "N m", "learned": False} for a in "xyz"]
    return {
        "schema": "greybox.learn/1",
        "model": "nano + GP(force)",
        "kind": "dynamics",
        "null": False,
        "candidates": [
            {"name": "motion, broad kernel", "held_out_gain": 0.31},
            {"name": "velocity", "held_out_gain": 0.0},
        ],
        "chosen": "motion, broad kernel",
        "features": ["body_velocity.x", "p"],
        "outputs": outputs,
        "points": 40,
        "fit": {
            "status": "converged",
            "iterations": 2,
            "cost_before": 10.0,
            "cost_after": 6.0,
            "held_out_gain": 0.31,
            "strengths": {"force.x": 1.0, "torque.x": None},
        },
        "calibration": {"factors": {"force": 2.6, "torque": 0.4}, "learned": 0.3, "gain": 0.12},
        "training": [
            {
                "candidate": "motion",
                "method": "sgpr",
                "kernel": "se",
                "points": 40,
                "seconds": {},
                "warnings": [],
                "outputs": [
                    {
                        "name": "force.x",
                        "status": "converged",
                        "signal_std": 0.01,
                        "noise_std": 0.002,
                        "gain": None,
                    }
                ],
            }
        ],
        "trained_on": ["a", "b"],
        "data_hash": "0" * 64,
        "seconds": 12.0,
        "warnings": ["something to know"],
        "versions": {"greybox": "1"},
        "command": "greybox learn model.json --train a.csv b.csv",
        "validation": {"before": before, "after": after},
    }


def text_of(page: str) -> str:
    tree = ET.fromstring(page.removeprefix("<!DOCTYPE html>\n"))
    body = tree.find("body")
    assert body is not None
    return re.sub(r"\s+", " ", " ".join(body.itertext()))


def test_it_says_what_was_learned_and_how_far_it_helps() -> None:
    text = text_of(learn_report(content()))
    assert "adds to force.x, force.y, force.z" in text
    assert "31 %" in text
    assert "Nothing held up for torque.x, torque.y, torque.z" in text
    assert "−20 %" in text  # RMSE is 1/1.25 of what it was
    assert "71.0 %" in text
    assert "cover too little or too much" in text
    assert "Errors of force grow faster" in text
    assert "Errors of torque grow more slowly" in text
    assert text.index("something to know") < text.index("What was learned")
    assert "greybox learn model.json" in text


def test_growing_errors_advise_against_it() -> None:
    change = {"group": "rate", "unit": "rad/s", "seconds": 0.5, "before": 0.1, "after": 0.2}
    worse = content()
    worse["against_physics"] = {
        "says": "worse",
        "line": "worse than the physics alone: 0.5 s ahead rate 0.1 -> 0.2 rad/s",
        "changes": [{**change, "clear": True}],
    }
    text = text_of(learn_report(worse))
    assert "Errors grew for rate 0.5 s ahead: keep the physics model" in text
    assert "Worse than the physics alone: 0.5 s ahead rate" in text
    assert "keep the physics model" not in text_of(learn_report(content()))


@pytest.mark.parametrize("says", ["not clear", "no better"])  # the latter in older files
def test_no_clear_difference_advises_the_physics_model(says: str) -> None:
    same = content()
    same["against_physics"] = {"says": says, "line": says, "changes": []}
    text = text_of(learn_report(same))
    assert "Keep the physics model" in text
    assert "Use hybrid.json" not in text


@pytest.mark.parametrize(
    "missing", ["validation", "before", "coverage", "curves", "training", "command"]
)
def test_what_is_not_there_is_left_out(missing: str) -> None:
    some = copy.deepcopy(content())
    if missing in ("validation", "training", "command"):
        some.pop(missing)
    elif missing == "before":
        some["validation"].pop("before")
    else:
        for v in some["validation"].values():
            v.pop("curves")
            for e in (e for row in v["horizons"] for e in row["groups"].values()):
                e.pop("coverage95", None)
    text = text_of(learn_report(some))
    assert ("Not validated" in text) is (missing == "validation")


def test_names_are_text_not_markup() -> None:
    evil = content()
    evil["trained_on"] = ["<script>alert(1)</script>"]
    evil["candidates"][0]["name"] = "<b>&"
    page = learn_report(evil, title="<i>")
    assert foreign_scripts(page) == []
    text_of(page)
