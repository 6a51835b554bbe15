"""What can be tried of Windows and macOS on Linux: no make, no compiler, nothing that only POSIX
has, spawned processes, lines that end in CR LF, blanks and other letters in paths, an installation
that cannot be written."""

from __future__ import annotations

import ast
import gzip
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from greybox.data.logs import read_table
from greybox.examples import flight_path, vehicle_path
from greybox.model.vehicle import read_vehicle
from tests.docs.pages import ROOT

MAPPING = 'schema = "greybox.mapping/1"\r\n[battery]\r\nfields = ["pwr_pm_vbat"]\r\n'


def run(
    folder: Path, *words: str, code: int = 0, root: Path = ROOT
) -> subprocess.CompletedProcess[str]:
    """A command on the foreign system, in a folder."""
    done = subprocess.run(
        [
            sys.executable,
            "-X",
            "warn_default_encoding",
            "-m",
            "tests.packaging.foreign_system",
            *words,
        ],
        cwd=folder,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
        env={**os.environ, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr, done.stderr
    return done


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with blanks and letters that are not ASCII, vehicle file and flights with CR LF."""
    folder = tmp_path_factory.mktemp("Eigene Dateien") / "Flüge über Ωmega 飞行"
    folder.mkdir()
    text = vehicle_path("nanobench").read_text(encoding="utf-8")
    (folder / "Größe.toml").write_bytes(text.replace("\n", "\r\n").encode())
    for name in ("B2_circle_fast_rep1", "B3_figure8_fast_rep1"):
        lines = gzip.decompress(flight_path("nanobench", name).read_bytes()).decode().splitlines()
        (folder / f"{name} é.csv").write_bytes("\r\n".join(lines[:1200]).encode() + b"\r\n")
    return folder


def test_files_with_other_ends_of_lines_and_paths_are_the_same(desk: Path):
    vehicle = read_vehicle(desk / "Größe.toml")
    assert vehicle == read_vehicle(vehicle_path("nanobench"))
    ours = read_table(flight_path("nanobench", "B2_circle_fast_rep1"), vehicle)
    theirs = read_table(desk / "B2_circle_fast_rep1 é.csv", vehicle)
    for name, values in theirs.channels.items():
        np.testing.assert_array_equal(values, ours.channels[name][: len(values)])
    marked = desk / "with a mark.toml"
    marked.write_bytes(
        "\N{ZERO WIDTH NO-BREAK SPACE}".encode() + (desk / "Größe.toml").read_bytes()
    )
    assert read_vehicle(marked) == vehicle  # as Notepad writes UTF-8


def test_commands_need_nothing_that_only_posix_has(desk: Path):
    log = "B2_circle_fast_rep1 é.csv"
    said = run(desk, "check", "--vehicle", "Größe.toml", log, "--json", "geprüft.json").stdout
    assert "every axis is excited" in said
    assert json.loads((desk / "geprüft.json").read_text(encoding="utf-8"))
    (desk / "Zuordnung.toml").write_bytes(MAPPING.encode())
    run(desk, "inspect", log, "--mapping", "Zuordnung.toml", code=1)
    assert "Größe.toml" in run(desk, "vehicle", "check", "fehlt Größe.toml", code=2).stderr


def test_text_files_are_opened_with_their_encoding():
    """Elsewhere the default is not UTF-8: a file that is read by it is another one."""
    bare = []
    for path in (
        p for package in ("greybox", "mpc_export") for p in (ROOT / package).rglob("*.py")
    ):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            given = {k.arg for k in node.keywords}
            method = node.func.attr if isinstance(node.func, ast.Attribute) else ""
            alone = (
                method in ("read_text", "write_text")
                and not given & {"encoding", None}
                and len(node.args) < 2
            )
            if alone or (
                "text" in given
                and "encoding" not in given
                and method in ("run", "Popen", "check_output")
            ):
                bare.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert bare == []


@pytest.mark.slow
def test_a_fit_and_its_export_work_there(desk: Path):
    train, test = "B2_circle_fast_rep1 é.csv", "B3_figure8_fast_rep1 é.csv"
    effects = "motor_lag,command_delay,rotor_drag,rotational_damping"
    words = [
        "--vehicle",
        "Größe.toml",
        "--train",
        train,
        "--test",
        test,
        "--manual",
        "--effects",
        effects,
    ]
    run(desk, "fit", *words, "--max-iterations", "12", "--out", "Ergebnis 1", code=1)
    model = str(Path("Ergebnis 1") / "model.json")
    assert "How it answers to commands" in (desk / "Ergebnis 1" / "report.html").read_text(
        encoding="utf-8"
    )
    run(desk, "export", model, "--even-so", "--name", "quad", "--out", "Bündel")
    assert (desk / "Bündel" / "manifest.json").exists()


@pytest.mark.slow
def test_an_installation_that_cannot_be_written_serves(desk: Path, tmp_path: Path):
    root = tmp_path / "read only"
    for package in ("greybox", "mpc_export"):
        shutil.copytree(
            ROOT / package, root / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    (root / "tests" / "packaging").mkdir(parents=True)
    shutil.copy(ROOT / "tests" / "packaging" / "foreign_system.py", root / "tests" / "packaging")
    before = {p: p.stat().st_mtime_ns for p in root.rglob("*")}
    for path in sorted(root.rglob("*"), reverse=True):
        path.chmod(0o555 if path.is_dir() else 0o444)
    try:
        assert "greybox works here" in run(desk, "selftest", root=root).stdout
    finally:
        for path in root.rglob("*"):
            path.chmod(0o755 if path.is_dir() else 0o644)
    assert {p: p.stat().st_mtime_ns for p in root.rglob("*")} == before
