"""`make test` and `make test-long` are all tests, each in one of them, and the gate runs both."""

from __future__ import annotations

import re
from pathlib import Path

from tests.conftest import LONG, is_long

TESTS = Path(__file__).parents[1]
ROOT = TESTS.parent


def test_the_gate_runs_what_the_readme_names():
    gate = (ROOT / ".ci/run").read_text(encoding="utf-8")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target, part in (("test", "quick"), ("test-long", "long")):
        assert re.search(rf"^make {target} ", gate, re.MULTILINE)
        assert re.search(rf"make {target}\b", readme)
        recipe = makefile.partition(f"\n{target}:")[2].partition("\n\n")[0]
        assert f"--part {part} " in recipe


def test_what_is_named_long_is_there():
    files = list(TESTS.rglob("test_*.py"))
    long = [f for f in files if is_long(f)]
    assert 0 < len(long) < len(files)
    for name in LONG:
        assert any(f.relative_to(TESTS).as_posix().startswith(name) for f in files), name
