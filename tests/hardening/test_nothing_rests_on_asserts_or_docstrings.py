"""Python -OO, which drops asserts and docstrings, changes nothing: helps are whole, asserts only
tell types."""

from __future__ import annotations

import ast
import hashlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HELPS = """
import argparse, sys
from greybox.cli import build_parser
def texts(parser):
    yield parser.format_help()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from texts(command)
sys.stdout.write("\\n".join(texts(build_parser())))
"""


def test_every_command_helps_alike() -> None:
    helps = [
        subprocess.run(
            [sys.executable, *flags, "-c", HELPS], capture_output=True, text=True, check=True
        ).stdout
        for flags in ([], ["-OO"])
    ]
    assert len(helps[0]) > 10_000
    assert helps[0] == helps[1]


def sources() -> Iterator[Path]:
    for package in ("greybox", "mpc_export"):
        yield from sorted((ROOT / package).rglob("*.py"))


def tells_a_type(test: ast.expr) -> bool:
    """`isinstance(x, T)`, `x is not None`, and several of them with `and`: what mypy asks for."""
    if isinstance(test, ast.BoolOp):
        return isinstance(test.op, ast.And) and all(map(tells_a_type, test.values))
    if isinstance(test, ast.Call):
        return isinstance(test.func, ast.Name) and test.func.id == "isinstance"
    return isinstance(test, ast.Compare) and all(
        isinstance(o, (ast.Is, ast.IsNot)) for o in test.ops
    )


def test_asserts_only_tell_types() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno} {ast.unparse(node.test)}"
        for path in sources()
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Assert) and not tells_a_type(node.test)
    ]
    assert found == [], "raise an error of greybox.errors instead"


def test_no_code_reads_a_docstring() -> None:
    readers = [
        path.relative_to(ROOT)
        for path in sources()
        if path.parent.name != "examples"  # scripts whose help may lack its first paragraph
        and any(word in path.read_text() for word in ("__doc__", "getdoc("))
    ]
    assert readers == []


@pytest.mark.slow
def test_a_fit_is_the_same_number_by_number(tmp_path: Path) -> None:
    from greybox.examples import flight_path, vehicle_path

    arpl = "arpl_crazyflie"
    fit = ["-m", "greybox", "fit", "--manual", "--vehicle", str(vehicle_path(arpl))]
    fit += ["--train", str(flight_path(arpl, "log15")), "--rate", "100", "--effects", "motor_lag"]
    hashes = set()
    for name, flags in (("plain", []), ("optimised", ["-OO"])):
        out = tmp_path / name
        subprocess.run(
            [sys.executable, *flags, *fit, "--out", str(out)], capture_output=True, check=False
        )
        hashes.add(hashlib.sha256((out / "model.json").read_bytes()).hexdigest())
    assert len(hashes) == 1
