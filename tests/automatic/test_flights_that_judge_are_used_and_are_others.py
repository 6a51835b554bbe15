"""Whatever is fitted, a vehicle or a model, flights to test judge it, and none of them may have
taught it under another name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox import build_model, compare, fit, validate
from greybox.automatic.fit import adaptation_of
from greybox.data import Dataset
from greybox.errors import DataError, ModelError
from greybox.estimation.recipe import Recipe
from greybox.model.verdict import Outcome
from tests.simulated import flights, vehicle


@pytest.fixture(scope="module")
def sets():
    both = flights(2)
    return both.select(["run0"]), both.select(["run1"])


@pytest.fixture(scope="module")
def model(sets):
    return build_model(vehicle(), sets[0].channels, ["motor_lag"], sample_time=0.01)


def test_an_explicit_fit_is_judged_on_the_flights_to_test(sets, model):
    train, test = sets
    found = fit(model, train, test=test["run1"])
    alone = fit(model, train)
    again = validate(alone.model, test)
    assert alone.verdict is None
    assert found.verdict == again.verdict
    assert found.verdict.flights == ("run1",)
    assert found.verdict.outcome in (Outcome.USABLE, Outcome.NOT_USABLE)


@pytest.mark.parametrize("subject", ["vehicle", "model"])
def test_a_copy_under_another_name_does_not_judge(subject, sets, model):
    train, _ = sets
    copy = Dataset(flights=(replace(train["run0"], name="another"),))
    with pytest.raises(DataError, match=r"another is both train and test .*samples are those of"):
        fit(vehicle() if subject == "vehicle" else model, train, test=copy)


def test_a_comparison_refuses_a_copy(sets):
    train, _ = sets
    copy = Dataset(flights=(replace(train["run0"], name="another"),))
    with pytest.raises(DataError, match=r"another is both train and test"):
        compare(vehicle(), train, copy, methods=["persistence"])


def test_flights_at_another_rate_are_refused_before_the_fit(sets, model):
    train, test = sets
    (segment,) = test["run1"].segments
    columns = {n: segment.column(n)[::2] for n in segment.names}
    slow = replace(test["run1"], segments=(replace(segment, t=segment.t[::2], channels=columns),))
    with pytest.raises(DataError, match=r"every 0.02 s; expected 0.01 s.*rate=100"):
        fit(model, train, test=slow)


def test_what_an_explicit_fit_cannot_use_is_refused(sets, model):
    train, _ = sets
    with pytest.raises(ModelError, match="source is where"):
        fit(model, train, source=fit(model, train).model)


@pytest.mark.parametrize(
    ("seconds", "adapted"),
    [(60.0, 5.0), (15.1, 5.0), (12.0, 4.0), (6.0, 2.0), (2.0, 0.6), (1.2, 0.0), (0.7, 0.0)],
)
def test_a_short_flight_adapts_too_on_a_third_where_enough_is_left_to_judge(sets, seconds, adapted):
    (segment,) = sets[1]["run1"].segments
    t = 0.01 * np.arange(round(seconds / 0.01))
    columns = {n: np.resize(segment.column(n), t.size) for n in segment.names}
    flight = replace(sets[1]["run1"], segments=(replace(segment, t=t, channels=columns),))
    test = Dataset(flights=(flight,))
    assert adaptation_of(Recipe(adapt=5.0), test) == adapted
    assert adaptation_of(Recipe(adapt=5.0), test, 2.0) == 2.0
    assert adaptation_of(Recipe(), test) is None
    assert adaptation_of(Recipe(adapt=5.0), test, 0.0) == 0.0  # the explicit command says it
