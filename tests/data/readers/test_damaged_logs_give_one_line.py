"""A damaged, truncated or foreign file gives one line and exit code 2, or is read: never a
traceback, in no format."""

from __future__ import annotations

import functools
import os
import random
import tempfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from greybox.cli import main
from greybox.data.logs import read_table
from greybox.data.readers import read_recording
from greybox.errors import DataError, GreyboxError
from tests.data.readers import writers as w

FORMATS = {
    "ulog": ("f.ulg", "pyulog"),
    "crazyflie": ("log00", "numpy"),
    "betaflight": ("f.bbl", "orangebox"),
    "ardupilot": ("f.bin", "numpy"),
    "bag": ("f.bag", "rosbags"),
    "mcap": ("f.mcap", "rosbags"),
    "sqlite": ("f.db3", "rosbags"),
    "parquet": ("f.parquet", "pyarrow"),
    "csv": ("f.csv", "numpy"),
}
"""MAT files are read in a process of their own, which takes a second each; they have a test of
their own below."""


@functools.cache
def intact(name: str) -> bytes:
    """A good file of 60 rows in this format."""
    c = w.channels(rows=60)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log"
        match name:
            case "ulog":
                w.write_ulog(path, c)
            case "crazyflie":
                w.write_crazyflie(path, c)
            case "ardupilot":
                w.write_ardupilot(path, c)
            case "betaflight":
                w.write_betaflight(path, c)
            case "parquet":
                w.write_parquet(path, c)
            case "matlab":
                path = w.write_mat(path.with_suffix(".mat"), c)
            case "csv":
                w.write_csv(path, c)
            case "bag":
                w.write_ros(path, c, kind="bag")
            case _:
                w.write_ros(path, c, kind=name)
                path = next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))
        return path.read_bytes()


def damage(content: bytes, seed: int) -> bytes:
    """Cut, flipped, inserted, removed or repeated bytes, more often near the beginning, where the
    headers are."""
    rng = random.Random(seed)
    data = bytearray(content)
    if rng.random() < 0.2:
        return bytes(data[: rng.randrange(len(data))])
    reach = min(len(data), 1500) if rng.random() < 0.6 else len(data)
    for _ in range(rng.choice([1, 1, 2, 4, 16, 64])):
        i = rng.randrange(reach)
        match rng.randrange(5):
            case 0:
                data[i] = rng.randrange(256)
            case 1:
                data[i] = rng.choice([0, 255, 127, 128])
            case 2:
                data[i:i] = rng.randbytes(rng.randrange(1, 9))
            case 3:
                del data[i : i + rng.randrange(1, 9)]
                reach = min(reach, len(data))
            case _:
                j = rng.randrange(len(data))
                data[i : i + 8] = data[j : j + 8]
    return bytes(data)


def survives(path: Path) -> bool:
    """Whether the file was read; a refusal must be one line."""
    said = ""
    try:
        assert read_table(path).n >= 2
    except GreyboxError as error:
        said = str(error)
    assert "\n" not in said
    assert len(said) < 1000
    return not said


@pytest.mark.parametrize("name", FORMATS)
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(seed=st.integers(0, 2**32))
def test_damage_is_survived_or_said(name: str, tmp_path: Path, seed: int) -> None:
    file, library = FORMATS[name]
    pytest.importorskip(library)
    path = tmp_path / file
    path.write_bytes(damage(intact(name), seed))
    survives(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_thousands_of_damaged_files(name: str, tmp_path: Path) -> None:
    file, library = FORMATS[name]
    pytest.importorskip(library)
    path = tmp_path / file
    read = 0
    for seed in range(3000):
        path.write_bytes(damage(intact(name), seed))
        read += survives(path)
    assert 0 < read < 3000


@pytest.mark.parametrize("seed", range(6))
def test_a_damaged_mat_file_does_not_take_the_interpreter_along(seed: int, tmp_path: Path) -> None:
    path = tmp_path / "f.mat"
    path.write_bytes(damage(intact("matlab"), seed))
    survives(path)


def test_a_reader_that_crashes_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process that reads MAT files dies of a signal, as scipy's parser does on some files."""
    from greybox.data.readers import matlab

    child = tmp_path / "mat_child.py"
    child.write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
    monkeypatch.setattr(matlab, "__file__", str(tmp_path / "matlab.py"))
    path = tmp_path / "f.mat"
    path.write_bytes(intact("matlab"))
    with pytest.raises(GreyboxError, match="its reader crashed on it"):
        read_table(path)


@pytest.mark.parametrize("name", [*FORMATS, "matlab"])
@pytest.mark.parametrize("keep", [0, 1, 7, 40, 300])
def test_the_command_line_says_it_in_one_line(
    name: str, keep: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    file, library = FORMATS.get(name, ("f.mat", "scipy"))
    pytest.importorskip(library)
    path = tmp_path / file
    path.write_bytes(intact(name)[:keep])
    before = sorted(tmp_path.iterdir())
    assert (
        main(
            [
                "inspect",
                str(path),
                "--out",
                str(tmp_path / "out.csv"),
                "--json",
                str(tmp_path / "out.json"),
            ]
        )
        == 2
    )
    said = capfd.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert said.err.startswith("greybox inspect: ")
    assert sorted(tmp_path.iterdir()) == before


def test_a_log_that_was_cut_off_is_read_up_to_there(tmp_path: Path) -> None:
    c = w.channels(rows=200)
    for name, write in (
        ("f.ulg", w.write_ulog),
        ("log00", w.write_crazyflie),
        ("f.bbl", w.write_betaflight),
    ):
        pytest.importorskip({"f.ulg": "pyulog", "f.bbl": "orangebox"}.get(name, "numpy"))
        path = write(tmp_path / name, c)
        whole = path.read_bytes()
        path.write_bytes(whole[: int(0.8 * len(whole))])
        raw = read_table(path)
        assert 120 <= raw.n < 200, name
        n = raw.n - 2
        assert abs(raw.channels["p"][:n] - c["p"][:n]).max() < 0.02
        # A ULog file has no end mark: that it was cut cannot be seen.
        assert name == "f.ulg" or any("read" in n for n in raw.notes), raw.notes


@pytest.mark.parametrize(
    ("module", "name"),
    [("pyulog", "ulog"), ("rosbags", "bag"), ("orangebox", "betaflight"), ("pyarrow", "parquet")],
)
def test_a_missing_library_is_named_with_its_extra(
    module: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(module)
    path = tmp_path / FORMATS[name][0]
    path.write_bytes(intact(name))
    import sys

    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(GreyboxError, match=rf"'{module}'.*greybox-sysid\[logs\]"):
        read_table(path)


def test_a_message_format_that_unfolds_without_end_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    log = w.ULogWriter()
    for i in range(9):
        log.definitions += log._message("F", f"n{i}:uint64_t timestamp;n{i + 1}[99] a;".encode())
    log.definitions += log._message("F", b"n9:uint64_t timestamp;")
    log.subscriptions += log._message("A", b"\0\0\0n0")
    path = tmp_path / "bomb.ulg"
    path.write_bytes(log.bytes())
    with pytest.raises(GreyboxError, match="more than 20000 fields"):
        read_table(path)


def test_a_pipe_or_a_device_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "log.csv")
    for path in (tmp_path / "log.csv", "/dev/zero"):
        with pytest.raises(DataError, match="a pipe or a device, not a file"):
            read_recording(path)
