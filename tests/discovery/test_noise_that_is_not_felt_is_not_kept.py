"""Colour and a filter of a sensor are offered together; what of them is not there leaves the model
again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.data import Dataset, Flight
from greybox.discovery.cause import sensor_cause
from greybox.discovery.evidence import Flights
from greybox.discovery.rules import EFFORT
from greybox.discovery.search import Search
from greybox.model.noise import Coloured, LowPass
from tests.discovery.small_world import damped


def coloured(flight: Flight, rng: np.random.Generator) -> Flight:
    """Errors of the gyro that last 80 ms, behind no filter."""
    kept = np.exp(-flight.dt / 0.08)
    segments = []
    for s in flight.segments:
        channels = {}
        for name in ("p", "q", "r"):
            error = np.zeros(s.n)
            for k in range(1, s.n):
                error[k] = kept * error[k - 1] + 0.02 * np.sqrt(1 - kept**2) * rng.standard_normal()
            channels[name] = s.channels[name] + error
        segments.append(s.replace(channels))
    return replace(flight, segments=tuple(segments))


@pytest.fixture(scope="module")
def flights() -> Flights:
    world, rng = damped(), np.random.default_rng(3)
    data = Dataset(flights=tuple(coloured(f, rng) for f in world.data))
    return replace(world, data=data)


def test_a_filter_that_is_not_there_is_dropped_and_colour_that_is_there_stays(flights):
    physics = flights.causes.model
    parts = [sensor_cause(p, physics) for p in (Coloured(sensor="gyro"), LowPass(sensor="gyro"))]
    flights.causes = flights.causes.with_cause(*parts)
    whole = flights.fit(flights.causes.base | {p.name for p in parts} | {"rotational_damping"})
    leaner = Search(flights=flights, most=8, say=lambda _text, _share: None)._leaner(whole)
    assert leaner is not None
    assert "low_pass.gyro" not in leaner.structure
    assert {"coloured.gyro", "rotational_damping"} <= leaner.structure
    assert leaner.log_evidence > whole.log_evidence


def test_a_fit_that_was_given_up_is_carried_on_when_it_is_asked_for():
    world = damped()
    world.effort = replace(EFFORT, behind=-1e9)  # nothing can catch up
    base = world.fit(world.causes.base)
    structure = world.causes.base | {"rotational_damping"}
    (given_up,) = world.contest([(structure, [base.known])], base)
    assert not given_up.exact and not given_up.comparable
    whole = world.fit(structure)
    assert whole.comparable and whole.value.cost < given_up.value.cost
