"""Flights of controllers become intervals, back-offs and a verdict that can also be a bad one."""

import copy
import json
import xml.etree.ElementTree as ET
from importlib import resources

import jsonschema
import numpy as np
import pytest

from greybox.report.mpc_report import format_table, mpc_report
from mpc_export.mission import OBSTACLE_COURSE
from mpc_export.mission.campaign import Entry, read_segments, tuned, write_segments
from mpc_export.mission.flight import Mission, PlantError, load_plant, paced, top_speed
from mpc_export.mission.summary import summary
from mpc_export.promise import exact
from mpc_export.tube.problem import TubeProblem

TASK = Mission(course=OBSTACLE_COURSE, problem=TubeProblem(), dt=0.01, pace=1.0)
ENTRIES = tuple(
    Entry(name=n, text=f"<{n}> & co", model="m.json") for n in ("hybrid", "tube", "constant")
)


def row(name, seed, depth=0.0, crashed=False, cost=1.0):
    margins = {p.name: 0.01 for p in OBSTACLE_COURSE.planes} | {
        "wall": -depth if depth else 0.01,
        "ceiling": None,
    }
    return {
        "controller": name,
        "key": "k",
        "seed": seed,
        "crashed": crashed,
        "margins": margins,
        "tilt": 0.7,
        "rmse": 0.04,
        "cost": cost,
        "late": 1,
        "samples": 100,
        "seconds": 1.0,
        "solve_ms": [2.0, 3.0, 4.0],
        "event_count": 1,
        "events": [{"time": 0.5, "what": "no measurement"}],
        "nearest": [None, 0.05, 0.01 - depth],
        "crossings": [{"plane": "wall", "time": 0.2, "depth": depth}] if depth else [],
    }


def content(rows, level=0.1):
    what = {
        "mode": "demo",
        "subject": "demo",
        "plant": "p",
        "plain": "hybrid",
        "model": "</script><b>m</b>",
        "learned": [],
        "model_sha256": "0" * 64,
        "trained_on": ["a"],
        "logs": [],
        "mass": 0.5,
        "disturbed_by": "gusts",
    }
    return summary(
        what=what,
        task=TASK,
        entries=ENTRIES,
        rows=rows,
        level=level,
        seeds=range(1000, 1020),
        jobs=1,
        command="greybox",
        tuning={
            "pairs": 30.0,
            "boole": 2.7,
            "kappa": 1.3,
            "risk": "rehearsal",
            "moved": 0.002,
            "flights": 10,
            "rehearsed": [{"kappa": 0.5, "flights": 12, "crossed": 7}],
        },
    )


def test_interval_is_exact():
    low, high = exact(0, 20)
    assert low == 0
    assert high == pytest.approx(1 - 0.025 ** (1 / 20))  # (1 - p)^20 = 0.025
    assert exact(0, 0) == (0.0, 1.0)


def test_a_promise_that_is_kept_and_one_that_is_broken():
    good = [row("tube", s) for s in range(20)] + [row("hybrid", s, depth=0.004) for s in range(20)]
    assert (
        "kept its promise so far" in content(good)["verdict"]
    )  # the interval of none of 20 goes up to 17 %
    assert "20 of 20" in content(good)["verdict"]
    assert "kept its promise:" in content([row("tube", s) for s in range(60)])["verdict"]
    bad = [row("tube", s, depth=0.003 if s < 6 else 0.0) for s in range(20)]
    found = content(bad)
    assert "broke its promise" in found["verdict"]
    assert found["controllers"]["tube"]["p_value"] == pytest.approx(
        0.0113, abs=1e-4
    )  # P(X >= 6), X ~ B(20, 0.1)
    assert any("surer than it should be" in text for text in found["next"])
    page = mpc_report(found, bad, {})
    assert (
        page.index("broke its promise")
        < page.index("<figure>")
        < page.index("What to do next</h3>")
    )


def test_a_crash_counts_as_beyond_a_limit_and_costs_are_paired_by_seed():
    rows = [row("tube", s, cost=1.0 + s) for s in range(3)] + [
        row("constant", s, cost=0.5 + s) for s in range(1, 3)
    ]
    rows += [row("hybrid", 0, crashed=True)]
    found = content(rows)
    assert found["controllers"]["hybrid"]["crossed"]["count"] == 1
    assert found["differences"]["constant"] == {
        "mean": pytest.approx(-0.5),
        "error": pytest.approx(0.0),
        "flights": 2,
    }
    assert found["controllers"]["tube"]["margins"]["ceiling"] is None


