"""A simulator's flights have no noise: each sensor gets that of the best of its kind, and says
so. Flights that sensors measured stay as they are."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from greybox.data import Dataset, Flight
from greybox.data.segment import Segment
from greybox.model.noise_free import BEST, said_of_added, with_sensor_noise
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle
from greybox.symbolic import FloatArray
from tests.simulated import flights, vehicle

OF_ATTITUDE = ("qw", "qx", "qy", "qz")


def smooth(seconds: float = 10.0, dt: float = 0.01, name: str = "one") -> Flight:
    """A flight of sines with a place, an attitude, rates and accelerations, all without noise."""
    t = np.arange(0.0, seconds, dt)
    turn = 0.3 * np.sin(2.0 * t)
    found: dict[str, FloatArray] = {
        "qw": np.cos(turn / 2),
        "qx": np.sin(turn / 2),
        "qy": np.zeros_like(t),
        "qz": np.zeros_like(t),
    }
    for i, n in enumerate(("x", "y", "z", "vx", "vy", "vz", "p", "q", "r", "ax", "ay", "az")):
        found[n] = np.sin((1.0 + 0.3 * i) * t)
    for i in range(4):
        found[f"u{i + 1}"] = 0.5 + 0.1 * np.sin((1.0 + i) * t)
    return Flight(name=name, segments=(Segment(t=t, channels=found, flight=name),))


def added_to(flight: Flight, craft: Vehicle) -> tuple[Mapping[str, FloatArray], list[str]]:
    """(what each channel has more than before, the sensors that got noise)."""
    noisy, added = with_sensor_noise(Dataset(flights=(flight,)), craft)
    old, new = flight.segments[0].channels, noisy.flights[0].segments[0].channels
    return {n: new[n] - old[n] for n in old}, [a.sensor for a in added]


def test_every_sensor_gets_a_tenth_of_what_is_typical() -> None:
    craft = vehicle()
    more, sensors = added_to(smooth(), craft)
    assert sensors == ["position", "velocity", "attitude", "gyro", "accelerometer"]
    for sensor in SENSORS:
        if sensor.name in ("position", "velocity", "gyro", "accelerometer"):
            wanted = BEST * float(np.mean(sensor.typical_noise(craft)))
            for signal in sensor.signals(craft):
                assert more[signal.name].std() == pytest.approx(wanted, rel=0.1)


def test_an_attitude_turns_and_stays_of_unit_length() -> None:
    craft, flight = vehicle(), smooth()
    noisy, _ = with_sensor_noise(Dataset(flights=(flight,)), craft)
    old, new = (f.segments[0].matrix(OF_ATTITUDE) for f in (flight, noisy.flights[0]))
    assert np.linalg.norm(new, axis=1) == pytest.approx(1.0, abs=1e-12)
    angle = 2.0 * np.arccos(np.clip(np.abs((old * new).sum(axis=1)), 0.0, 1.0))
    # Three components of 0.3 mrad each.
    assert np.sqrt((angle**2).mean() / 3) == pytest.approx(0.1 * 0.003, rel=0.1)


def test_commands_stay() -> None:
    more, _ = added_to(smooth(), vehicle())
    assert all(not more[f"u{i + 1}"].any() for i in range(4))


def test_missing_samples_stay_missing() -> None:
    flight = smooth()
    segment = flight.segments[0]
    gap = segment.channels["p"].copy()
    gap[100:120] = np.nan
    holed = Flight(name="one", segments=(segment.replace({"p": gap}),))
    noisy, _ = with_sensor_noise(Dataset(flights=(holed,)), vehicle())
    assert (np.isnan(noisy.flights[0].segments[0].channels["p"]) == np.isnan(gap)).all()


def test_only_sensors_without_noise_get_some() -> None:
    flight, random = smooth(), np.random.default_rng(1)
    segment = flight.segments[0]
    measured = {
        n: segment.channels[n] + 0.02 * random.standard_normal(segment.n) for n in ("p", "q", "r")
    }
    more, sensors = added_to(Flight(name="one", segments=(segment.replace(measured),)), vehicle())
    assert "gyro" not in sensors and "position" in sensors
    assert not more["p"].any() and more["x"].any()


def test_a_sensor_with_a_fiftieth_of_what_is_typical_has_noise() -> None:
    flight, random = smooth(), np.random.default_rng(2)
    segment = flight.segments[0]
    quiet = {n: segment.channels[n] + 4e-4 * random.standard_normal(segment.n) for n in "pqr"}
    _, sensors = added_to(Flight(name="one", segments=(segment.replace(quiet),)), vehicle())
    assert "gyro" not in sensors


@pytest.mark.parametrize("metres", [5.0, 100.0])
def test_a_flight_of_many_metres_has_no_noise(metres: float) -> None:
    """What a window lets through of a long way is a millionth of it, and no noise."""
    flight = smooth(12.0)
    segment = flight.segments[0]
    far = {n: metres * np.sin(2.1 * segment.t + i) for i, n in enumerate("xyz")}
    _, sensors = added_to(Flight(name="one", segments=(segment.replace(far),)), vehicle())
    assert sensors == ["position", "velocity", "attitude", "gyro", "accelerometer"]


def test_far_flights_keep_the_noise_that_they_have() -> None:
    flight, random = smooth(12.0), np.random.default_rng(4)
    segment = flight.segments[0]
    far = {
        n: 100.0 * np.sin(2.1 * segment.t + i) + 2e-5 * random.standard_normal(segment.n)
        for i, n in enumerate("xyz")
    }
    _, sensors = added_to(Flight(name="one", segments=(segment.replace(far),)), vehicle())
    assert "position" not in sensors and "velocity" in sensors


def test_commands_that_jump_are_no_noise() -> None:
    """Waypoints that jump, motors at their limits: kinks in the rates now and then, and a drag-free
    craft whose sideways force is exactly zero. No filter can weigh such a sensor."""
    flight = smooth(14.0)
    segment = flight.segments[0]
    since = segment.t % 1.3
    jump = np.where(since < 0.3, 8.0 * np.sin(np.pi * since / 0.3), 0.0)
    still = np.zeros(segment.n)
    found = {n: segment.channels[n] + jump for n in ("p", "q", "r", "az")} | {
        "ax": still,
        "ay": still,
    }
    _, sensors = added_to(Flight(name="one", segments=(segment.replace(found),)), vehicle())
    assert sensors == ["position", "velocity", "attitude", "gyro", "accelerometer"]


@pytest.mark.parametrize(("cut", "rate"), [(10, 100), (20, 200), (30, 250)])
def test_a_gyro_behind_a_low_pass_has_noise(cut: float, rate: float) -> None:
    flight, random = smooth(20.0, 1 / rate), np.random.default_rng(3)
    segment = flight.segments[0]
    low_pass = butter(2, cut / (rate / 2))
    filtered = {
        n: segment.channels[n] + lfilter(*low_pass, 0.02 * random.standard_normal(segment.n))
        for n in "pqr"
    }
    _, sensors = added_to(Flight(name="one", segments=(segment.replace(filtered),)), vehicle())
    assert "gyro" not in sensors and "position" in sensors


def test_it_is_the_same_noise_each_time_and_another_in_each_flight() -> None:
    craft = vehicle()
    both = Dataset(flights=(smooth(), smooth(name="two")))
    first, again = (with_sensor_noise(both, craft)[0] for _ in range(2))
    assert first.hash == again.hash
    one, two = (f.segments[0].channels["p"] for f in first)
    assert (one != two).mean() > 0.99
    alone = with_sensor_noise(Dataset(flights=(smooth(name="two"),)), craft)[0]
    assert (alone.flights[0].segments[0].channels["p"] == two).all()


def test_flights_are_known_as_those_that_they_were() -> None:
    flight = smooth()
    noisy, _ = with_sensor_noise(Dataset(flights=(flight,)), vehicle())
    assert noisy.flights[0].known_by == flight.known_by


def test_measured_flights_stay_as_they_are() -> None:
    data = flights(seconds=6.0)
    noisy, added = with_sensor_noise(data, vehicle())
    assert noisy is data and added == ()


def test_what_was_added_is_said_with_its_unit() -> None:
    _, added = with_sensor_noise(Dataset(flights=(smooth(),)), vehicle())
    said = said_of_added(added)
    assert "position 0.0001 m" in said and "gyro 0.002 rad/s" in said
