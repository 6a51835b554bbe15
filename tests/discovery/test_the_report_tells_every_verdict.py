"""The report of a discovery is one safe page for every verdict, however little is known."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from importlib import resources
from typing import Any

import jsonschema
import pytest

from greybox.report.discover_report import ANSWERS, discover_report
from tests.report.scripts import foreign_scripts

AXES = [f"{kind}.{axis}" for kind in ("force", "torque") for axis in "xyz"]


def content(verdict: str = "named") -> dict[str, Any]:
    """A discovery.json made by hand."""
    named = verdict == "named"
    axis = {
        "unit": "N",
        "rms": 0.2,
        "share": 0.6,
        "depends_on": ["velocity.x"],
        "proposal": "force.x = -0.1 velocity.x",
        "gain": 80.0,
        "lasts_s": 0.4,
    }
    gap = {"group": "rotation", "unit": "rad", "before": 0.5, "after": 0.1, "floor": 0.02}
    worth = {"share": 0.31, "group": "velocity", "horizon_s": 0.5, "log10_e": 1.4, "seconds": 8}
    grounds = {"log10_e": 60.2, "against": "parasitic_drag", "worth": worth}
    effect = {
        "name": "rotor_drag",
        "status": "certified",
        "stage": "wrench",
        **grounds,
        "parameters": {
            "k_x": {"value": 2e-5, "std": 1e-7, "unit": "kg/rad"},
            "k_y": {"value": 0.0, "std": None, "unit": "kg/rad"},
        },
    }
    group = {
        "candidates": [{"name": "a", "weight": 0.7}, {"name": "b", "weight": 0.3}],
        "separating_manoeuvre": None,
        "log10_e": 12.0,
        "parameters": {"k": {"value": 1.0, "std": 0.1, "unit": "s"}},
    }
    trace = {
        "name": "thrust_curve",
        "status": "trace",
        **grounds,
        "reason": "it removes 0.1 % of the error at most",
    }
    searched = verdict != "bad_data"
    return {
        "schema": "greybox.discovery/2",
        "verdict": verdict,
        "line": "MISSING: rotor_drag",
        "bar_log10_e": 2.8,
        "effects": [effect] if named else [],
        "traces": [trace] if named else [],
        "not_certified": [],
        "omega_known": True,
        "ambiguous": [group] if verdict == "ambiguous" else [],
        "unnamed": [axis | {"channel": "force.x", "file": "proposal_1.py"}]
        if verdict == "unnamed"
        else [],
        "locations": [
            axis | {"channel": a, "unit": "N" if a[0] == "f" else "N m", "rms_after": 0.01}
            for a in AXES
        ]
        if searched
        else [],
        "steps": [
            {
                "structure": [],
                "log_evidence": 1e5,
                "predicted": {"rotor_drag": 500.0, "gyro_bias": -1.2},
                "tried": [{"added": ["rotor_drag"], "gain": 612.0}],
                "added": ["rotor_drag"] if named else [],
            },
        ]
        if searched
        else [],
        "gap": [
            gap | {"horizon_s": 0.0, "closed": None, "ci95": None},
            gap | {"horizon_s": 0.5, "closed": 0.96, "ci95": [0.9, 0.99]},
            gap
            | {
                "group": "rate",
                "unit": "rad/s",
                "horizon_s": 0.5,
                "floor": None,
                "closed": -0.2,
                "ci95": None,
            },
        ]
        if searched
        else [],
        "gap_on": "test" if searched else "",
        "minimum_detectable": {"gyro_bias": {"b_x": 0.001}} if searched else {},
        "not_judged": {"battery_sag": "no vbat"},
        "faults": [] if searched else ["a: motors 1 and 2 are swapped"],
        "warnings": [],
        "settings": {"alpha": 0.05, "seed": 0, "sample_time": 0.01},
        "trained_on": ["a"] if searched else [],
        "tested_on": ["b"] if searched else [],
        "data_hash": "ff" if searched else None,
        "seconds": 3.0,
        "versions": {"greybox": "1"},
        "command": "greybox discover",
    }


def tree(page: str) -> ElementTree.Element:
    return ElementTree.fromstring(page.split("\n", 1)[1].replace('<html lang="en">', "<html>", 1))


@pytest.mark.parametrize("verdict", list(ANSWERS))
def test_every_verdict_has_a_page_that_says_it(verdict: str):
    given = content(verdict)
    if given["ambiguous"]:
        given["ambiguous"][0]["separating_manoeuvre"] = told()
    schema = json.loads(resources.files("greybox.schemas").joinpath("discovery.json").read_text())
    jsonschema.validate(given, schema)
    page = discover_report(given)
    tree(page)
    assert ANSWERS[verdict] in page
    assert foreign_scripts(page) == []
    words = re.sub(r"<[^>]*>", " ", page).lower().split()
    assert "nan" not in words
    assert "none" not in words


def test_a_name_comes_with_its_number_its_place_and_its_gain():
    page = discover_report(content())
    for text in (
        "rotor_drag.k_x",
        "at bound",
        "60.2",
        "parasitic_drag",
        "31 %",
        "96 %",
        "90 % .. 99 %",
        "force.x",
    ):
        assert text in page
    assert page.index("What has a name</h2>") < page.index("How far the gap closed</h2>")


def test_names_by_errors_ahead_are_not_said_to_stand_on_a_likelihood():
    told = "how much likelier they are with the name"
    assert told in discover_report(content())
    page = discover_report(content() | {"by_errors_ahead": True})
    assert told not in page
    assert "errors fall with it. It refutes no other cause. A name needs" in page


def test_what_was_not_judged_and_not_seen_is_said():
    page = discover_report(content("nothing_missing"))
    assert "no vbat" in page
    assert "gyro_bias.b_x" in page


def test_a_group_shows_its_weights_and_a_law_its_terms():
    assert "70 %" in discover_report(content("ambiguous"))
    assert "-0.1 velocity.x" in discover_report(content("unnamed")).replace("\N{MINUS SIGN}", "-")


def told() -> dict[str, Any]:
    """A manoeuvre that separates two candidates."""
    one = {
        "name": "turn",
        "text": "fly to and fro while turning",
        "amplitude": 2.0,
        "unit": "rad/s",
        "seconds": 6.0,
        "expected_log_likelihood_ratio": 41.5,
        "seconds_to_bic_10": 0.7,
    }
    other = {
        **one,
        "text": "hover",
        "unit": "",
        "expected_log_likelihood_ratio": 0.0,
        "seconds_to_bic_10": None,
    }
    return {**one, "runners_up": [other]}


def test_a_set_that_no_flight_tells_apart_is_to_be_measured():
    page = discover_report(content("ambiguous"))
    assert "No flight of the library tells a or b apart" in page


def test_a_name_says_which_rivals_only_all_flights_refute():
    given = content("named")
    assert "certified, rather than" not in discover_report(given)
    given["effects"][0]["unlikely"] = [{"name": "a+b", "log10_odds": 9.0, "log10_e": -1.0}]
    assert "certified, rather than a+b" in discover_report(given)


def test_an_ambiguous_answer_says_what_to_fly_and_what_it_will_tell():
    given = content("ambiguous")
    given["ambiguous"][0]["separating_manoeuvre"] = told()
    page = discover_report(given)
    for text in (
        "Fly what tells the candidates apart: fly to and fro while turning",
        "41.5",
        "2 rad/s",
        "never",
    ):
        assert text in page


def test_what_has_no_name_stands_with_its_reason():
    page = discover_report(content())
    assert "What was asked and has no name" in page
    assert "it removes 0.1 % of the error at most" in page
    assert "What was asked and has no name" not in discover_report(content("unnamed"))


def test_the_attainable_line_and_the_proposals_stand_in_the_gap_table_when_they_are_known():
    given = content("unnamed")
    given["gap"][1] |= {"with_proposals": 0.83, "attainable": 0.71}
    page = discover_report(given)
    for text in ("closed with the proposed laws", "83 %", "closed by a learned part alone", "71 %"):
        assert text in page
    assert "learned part alone" not in discover_report(content("unnamed"))


def test_the_way_on_from_what_has_no_name_is_a_command():
    given = content("unnamed")
    page = discover_report(given)
    assert "with --effects-file and another --out" in page
    assert "greybox learn" not in page
    given |= {"model_with_laws": "model_with_laws.json", "effects_files": ["mine.py"]}
    page = discover_report(given)
    assert (
        "greybox learn model_with_laws.json --train LOGS --effects-file mine.py proposal_1.py"
        in page
    )
    assert "No law was found" not in page
    given["unnamed"] = [
        *given["unnamed"],
        given["unnamed"][0] | {"channel": "torque.x", "file": None},
    ]
    page = discover_report(given)
    assert "No law was found for torque.x: no signal of the log explains it" in page
    assert "greybox learn model.json --train LOGS --effects-file mine.py" in page


def test_faults_stand_first():
    page = discover_report(content("bad_data"))
    assert page.index("motors 1 and 2 are swapped") < page.index("What to do next</h3>")


def test_hostile_names_are_shown_not_run():
    evil = "<script>alert(\"$x$ & 'y'\")</script>"
    given = content()
    given["effects"][0]["name"] = given["steps"][0]["added"][0] = evil
    given["steps"][0]["predicted"] = {evil: 3.0}
    given["warnings"] = [evil]
    page = discover_report(given)
    assert foreign_scripts(page) == []
    tree(page)


def test_what_only_the_sensors_do_stands_apart_from_physics():
    filtered = [
        {
            "channel": c,
            "kind": "low_pass",
            "parameters": {"T": 0.004, "cutoff": 39.8, "sigma": 0.01},
        }
        for c in ("p", "q")
    ]
    white = {"channel": "x", "kind": "white", "parameters": {"sigma": 0.001}}
    page = discover_report(content() | {"sensors": [*filtered, white]})
    assert "a low-pass filter" in page
    assert "cut-off 39.8 Hz" in page
    assert "What only the sensors do" not in discover_report(content() | {"sensors": [white]})
