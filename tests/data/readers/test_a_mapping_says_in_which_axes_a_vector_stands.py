"""Rotation matrices, rates and accelerations along the world, and accelerations without gravity
become the same channels as a log of our own; axes that are said wrongly are found."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from greybox.data.checks import check
from greybox.data.logs import read_table
from greybox.data.readers.axes import from_matrix
from greybox.data.readers.mapping import mapping_of
from greybox.errors import DataError
from greybox.examples import flight_path, vehicle_path
from greybox.frames import GRAVITY, numeric
from greybox.model.vehicle import read_vehicle
from tests.data.readers import writers as w

UP = np.array([0.0, 0.0, GRAVITY])
KEPT = ("t", "u1", "u2", "u3", "u4", "x", "y", "z", "vx", "vy", "vz")
ATTITUDE = {"fields": ["qw", "qx", "qy", "qz"]}


Turn = Callable[[np.ndarray, np.ndarray], np.ndarray]


def log(path: Path, c: w.Columns, **vectors: Turn | None) -> Path:
    """A flight whose attitude, rate (w1 to w3) and specific force (f1 to f3) are written anew."""
    q = np.column_stack([c[n] for n in ATTITUDE["fields"]])
    columns = {n: c[n] for n in KEPT} | dict(zip(ATTITUDE["fields"], q.T, strict=True))
    given = {"w": np.column_stack([c[n] for n in ("p", "q", "r")])}
    given["f"] = np.column_stack([c[n] for n in ("ax", "ay", "az")])
    for name, turn in vectors.items():
        given[name] = given[name] if turn is None else turn(q, given[name])
    for name, values in given.items():
        columns |= {f"{name}{i + 1}": values[:, i] for i in range(values.shape[1])}
    columns |= {f"R{i}{j}": numeric("matrix", q)[:, 3 * i + j] for i in range(3) for j in range(3)}
    return w.write_csv(path, columns)


def to_world(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return numeric("rotate", q, v)


def moving_in_the_world(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return to_world(q, v) - UP


def moving(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return numeric("rotate_inverse", q, moving_in_the_world(q, v))


def to_ned(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return moving_in_the_world(q, v)[:, [1, 0, 2]] * [1.0, 1.0, -1.0]


RATE = {"fields": ["w1", "w2", "w3"]}
FORCE = {"fields": ["f1", "f2", "f3"]}
MATRIX = {"fields": [f"R{i}{j}" for i in range(3) for j in range(3)]}


@pytest.mark.parametrize(
    ("turn", "force"),
    [
        (None, {}),
        (moving, {"gravity": False}),
        (to_world, {"frame": "ENU"}),
        (moving_in_the_world, {"gravity": False, "frame": "ENU"}),
        (to_ned, {"gravity": False, "frame": "NED"}),
    ],
)
@pytest.mark.parametrize("attitude", [ATTITUDE, MATRIX])
def test_whatever_the_axes_the_channels_are_the_same(
    turn: Turn | None, force: dict[str, object], attitude: dict[str, object], tmp_path: Path
) -> None:
    path = log(tmp_path / "a.csv", w.channels(rows=300), f=turn, w=to_world)
    tables = {"rate": RATE | {"frame": "ENU"}, "specific_force": FORCE | force}
    said = mapping_of(tables | {"attitude": attitude}, where="m.toml")
    read, true = read_table(path, mapping=said), w.channels(rows=300)
    for name in ("p", "q", "r", "ax", "ay", "az", "qw", "qx", "qy", "qz", "vx"):
        np.testing.assert_allclose(read.channels[name], true[name], atol=2e-5, err_msg=name)


def test_a_slower_attitude_turns_every_sample_of_a_vector(tmp_path: Path) -> None:
    """Nine of ten samples of the rate were lost, at a tenth of its rate."""
    true = w.channels(rows=300)
    path = log(tmp_path / "a.csv", true, w=to_world)
    text = [line.split(",") for line in path.read_text().splitlines()]
    lost = [text[0].index(n) for n in ATTITUDE["fields"]]
    for k, row in enumerate(text[1:]):
        if k % 10:
            for i in lost:
                row[i] = ""
    path.write_text("\n".join(",".join(row) for row in text) + "\n")
    said = mapping_of({"rate": RATE | {"frame": "ENU"}, "attitude": ATTITUDE}, where="m.toml")
    read = read_table(path, mapping=said)
    assert np.isfinite(read.channels["qw"]).mean() < 0.2
    for name in ("p", "q", "r"):
        off = read.channels[name] - true[name]
        assert np.isfinite(off).mean() > 0.95 and np.nanstd(off) < 0.05 * np.std(true[name]), name


def test_a_matrix_is_a_quaternion_of_unit_length_only_where_it_turns() -> None:
    q = np.random.default_rng(0).normal(size=(200, 4))
    q[:4] = np.eye(4)  # half turns, whose scalar is zero, too
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    back = from_matrix(numeric("matrix", q))
    np.testing.assert_allclose(np.abs(np.sum(back * q, axis=1)), 1.0, atol=1e-12)
    some = np.where(np.arange(9) == 0, np.nan, np.eye(3).ravel() + 0.1)
    lost = from_matrix(np.array([np.zeros(9), np.full(9, np.nan), some]))
    assert abs(np.linalg.norm(lost[0]) - 0.5) < 1e-12 and np.isnan(lost[1:]).all()


@pytest.mark.parametrize(
    ("turn", "rate", "force", "words"),
    [
        (moving_in_the_world, {}, {"gravity": False}, "without gravity is in world axes"),
        (moving, {}, {"gravity": False, "frame": "ENU"}, "without gravity is in body axes"),
        (None, {"frame": "ENU"}, {}, "the gyro is in body axes"),
    ],
)
def test_axes_that_are_said_wrongly_are_found(
    turn: Turn | None, rate: dict[str, object], force: dict[str, object], words: str, tmp_path: Path
) -> None:
    vehicle = read_vehicle(vehicle_path("nanobench"))
    circle = read_table(flight_path("nanobench", "B2_circle_fast_rep1"), vehicle)
    path = log(tmp_path / "a.csv", {"t": circle.t, **circle.channels}, f=turn)
    tables = {"rate": RATE | rate, "specific_force": FORCE | force}
    raw = read_table(path, mapping=mapping_of(tables, where="m.toml"))
    report = check([raw], vehicle)
    assert any(words in f.message for f in report.blocking), report.summary()


def test_what_takes_the_attitude_is_left_out_where_there_is_none(tmp_path: Path) -> None:
    path = log(tmp_path / "a.csv", w.channels(rows=50))
    tables = {"attitude": {"use": False}, "rate": RATE, "specific_force": FORCE}
    tables["specific_force"] = FORCE | {"gravity": False}
    read = read_table(path, mapping=mapping_of(tables, where="m.toml"))
    assert "ax" not in read.channels and "p" in read.channels
    assert any("specific_force without gravity left out" in note for note in read.notes)


def test_gravity_is_said_of_a_specific_force_alone() -> None:
    with pytest.raises(DataError, match="gravity"):
        mapping_of({"rate": RATE | {"gravity": False}}, where="m.toml")
    said = mapping_of({"specific_force": FORCE | {"gravity": False}}, where="m.toml")
    assert said.to_dict()["specific_force"] == FORCE | {"gravity": False}
