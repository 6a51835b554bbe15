"""Every command that writes says in one line that it cannot, before its work; all files go through
one place."""

from __future__ import annotations

import argparse
import ast
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from greybox.cli import COMMANDS, build_parser, main
from greybox.files import OutputError, check_writable, write_json

ROOT = Path(__file__).resolve().parents[2]
WRITERS = {
    "greybox/files.py": "the one place",
    "greybox/estimation/build.py": "a temporary folder in the cache of compiled models",
    "greybox/estimation/cache.py": "the cache of compiled models",
    "greybox/commands/missing_effect.py": "below the folder of the demo's --out, which is checked "
    "before",
    "greybox/commands/selftest_checks.py": "a temporary folder",
    "greybox/data/readers/mat_child.py": "a temporary folder of its parent",
    "greybox/residual/laws/effect_file.py": "a temporary folder",
    "greybox/plants/flight_log.py": "logs of a simulated craft, which nothing reads before they "
    "are whole",
    "greybox/plants/vehicle_file.py": "the vehicle file of a simulated craft, likewise",
    "greybox/commands/mpc_own.py": "the folder of --out, which is checked before",
    "mpc_export/acados.py": "inside the temporary folder of a bundle, which is moved when it is "
    "whole",
    "mpc_export/bundle.py": "the same",
    "mpc_export/bundle_cache.py": "the cache of bundles",
    "mpc_export/place.py": "the folder that holds it",
    "mpc_export/c_code.py": "the same",
    "mpc_export/c_model.py": "the same",
    "mpc_export/fmu.py": "the same",
    "mpc_export/mission/campaign.py": "the folder of --out, which is checked before",
    "mpc_export/tube/solver.py": "the cache of compiled controllers",
}
"""Files that may open a file for writing, and where."""
WRITING = {
    "write_text",
    "write_bytes",
    "mkdir",
    "makedirs",
    "copytree",
    "copyfile",
    "touch",
    "rename",
}


def parsers() -> Iterator[tuple[list[str], argparse.ArgumentParser]]:
    """Every command, with its parser; `vehicle` has commands of its own."""

    def below(
        words: list[str], parser: argparse.ArgumentParser
    ) -> Iterator[tuple[list[str], argparse.ArgumentParser]]:
        inner = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
        if not inner:
            yield words, parser
        for action in inner:
            for name, child in action.choices.items():
                yield from below([*words, name], child)

    yield from below([], build_parser())


def lines() -> list[list[str]]:
    """A command line for every option of every command that names what is written; inputs are files
    that there are not."""
    out = []
    for words, parser in parsers():
        needed: list[str] = []
        for action in parser._actions:
            if action.required:
                value = str(next(iter(action.choices))) if action.choices else "missing"
                needed += [action.option_strings[0], value] if action.option_strings else [value]
        for option in ("--out", "--json"):
            if option in parser._option_string_actions:
                asked = list(needed)
                if option in asked:
                    del asked[asked.index(option) : asked.index(option) + 2]
                out.append([*words, *asked, option])
    return out


def test_every_command_is_here() -> None:
    asked = {line[0] for line in lines()}
    assert asked == set(COMMANDS) - {"completion", "selftest"}  # these write nothing that stays


@pytest.mark.parametrize("line", lines(), ids=" ".join)
def test_a_place_that_cannot_be_is_refused_before_the_work(
    line: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("here")
    assert main([*line, "file/below"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "cannot write: Not a directory" in said.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file"]


def test_a_file_is_no_folder_and_a_folder_no_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("old")
    with pytest.raises(OutputError, match="Not a directory"):
        check_writable(tmp_path / "file", folder=True)
    with pytest.raises(OutputError, match="Is a directory"):
        check_writable(tmp_path)
    check_writable(tmp_path / "file")
    check_writable(tmp_path, folder=True)
    check_writable(tmp_path / "new" / "below", folder=True)


FULL = """
import json, resource, sys
from greybox.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))  # no byte fits into any file
for line in json.loads(sys.argv[1]):
    print(main([*line, "there/below"]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
def test_a_full_disk_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", FULL, json.dumps(lines())],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        timeout=120,
    )
    assert done.stdout.split() == ["2"] * len(lines())
    said = done.stderr.splitlines()
    assert len(said) == len(lines())
    assert all("cannot write: File too large" in line for line in said)
    assert not list((tmp_path / "there").iterdir())


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("old")
    tmp_path.chmod(0o500)
    try:
        for name in ("file", "new", "."):
            with pytest.raises(OutputError, match="Permission denied"):
                check_writable(tmp_path / name, folder=name == ".")
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_disk_that_fills_up_later_leaves_the_old_file(tmp_path: Path) -> None:
    write_json(tmp_path / "old.json", {"a": 1})
    (tmp_path / "new.json").symlink_to("/dev/full")
    with pytest.raises(OutputError, match="No space left"):
        write_json(tmp_path / "new.json", {"a": 2})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new.json", "old.json"]


def test_all_files_are_written_in_known_places() -> None:
    found = set()
    for folder in ("greybox", "mpc_export"):
        for path in (ROOT / folder).rglob("*.py"):
            source = path.read_text(encoding="utf-8")
            if "examples" in path.parts or not any(word in source for word in (*WRITING, "open(")):
                continue
            for node in ast.walk(ast.parse(source)):
                if not isinstance(node, ast.Call):
                    continue
                name = (
                    node.func.attr
                    if isinstance(node.func, ast.Attribute)
                    else getattr(node.func, "id", "")
                )
                mode = [
                    a.value
                    for a in [*node.args[1:2], *(k.value for k in node.keywords if k.arg == "mode")]
                    if isinstance(a, ast.Constant) and isinstance(a.value, str)
                ]
                if name in WRITING or (
                    name == "open" and set("".join(mode)) & set("wax") and path.name != "cli.py"
                ):
                    found.add(str(path.relative_to(ROOT)))
    assert found <= set(WRITERS)
