"""A number that several files need is assigned in one of them: a step of BIC, gravity, the start of
a segment."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from greybox.data.segment import START_SECONDS
from greybox.model.effects import effect_by_name
from greybox.model.example import example_vehicle
from tests.architecture.test_imports import ROOT, files


class Number(NamedTuple):
    """A numeric literal: the name that it is given, "" for none, and the file and line where it
    stands."""

    name: str
    value: float
    file: str
    line: int


ONCE = {
    "CLEAR": (r"CLEAR(_BIC)?", 10.0, "greybox/statistics/evidence.py"),
    "CLEAR_LOG_RATIO": (r"CLEAR(_LOG)?(_RATIO)?", 5.0, None),
    "BLOCK_SECONDS": (r"BLOCK(_SECONDS)?", 0.5, "greybox/statistics/blocks.py"),
    "START_SECONDS": (
        r"(START|LEAD|start|lead)(_SECONDS|_seconds)?",
        0.1,
        "greybox/data/segment.py",
    ),
    "RUN_IN": (r"RUN_IN", 2.0, "greybox/linear/validation.py"),
    "SPACING": (r"SPACING", 0.1, "greybox/baselines/compare_scores.py"),
    "STRETCH": (r"STRETCH|GAP", 2.5, "greybox/data/resampling.py"),
    "AVERAGE_FROM": (r"AVERAGE_FROM|FAST", 1.5, "greybox/data/resampling.py"),
    "GRAVITY": (r".*", 9.80665, "greybox/frames.py"),
    "milli-gravity": (r".*", 9.80665e-3, None),
    "rounded gravity": (r".*", 9.81, "greybox/simulators/targets/rotorpy.py"),
}
"""What is meant -> (names that it goes by, its value, the one file that may assign it; None: it is
derived)."""

APART = ("plants", "excitation")
"""Rooms of greybox that share no number with what is fitted, as they judge it."""


def plain(node: ast.expr | None) -> float | None:
    """The value of a numeric literal."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        inner = plain(node.operand)
        return None if inner is None else -inner
    number = isinstance(node, ast.Constant) and type(node.value) in (int, float)
    return float(node.value) if number else None


def given(node: ast.AST) -> Iterator[tuple[str, ast.expr | None]]:
    """(name, value) pairs of an assignment, also of several at once, and of the defaults of a
    function."""
    if isinstance(node, ast.Assign):
        for target in node.targets:
            several = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
            names = target.elts if several else [target]
            values = node.value.elts if several else [node.value]
            yield from ((ast.unparse(n), v) for n, v in zip(names, values, strict=True))
    elif isinstance(node, ast.AnnAssign):
        yield ast.unparse(node.target), node.value
    elif isinstance(node, ast.arguments):
        places = [*node.posonlyargs, *node.args]
        late = places[len(places) - len(node.defaults) :]
        yield from ((a.arg, d) for a, d in zip(late, node.defaults, strict=True))
        yield from ((a.arg, d) for a, d in zip(node.kwonlyargs, node.kw_defaults, strict=True))


def numbers(path: Path) -> Iterator[Number]:
    """Every numeric literal of a file, with the name that it is given."""
    where = path.relative_to(ROOT).as_posix()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    named = {id(v): n for node in ast.walk(tree) for n, v in given(node) if v is not None}
    for node in ast.walk(tree):
        value = plain(node) if isinstance(node, ast.expr) else None
        if value is not None:
            yield Number(named.get(id(node), ""), value, where, node.lineno)


@pytest.fixture(scope="module")
def all_numbers() -> list[Number]:
    judged = (p for top in ("greybox", "mpc_export") for p in files(top))
    return [n for p in judged if p.parts[len(ROOT.parts) + 1] not in APART for n in numbers(p)]


@pytest.mark.parametrize("meant", ONCE)
def test_it_is_assigned_once(meant: str, all_numbers: list[Number]):
    names, value, home = ONCE[meant]
    found = [n for n in all_numbers if n.value == value and re.fullmatch(names, n.name)]
    assert [n.file for n in found] == ([] if home is None else [home]), found


def test_the_scan_sees_every_way_to_assign(tmp_path, monkeypatch):
    monkeypatch.setitem(numbers.__globals__, "ROOT", tmp_path)
    text = "A, B = 0.1, -4\nC: float = 3\n\ndef f(a, d=2.0, *, e=9.81):\n    return 7 * a\n"
    path = tmp_path / "code.py"
    path.write_text(text)
    seen = {(n.name, n.value) for n in numbers(path)}
    assert {("A", 0.1), ("B", -4.0), ("C", 3.0), ("d", 2.0), ("e", 9.81), ("", 7.0)} <= seen


def test_the_start_of_a_segment_is_as_long_as_the_longest_delay_of_a_command():
    (delay,) = effect_by_name("command_delay").parameters(example_vehicle())
    assert delay.upper <= START_SECONDS
