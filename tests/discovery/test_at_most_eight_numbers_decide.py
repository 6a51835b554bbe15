"""Decisions rest on one frozen record of at most eight numbers; every other number of the package
is listed here with what it does instead, and the package stays short enough to be read."""

from __future__ import annotations

import ast
import inspect
from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest

import greybox.discovery
from greybox.discovery.rules import RULES, Rules

FOLDER = Path(greybox.discovery.__file__).parent
LINES, OWN, FILE, WORDS, NUMBERS = 3000, 120, 200, 200, 8

PROPOSES = "decides what is tried or how long; what is taken is the evidence"
COMPUTES = "accuracy of a computation"
SAYS = "how something is said"
ELSEWHERE = {
    "propose.CLEARLY": PROPOSES,
    "propose.LAGS": PROPOSES,
    "propose.LEVEL": PROPOSES,
    "propose.DEAD": COMPUTES,
    "name.EXACT": "below it no manoeuvre is sought",
    "name.LOG10": SAYS,
}
"""module.CONSTANT -> what it does."""
COMPARED = {
    "propose.instead: 0.5": PROPOSES,
    "search.doubted: 3": PROPOSES,
}
"""module.function: number in a comparison -> what it does. Zero, one and two need no reason."""


def modules() -> dict[str, ast.Module]:
    paths = sorted(p for p in FOLDER.glob("*.py") if p.name != "__init__.py")
    return {p.stem: ast.parse(p.read_text(encoding="utf-8")) for p in paths}


def numbers(node: ast.AST) -> list[float]:
    """Every numeric literal below a node."""
    return [
        float(n.value)
        for n in ast.walk(node)
        if isinstance(n, ast.Constant) and type(n.value) in (int, float)
    ]


def constants() -> set[str]:
    """module.NAME of every constant that holds a number."""
    out = set()
    for module, tree in modules().items():
        for node in tree.body:
            if isinstance(node, ast.Assign) and numbers(node.value):
                out |= {f"{module}.{t.id}" for t in node.targets if isinstance(t, ast.Name)}
    return out


def compared() -> set[str]:
    """module.function: number of every number that something is compared with."""
    out = set()
    for module, tree in modules().items():
        for function in (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)):
            for node in (n for n in ast.walk(function) if isinstance(n, ast.Compare)):
                out |= {
                    f"{module}.{function.name}: {v:g}" for v in numbers(node) if v not in (0, 1, 2)
                }
    return out


def test_they_are_one_frozen_record_and_each_says_its_source():
    fields = Rules.__dataclass_fields__
    assert 0 < len(fields) <= NUMBERS
    with pytest.raises(FrozenInstanceError):
        RULES.trace = 0.5  # type: ignore[misc]
    source = inspect.getsource(Rules)
    for name, field in fields.items():
        after = source.split(f"    {name}: {field.type}", 1)[1].split("\n", 1)[1]
        assert after.lstrip().startswith('"""') and len(after.split('"""')[1]) > 60, name


def test_every_other_number_has_another_purpose():
    assert constants() == set(ELSEWHERE)
    assert compared() == set(COMPARED)


def test_nothing_outside_of_the_record_reads_an_effort_to_judge():
    """`name` says the verdicts, `left` what is left of them."""
    for module in ("name", "left", "result", "further"):
        assert "effort" not in (FOLDER / f"{module}.py").read_text(encoding="utf-8").lower(), module


def test_the_package_can_be_read():
    """The search; what a model of the user's own offers to it, the types of its file, and what is
    said of it for people, are short files of their own."""
    lines = {p.stem: len(p.read_text(encoding="utf-8").splitlines()) for p in FOLDER.glob("*.py")}
    assert lines.pop("own_cause") <= OWN
    assert lines.pop("document") <= FILE
    assert lines.pop("words") <= WORDS
    assert sum(lines.values()) <= LINES
