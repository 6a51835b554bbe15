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

AXES = [f"{kind}.{axis}" for kind in ("force", "torque") for axis in "xyz"]


def content(verdict: str = "named") -> dict[str, Any]:
    """A discovery.json made by hand."""
    named, nothing = verdict == "named", verdict in ("bad_data", "nothing_missing")
    scores = [
        {"name": "rotor_drag", "gain": 500.0, "statistic": 90000.0, "dof": 2, "p": 0.0, "p_family": 0.001},
        {"name": "gyro_bias", "gain": 1.2, "statistic": 2.0, "dof": 3, "p": 0.57, "p_family": 0.98},
    ]
    axis = {
        "unit": "N",
        "rms": 0.2,
        "share": 0.6,
        "depends_on": ["velocity.x"],
        "proposal": "force.x = -0.1 velocity.x",
    }
    gap = {"group": "rotation", "unit": "rad", "before": 0.5, "after": 0.1, "floor": 0.02}
    effect = {
        "name": "rotor_drag", "stage": "wrench", "p_value": 0.001, "delta_bic": 600.0, "delta_bic_rival": None,
        "alternatives": [], "step": 1,
        "parameters": {
            "k_x": {"value": 2e-5, "std": 1e-7, "unit": "kg/rad"}, "k_y": {"value": 0.0, "std": None, "unit": "kg/rad"},
        },
    }  # fmt: skip
    group = {
        "candidates": [{"name": "a", "weight": 0.7}, {"name": "b", "weight": 0.3}], "separating_manoeuvre": None,
    }  # fmt: skip
    searched = verdict != "bad_data"
    return {
        "schema": "greybox.discovery/1", "verdict": verdict, "effects": [effect] if named else [], "omega_known": True,
        "ambiguous": [group] if verdict == "ambiguous" else [],
        "unnamed": [axis | {"channel": "force.x", "file": "proposal_1.py"}] if verdict == "unnamed" else [],
        "locations": [
            axis | {"channel": a, "unit": "N" if a[0] == "f" else "N m", "rms_after": 0.01} for a in AXES
        ] if searched else [],
        "deficiency": {"before": None, "after": None} if not searched
        else {"before": -12.0 if nothing else 800.0, "after": -12.0},
        "spectrum": {
            "frequency_hz": [0.5, 2.0, 20.0],
            "channels": [
                {"name": "p", "before": [30.0, 4.0, 1.0], "after": [1.0, 1.1, 0.9]},
                {"name": "x", "before": [None] * 3, "after": [None] * 3},
            ],
        } if searched else None,
        "steps": [
            {"step": 1, "added": ["rotor_drag"] if named else [], "delta_bic": 600.0 if named else None, "rivals": {},
             "p_limit": 0.002, "scores": scores},
        ] if searched else [],
        "gap": [
            gap | {"horizon_s": 0.0, "closed": None, "ci95": None},
            gap | {"horizon_s": 0.5, "closed": 0.96, "ci95": [0.9, 0.99]},
            gap | {"group": "rate", "unit": "rad/s", "horizon_s": 0.5, "floor": None, "closed": -0.2, "ci95": None},
        ] if searched else [],
        "gap_on": "test" if searched else "", "minimum_detectable": {"gyro_bias": {"b_x": 0.001}} if searched else {},
        "not_judged": {"battery_sag": "no vbat", "payload_mass": "collinear with the free parameters"},
        "faults": [] if searched else ["a: motors 1 and 2 are swapped"], "warnings": [],
        "settings": {"alpha": 0.05, "seed": 0, "sample_time": 0.01}, "trained_on": ["a"] if searched else [],
        "tested_on": ["b"] if searched else [], "data_hash": "ff" if searched else None, "seconds": 3.0,
        "versions": {"greybox": "1"}, "command": "greybox discover",
    }  # fmt: skip


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
    assert "<script" not in page
    words = re.sub(r"<[^>]*>", " ", page).lower().split()
    assert "nan" not in words
    assert "none" not in words


def test_a_name_comes_with_its_number_its_place_and_its_gain():
    page = discover_report(content())
    for text in ("rotor_drag.k_x", "at bound", "velocity.x", "96 %", "90 % .. 99 %", "model.json", "force.x"):
        assert text in page
    assert page.index("What was added</h2>") < page.index("How far the gap closed</h2>")


def test_what_is_the_same_thing_is_said_with_the_name():
    given = content()
    assert "the same thing" not in discover_report(given)
    given["effects"][0] |= {"name": "command_delay", "alternatives": ["sensor_delay+pose_delay"]}
    assert "the same thing here, sensor_delay and pose_delay alike" in discover_report(given)


def test_what_was_not_judged_and_not_seen_is_said():
    page = discover_report(content("nothing_missing"))
    assert "no vbat" in page
    assert "gyro_bias.b_x" in page
    assert "weigh" in page


