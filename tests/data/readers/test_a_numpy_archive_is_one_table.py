"""Arrays that a script saved by np.savez are columns of one table; what is none is refused in one
line."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from greybox.cli import main
from greybox.data.logs import read_log
from greybox.data.readers import read_columns
from greybox.data.readers.numpy_archive import read_npz
from greybox.errors import DataError
from tests.data.readers import writers as w


def test_the_draft_of_an_archive_reads_what_was_flown(tmp_path: Path) -> None:
    c = w.channels(rows=300)
    groups = {"cmd": "u1 u2 u3 u4", "gyro": "p q r", "accel": "ax ay az", "pos": "x y z"}
    arrays = {k: np.column_stack([c[n] for n in names.split()]) for k, names in groups.items()}
    log, draft = tmp_path / "lab.npz", tmp_path / "m.toml"
    images = np.zeros((300, 8, 8), dtype=np.uint8)
    note = np.array(["seen by", {"a": 1}], dtype=object)
    np.savez(log, timestamps=c["t"], images=images, note=note, mass=0.7, **arrays)
    assert main(["inspect", str(log), "--draft", str(draft)]) == 1
    read = read_log(log, mapping=draft, trim=False).segments[0].channels
    for name in " ".join(groups.values()).split():
        np.testing.assert_allclose(read[name], c[name][: len(read[name])], err_msg=name)


def test_rotation_matrices_are_nine_columns_and_what_is_left_out_is_said(tmp_path: Path) -> None:
    log, turns = tmp_path / "a.npz", np.arange(90.0).reshape(10, 3, 3)
    note = np.array(["seen", {}] * 5, dtype=object)
    np.savez(log, t=np.arange(10.0), R=turns, gyro=np.zeros((3, 100)), note=note, mass=0.7)
    table = read_columns(log.rename(tmp_path / "a.zip"))
    np.testing.assert_array_equal(table.columns["R[5]"], turns[:, 1, 2])
    assert table.notes == ("left out, no numbers or more than 16 a row: gyro, note",)


def test_what_is_no_table_is_refused_in_one_line(tmp_path: Path) -> None:
    log = tmp_path / "a.npz"
    np.savez(log, states=np.zeros((1, 16, 50)))
    with pytest.raises(DataError, match="no numeric vectors"):
        read_npz(log)
    whole = log.read_bytes()
    with zipfile.ZipFile(log, "w") as packed:
        packed.writestr("readme.txt", "no arrays")
    with pytest.raises(DataError, match="no numeric vectors"):
        read_npz(log)
    for broken in (whole[:200], b"PK\x03\x04" + bytes(300)):
        log.write_bytes(broken)
        with pytest.raises(DataError, match="cannot be read as a NumPy archive"):
            read_npz(log)
