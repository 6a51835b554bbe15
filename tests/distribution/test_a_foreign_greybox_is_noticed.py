"""The other project of the package index that is called greybox is noticed, and every hint names
the right distribution."""

from __future__ import annotations

import json
import re
import sys
import tomllib
from pathlib import Path

import pytest

from greybox.cli import main
from greybox.distribution import NAME, TORCH_CPU, VERSION, install_line, other_greybox

ROOT = Path(__file__).resolve().parents[2]


def install(folder: Path, *, files: str, name: str = "greybox") -> None:
    """Metadata as pip leaves it."""
    info = folder / "greybox-1.0.10.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0.10\n")
    (info / "RECORD").write_text(f"{files},,\ngreybox-1.0.10.dist-info/METADATA,,\n")


def test_it_is_noticed_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path, files="greybox/__init__.py")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    assert other_greybox() == "1.0.10"
    main(["effects"])
    said = capsys.readouterr().err
    assert "another package called greybox (1.0.10)" in said
    assert f"pip install --force-reinstall {NAME}" in said


def test_a_checkout_is_not_taken_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, files="__editable___greybox_finder.py")
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    assert other_greybox() is None


def test_the_project_has_the_name_and_version_that_hints_give() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["project"]["name"] == NAME
    assert (
        project["tool"]["setuptools"]["dynamic"]["version"]["attr"]
        == "greybox.distribution.VERSION"
    )
    assert re.fullmatch(r"\d+\.\d+\.\d+", VERSION)


def test_every_extra_that_a_hint_names_is_declared() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    files = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
    files += [
        p for room in ("greybox", "mpc_export", "scenarios") for p in (ROOT / room).rglob("*.py")
    ]
    wrong = []
    for path in files:
        text = path.read_text(encoding="utf-8")
        wrong += [f"{path}: {m}" for m in re.findall(r"\bgreybox\[\w+\]", text)]
        named = re.findall(rf"{NAME}\[(\w+)\]", text) + re.findall(r'install_line\("(\w+)"\)', text)
        wrong += [f"{path}: no extra {m}" for m in named if m not in extras]
    assert wrong == []


def test_pytorch_comes_from_its_index_of_cpu_builds() -> None:
    assert install_line("gp").startswith(f"pip install torch --index-url {TORCH_CPU} && ")
    assert install_line("logs") == f'pip install "{NAME}[logs]"'


def test_every_file_that_states_a_version_states_this_one() -> None:
    assert f"version: {VERSION}" in (ROOT / "CITATION.cff").read_text()
    assert json.loads((ROOT / "codemeta.json").read_text())["version"] == VERSION
    assert f'set version = "{VERSION}"' in (ROOT / "recipe" / "meta.yaml").read_text()
    assert f"## {VERSION}" in (ROOT / "CHANGELOG.md").read_text()


def test_every_work_that_the_paper_cites_is_in_its_bibliography() -> None:
    cited = set(re.findall(r"@(\w+)", (ROOT / "paper" / "paper.md").read_text()))
    listed = set(re.findall(r"^@\w+\{(\w+),", (ROOT / "paper" / "paper.bib").read_text(), re.M))
    assert cited == listed
