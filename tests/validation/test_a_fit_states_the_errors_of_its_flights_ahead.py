"""A fit states ahead what its flights show, whatever its noise one sample ahead says; predictions and
estimates stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import greybox as gb
from greybox.data import Dataset
from greybox.validation.calibration import calibrated
from greybox.validation.validate import validate
from tests import motor
from tests.residual.hybrid_cases import pendulum_model, swings

SHARE = 0.25
"""What the stated process noise is of the true one."""


@pytest.fixture(scope="module")
def fitted():
    """A fit that ended at the right pendulum with a part of its noise, and its flights."""
    some = gb.fit(motor.model(), motor.record(200), free=("R", "J"), use_compiler=False)
    right = pendulum_model()
    model = replace(right, process_noise=SHARE * right.process_noise)
    train = swings(3, 1, hidden=0.35, period=4.0, seconds=8.0)
    return replace(some, estimates=replace(some.estimates, model=model)), train


def inside(model) -> np.ndarray:
    """Share of the errors inside the stated 95 % regions 50 samples ahead, on flights not seen."""
    flights = swings(2, 77, hidden=0.35, period=4.0, name="unseen")
    table = validate(model, flights, horizon_samples=(50,), every=10, use_compiler=False).table
    return np.array([e.coverage[0.95][49] for e in table.groups.values()])


def test_the_noise_ahead_is_what_the_flights_show(fitted):
    found, train = fitted
    after = calibrated(found, train)
    assert 1.5 < (after.model.horizon_noise / found.model.process_noise).max() < 10.0
    assert after.parameters == found.parameters
    assert np.array_equal(after.model.process_noise, found.model.process_noise)


@pytest.mark.slow
def test_regions_hold_on_flights_that_were_not_seen(fitted):
    found, train = fitted
    assert inside(found.model).max() < 0.8
    assert inside(calibrated(found, train).model).min() > 0.85


def test_flights_too_short_to_tell_leave_the_fit_as_it_is(fitted):
    found, train = fitted
    first = train.flights[0]
    short = replace(first, segments=(first.segments[0].between(0.0, 0.3),))
    assert calibrated(found, Dataset(flights=(short,))) is found
