"""Advice leaves out the effects and disturbances that a model has, and says so where none is left."""

from __future__ import annotations

import pytest

from greybox.validation.advice import ADVICE, lacking

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


@pytest.mark.parametrize("action", [a.action for a in ADVICE])
def test_a_model_that_has_nothing_gets_all_of_it(action: str) -> None:
    assert lacking(action, set()) == action
