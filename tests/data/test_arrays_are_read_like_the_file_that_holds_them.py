"""Arrays and data frames whose stamps jitter, or that leave gaps, become the flight that their file
would be; on a uniform clock samples stay as they are. Their samples tell copies, as those of files
do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from greybox.data import Dataset, Flight, dataset_from_arrays, read_log, read_table
from greybox.data.halves import demand_disjoint
from greybox.errors import DataError
from greybox.examples import flight_paths, vehicle_path
from greybox.model.vehicle import read_vehicle

T = np.arange(1_200) * 0.01


def arrays(seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(0, 0.05, (3, T.size)), axis=1)
    commands = {f"u{i}": np.round(0.5 + 0.1 * np.sin(T * i), 3) for i in range(1, 5)}
    return {"t": T, **dict(zip("pqr", walk, strict=True)), **commands}


def uneven(seed: int = 0) -> dict[str, np.ndarray]:
    """With stamps that jitter by 4 % of a sample, two samples missing, and a gap of 0.4 s."""
    log = arrays(seed)
    log["t"] = T + np.random.default_rng(1).normal(0, 4e-4, T.size)
    kept = np.ones(T.size, dtype=bool)
    kept[400:440] = kept[700:702] = False
    return {k: v[kept] for k, v in log.items()}


def csv(log: dict[str, np.ndarray], path: Path) -> Path:
    rows = [",".join(map(repr, map(float, r))) for r in np.column_stack(list(log.values()))]
    path.write_text("\n".join([",".join(log), *rows]) + "\n")
    return path


def same(a: Flight, b: Flight) -> bool:
    return len(a.segments) == len(b.segments) and all(
        np.array_equal(x.t, y.t)
        and set(x.names) == set(y.names)
        and all(np.array_equal(x.column(n), y.column(n), equal_nan=True) for n in x.names)
        for x, y in zip(a.segments, b.segments, strict=True)
    )


@pytest.mark.parametrize("options", [{}, {"rate": 50.0}, {"vehicle": True, "rate": 80.0}])
@pytest.mark.parametrize("form", ["arrays", "frame"])
def test_what_jitters_or_has_gaps_is_the_flight_of_its_file(options, form, tmp_path):
    if options.get("vehicle"):
        options = {**options, "vehicle": read_vehicle(vehicle_path("nanobench"))}
    log = uneven()
    channels = {k: v for k, v in log.items() if k != "t"}
    if form == "frame":
        channels = pytest.importorskip("pandas").DataFrame(log)  # its column t is no channel
    (flight,) = dataset_from_arrays(log["t"], channels, name="log", **options)
    file = read_log(csv(log, tmp_path / "log.csv"), trim=False, **options)
    assert len(flight.segments) == 2
    assert same(flight, file)
    assert flight.notes[-2:] == file.notes[-2:]
    assert flight.known_by == file.known_by


def test_a_real_log_on_its_own_clock_is_too():
    vehicle = read_vehicle(vehicle_path("arpl_crazyflie"))
    path = flight_paths("arpl_crazyflie")[0]
    raw = read_table(path, vehicle)
    file = read_log(path, vehicle, trim=False, rate=100)
    (flight,) = dataset_from_arrays(raw.t, raw.channels, vehicle=vehicle, rate=100)
    assert same(flight, file)


def test_samples_on_a_uniform_clock_stay_as_they_are():
    log = arrays()
    (flight,) = dataset_from_arrays(log["t"], log)
    (segment,) = flight.segments
    assert "t" not in segment.names
    assert np.array_equal(segment.t, T)
    assert all(np.array_equal(segment.column(n), log[n]) for n in segment.names)


@pytest.mark.parametrize(
    ("t", "channels", "words"),
    [
        (T[::-1], {"p": T}, "time goes back"),
        (np.r_[T, T], {"p": np.r_[T, T]}, "another flight begins there"),
        ((1.7e9 + T).astype(np.float32), {"p": T}, "float32"),
        ((1.7e9 + T).astype(int), {"p": T}, "whole seconds"),
        (np.r_[T[:-1], T[-2]], {"p": T}, "the same time stamp twice"),
        (T**2, {"voltage": T}, "none of voltage is a channel"),
        (T**2, {"p": np.full(T.size, np.inf)}, "infinite"),
        (T**2, {"p": T[1:]}, "shape"),
        (np.where(T == 1.0, np.nan, T), {"p": T}, "no value at sample 100"),
    ],
)
def test_what_cannot_be_a_clock_is_refused(t, channels, words):
    with pytest.raises(DataError, match=words):
        dataset_from_arrays(t, channels, name="a")


def test_columns_that_are_no_channels_stay_beside_them():
    log = uneven()
    (flight,) = dataset_from_arrays(log["t"], {**log, "temperature": log["t"]})
    assert "temperature" not in flight.channels
    assert all("temperature" in s.extra for s in flight.segments)
    assert any("temperature" in note for note in flight.notes)


def made(name: str, log: dict[str, np.ndarray]) -> Dataset:
    return dataset_from_arrays(log["t"], log, name=name)


def test_a_copy_in_memory_is_the_same_flight_under_any_name():
    first, other = made("a", arrays()), made("c", arrays(seed=1))
    by_hand = Dataset(flights=(Flight(name="b", segments=first["a"].segments),))
    renamed = Dataset(flights=(replace(first["a"], name="b"),))
    part = made("b", {k: v[300:900] for k, v in arrays().items()})
    for copy in (made("b", arrays()), by_hand, renamed, part):
        with pytest.raises(DataError, match=r"b is both train and test .*samples are those of a"):
            demand_disjoint(first.files, copy.files)
        with pytest.raises(DataError, match="a and b hold the same samples"):
            demand_disjoint((first + copy).files)
    demand_disjoint(first.files, other.files)


def test_parts_in_memory_that_share_nothing_are_two_flights():
    early, late = made("a", arrays()).split_by_time(0.5)
    demand_disjoint(early.files, Dataset(flights=(replace(late["a"], name="b"),)).files)


def test_a_copy_of_a_file_in_memory_is_known(tmp_path):
    log = arrays()
    file = read_log(csv(log, tmp_path / "log.csv"), trim=False)
    with pytest.raises(DataError, match="both train and test"):
        demand_disjoint(Dataset(flights=(file,)).files, made("b", log).files)
