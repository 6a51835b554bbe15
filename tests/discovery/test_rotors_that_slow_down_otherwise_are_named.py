"""Rotors that slow down in another time than they speed up are no late commands, and without a lag nobody can tell."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import greybox.discovery.candidates
from greybox.discovery.workflow import discover
from greybox.model.effects import CATALOGUE
from scenarios.plants.effects import MotorLag, MotorLagAsymmetry
from tests.discovery.small_world import flown, vehicle

OFFERED = ("motor_lag", "motor_lag_asymmetry", "command_delay", "gyro_bias")


@pytest.fixture(scope="module", autouse=True)
def few() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(greybox.discovery.candidates, "CATALOGUE", tuple(e for e in CATALOGUE if e.name in OFFERED))
        yield


def test_two_time_constants_get_two_names():
    hidden = (MotorLag(tau=0.04), MotorLagAsymmetry(a=0.3))
    found = discover(vehicle(), flown(*hidden, seconds=8.0), flown(*hidden, seeds=(11,), name="test"))
    sizes = {e["name"]: next(iter(e["parameters"].values())) for e in found.effects()}
    assert set(sizes) == {"motor_lag", "motor_lag_asymmetry"}
    for name, true in (("motor_lag", 0.04), ("motor_lag_asymmetry", 0.3)):
        assert abs(sizes[name]["value"] - true) < 4 * sizes[name]["std"] < 0.1 * true, name
    assert not any(a.rivals for a in found.additions)


def test_without_a_lag_it_is_said_why_it_cannot_be_judged():
    found = discover(vehicle(), flown(seconds=6.0))
    assert found.verdict == "nothing_missing"
    assert found.unjudged == {"motor_lag_asymmetry": "felt only with motor_lag"}
