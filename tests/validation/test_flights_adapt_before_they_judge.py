"""What belongs to a flight is taken from its beginning before it judges, unless the model knows it:
an offset of a sensor is no error of the model, nor of what it is held against."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.errors import GreyboxError
from greybox.validation.gap import predict_ahead
from greybox.validation.validate import validate
from tests.validation.test_validate_judges_causally import dataset, fly, make_model

ATTITUDE = ("qw", "qx", "qy", "qz")
BIAS = {"accelerometer_bias.b_x": 0.25, "accelerometer_bias.b_y": -0.1}


@pytest.fixture(scope="module")
def model():
    return make_model()


@pytest.fixture(scope="module")
def flight(model):
    return dataset(fly(model, 900, noise=1.0, changes=BIAS))


def test_a_flight_that_the_model_does_not_know_adapts_on_a_third(model, flight):
    plain, asked = validate(model, flight), validate(model, flight, adapt=3.0)
    assert plain.adapted_seconds == 3.0
    assert plain.table.to_dict((50,)) == asked.table.to_dict((50,))
    assert abs(plain.adaptation["f"].values["accelerometer_bias.b_x"] - 0.25) < 0.05
    without = validate(model, flight, adapt=0)
    assert without.adapted_seconds is None
    assert any("95 % regions do not hold on f" in w for w in without.warnings)


def test_values_that_the_model_knows_are_used(model, flight):
    known = replace(model, per_flight={"f": {**dict.fromkeys(model.flight_spread, 0.0), **BIAS}})
    result = validate(known, flight)
    assert result.adapted_seconds is None
    assert not any("95 % regions" in w for w in result.warnings)


def test_a_time_below_zero_is_refused(model, flight):
    with pytest.raises(GreyboxError, match="adapt takes a number, zero or above"):
        validate(model, flight, adapt=-1.0)


def test_the_floor_of_a_gap_knows_the_offsets_of_the_flight_too(model):
    (segment,) = dataset(fly(model, 900, noise=1.0)).segments
    turned = segment.replace({"p": segment.channels["p"] + 0.05})
    plain, adapted = (predict_ahead(model, dataset(turned), adapt=s) for s in (0.0, 3.0))
    floors = [np.concatenate(e.floor["rotation", 0.5]).mean() for e in (plain, adapted)]
    assert np.sqrt(floors[0]) > 0.02
    assert np.sqrt(floors[1]) < 0.5 * np.sqrt(floors[0])


def test_the_floor_of_a_gap_holds_where_the_attitude_is_slower_than_the_gyro(model):
    (segment,) = dataset(fly(model, 900, noise=1.0)).segments
    slow = segment.replace(
        {n: np.where(np.arange(segment.n) % 3, np.nan, segment.channels[n]) for n in ATTITUDE}
    )
    floors = [predict_ahead(model, dataset(s)).floor for s in (segment, slow)]
    for key in (("position", 0.5), ("rotation", 0.5)):
        every, third = (np.sqrt(np.concatenate(f[key]).mean()) for f in floors)
        assert third < 1.5 * every, key
