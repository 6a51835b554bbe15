"""What the cache of compiled models gives is what this user put there; else it is built again and
said."""

from __future__ import annotations

import ctypes
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from greybox.estimation import build as build_module
from greybox.estimation import cache
from greybox.estimation.build import BuildError, build, compiler, opened

SOURCE = [("one.c", "int one(void) { return 1; }\n", ("-O1", "-fPIC"))]

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler here")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache of its own, and nothing remembered of another."""
    monkeypatch.setenv("GREYBOX_CACHE", str(tmp_path / "cache"))
    for remembered in (cache.cache_root, cache.say, compiler):
        remembered.cache_clear()
    build_module._TROUBLE.clear()
    yield tmp_path / "cache"
    for remembered in (cache.cache_root, cache.say, compiler):
        remembered.cache_clear()
    build_module._TROUBLE.clear()


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def changed(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def opened_to_others(path: Path) -> None:
    path.chmod(0o722)


def replaced_by_link(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


def replaced_by_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def replaced_by_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


DAMAGE = [cut, emptied, changed, opened_to_others, replaced_by_link, replaced_by_pipe]


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("what", ["library", "index"])
def test_a_file_that_is_not_as_it_was_is_built_again_and_said(folder, capfd, damage, what):
    path = build(SOURCE)
    good = path.read_bytes()
    index = next(
        p for p in path.parent.iterdir() if p.is_file() and p.suffix == "" and len(p.name) == 64
    )
    assert capfd.readouterr().err == ""
    damage(path if what == "library" else index)
    again = build(SOURCE)
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert "built again" in said
    assert again.read_bytes() == good
    assert again.stat().st_mode & 0o777 == 0o700
    assert build(SOURCE) == again
    assert capfd.readouterr().err == ""
    assert ctypes.CDLL(str(again)).one() == 1


def test_a_cut_library_does_not_end_the_command(folder):
    """The same through a process of its own, which SIGBUS would end."""
    program = f"from greybox.estimation.build import opened\nprint(opened({SOURCE!r}).one())\n"
    run = lambda: subprocess.run(  # noqa: E731
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert run().stdout == "1\n"
    for library in (folder / "build").glob("*.so"):
        cut(library)
    done = run()
    assert (done.returncode, done.stdout) == (0, "1\n")
    assert "built again" in done.stderr


def test_a_folder_that_others_may_write_is_closed_and_one_of_theirs_is_not_used(
    folder, capfd, monkeypatch
):
    folder.mkdir()
    folder.chmod(0o777)
    assert cache.cache_root() == folder
    assert not stat.S_IMODE(folder.stat().st_mode) & 0o022
    cache.cache_root.cache_clear()
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(folder.parent / "home"))
    real = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: real + 1)
    root = cache.cache_root()
    said = capfd.readouterr().err
    assert root != folder
    assert "belongs to user" in said


def test_processors_do_not_share_what_is_compiled_for_one(folder, monkeypatch):
    native = [("one.c", SOURCE[0][1], ("-O1", "-fPIC", "-march=native"))]
    keys = []
    for processor in ("one", "two"):
        monkeypatch.setattr(build_module, "_processor", lambda cc, processor=processor: processor)
        keys.append(
            (build_module._library(("cc",), native, ()), build_module._library(("cc",), SOURCE, ()))
        )
    assert keys[0][0] != keys[1][0]
    assert keys[0][1] == keys[1][1]


def test_two_writers_leave_one_good_entry(folder):
    program = f"from greybox.estimation.build import opened\nprint(opened({SOURCE!r}).one())\n"
    both = [
        subprocess.Popen(
            [sys.executable, "-c", program],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    assert [p.communicate() for p in both] == [("1\n", "")] * 2
    assert ctypes.CDLL(str(build(SOURCE))).one() == 1
    assert not list((folder / "build").glob("build-*"))


@pytest.mark.parametrize(
    "script",
    [
        "echo 'internal error' >&2; exit 1",
        "exit 0",
        "kill -9 $$",
        "printf '\\377\\376' >&2; exit 4",
    ],
    ids=["complains", "writes nothing", "is killed", "says no text"],
)
def test_a_compiler_that_fails_leaves_the_virtual_machine_and_one_line(
    folder, monkeypatch, tmp_path, capfd, script
):
    cc = tmp_path / "cc"
    cc.write_text(f"#!/bin/sh\n{script}\n")
    cc.chmod(0o755)
    monkeypatch.setenv("GREYBOX_COMPILER", str(cc))
    compiler.cache_clear()
    with pytest.raises(BuildError):
        build(SOURCE)
    assert opened(SOURCE) is None
    assert opened(SOURCE) is None
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert "virtual machine" in said or "CasADi's VM" in said
    assert build_module.trouble().split(": ")[-1] in said
    assert not list((folder / "build").iterdir())
