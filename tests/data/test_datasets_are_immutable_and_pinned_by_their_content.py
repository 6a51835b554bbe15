"""Segments and data sets check themselves, cannot be changed, split without leaks, and hash their
content."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from greybox.data import Dataset, Flight, Segment, channel, dataset_from_arrays, group_names
from greybox.data.channel import canonical_names, is_canonical, rotor_index
from greybox.errors import DataError, UnknownNameError

T = np.arange(100) * 0.01


def made(name="a", shift=0.0, **more):
    return dataset_from_arrays(
        T + shift, {"u1": np.full(100, 0.5), "p": np.sin(T), **more}, name=name
    )


def test_arrays_are_read_only_copies():
    p = np.sin(T)
    segment = Segment(t=T, channels={"p": p}, flight="a")
    p[0] = 99.0
    assert segment.column("p")[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        segment.column("p")[0] = 1.0
    with pytest.raises(TypeError):
        segment.channels["p"] = p
    changed = segment.replace({"q": 2 * T})
    assert "q" not in segment.channels
    assert changed.names == ("p", "q")


@pytest.mark.parametrize(
    ("t", "channels", "words"),
    [
        (T, {"p": np.zeros(99)}, "shape"),
        (T[:1], {"p": [0.0]}, "at least 2"),
        (T[::-1], {"p": T}, "not increasing"),
        (T**2 + T, {"p": T}, "not uniform"),
        (T, {"p": np.full(100, np.inf)}, "infinite"),
    ],
)
def test_segments_check_themselves(t, channels, words):
    with pytest.raises(DataError, match=words):
        Segment(t=t, channels=channels, flight="a")


def test_matrix_and_columns():
    segment = made().flights[0].segments[0]
    assert segment.matrix(["p", "u1"]).shape == (100, 2)
    assert segment.dt == 0.01
    assert segment.duration == pytest.approx(1.0)
    with pytest.raises(UnknownNameError, match="unknown channel 'q'"):
        segment.matrix(["q"])
    assert np.isnan(segment.matrix(["q", "p"], missing_ok=True)[:, 0]).all()


def test_between_takes_the_half_open_interval():
    part = made().flights[0].segments[0].between(0.2, 0.5)
    assert part.t[0] == pytest.approx(0.2)
    assert part.n == 30
    with pytest.raises(DataError, match="at least 2"):
        part.between(5.0, 6.0)


def test_splits_are_disjoint_and_complete():
    data = made("a") + made("b") + made("c")
    train, test = data.split_by_flight(["b"])
    assert (train.names, test.names) == (("a", "c"), ("b",))
    first, second = data.split_by_time(0.3)
    for one, two, whole in zip(first, second, data, strict=True):
        assert one.n + two.n == whole.n
        assert one.segments[-1].t[-1] < two.segments[0].t[0]
        assert one.n == 30
    assert data.split_by_time(at=0.25)[0].flights[0].n == 25
    with pytest.raises(DataError, match="between 0 and 1"):
        data.split_by_time(1.5)
    with pytest.raises(UnknownNameError, match="did you mean"):
        made("flight_one").split_by_flight(["flight_on"])


def test_names_are_unique():
    with pytest.raises(DataError, match="given twice: a"):
        made("a") + made("a")


def test_hash_sees_content_and_nothing_else():
    data = made()
    assert data.hash == made().hash
    assert data.hash != made("b").hash
    assert data.hash != made(shift=1.0).hash
    assert data.hash != made(q=T).hash
    nan = np.sin(T)
    nan[3] = np.nan
    assert data.hash != made(p=nan).hash
    flight = data.flights[0]
    noted = Dataset(
        flights=(Flight(name="a", segments=flight.segments, notes=("cut",), source="x.csv"),)
    )
    assert noted.hash == data.hash


def test_channels_of_all_and_of_any_flight():
    data = made("a", q=T) + made("b")
    assert data.channels == ("u1", "p")
    assert data.any_channels == ("u1", "p", "q")


def test_flights_demand_one_rate_and_order_in_time():
    slow = Segment(t=T * 2 + 5, channels={"p": T}, flight="a")
    fast = Segment(t=T, channels={"p": T}, flight="a")
    with pytest.raises(DataError, match="different sample times"):
        Flight(name="a", segments=(fast, slow))
    with pytest.raises(DataError, match="overlap"):
        Flight(name="a", segments=(fast, fast))
    with pytest.raises(DataError, match="no usable samples"):
        Flight(name="a", segments=())


def test_segments_survive_pickling_read_only():
    segment = pickle.loads(pickle.dumps(made().flights[0].segments[0]))
    assert not segment.column("p").flags.writeable
    assert segment.names == ("u1", "p")


def test_channel_catalogue():
    assert channel("p").unit == "rad/s"
    assert channel("omega12").group == "rotor_speed"
    assert rotor_index("u3") == 3
    assert rotor_index("p") is None
    assert not is_canonical("u0")
    assert group_names("command", 6)[-1] == "u6"
    assert all(channel(n).name == n for n in canonical_names(8))
    with pytest.raises(UnknownNameError):
        channel("gyro_x")
    with pytest.raises(UnknownNameError):
        group_names("rates")


def test_a_cut_segment_remembers_what_was_before():
    (whole,) = next(iter(made())).segments
    cut = whole.rows(50, 90)
    assert dict(whole.earlier) == {}
    assert np.array_equal(cut.earlier["p"], np.sin(T[30:50]))
    assert np.array_equal(cut.replace({"q": np.zeros(40)}).earlier["p"], cut.earlier["p"])
    assert "p" not in cut.without(["p"]).earlier
    assert np.array_equal(pickle.loads(pickle.dumps(cut)).earlier["u1"], np.full(20, 0.5))
    assert np.array_equal(cut.rows(0, 10).earlier["p"], cut.earlier["p"])
    assert np.array_equal(cut.rows(5, 40).earlier["p"], np.sin(T[35:55]))


def test_a_flight_as_a_log_keeps_the_order_of_its_columns():
    """Before, it was that of a set: another in each run."""
    names = [f"column{i}" for i in range(20)]
    parts = tuple(
        Segment(t=T + at, channels={"p": T}, flight="a", extra=dict.fromkeys(names, T))
        for at in (0.0, 5.0)
    )
    log = Flight(name="a", segments=parts).as_log()
    assert list(log.extra) == names
    assert log.t.size == log.extra["column0"].size == 200
