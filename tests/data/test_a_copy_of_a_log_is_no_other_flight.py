"""A flight is its samples: a copy in another number format, a part of a log, or a log on another
clock is the same flight, to teach by and to judge by."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

import greybox as gb
from greybox.data import Dataset
from greybox.data.conditioning import condition
from greybox.data.fingerprint import fingerprint, of_one_flight
from greybox.data.halves import demand_apart, demand_disjoint
from greybox.data.logs import read_table
from greybox.data.raw import RawLog
from greybox.errors import DataError
from greybox.examples import flight_path, flight_paths, vehicle_path
from greybox.model.vehicle import read_vehicle
from tests import motor

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


DEGREE, CHIP = np.pi / 180, 0.061 * np.pi / 180
KINDS = {  # rows a second, spread and noise in rad/s, step, times filtered
    "whole deg/s in hover": (1000, 3 * DEGREE, 0.0, DEGREE, 1),
    "whole deg/s in a calm hover": (1000, DEGREE, 0.0, DEGREE, 1),
    "whole deg/s, filtered": (1000, 3 * DEGREE, 0.0, DEGREE, 3),
    "whole deg/s on the ground": (1000, 0.0, 0.3 * DEGREE, DEGREE, 1),
    "whole deg/s at 100 Hz": (100, 3 * DEGREE, 0.0, DEGREE, 1),
    "two decimals": (100, 0.03, 0.0, 0.01, 1),
    "steps of a chip in hover": (1000, DEGREE, 0.0, CHIP, 1),
    "steps of a chip on the ground": (1000, 0.0, 0.05 * DEGREE, CHIP, 1),
}


def coarse(kind: str, seed: int) -> dict[str, np.ndarray]:
    """A minute of a gyro that has 50 ms of memory."""
    rate, spread, noise, step, order = KINDS[kind]
    white, more = np.random.default_rng(seed).standard_normal((2, 60 * rate, 3))
    memory = np.exp(-1 / (0.05 * rate))
    for _ in range(order):
        white = lfilter([1 - memory], [1, -memory], white, axis=0)
    values = spread * white / white.std(axis=0) + noise * more
    return dict(zip("pqr", np.round(values / step).T * step, strict=True))


@pytest.mark.parametrize("kind", KINDS)
def test_minutes_of_a_coarse_gyro_are_told_apart_and_their_parts_known(kind):
    logs = [coarse(kind, seed) for seed in range(5)]
    marks = [fingerprint(one) for one in logs]
    assert min(map(len, marks)) > 50
    assert not any(a & b for i, a in enumerate(marks) for b in marks[:i])
    n = len(logs[0]["p"])
    part = fingerprint({c: v[n // 3 : n // 2] for c, v in logs[0].items()})
    assert of_one_flight(marks[0], part)
    assert of_one_flight(frozenset().union(*marks), part)
    assert not of_one_flight(frozenset().union(*marks[1:]), part)


def test_a_short_flight_is_not_among_many_others():
    log = coarse("whole deg/s at 100 Hz", 0)
    marks = [
        fingerprint({c: v[i : i + 1_000] for c, v in log.items()}) for i in range(0, 6_000, 1_000)
    ]
    for seed in range(1, 10):
        marks.append(fingerprint(coarse("whole deg/s at 100 Hz", seed)))
    for one in marks:
        others = frozenset().union(*(m for m in marks if m is not one))
        assert one
        assert not of_one_flight(one, others)


def test_wild_values_do_no_harm():
    rates = np.random.default_rng(0).standard_normal((3, 3_000))
    rates[0, ::100], rates[1, ::70] = 1e306, -0.0
    log = dict(zip("pqr", rates, strict=True))
    assert of_one_flight(fingerprint(log), fingerprint(log))
    assert not fingerprint({c: v[:0] for c, v in log.items()})
    assert not fingerprint({c: v[:7] for c, v in log.items()})


def test_a_flicker_between_two_rows_is_no_flight():
    flicker = {c: DEGREE * (np.arange(9_000) % k == 0) for c, k in (("p", 2), ("q", 9_999))}
    assert not fingerprint({**flicker, "r": np.zeros(9_000)})


@pytest.mark.parametrize("unit", [1.0, DEGREE], ids=["rad/s", "deg/s"])
@pytest.mark.parametrize("decimals", [4, 5, 6, 7])
@pytest.mark.parametrize("spread", [0.05, 0.5])
def test_a_copy_with_fewer_decimals_is_known(unit, decimals, spread):
    memory = np.exp(-0.2)
    white = np.random.default_rng(9).standard_normal((3, 6_000))
    rates = spread * lfilter([1 - memory], [1, -memory], white, axis=1) * np.sqrt(10)
    digits = decimals - (unit != 1.0)  # a digit less is as fine in deg/s
    copy = np.round(rates / unit, digits) * unit
    first, again = (fingerprint(dict(zip("pqr", x, strict=True))) for x in (rates, copy))
    assert of_one_flight(first, again)


def test_a_copy_that_lost_rows_is_known():
    log = coarse("whole deg/s in hover", 0)
    kept = np.random.default_rng(1).random(len(log["p"])) > 0.02
    assert of_one_flight(fingerprint(log), fingerprint({c: v[kept] for c, v in log.items()}))


def test_a_long_log_leaves_few_marks_and_knows_its_parts():
    rates = np.random.default_rng(0).standard_normal((3, 600_000))
    whole = fingerprint(dict(zip("pqr", rates, strict=True)))
    assert 100 < len(whole) <= 256
    for width in (60_000, 300_000):
        part = fingerprint(dict(zip("pqr", rates[:, 200_000 : 200_000 + width], strict=True)))
        assert of_one_flight(whole, part)
        other = coarse("whole deg/s in hover", 1)
        assert of_one_flight(whole | fingerprint(other), part)


@pytest.mark.parametrize("unit", [DEGREE, 0.01], ids=["whole deg/s", "0.01 rad/s"])
def test_real_flights_of_a_coarse_gyro_are_told_apart(unit):
    marks = []
    for path in flight_paths(SET):
        seen = read_table(path, VEHICLE).channels
        marks.append(fingerprint({n: np.round(seen[n] / unit) * unit for n in "pqr"}))
    assert min(len(m) for m in marks) > 10
    assert not any(a & b for i, a in enumerate(marks) for b in marks[:i])
    assert not any(of_one_flight(a, b) for i, a in enumerate(marks) for b in marks[:i])


def test_a_slow_gyro_that_a_table_carries_on_is_known():
    rates = np.random.default_rng(0).standard_normal((3, 3_000))
    whole = dict(zip("pqr", np.repeat(rates, 20, axis=1), strict=True))
    part = {n: v[20_000:40_000] for n, v in whole.items()}
    assert of_one_flight(fingerprint(whole), fingerprint(part))


def heated(seed: int, digit: float) -> dict[str, np.ndarray]:
    """A bench that is heated: every run has the same input, and rises alike."""
    t, rng = 0.02 * np.arange(1_000), np.random.default_rng(seed)
    rise = 20.0 + 5.0 * (1.0 - np.exp(-np.maximum(t - 1.0, 0.0) / 4.0))
    warm = digit * np.rint((rise + 0.02 * rng.standard_normal(t.size)) / digit)
    return {"power": (t > 1.0) * 1.0, "warm": warm}


@pytest.mark.parametrize("digit", [1e-6, 0.01, 0.1])
def test_a_log_of_something_else_is_known_by_all_its_columns(digit):
    log, again = heated(0, digit), {c: np.char.mod("%.6e", v) for c, v in heated(0, digit).items()}
    mark = fingerprint(log)
    assert of_one_flight(mark, fingerprint({c: v.astype(float) for c, v in again.items()}))
    for seed in range(1, 8):
        assert not of_one_flight(mark, fingerprint(heated(seed, digit)))


def test_a_model_of_something_else_knows_a_flight_that_it_was_fitted_on():
    one, seen = motor.record(torque_noise=0.002), "the flights that were fitted"
    fitted = gb.fit(motor.model(), one).model
    copy = Dataset(flights=(replace(one.flights[0], name="other"),))
    another = motor.record(torque_noise=0.002, seed=9, name="other")
    assert gb.validate(fitted, copy).verdict.judged_on == seen
    assert gb.validate(fitted, another).verdict.judged_on != seen
