"""Flights come to one sample rate that is enough, and a flight of another craft stays out and is
named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.automatic.facts import response_rate
from greybox.automatic.fit import prepare
from greybox.automatic.flights import LEAST_RATE, MOST_RATE
from greybox.data.conditioning import condition
from greybox.estimation.record import sample_time
from greybox.model.faults import BadDataError
from tests.automatic.craft import IMU, POSE, flown, raw, vehicle


def logs(*seeds: int, sensors: tuple[str, ...] = (*IMU, *POSE), seconds: float = 5.0) -> list:
    names = {"u1", "u2", "u3", "u4", *sensors}
    whole = [raw(c, f"run{s}") for s, c in zip(seeds, flown(seeds, seconds), strict=True)]
    return [replace(r, channels={n: v for n, v in r.channels.items() if n in names}) for r in whole]


def faster(log, factor: int):
    """The same flight logged `factor` times as often, between the samples on straight lines
    (commands held)."""
    t = np.linspace(log.t[0], log.t[-1], (log.n - 1) * factor + 1)
    held = np.searchsorted(log.t, t + 1e-9) - 1
    channels = {
        n: v[held] if n[0] == "u" else np.interp(t, log.t, v) for n, v in log.channels.items()
    }
    return replace(log, t=t, channels=channels, rows=np.arange(1, t.size + 1, dtype=np.int64))


@pytest.mark.parametrize("slower", [pytest.param(1.0004, marks=pytest.mark.slow), 1.004])
def test_sample_times_that_differ_a_little_are_no_obstacle(slower):
    a, b = logs(1, 2)
    ready = prepare(vehicle(), [a, replace(b, t=b.t * slower)])
    assert [f.dt for f in ready.data] == [0.01, 0.01]


def test_sample_times_that_differ_by_more_become_one_and_it_is_said():
    a, b = logs(1, 2)
    ready = prepare(vehicle(), [a, replace(b, t=b.t * 1.004)])
    assert ready.rate == 100.0
    (said,) = [d for d in ready.decisions() if d.about == "rate"]
    assert (said.choice, said.option) == ("100 Hz", "--rate")


def test_a_log_at_1_khz_is_averaged_down():
    (log,) = logs(1)
    ready = prepare(vehicle(), [faster(log, 10)])
    assert ready.rate is not None
    assert LEAST_RATE <= ready.rate <= MOST_RATE
    assert sample_time(ready.data) == pytest.approx(1 / ready.rate)
    assert ready.data.flights[0].duration == pytest.approx(5.0, abs=0.05)


def test_a_gyro_slower_than_the_rows_needs_no_higher_rate():
    (log,) = logs(1)
    dense = faster(log, 4)
    rare = np.arange(dense.n) % 4 != 0
    channels = {
        n: np.where(rare, np.nan, v) if n in ("p", "q", "r") else v
        for n, v in dense.channels.items()
    }
    sparse = replace(dense, channels=channels)
    needed = [response_rate(condition(one, trim=False)) for one in (dense, sparse)]
    assert needed[1] == pytest.approx(needed[0], rel=0.1)


def test_flights_at_one_rate_that_is_enough_are_taken_as_they_are():
    ready = prepare(vehicle(), logs(1, 2))
    assert ready.rate is None
    assert [d for d in ready.decisions() if d.about == "rate"] == []


def test_a_rate_that_is_asked_for_is_taken():
    ready = prepare(vehicle(), logs(1, 2), rate=50.0)
    assert ready.rate == 50.0
    assert sample_time(ready.data) == pytest.approx(0.02)


def test_a_log_of_another_vehicle_among_four_is_left_out_and_named():
    own = logs(1, 2, 3, 4)
    heavy = replace(
        own[2], channels={n: v * (0.55 if n[0] == "u" else 1.0) for n, v in own[2].channels.items()}
    )
    ready = prepare(vehicle(), [*own[:2], heavy, own[3]])
    assert ready.data.names == ("run1", "run2", "run4")
    (gone,) = ready.left_out
    assert gone.flight == "run3"
    assert "another craft" in gone.reason
    (said,) = [d for d in ready.decisions() if d.about == "flights"]
    assert said.choice == "run3 left out"
    everyone = prepare(vehicle(), [*own[:2], heavy, own[3]], all_flights=True)
    assert len(everyone.data) == 4


def swapped(log):
    """The log with two motors exchanged."""
    c = log.channels
    return replace(log, channels={**c, "u1": c["u2"], "u2": c["u1"]})


def test_a_faulty_flight_is_left_out_and_where_all_are_nothing_is_fitted():
    sound, *others = logs(1, 2, 3, seconds=8.0)
    faulty = [swapped(log) for log in others]
    ready = prepare(vehicle(), [sound, *faulty])
    assert ready.data.names == ("run1",)
    assert all("motor order" in f.reason for f in ready.left_out)
    with pytest.raises(BadDataError, match=r"run2: the motor order is wrong.*accept=") as refused:
        prepare(vehicle(), faulty)
    checks = {f.check for f in refused.value.report.blocking}
    for choice in ({"accept": checks}, {"all_flights": True}):
        assert len(prepare(vehicle(), faulty, **choice).data) == 2


def test_four_flights_of_one_craft_all_take_part():
    ready = prepare(vehicle(), logs(1, 2, 3, 4))
    assert len(ready.data) == 4
    assert ready.left_out == ()
