"""Colour and a filter of a sensor are offered together; what of them is not there leaves the model
again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.data import Dataset, Flight
from greybox.discovery.cause import offer, sensor_cause
from greybox.discovery.evidence import ARRIVED, Flights
from greybox.discovery.left import Left
from greybox.discovery.options import DiscoverOptions
from greybox.discovery.propose import sensor_proposals
from greybox.discovery.result import Discovery
from greybox.discovery.rules import EFFORT
from greybox.discovery.search import Search, drop_gain
from greybox.discovery.workflow import _Run
from greybox.estimation.status import Code
from greybox.model.noise import Coloured, LowPass
from greybox.validation.judges import Judges
from tests.discovery.small_world import damped, shorten, vehicle


def coloured(
    flight: Flight,
    rng: np.random.Generator,
    channels_of: tuple[str, ...] = ("p", "q", "r"),
    size: float = 0.02,
) -> Flight:
    """Errors of a sensor, the gyro [rad/s], of some `size` that last 80 ms, behind no filter."""
    kept = np.exp(-flight.dt / 0.08)
    segments = []
    for s in flight.segments:
        channels = {}
        for name in channels_of:
            error = np.zeros(s.n)
            for k in range(1, s.n):
                error[k] = kept * error[k - 1] + size * np.sqrt(1 - kept**2) * rng.standard_normal()
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


def test_colour_that_lasts_longer_than_flights_tell_is_there(flights):
    flights.causes = flights.causes.with_cause(
        sensor_cause(Coloured(sensor="gyro"), flights.causes.model)
    )
    found = flights.fit(flights.causes.base | {"coloured.gyro"})
    place = found.space.index["coloured.gyro.T", None]
    theta, slope = found.theta.copy(), np.zeros_like(found.theta)
    theta[place], slope[place] = found.space.upper[place], -1.0
    ended = replace(found, theta=theta, value=replace(found.value, gradient=slope))
    assert ended.held[place]
    assert drop_gain(ended, flights, "coloured.gyro") == -np.inf


def test_a_fit_that_was_given_up_is_carried_on_when_it_is_asked_for():
    world = damped()
    world.effort = replace(EFFORT, behind=-1e9)  # nothing can catch up
    base = world.fit(world.causes.base)
    structure = world.causes.base | {"rotational_damping"}
    (given_up,) = world.contest([(structure, [base.known])], base)
    assert not given_up.exact and given_up.status.code not in ARRIVED
    whole = world.fit(structure)
    assert whole.status.code in ARRIVED and whole.value.cost < given_up.value.cost


def test_a_promise_as_small_as_the_last_one_leaves_no_fit_unfinished():
    """What an opening left counts as done only where its iterations were not cut short."""
    gains = []
    for rough in (EFFORT.rough, EFFORT.exact):
        world = damped()
        world.effort = replace(EFFORT, opening=2, rough=rough)
        base = world.fit(world.causes.base)
        moves = [
            (world.causes.base | {n}, [base.known])
            for n in ("rotational_damping", "parasitic_drag")
        ]
        gains.append(world.contest(moves, base)[0].log_evidence - base.log_evidence)
    assert gains[1] == pytest.approx(gains[0], abs=0.1)


def test_no_filter_is_sought_where_clocks_wander():
    offered, rng = {}, np.random.default_rng(4)
    data = Dataset(flights=tuple(coloured(f, rng, ("ax", "ay", "az"), 3.0) for f in damped().data))
    for wander in (False, True):
        with pytest.MonkeyPatch.context() as patch:
            shorten(patch)
            causes = offer(vehicle(), data.channels, sample_time=0.01, kinematic_noise=wander)
        some = Flights(causes=causes, data=data)
        parts, gain = sensor_proposals(some.fit(causes.base), causes)
        offered[wander] = {p.name for p in parts}
        assert gain > 0
    assert {"coloured.accelerometer", "low_pass.accelerometer"} <= offered[False]
    assert "coloured.accelerometer" in offered[True]
    assert not any(n.startswith("low_pass") for n in offered[True])


def test_the_fit_of_an_answer_goes_on_until_it_has_arrived_and_says_first_where_it_did_not():
    world = damped()
    world.effort = replace(EFFORT, iterations=2)
    cut = world.fit(world.causes.base)
    assert cut.status.code is Code.MAX_ITERATIONS
    short = replace(world, effort=replace(EFFORT, last=1)).arrived(cut)
    whole = world.arrived(cut)
    said = {
        name: Discovery(
            verdict="nothing_missing",
            omega_known=True,
            seconds=0.0,
            fit=world.settled(found),
            left=Left(axes=(), written=with_laws),
        ).line
        for name, found, with_laws in (
            ("short", short, None),
            ("laws", whole, short),
            ("whole", whole, whole),
        )
    }
    assert said["laws"] == said["short"]
    assert said["short"].startswith("NOT CONVERGED, every number may move: NOTHING MISSING")
    assert said["whole"].startswith("NOTHING MISSING")
    assert whole.value.cost < cut.value.cost


def test_a_result_is_that_of_its_own_fit_not_of_an_earlier_one_of_the_same_structure():
    """Rivals are fitted roughly, and the structure of the answer may have been one."""
    world = damped()
    world.effort = replace(EFFORT, iterations=2)
    rough = world.fit(world.causes.base)
    run = _Run(
        flights=world,
        test=None,
        judges=Judges(flights=world.data),
        options=DiscoverOptions(),
        settings={},
        say=lambda _text, _share: None,
        save=lambda _found: None,
        began=0.0,
    )
    assert not run.settled(rough).converged
    whole = world.arrived(rough)
    assert whole.structure == rough.structure
    assert run.settled(whole).converged
    assert run.settled(rough) is run.settled(rough)