def test_what_went_wrong_is_counted_in_full_and_told():
    said = {"no measurement": 30, "descent declared: position or attitude not measured": 1}
    rows = [row("tube", s) | {"event_kinds": said, "descended": True} for s in range(2)] + [
        row("tube", 2)
    ]
    found = content(rows)
    assert found["controllers"]["tube"]["events"]["no measurement"] == 61
    assert found["controllers"]["tube"]["descended"] == 2
    assert any("came down in 2 of 3 flights" in text for text in found["next"])
    page = mpc_report(found, rows, {})
    assert "descent declared: position or attitude not measured" in page
    calm = [row("tube", 0) | {"events": [], "event_kinds": {}}]
    assert "What went wrong" not in mpc_report(content(calm), calm, {})


def test_result_follows_its_schema_with_and_without_flights():
    schema = json.loads((resources.files("greybox.schemas") / "mpc.json").read_text())
    for rows in ([], [row("tube", 1), row("hybrid", 1, depth=0.01)]):
        found = json.loads(json.dumps(content(rows)))
        jsonschema.validate(found, schema)
        assert len(format_table(found).splitlines()) == 4


def test_page_without_traces_is_whole_and_escapes_names():
    rows = [row("tube", s) for s in range(3)]
    for some in (rows, []):
        page = mpc_report(content(some), some, {})
        ET.fromstring(page[len("<!DOCTYPE html>") :])
        assert "<b>m" not in page


def watched_page():
    """The page of two flights with their traces."""
    rows = [row(n, 1000) for n in ("tube", "hybrid")]
    plan = {
        "time": 0.0,
        "place": [[0.0, 0.0, 1.0]] * 3,
        "spread": [[1e-6, 0, 0, 1e-6, 0, 1e-6]] * 3,
        "left": [None, 0.2, 0.1],
        "backoff": [0.0, 0.01, 0.02],
        "unsure": [],
        "outside": 0.0,
    }
    path = np.column_stack([np.linspace(0, 1, 50), np.zeros(50), np.ones(50)]).tolist()
    trace = {
        "time": (0.02 * np.arange(50)).tolist(),
        "path": path,
        "tilt": [0.1] * 50,
        "commands": [[0.5] * 4] * 50,
        "nearest": [None] * 25 + [0.1] * 25,
        "plans": [plan, copy.deepcopy(plan) | {"time": 0.04}],
    }
    return mpc_report(content(rows), rows, {1000: {"tube": trace, "hybrid": trace | {"plans": []}}})


def test_animation_data_cannot_end_its_script():
    page = watched_page()
    tree = ET.fromstring(page[len("<!DOCTYPE html>") :])
    scripts = list(tree.iter("script"))
    assert len(scripts) == 3  # the data, the animation, the curves
    data = json.loads(next(s.text for s in scripts if s.get("type") == "application/json"))
    assert [c["text"] for c in data["controllers"]] == ["<hybrid> & co", "<tube> & co"]
    policy = next(m.get("content") for m in tree.iter("meta") if m.get("http-equiv"))
    assert policy.count("'sha256-") == 2
    assert "unsafe-inline'; script-src" in policy


def test_constant_leaves_at_most_the_level_of_training_flights_beyond_a_limit():
    rows = [
        row("hybrid", s, depth=d) | {"pairs": 20 + s}
        for s, d in enumerate((0.001, 0.0, 0.005, 0.003))
    ]
    assert tuned(rows, 0.1)["moved"] == 0.005
    assert tuned(rows, 0.25)["moved"] == 0.003
    assert tuned(rows, 0.5)["moved"] == 0.001
    assert tuned(rows, 0.1)["pairs"] == pytest.approx(21.5)


def test_disturbances_of_any_length_are_read_as_they_were_written(tmp_path):
    rng = np.random.default_rng(0)
    segments = [rng.normal(size=(n, 6)) for n in (3, 1, 7)]
    write_segments(tmp_path / "a.npy", segments)
    write_segments(tmp_path / "b.npy", segments)
    assert (tmp_path / "a.npy").read_bytes() == (tmp_path / "b.npy").read_bytes()
    for one, other in zip(segments, read_segments(str(tmp_path / "a.npy")), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_slower_course_is_the_same_path_at_a_lower_speed():
    slow = paced(OBSTACLE_COURSE, 2.0)
    assert top_speed(slow) == pytest.approx(0.5 * top_speed(OBSTACLE_COURSE), rel=1e-3)
    leg = OBSTACLE_COURSE.wait + 0.5 * OBSTACLE_COURSE.legs[0].time
    at = np.array([OBSTACLE_COURSE.wait + OBSTACLE_COURSE.legs[0].time])
    np.testing.assert_allclose(
        slow.sample(at).position, OBSTACLE_COURSE.sample(np.array([leg])).position, atol=1e-12
    )


def test_plants_are_named_by_module_and_attribute():
    assert load_plant("mpc_export.mission.craft:vehicle").rotors == 4
    for wrong in ("mpc_export.mission", "nowhere:plant", "mpc_export.mission:OBSTACLE_COURSE"):
        with pytest.raises(PlantError):
            load_plant(wrong)
