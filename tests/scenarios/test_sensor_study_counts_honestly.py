"""The study of realistic sensors: what counts as right, false physics and false sensor, and its
intervals."""

from __future__ import annotations

import pytest

from scenarios.plants.realistic_sensors import INGREDIENTS, REALISTIC
from scenarios.studies.discovery_sensors import judge, realism_of, summary, wilson


def row(effect="clean", effects=(), groups=(), unnamed=(), ingredients="all", verdict="named"):
    return {
        "effect": effect,
        "effects": dict.fromkeys(effects),
        "groups": list(groups),
        "unnamed": list(unnamed),
        "ingredients": ingredients,
        "verdict": verdict,
    }


@pytest.mark.parametrize(
    ("case", "right"),
    [
        (row(verdict="nothing_missing"), True),
        (row(effects=["pose_delay", "gyro_bias"]), True),
        (row(effects=["pose_delay"], ingredients="none"), True),
        (row(effects=["rotor_drag"]), False),
        (row(unnamed=["force.x = 2 p"]), False),
        (row(verdict="bad_data"), False),
        (row("motor_lag", ["motor_lag", "pose_delay"]), True),
        (row("motor_lag", [], [["motor_lag", "command_delay"]]), True),
        (row("motor_lag", [], [["rotor_drag", "command_delay"]]), False),
        (row("motor_lag", ["pose_delay"]), False),
        (row("motor_lag", ["motor_lag", "rotor_drag"]), False),
    ],
)
def test_right_means_the_truth_and_no_other_physics(case, right):
    assert judge(case)["right"] is right


def test_late_commands_are_all_sensors_late_alike_only_where_they_are():
    said = {
        "alternatives": {"command_delay": ["sensor_delay+pose_delay"]},
        "truth": {"sensor_delay.d": 0.02},
        "effects": {"command_delay": {"d": [0.0198, 1e-4]}},
    }
    late = row(effect="sensor_delay", effects=["command_delay"])
    assert not judge(late)["right"]
    assert judge(late | said)["right"]
    assert not judge(late | said | {"truth": {"sensor_delay.d": 0.012}})["right"]
    assert not judge(late | said | {"effects": {"command_delay": {"d": [0.012, 1e-4]}}})["right"]
    assert not judge(row(effect="motor_lag") | said)["right"]
    assert not judge(row(effect="sensor_delay", ingredients="colour") | said)["right"]
    assert not judge(row() | said)["right"]


def test_names_of_sensors_that_nobody_hid_are_counted_apart():
    assert judge(row(effects=["pose_delay"], ingredients="none"))["sensor"] == ["pose_delay"]
    assert judge(row(effects=["pose_delay"], ingredients="pose_delay"))["sensor"] == []


def test_ingredients_are_read_from_the_cell():
    assert realism_of("all") == REALISTIC
    assert realism_of("none").switched_on == ()
    assert set(realism_of("low_pass+lost").switched_on) == {"low_pass", "lost"}
    assert set(REALISTIC.switched_on) == set(INGREDIENTS)


def test_wilson_intervals_have_their_textbook_values():
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=1e-3)  # Newcombe 1998, table II
    assert wilson(0, 20)[1] == pytest.approx(0.1611, abs=1e-3)


def test_the_table_has_one_line_per_kind_of_cell():
    text = summary([row(), row(effects=["rotor_drag"]), row("motor_lag", ["motor_lag"])])
    assert len(text.splitlines()) == 3
    assert "50.0%" in text
