"""Advice leaves out the effects and disturbances that a model has, and says so where none is left."""

from __future__ import annotations

import pytest

from greybox.data.checks import CheckReport, Finding
from greybox.model.model import build_model
from greybox.validation.advice import (
    ADVICE,
    Symptom,
    hints_of_checks,
    impossible,
    lacking,
    likely,
)
from tests.data.faults import vehicle

COMMANDS = ("u1", "u2", "u3", "u4")
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
IMU = ("p", "q", "r", "ax", "ay", "az")

FIT = "--effects motor_lag,rotor_drag and --disturbance force,torque; hold what was weighed"
DISCOVER = "greybox discover names what is missing"


@pytest.mark.parametrize(
    ("there", "left"),
    [
        (set(), FIT),
        ({"motor_lag"}, FIT.replace("motor_lag,", "")),
        ({"force"}, FIT.replace("force,", "")),
        ({"force", "torque"}, "--effects motor_lag,rotor_drag; hold what was weighed"),
        ({"motor_lag", "rotor_drag", "force", "torque"}, "hold what was weighed"),
    ],
)
def test_only_what_is_not_there_is_left(there: set[str], left: str) -> None:
    assert lacking(FIT, there) == left


def test_where_nothing_is_left_a_search_is_advised() -> None:
    assert lacking("--effects motor_lag", {"motor_lag"}) == DISCOVER


@pytest.mark.parametrize(
    ("columns", "left"),
    [
        ((*POSE, *IMU, "vbat"), "--effects battery_sag,rotor_drag,accelerometer_bias"),
        ((*POSE, *IMU), "--effects rotor_drag,accelerometer_bias"),
        (POSE, "--effects rotor_drag"),
    ],
)
def test_what_the_logs_cannot_show_is_not_proposed(columns: tuple[str, ...], left: str) -> None:
    (action,) = {a.action for a in ADVICE if a.symptom is Symptom.POSITION}
    model = build_model(vehicle("nanobench"), (*COMMANDS, *columns))
    cannot = impossible(action, model, (*COMMANDS, *columns))
    assert lacking(action, cannot) == f"{left} --disturbance force"
    there = {"rotor_drag", "accelerometer_bias", "force"}
    assert lacking(action, cannot | there) == (
        "--effects battery_sag" if "vbat" in columns else DISCOVER
    )


@pytest.mark.parametrize("action", [a.action for a in ADVICE])
def test_a_model_that_has_nothing_gets_all_of_it(action: str) -> None:
    assert lacking(action, set()) == action


def limited(what: str, share: float, flight: str = "a") -> Finding:
    return Finding(
        check="saturation",
        severity="warning",
        flight=flight,
        where="channel u1",
        message=f"a command is at {what} for {100 * share:.1f} % of the flight",
        evidence={"share": share, "share_u1": share},
    )


def report(*findings: Finding) -> CheckReport:
    return CheckReport(vehicle="v", flights=(), findings=findings, not_judged=())


def test_of_commands_at_their_limits_the_worst_is_named() -> None:
    seen = report(limited("u_min", 0.02), limited("u_max", 0.2, "b"))
    reason, _, anchor = likely(hints_of_checks(seen, effects=()), Symptom.RATE)
    assert anchor == Symptom.SATURATED.anchor and "b: a command is at u_max for 20.0 %" in reason
    assert [h.flight for h in hints_of_checks(seen, effects=())] == ["b", "a"]


def test_a_sensor_that_clips_and_a_limit_that_the_model_has_are_no_lack_of_headroom() -> None:
    clips = Finding(
        check="saturation",
        severity="warning",
        flight="a",
        where="channel p",
        message="9 row(s) at the same extreme value 4: the sensor clips",
        evidence={"rows": 9, "limit": 4.0},
    )
    assert not hints_of_checks(report(clips), effects=())
    assert not hints_of_checks(report(limited("u_max", 0.2)), effects=("command_saturation",))
