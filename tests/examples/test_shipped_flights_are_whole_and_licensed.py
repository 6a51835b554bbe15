"""Every shipped log has its checksum, licence and provenance, and loads unchanged with the vehicle
file of its set."""

from __future__ import annotations

import hashlib
import os
import shutil

import numpy as np
import pytest

import greybox
from greybox import examples
from greybox.cli import main
from greybox.data import read_logs
from greybox.errors import UnknownNameError
from greybox.examples import (
    NANOBENCH_TEST,
    SETS,
    flight_path,
    flight_paths,
    nanobench_split,
    path,
    vehicle_path,
)
from greybox.model.vehicle import read_vehicle


@pytest.mark.parametrize("set_name", SETS)
def test_checksums_cover_every_log_and_hold(set_name):
    folder = path(set_name)
    lines = [line.split("  ") for line in (folder / "SHA256SUMS").read_text().splitlines()]
    for digest, name in lines:
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    assert {name for _, name in lines} == {
        *(p.name for p in flight_paths(set_name)),
        "LICENSE",
        "vehicle.toml",
    }


@pytest.mark.parametrize(
    ("set_name", "licence"), [("nanobench", "BSD 3-Clause"), ("arpl_crazyflie", "MIT License")]
)
def test_licence_and_provenance_stand_beside_the_data(set_name, licence):
    folder = path(set_name)
    assert licence in (folder / "LICENSE").read_text()
    page = (folder / "README.md").read_text()
    assert "commit" in page
    assert "What differs from the source" in page


def test_compressed_files_carry_no_time_stamp():
    for set_name in SETS:
        for log in flight_paths(set_name):
            assert log.read_bytes()[4:8] == b"\0\0\0\0"


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


def test_the_command_copies_a_set_with_its_licence_and_touches_no_file_of_the_user(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main(["examples"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in SETS)
    for arguments in (["arpl_crazyflie"], ["arpl_crazyflie", "--out", "a b/ü"]):
        assert main(["examples", *arguments]) == 0
        folder = tmp_path / arguments[-1]
        assert sorted(p.name for p in folder.iterdir()) == sorted(
            p.name for p in path("arpl_crazyflie").iterdir()
        )
    assert main(["examples", "arpl_crazyflie"]) == 0  # the same files once more
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "vehicle.toml").write_text("mine")
    assert main(["examples", "arpl_crazyflie", "--out", "mine"]) == 2
    assert [p.read_text() for p in (tmp_path / "mine").iterdir()] == ["mine"]
    assert main(["examples", "crazyflie"]) == 2
    assert main(["examples", "--out", "elsewhere"]) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a b", "arpl_crazyflie", "mine"]


def test_they_are_there_as_an_attribute_of_greybox():
    assert greybox.examples.path("nanobench").is_dir()
    assert "examples" in greybox.__all__


@pytest.mark.parametrize("how", ["cut", "gone", "no file", "no sums"])
def test_files_that_are_not_whole_are_one_line_and_nothing_is_copied(
    how, tmp_path, capsys, monkeypatch
):
    shutil.copytree(path("arpl_crazyflie"), tmp_path / "arpl_crazyflie")
    monkeypatch.setattr(examples, "ROOT", tmp_path)
    victim = tmp_path / "arpl_crazyflie" / ("SHA256SUMS" if how == "no sums" else "log15.csv.gz")
    content = victim.read_bytes()
    victim.unlink()
    if how == "cut":
        victim.write_bytes(content[:5000])
    if how == "no file":
        victim.mkdir()
    assert main(["examples", "arpl_crazyflie", "--out", str(tmp_path / "mine")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert victim.name in said.err
    assert "Usual fix: install greybox again" in said.err
    assert not (tmp_path / "mine").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everywhere")
def test_an_unreadable_file_is_one_line(tmp_path, capsys, monkeypatch):
    shutil.copytree(path("arpl_crazyflie"), tmp_path / "arpl_crazyflie")
    monkeypatch.setattr(examples, "ROOT", tmp_path)
    (tmp_path / "arpl_crazyflie" / "log15.csv.gz").chmod(0)
    assert main(["examples", "arpl_crazyflie", "--out", str(tmp_path / "mine")]) == 2
    assert "cannot read: Permission denied" in capsys.readouterr().err
