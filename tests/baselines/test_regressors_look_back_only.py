"""Regressors hold the past and nothing else: order, names, holes, signs of quaternions."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.baselines.regressors import Lags
from greybox.data import dataset_from_arrays
from greybox.errors import DataError


def counting(n=12, **more):
    t = np.arange(n, dtype=float)
    return dataset_from_arrays(0.01 * t, {"p": t, "q": 100 + t, "u1": 200 + t, **more}).segments[0]


def test_rows_are_newest_first_and_named_after_what_they_hold():
    lags = Lags(outputs=("p", "q"), inputs=("u1",), n_a=2, n_b=3)
    assert lags.layout.names == (
        "p[t-1]",
        "q[t-1]",
        "p[t-2]",
        "q[t-2]",
        "u1[t-1]",
        "u1[t-2]",
        "u1[t-3]",
    )
    assert lags.layout.units == ("rad/s",) * 4 + ("1",) * 3
    assert lags.rows(counting())[7].tolist() == [6, 106, 5, 105, 206, 205, 204]
    assert np.isnan(lags.rows(counting())[:3]).any(axis=1).all()
    assert np.isfinite(lags.rows(counting())[3:]).all()
    assert lags.history == 3


def test_the_command_of_the_same_instant_enters_only_when_asked_for():
    now = Lags(outputs=("p",), inputs=("u1",), n_a=1, n_b=2, newest=0)
    assert now.layout.names == ("p[t-1]", "u1[t]", "u1[t-1]")
    assert now.rows(counting())[7].tolist() == [6, 207, 206]


def test_starts_continue_the_rows_and_end_with_the_record():
    lags = Lags(outputs=("p", "q"), inputs=("u1",), n_a=2, n_b=3)
    segment = counting()
    past, moved = lags.starts(segment, [5, 11], 3)
    rows = lags.rows(segment)
    assert np.array_equal(lags.joined(past, moved[:, 0])[0], rows[6])
    assert moved[0, 2].tolist() == rows[8, 4:].tolist()
    assert (
        lags.pushed(past, np.array([[6.0, 106.0], [0.0, 0.0]]))[0].tolist() == rows[7, :4].tolist()
    )
    assert np.isfinite(past[1]).all() and np.isfinite(moved[1, 0]).all(), (
        "one sample past the end is known"
    )
    assert np.isnan(moved[1, 1:, 0]).all()
    with pytest.raises(DataError, match="outside"):
        lags.starts(segment, [12], 1)


def test_samples_with_a_hole_in_their_past_are_left_out():
    lags = Lags(outputs=("p",), inputs=("u1",), n_a=2, n_b=1)
    t = np.arange(12.0)
    z, y, names = lags.pairs([counting(p=np.where(t == 6, np.nan, t))])
    assert y[:, 0].tolist() == [2, 3, 4, 5, 9, 10, 11]
    assert z.shape == (7, 3)
    assert set(names) == {"flight"}


def test_a_quaternion_that_jumps_to_its_negative_does_not_jump_here():
    angle = np.linspace(0.0, 3.0, 12)
    q = {"qw": np.cos(angle / 2), "qx": np.sin(angle / 2), "qy": 0 * angle, "qz": 0 * angle}
    sign = np.where(np.arange(12) >= 6, -1.0, 1.0)
    lags = Lags(outputs=("qw", "qx", "qy", "qz"), inputs=("u1",))
    straight = lags.measured(counting(**q))
    assert lags.measured(counting(**{k: v * sign for k, v in q.items()})) == pytest.approx(straight)


def test_impossible_lags_are_refused():
    for wrong in ({"n_a": 0}, {"n_b": 0}, {"newest": 2}):
        with pytest.raises(DataError, match="at least 1"):
            Lags(outputs=("p",), inputs=("u1",), **wrong)
