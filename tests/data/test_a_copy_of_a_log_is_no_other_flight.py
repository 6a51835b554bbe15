"""A flight is its samples: a copy in another number format, a part of a log, or a log on another
clock is the same flight, to teach by and to judge by."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from greybox.data import Dataset
from greybox.data.conditioning import condition
from greybox.data.fingerprint import fingerprint, of_one_flight
from greybox.data.halves import demand_apart, demand_disjoint
from greybox.data.logs import read_table
from greybox.data.raw import RawLog
from greybox.errors import DataError
from greybox.examples import flight_path, flight_paths, vehicle_path
from greybox.model.vehicle import read_vehicle

SET, NAME, OTHER = "nanobench", "B2_circle_medium_rep1", "B3_figure8_fast_rep1"
VEHICLE = read_vehicle(vehicle_path(SET))


def text() -> list[str]:
    return gzip.decompress(Path(flight_path(SET, NAME)).read_bytes()).decode().splitlines()


def rewritten(cell: str) -> str:
    """A number with seven digits, in another format."""
    try:
        return f"{float(cell):.6e}"
    except ValueError:
        return cell


def log(folder: Path, lines: list[str], name: str) -> RawLog:
    (folder / name).write_text("\n".join(lines) + "\n")
    return read_table(folder / name, VEHICLE)


@pytest.fixture(scope="module")
def copies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, RawLog]:
    folder, (head, *rows) = tmp_path_factory.mktemp("logs"), text()
    other = [",".join(map(rewritten, r.split(","))) for r in rows]
    third = len(rows) // 3
    return {
        "saved again": log(folder, [head, *other], "again.csv"),
        "a part": log(folder, [head, *rows[third : 2 * third]], "part.csv"),
        "its end, saved again": log(folder, [head, *other[2 * third :]], "end.csv"),
    }


@pytest.mark.parametrize("how", ["saved again", "a part", "its end, saved again"])
def test_a_copy_neither_teaches_twice_nor_judges(copies, how):
    first, copy = read_table(flight_path(SET, NAME), VEHICLE), copies[how]
    assert first.sha256 != copy.sha256
    with pytest.raises(DataError, match=f"{copy.flight} hold the same samples"):
        demand_disjoint([first.file, copy.file])
    with pytest.raises(DataError, match=r"train and test .its samples are those of"):
        demand_disjoint([first.file], [copy.file])
    train, test = (Dataset(flights=(condition(r, VEHICLE),)) for r in (first, copy))
    with pytest.raises(DataError, match="both train and test"):
        demand_apart(train, test)


def test_another_flight_is_none(copies):
    other = read_table(flight_path(SET, OTHER), VEHICLE)
    demand_disjoint([c.file for c in [copies["a part"]]], [other.file])
    assert not of_one_flight(other.fingerprint, copies["saved again"].fingerprint)


def test_a_sensor_that_stands_still_is_no_flight():
    still = {n: np.full(4000, 0.1) for n in ("p", "q", "r")}
    assert not of_one_flight(fingerprint(still), fingerprint(still))


@pytest.mark.parametrize("step", [np.pi / 180, 0.01, 0.061 * np.pi / 180])
@pytest.mark.parametrize("spread", [0.002, 0.05, 0.15])
def test_other_flights_of_a_coarse_gyro_are_none(step, spread):
    """Whole degrees per second of a flight controller's log, two decimals, steps of a chip: still
    and in flight at 1 kHz."""
    logs = []
    for seed in range(4):
        white = spread * np.random.default_rng(seed).standard_normal((3, 30_000))
        lively = np.cumsum(white, axis=1) * 0.03 + white
        rates = np.round((lively - lively.mean(axis=1, keepdims=True)) / step) * step
        logs.append(dict(zip("pqr", rates, strict=True)))
    marks = [fingerprint(one) for one in logs]
    assert not any(of_one_flight(a, b) for i, a in enumerate(marks) for b in marks[:i])
    assert not any(of_one_flight(a, frozenset().union(*marks) - a) for a in marks)
    if spread > step:
        part = fingerprint({n: v[9_000:21_000] for n, v in logs[0].items()})
        assert of_one_flight(marks[0], part)


def test_real_flights_in_whole_degrees_are_told_apart():
    marks = []
    for path in flight_paths(SET):
        seen = read_table(path, VEHICLE).channels
        unit = np.pi / 180
        marks.append(fingerprint({n: np.round(seen[n] / unit) * unit for n in "pqr"}))
    assert min(len(m) for m in marks) > 10
    assert not any(of_one_flight(a, b) for i, a in enumerate(marks) for b in marks[:i])


def test_a_slow_gyro_that_a_table_carries_on_is_known():
    rates = np.random.default_rng(0).standard_normal((3, 3_000))
    whole = dict(zip("pqr", np.repeat(rates, 20, axis=1), strict=True))
    part = {n: v[20_000:40_000] for n, v in whole.items()}
    assert of_one_flight(fingerprint(whole), fingerprint(part))
