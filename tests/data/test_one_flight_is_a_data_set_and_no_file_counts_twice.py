"""One flight goes wherever flights go; a file that is there twice, under whatever name, is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import greybox as gb
from greybox.data import Dataset, Segment
from greybox.data.dataset import Flight
from greybox.data.halves import demand_disjoint
from greybox.errors import DataError
from greybox.examples import flight_path, vehicle_path

SET = "nanobench"


def flight(name: str = "one", content: str = "") -> Flight:
    t = 0.01 * np.arange(50)
    return Flight(name=name, segments=(Segment(t=t, channels={"p": t}),), sha256=content)


def test_a_flight_is_a_data_set_and_its_segments_bear_its_name() -> None:
    one = flight()
    assert Dataset.of(one).names == ("one",)
    assert {s.flight for s in one.segments} == {"one"}
    both = Dataset(flights=(one, flight("two")))
    assert Dataset.of(both) is both


@pytest.mark.parametrize("data", ["a.csv", [], 3, Dataset(flights=())])
def test_what_is_none_is_said(data: object) -> None:
    with pytest.raises(DataError, match=r"Dataset|no flights"):
        Dataset.of(data)  # type: ignore[arg-type]
    with pytest.raises(DataError, match=r"Dataset|no flights"):
        gb.fit(gb.read_vehicle(vehicle_path(SET)), data)  # type: ignore[arg-type]


def test_one_path_is_read_and_one_flight_is_checked() -> None:
    vehicle = gb.read_vehicle(vehicle_path(SET))
    name = "B2_circle_medium_rep1"
    path = flight_path(SET, name)
    data = gb.read_logs(Path(path), vehicle)
    assert data.names == gb.read_logs(str(path), vehicle).names == (name,)
    assert gb.check(data[name], vehicle).ok


@pytest.mark.parametrize(
    ("train", "test", "said"),
    [
        ([("a", "1"), ("b", "1")], [], "flights a and b are the same file"),
        ([("a", "1")], [("b", "1")], "b is both train and test .byte for byte a"),
        ([("a", "1")], [("a", "1")], "a is both train and test"),
        ([("a", "")], [("a", "")], "a is both train and test"),
        ([("log", "1")], [("log", "2")], "two files are called log"),
    ],
)
def test_no_file_teaches_twice_or_judges_itself(
    train: list[tuple[str, str]], test: list[tuple[str, str]], said: str
) -> None:
    with pytest.raises(DataError, match=said):
        demand_disjoint(train, test)


def test_flights_from_memory_have_no_file() -> None:
    demand_disjoint([("a", ""), ("b", "")], [("c", ""), ("d", "1")])
