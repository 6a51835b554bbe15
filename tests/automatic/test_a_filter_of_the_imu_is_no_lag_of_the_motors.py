"""A gyro that is filtered before the log gets a filter in the model, and the motors keep their
lag."""

from __future__ import annotations

import pytest

from greybox.automatic.decide import Decided, decide
from greybox.automatic.facts import facts_of
from greybox.automatic.fit import prepare
from greybox.automatic.setting import Given
from greybox.data import Dataset
from scenarios.plants.sensor_faults import low_passed
from tests.automatic.craft import RATES, flight, flown, plant, vehicle

ATTITUDE = ("qw", "qx", "qy", "qz")
CUTOFF = 30.0
"""Of the gyro [Hz]."""


def decided(cutoff: float | None, **choices: object) -> Decided:
    parts = []
    for i, columns in enumerate(flown(seeds=(1,), seconds=12.0)):
        seen = columns if cutoff is None else low_passed(dict(columns), list(RATES), cutoff)
        parts.append(flight(seen, f"run{i}", (*RATES, *ATTITUDE)).flights[0])
    ready = prepare(vehicle(), Dataset(flights=tuple(parts)))
    given = Given(effects=("motor_lag", "command_delay"), choices=choices)  # type: ignore[arg-type]
    return decide(vehicle(), ready.data, facts_of(ready.data, vehicle(), ready.report), given)


def lag(found: Decided) -> tuple[float, float]:
    """(deviation from the truth [s], standard error [s]) of the motors' lag."""
    assert found.candidate is not None
    estimate = found.candidate.fit["motor_lag.tau"]
    return estimate.value - plant().truth()["parameters"]["motor_lag.tau"], estimate.std


def said(found: Decided) -> str:
    (one,) = [d.choice for d in found.decisions if d.about == "noise of the IMU"]
    return one


@pytest.mark.slow
def test_a_filter_is_found_and_the_lag_is_right_with_it_and_wrong_without():
    found, without = decided(CUTOFF), decided(CUTOFF, noise_parts=())
    assert found.recipe.options.noise_parts == ("low_pass.gyro",)
    assert "low_pass.gyro" in said(found)
    off, error = lag(found)
    wrong, small = lag(without)
    assert abs(off) < 2 * error
    assert wrong > 2 * small
    assert abs(off) < wrong / 2
    assert "--noise-parts" in found.recipe.arguments()


def test_without_one_none_is_taken():
    found = decided(None)
    assert found.recipe.options.noise_parts == ()
    assert said(found) == "white"
    off, error = lag(found)
    assert off == pytest.approx(0.0, abs=3 * error)


def test_where_the_parameters_are_named_no_time_constant_of_a_filter_is_one():
    """Colour was offered, and its time constant, which is not estimated, was asked for."""
    found = decided(CUTOFF, free=("torque.c2",))
    assert found.recipe.options.noise_parts == () and said(found) == "white"
    assert found.candidate is not None
    assert tuple(found.candidate.likelihood.parameters) == ("torque.c2",)
