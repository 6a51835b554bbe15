"""Every shipped log has its checksum, licence and provenance, and loads unchanged with the vehicle file of its set."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from greybox.data import read_logs
from greybox.errors import UnknownNameError
from greybox.model.vehicle import read_vehicle
from scenarios.flights import (
    NANOBENCH_TEST,
    SETS,
    flight_path,
    flight_paths,
    nanobench_split,
    set_folder,
    vehicle_path,
)


@pytest.mark.parametrize("set_name", SETS)
def test_checksums_cover_every_log_and_hold(set_name):
    folder = set_folder(set_name)
    lines = [line.split("  ") for line in (folder / "SHA256SUMS").read_text().splitlines()]
    for digest, name in lines:
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    assert {name for _, name in lines} == {p.name for p in flight_paths(set_name)} | {"LICENSE"}


@pytest.mark.parametrize(("set_name", "licence"), [("nanobench", "BSD 3-Clause"), ("arpl_crazyflie", "MIT License")])
def test_licence_and_provenance_stand_beside_the_data(set_name, licence):
    folder = set_folder(set_name)
    assert licence in (folder / "LICENSE").read_text()
    page = (folder / "README.md").read_text()
    assert "commit" in page
    assert "What differs from the source" in page


def test_compressed_files_carry_no_time_stamp():
    for set_name in SETS:
        for path in flight_paths(set_name):
            assert path.read_bytes()[4:8] == b"\0\0\0\0"


def test_the_split_is_complete_and_disjoint():
    train, test = nanobench_split()
    assert (len(train), len(test)) == (9, 5)
    assert sorted([*train, *test]) == flight_paths("nanobench")
    assert {p.name.split(".")[0] for p in test} == set(NANOBENCH_TEST)


@pytest.mark.parametrize(("set_name", "count"), [("nanobench", 14), ("arpl_crazyflie", 3)])
def test_logs_load_in_si_units(set_name, count):
    vehicle = read_vehicle(vehicle_path(set_name))
    data = read_logs(flight_paths(set_name), vehicle)
    assert len(data) == count
    for segment in data.segments:
        assert np.nanmedian(segment.column("az")) == pytest.approx(9.8, abs=1.0)
        assert np.nanmax(np.abs(segment.matrix(["p", "q", "r"]))) < 40.0
        commands = segment.matrix(["u1", "u2", "u3", "u4"])
        assert commands.min() >= 0.0
        assert commands.max() <= 1.0
    assert data.noncausal == ({"vx", "vy", "vz"} if set_name == "nanobench" else set())


def test_unknown_sets_and_flights():
    with pytest.raises(UnknownNameError, match="did you mean nanobench"):
        flight_paths("nanobnch")
    with pytest.raises(UnknownNameError, match="unknown flight"):
        flight_path("nanobench", "B9_square")
