"""A horizon is a time: the same in seconds at every rate, never less than a sample, and never
samples by mistake."""

from __future__ import annotations

import pytest

from greybox.errors import DataError
from greybox.validation.horizons import HORIZONS, horizons_of, parse_samples, parse_seconds


def test_the_same_seconds_are_other_samples_at_another_rate() -> None:
    assert horizons_of(sample_time=0.01).steps == (1, 10, 50, 100)
    assert horizons_of(sample_time=0.002).steps == (5, 50, 250, 500)
    assert horizons_of((0.5, 0.1), sample_time=0.01).steps == (10, 50)


def test_less_than_a_sample_becomes_one_and_is_said() -> None:
    found = horizons_of((0.01, 0.1), sample_time=0.02)
    assert found.steps == (1, 5)
    assert "0.01 s is below one sample" in found.notes[0]
    assert not horizons_of((0.01, 0.1), sample_time=0.01).notes
    # Nobody asked for the usual ones one by one.
    assert horizons_of(HORIZONS, sample_time=0.02).steps == (1, 5, 25, 50)
    assert not horizons_of(HORIZONS, sample_time=0.02).notes


def test_samples_are_taken_where_they_are_asked_for() -> None:
    assert horizons_of(samples=(50, 1, 10), sample_time=0.02).steps == (1, 10, 50)


@pytest.mark.parametrize(
    "seconds", [(), (0.0,), (-0.1,), (1, 10, 50), (float("nan"),), (float("inf"),)]
)
def test_what_is_no_time_ahead_is_refused(seconds: tuple[float, ...]) -> None:
    with pytest.raises(DataError, match="seconds"):
        horizons_of(seconds, sample_time=0.01)


def test_text_is_read_or_refused_in_one_line() -> None:
    assert parse_seconds("0.1,0.5, 1") == (0.1, 0.5, 1.0)
    assert parse_samples("1,10") == (1, 10)
    for text in ("", "soon", "1,10,50", "0"):
        with pytest.raises(DataError, match="--horizons"):
            parse_seconds(text)
    for text in ("", "0.5", "0"):
        with pytest.raises(DataError, match="--horizons-samples"):
            parse_samples(text)