def test_a_group_shows_its_weights_and_a_law_its_terms():
    assert "70 %" in discover_report(content("ambiguous"))
    assert "-0.1 velocity.x" in discover_report(content("unnamed")).replace("\N{MINUS SIGN}", "-")


def told() -> dict[str, Any]:
    """A manoeuvre that separates two candidates."""
    one = {
        "name": "turn", "text": "fly to and fro while turning", "amplitude": 2.0, "unit": "rad/s", "seconds": 6.0,
        "expected_log_likelihood_ratio": 41.5, "seconds_to_bic_10": 0.7,
    }  # fmt: skip
    other = {**one, "text": "hover", "unit": "", "expected_log_likelihood_ratio": 0.0, "seconds_to_bic_10": None}
    return {**one, "runners_up": [other]}


def test_delays_that_no_flight_tells_apart_are_not_to_be_flown():
    given = content("ambiguous")
    given["ambiguous"][0] |= {
        "candidates": [{"name": n, "weight": 0.5} for n in ("command_delay", "sensor_delay")], "separating_manoeuvre": None
    }  # fmt: skip
    page = discover_report(given)
    assert "No flight tells command_delay or sensor_delay" in page
    assert "Fly what tells the candidates apart" not in page


def test_an_ambiguous_answer_says_what_to_fly_and_what_it_will_tell():
    given = content("ambiguous")
    given["ambiguous"][0]["separating_manoeuvre"] = told()
    page = discover_report(given)
    for text in ("Fly what tells the candidates apart: fly to and fro while turning", "41.5", "2 rad/s", "never"):
        assert text in page


def test_names_that_were_taken_back_stand_with_their_reason():
    given = content("unnamed") | {
        "withheld": [
            {"effects": ["gyro_bias"], "reason": "errors ahead do not shrink", "loglik_gain": 3.0, "ahead_gain": 0.0}
        ]
    }
    page = discover_report(given)
    assert "What was not given a name" in page
    assert "errors ahead do not shrink" in page
    assert "proposal_1.py" in page
    assert "What was not given a name" not in discover_report(content())


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
    assert "greybox learn model_with_laws.json --train LOGS --effects-file mine.py proposal_1.py" in page
    assert "No law was found" not in page
    given["unnamed"] = [*given["unnamed"], given["unnamed"][0] | {"channel": "torque.x", "file": None}]
    page = discover_report(given)
    assert "No law was found for torque.x: no signal of the log explains it" in page
    assert "greybox learn model.json --train LOGS --effects-file mine.py" in page


def test_the_map_of_regimes_is_drawn_where_something_is_missing():
    regime = {"signal": "speed", "unit": "m/s", "edges": [0.0, 0.5, 1.0, 2.0, 4.0], "ratio": [[0.5, 0.8, 1.0, 1.6]] * 6}
    given = content() | {"regimes": [regime]}
    page = discover_report(given)
    tree(page)
    assert "quarters of speed" in page
    clean = content("nothing_missing") | {"regimes": [regime]}
    assert "quarters of speed" not in discover_report(clean)


def test_faults_stand_first():
    page = discover_report(content("bad_data"))
    assert page.index("motors 1 and 2 are swapped") < page.index("The answer</h2>")


def test_hostile_names_are_shown_not_run():
    evil = "<script>alert(\"$x$ & 'y'\")</script>"
    given = content()
    given["effects"][0]["name"] = given["steps"][0]["added"][0] = given["steps"][0]["scores"][0]["name"] = evil
    given["warnings"] = [evil]
    page = discover_report(given)
    assert "<script" not in page
    tree(page)


def test_what_only_the_sensors_do_stands_apart_from_physics():
    filtered = [
        {
            "channel": c,
            "kind": "low_pass",
            "parameters": {"T": 0.004, "cutoff": 39.8, "sigma": 0.01},
            "delta_bic": 812.0,
        }
        for c in ("p", "q")
    ]
    white = {"channel": "x", "kind": "white", "parameters": {"sigma": 0.001}, "delta_bic": None}
    page = discover_report(content() | {"sensors": [*filtered, white]})
    assert "a low-pass filter" in page
    assert "cut-off 39.8 Hz" in page
    assert "812" in page
    assert "What only the sensors do" not in discover_report(content() | {"sensors": [white]})


def test_flights_that_disagree_are_marked():
    row = {"parameter": "motor_lag.tau", "unit": "s", "spread": 0.01}
    flights = {"a": {"value": 0.03, "std": 0.001}, "b": {"value": 0.05, "std": 0.001}}
    page = discover_report(content() | {"stability": [row | {"flights": flights, "p_value": 1e-9, "differs": True}]})
    assert "differs" in page
    assert "0.0300" in page
    row |= {"flights": flights, "p_value": 0.4, "differs": False}
    assert ">agrees<" in discover_report(content() | {"stability": [row]})
