"""Reading takes at most 200 MB plus 20 times the size of a model file, whatever the file declares."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from greybox.errors import FileFormatError, VehicleError
from greybox.files import MOST_CONTAINERS
from greybox.model.vehicle import read_vehicle
from greybox.model.vehicle_template import template_text
from greybox.residual.files import load_model
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
        [sys.executable, "-c", CHILD, str(path)], capture_output=True, text=True, check=True, timeout=60
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


@pytest.mark.parametrize(
    "line",
    [
        ".".join("a" * 100_000) + " = 1",
        "x = " + "[" * 50_000,
        "x = 0x" + "F" * 100_000,
        "mass = " + "9" * 6000,
        "mass = 1e999",
    ],
)
def test_costly_lines_of_vehicle_files_are_refused(line: str, tmp_path: Path) -> None:
    path = tmp_path / "v.toml"
    path.write_text(f"{line}\n{template_text('x')}")
    with pytest.raises((VehicleError, KeyError)) as caught:
        read_vehicle(path)
    assert len(str(caught.value)) < 2000


def test_control_characters_of_a_file_do_not_reach_the_terminal(tmp_path: Path) -> None:
    path = tmp_path / "v.toml"
    path.write_text(template_text("x").replace("[actuator]", '[actuator]\n"\\u001b[2J\\u202e" = 1'))
    with pytest.raises(KeyError) as caught:
        read_vehicle(path)
    assert str(caught.value).isprintable()
    assert r"\x1b[2J\u202e" in str(caught.value)
