"""Whether a flight is long enough for more than rotors and sensors, pieces of it that are left out
and BIC decide, as they do for long ones: no number of seconds does."""

from __future__ import annotations

import numpy as np
import pytest

import greybox as gb
from greybox.automatic.foretell import foretell
from greybox.automatic.pieces import SHORTEST, first_parts
from greybox.data import Dataset
from greybox.examples import flight_path, vehicle_path
from greybox.validation.validate import validate
from tests import simulated


def seconds(data: Dataset, begin: float, length: float) -> Dataset:
    (flight,) = data
    start = float(flight.segments[0].t[0]) + begin
    cut = flight.between(start, start + length)
    assert cut is not None
    return Dataset(flights=(cut,))


def test_the_shortest_flight_leaves_a_piece_whose_score_has_an_error() -> None:
    data = simulated.flights(1, 6.0)
    some = seconds(data, 0.0, 2.0)
    model = gb.fit(
        gb.build_model(simulated.vehicle(), data.channels, ("motor_lag",)), some, use_compiler=False
    ).model
    parts = first_parts(seconds(data, 0.0, SHORTEST + 0.02))
    assert parts is not None
    score = foretell(model, parts[1], use_compiler=False)
    assert np.isfinite(score.better_by(score)[1])
    assert first_parts(seconds(data, 0.0, SHORTEST - 0.1)) is None


@pytest.mark.slow
def test_five_seconds_of_a_real_flight_foretell_another_one() -> None:
    """With rotors and sensors alone the rate was wrong by 5 rad/s half a second ahead."""
    own = gb.read_vehicle(vehicle_path("nanobench"))

    def read(name: str) -> Dataset:
        return gb.read_logs([flight_path("nanobench", name)], own)

    found = gb.fit(own, seconds(read("B3_figure8_medium_rep2"), 12.0, 5.0))
    assert any(n.startswith("rotor_drag.") for n in found.parameters)
    seen = validate(found.model, read("B7_oval_fast_rep1"), adapt=5.0)
    assert seen.verdict is not None and not seen.verdict.refused
