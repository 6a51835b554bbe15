"""Every row of docs/accuracy.md names a test, or a command, that is there; a row marked slow names
one that is."""

from __future__ import annotations

import importlib.util
import re

from tests.docs.pages import ROOT

PAGE = (ROOT / "docs" / "accuracy.md").read_text()


def test_tests_exist() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", PAGE)
    assert len(named) > 40
    absent = [
        f"{file}::{name}"
        for file, name in named
        if not (ROOT / file).exists() or (name and f"def {name}(" not in (ROOT / file).read_text())
    ]
    assert not absent


def test_commands_exist() -> None:
    modules = set(re.findall(r"`python -m ([\w.]+)", PAGE)) | {
        script.replace("/", ".") for script in re.findall(r"`python (benchmarks/\w+)\.py", PAGE)
    }
    assert len(modules) > 8
    assert [m for m in sorted(modules) if importlib.util.find_spec(m) is None] == []


def test_slow_is_said_where_it_is() -> None:
    wrong = []
    for row in PAGE.splitlines():
        named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", row)
        for file, name in named:
            text = (ROOT / file).read_text()
            tests = re.findall(r"((?:^@.*\n)*)^def (test_\w+)", text, flags=re.MULTILINE)
            chosen = [marks for marks, test in tests if not name or test == name]
            if all("pytest.mark.slow\n" in marks for marks in chosen) != ("*slow*" in row):
                wrong.append(row)
    assert not wrong


def test_every_row_of_a_table_has_its_proof() -> None:
    rows = [
        r for r in PAGE.splitlines() if r.startswith("| ") and not r.startswith(("| what", "|---"))
    ]
    assert [r for r in rows if "`tests/" not in r and "`python " not in r] == []
