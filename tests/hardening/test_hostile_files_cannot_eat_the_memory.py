"""Reading takes at most 200 MB plus 20 times the size of a model file, whatever the file
declares."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from greybox.data.readers.mapping import read_mapping
from greybox.errors import DataError, FileFormatError, VehicleError
from greybox.files import MOST_CONTAINERS
from greybox.model.vehicle import read_vehicle
from greybox.model.vehicle_template import template_text
from greybox.residual import array_file
from greybox.residual.array_file import load_arrays
from greybox.residual.files import load_model
from greybox.simulators.sources import crazyflow
from tests.hardening import hostile

CHILD = """
import resource, sys
from greybox.errors import GreyboxError
from greybox.residual.files import load_model
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
before = peak()
try:
    load_model(sys.argv[1])
except GreyboxError as error:
    print(peak() - before, error)
"""


def body(content: str) -> str:
    return '{"schema": "greybox.model/1", "kind": "physics", "checksum": "", "a": ' + content + "}"


def many_points() -> str:
    tree = hostile.good_model("hybrid")
    tree["gp"]["points"] = 10**9
    return json.dumps(hostile.sealed(tree))


def many_steps() -> str:
    tree = hostile.good_model("physics")
    tree["model_sample_time"] = 1e-12
    return json.dumps(hostile.sealed(tree))


FILES = {
    "numbers": lambda: body("[" + "1e1," * 500_000 + "1]"),
    "texts": lambda: body("[" + '"ab",' * 500_000 + "1]"),
    "objects": lambda: body("[" + '{"a":[]},' * (MOST_CONTAINERS // 2 - 10) + "1]"),
    "points": many_points,
    "steps": many_steps,
}


@pytest.mark.parametrize("name", FILES)
def test_memory_is_bounded_by_the_size_of_the_file(name: str, tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_text(FILES[name]())
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    grown, line = done.stdout.split(maxsplit=1)
    assert str(path) in line or "GP posterior" in line
    assert float(grown) < 200 + 20 * path.stat().st_size / 2**20


def test_too_many_containers_are_refused_before_they_are_made(tmp_path: Path) -> None:
    path = tmp_path / "model.json"
    path.write_text(body("[" + "[]," * MOST_CONTAINERS + "1]"))
    with pytest.raises(FileFormatError, match="too many arrays"):
        load_model(path)


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no /dev/zero")
def test_a_file_without_end_is_refused() -> None:
    with pytest.raises(FileFormatError, match="more than 128 MiB"):
        load_model("/dev/zero")
    with pytest.raises(VehicleError, match="more than 256 KiB"):
        read_vehicle("/dev/zero")


READERS = {"vehicle": read_vehicle, "mapping": read_mapping, "parameters": crazyflow.tables}
"""Whatever reads the TOML of a stranger."""


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    "line",
    [
        ".".join("a" * 100_000) + " = 1",
        "[" + ".".join("a" * 50_000) + "]",
        "x = " + "[" * 50_000,
        "x = " + "{a=" * 20_000 + "1" + "}" * 20_000,
        "x = 0x" + "F" * 100_000,
        "mass = " + "9" * 6000,
        "when = 2026-99-99",
    ],
)
def test_costly_lines_of_toml_are_refused(line: str, reader: str, tmp_path: Path) -> None:
    path = tmp_path / "v.toml"
    path.write_text(f"{line}\n{template_text('x')}")
    if reader == "parameters" and "0x" in line:
        assert READERS[reader](path) == {}  # a number, and no craft
        return
    with pytest.raises((VehicleError, DataError, KeyError)) as caught:
        READERS[reader](path)
    assert len(str(caught.value)) < 2000


@pytest.mark.parametrize("depth", [150, 50_000])
def test_nesting_is_no_syntax_error(depth: int, tmp_path: Path) -> None:
    path = tmp_path / "map.toml"
    path.write_text("x = " + "[" * depth + "]" * depth)
    with pytest.raises(DataError, match="wrong schema" if depth < 200 else "nested too deeply"):
        read_mapping(path)


def archive(path: Path, entries: dict[str, tuple[int, int]], kind: str) -> None:
    """An .npz whose arrays declare some numbers of a kind and hold some zero bytes: name ->
    (numbers, bytes)."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, (declared, held) in entries.items():
            with file.open(f"{name}.npy", "w", force_zip64=True) as entry:
                form = {"descr": kind, "fortran_order": False, "shape": (declared,)}
                np.lib.format.write_array_header_1_0(entry, form)  # type: ignore[arg-type]
                for _ in range(held >> 20):
                    entry.write(bytes(1 << 20))


@pytest.mark.parametrize(
    ("entries", "kind", "said"),
    [
        ({"a": (5 << 17, 5 << 20)}, "<f8", "unpack to more than 4 MiB"),
        ({"a": (3 << 17, 3 << 20), "b": (3 << 17, 3 << 20)}, "<f8", "unpack to more than 4 MiB"),
        # a byte each on disk, eight as the doubles that they become
        ({"a": (1 << 20, 1 << 20)}, "|b1", "unpack to more than 4 MiB"),
        ({"a": (1 << 18, 1 << 20), "b": (1 << 19, 1 << 20)}, "<f2", "unpack to more than 4 MiB"),
        ({"a": (10**15, 1 << 20)}, "<f8", "cannot read the arrays"),
    ],
)
def test_a_bomb_of_arrays_is_refused(
    entries: dict[str, tuple[int, int]],
    kind: str,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(array_file, "LARGEST_ARRAYS", 4 << 20)
    archive(tmp_path / "gp.npz", entries, kind)
    assert (tmp_path / "gp.npz").stat().st_size < 100_000
    with pytest.raises(FileFormatError, match=said):
        load_arrays(tmp_path / "gp.npz")


@pytest.mark.parametrize("content", [b"", b"PK\3\4", b"\x93NUMPY", b"text"])
def test_what_is_no_archive_of_arrays_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "gp.npz").write_bytes(content)
    with pytest.raises(FileFormatError, match="cannot read the arrays"):
        load_arrays(tmp_path / "gp.npz")


def test_a_pipe_of_arrays_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "gp.npz")
    with pytest.raises(FileFormatError, match="no such file of arrays"):
        load_arrays(tmp_path / "gp.npz")


def test_control_characters_of_a_file_do_not_reach_the_terminal(tmp_path: Path) -> None:
    path = tmp_path / "v.toml"
    path.write_text(template_text("x").replace("[actuator]", '[actuator]\n"\\u001b[2J\\u202e" = 1'))
    with pytest.raises(KeyError) as caught:
        read_vehicle(path)
    assert str(caught.value).isprintable()
    assert r"\x1b[2J\u202e" in str(caught.value)
