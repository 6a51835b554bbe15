"""The rules of docs/hardening.md name the tests that show them, and there is none without a
test."""

from __future__ import annotations

import re

import pytest

from tests.docs.pages import ROOT

PAGE = (ROOT / "docs" / "hardening.md").read_text(encoding="utf-8")


def rules() -> list[tuple[str, str]]:
    """(Rule, test) of every line of the block under "Rules and their tests"; a test is
    file::function."""
    block = PAGE.split("## Rules and their tests")[1].split("```")[1].splitlines()[1:]
    found: list[tuple[str, str]] = []
    for line in block:
        if line.startswith("    "):
            found.append((found[-1][0] if found[-1][1] else found.pop()[0], line.strip()))
        elif line:
            found.append((line, ""))
    return found


def test_every_rule_has_a_test() -> None:
    assert len({rule for rule, _ in rules()}) >= 30
    assert [rule for rule, test in rules() if not test] == []


@pytest.mark.parametrize(("rule", "test"), rules())
def test_the_test_is_there(rule: str, test: str) -> None:
    file, name = test.split("::")
    text = (ROOT / "tests" / file).read_text(encoding="utf-8")
    assert re.search(rf"^def {name}\(", text, flags=re.MULTILINE), f"{rule}: {test}"
