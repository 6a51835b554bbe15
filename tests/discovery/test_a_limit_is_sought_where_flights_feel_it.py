"""A limit inside the range of the commands has no slope until it reaches one: fits of it begin where
flights feel it, and no smaller one is promised a name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.discovery.cause import offer
from greybox.discovery.evidence import Flights
from greybox.discovery.propose import scored
from greybox.discovery.search import Search
from greybox.plants.effects import CommandSaturation
from tests.discovery import linear_world, small_world

TOP = 0.74
"""Where the motors saturate; commands go to 0.79, and one of a hundred beyond it."""
HIGH = "command_saturation.a_hi"


@pytest.fixture(scope="module")
def flights() -> Flights:
    with pytest.MonkeyPatch.context() as patch:
        small_world.shorten(patch, "command_saturation")
        data = small_world.flown(CommandSaturation(a_hi=1 - TOP))
        return Flights(
            causes=offer(small_world.vehicle(), data.channels, sample_time=0.01), data=data
        )


def test_the_search_finds_it(flights: Flights):
    search = Search(flights=flights, most=2, say=lambda _text, _share: None)
    found = search.run()
    assert "command_saturation" in found.structure
    assert found.known[HIGH, None] == pytest.approx(1 - TOP, abs=0.01)


def test_no_size_is_promised_that_no_command_feels(flights: Flights):
    scores = scored(flights, flights.fit(flights.causes.base))
    most = max(float(np.max(f.segments[0].matrix(["u1", "u2", "u3", "u4"]))) for f in flights.data)
    least = scores.smallest("command_saturation", 1.0, 0.5)[HIGH]
    assert least >= 1 - most


def test_a_fit_begins_there_and_on_the_side_that_is_promised():
    world, _ = linear_world.drawn(2, {"a": np.array([0.1])})
    key = "limit", None
    scores = replace(linear_world.scores(world, ("a",)), least={key: 3.0})
    begun = [scores.begun(key, 1.0, step) for step in (-5.0, -1.0, 0.0, 1.0, 5.0)]
    assert begun == [-4.0, -2.0, 1.0, 4.0, 6.0]
    assert scores.begun(("other", None), 1.0, 0.5) == 1.5
