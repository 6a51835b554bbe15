"""Each part of an installation is tried; what is broken decides the exit code, what is optional
does not."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest

from greybox.cli import main
from greybox.commands import selftest_checks as checks
from greybox.data.readers import FORMATS
from greybox.distribution import install_line
from greybox.errors import DataError

ROOT = Path(__file__).parents[2]


def fails(error: Exception) -> checks.Check:
    def run(_: checks.Bench) -> str:
        raise error

    return checks.Check("part", run)


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (
            checks.Missing("no such", fix="pip install x"),
            0,
            ["missing", "pip install x", "optional"],
        ),
        (checks.Broken("wrong number", fix="do this"), 1, ["BROKEN", "do this", "Not all"]),
        (DataError("bad", fix="that"), 1, ["BROKEN", "Usual fix: that"]),
        (ImportError("lib.so\nmissing"), 1, ["BROKEN", "ImportError: lib.so missing", "reinstall"]),
    ],
)
def test_only_what_is_broken_is_an_error(
    error: Exception,
    code: int,
    said: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    good = checks.Check("good", lambda bench: "as it should be")
    monkeypatch.setattr(checks, "CHECKS", (fails(error), good))
    assert main(["selftest"]) == code
    out = capsys.readouterr().out
    assert all(words in out for words in said), out
    assert "works    good" in out


def test_a_wrong_number_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """The fit is told another truth, and the derivative another function."""
    import casadi as ca

    monkeypatch.setattr(ca, "exp", ca.sin)
    assert (
        checks.outcome(checks.Check("CasADi", checks.casadi), checks.Bench(folder=tmp_path))[0]
        == "broken"
    )
    monkeypatch.setattr(checks, "DISTANCE", 0.0)
    state, text, fix = checks.outcome(
        checks.Check("fit", checks.fit), checks.Bench(folder=tmp_path)
    )
    assert state == "broken", text
    assert "inertia.xx is 0.0021, the fit says 0.002" in text
    assert fix


def test_what_rests_on_a_fit_that_failed_is_not_tried(tmp_path: Path):
    state, text, _ = checks.outcome(
        checks.Check("export", checks.export), checks.Bench(folder=tmp_path)
    )
    assert (state, text) == ("broken", "not tried, as the fit failed")


def test_without_a_compiler_the_line_to_type_is_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr("greybox.estimation.build.compiler", lambda: None)
    state, _, fix = checks.outcome(
        checks.Check("compiler", checks.compiler), checks.Bench(folder=tmp_path)
    )
    assert state == "missing"
    assert fix.startswith(install_line("compiler"))


@pytest.mark.parametrize("one", FORMATS, ids=lambda one: one.name)
def test_a_reader_without_its_library_is_missing(
    one, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    check = checks.Check(one.name, lambda bench: checks.reader(one, bench))
    for name in one.libraries:
        monkeypatch.setitem(sys.modules, name, None)
    state, text, fix = checks.outcome(check, checks.Bench(folder=tmp_path))
    assert state == ("missing" if one.libraries else "works"), text
    assert fix == (install_line("logs") if one.libraries else "")


def test_libraries_of_readers_are_those_of_the_extra():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]["logs"]
    asked = {e.split(">")[0] for e in extras}
    assert {name for one in FORMATS for name in one.libraries} == asked
