"""Ten notebooks, kept as text in jupytext's percent format: each runs from top to bottom and
draws."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.docs.pages import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.py"))
TEN = {
    "crazyflie",
    "px4",
    "betaflight",
    "own_csv",
    "own_model",
    "own_effect",
    "hybrid",
    "export_acados",
    "tube_mpc",
    "fleet",
}
LINES = 70
"""A notebook is read in one go."""


def cells(text: str) -> list[tuple[str, str]]:
    """(kind, text) of the cells of a notebook, "markdown" or "code", in order."""
    parts = re.split(r"^# %%(.*)\n", text, flags=re.MULTILINE)[1:]
    kinds = ["markdown" if "[markdown]" in head else "code" for head in parts[::2]]
    return list(zip(kinds, parts[1::2], strict=True))


def test_there_are_ten_and_the_index_links_to_them():
    assert {p.stem for p in NOTEBOOKS} == TEN
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    assert [n for n in TEN if f"notebooks/{n}.py" not in index] == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_it_is_short_and_its_cells_are_of_the_format(path: Path):
    text = path.read_text(encoding="utf-8")
    found = cells(text)
    assert text.startswith("# %% [markdown]\n# # ")
    assert len(text.splitlines()) <= LINES
    for kind, body in found:
        if kind == "markdown":
            assert all(line.startswith("#") for line in body.strip().splitlines())
        else:
            ast.parse(body)
    assert sum(kind == "code" for kind, _ in found) >= 3


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_program_that_it_starts_must_end_well(path: Path):
    calls = [
        n for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.Call)
    ]
    started = [c for c in calls if ast.unparse(c.func).startswith("subprocess.")]
    for call in started:
        told = {k.arg: ast.unparse(k.value) for k in call.keywords}
        assert told.get("check") == "True", ast.unparse(call)


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder to work in, with the logs that a reader brings along; figures stay in memory."""
    import matplotlib.pyplot as plt

    monkeypatch.chdir(tmp_path)
    before, modules = list(sys.path), set(sys.modules)
    plt.switch_backend("agg")
    with plt.rc_context({"figure.max_open_warning": 0}):
        yield tmp_path
    plt.close("all")
    sys.path[:] = before
    for name in set(sys.modules) - modules:
        if name == "rebuild" or name.startswith("consumers"):
            del sys.modules[name]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_it_runs_and_draws(path: Path, desk: Path):
    import matplotlib.pyplot as plt

    from greybox.examples import vehicle_path
    from tests.data.readers.writers import channels, write_betaflight, write_ulog

    if path.stem == "px4":
        pytest.importorskip("pyulog")
        c = channels(rows=1200)
        write_ulog(
            desk / "flight.ulg", c | {f"sp_{k}": np.zeros(1200) for k in "xyz"}, slow_every=1
        )
    if path.stem == "betaflight":
        pytest.importorskip("orangebox")
        write_betaflight(desk / "flight.bbl", channels(rows=1800))
    if path.stem == "hybrid":
        pytest.importorskip("gpytorch")
    (desk / "vehicle.toml").write_bytes(vehicle_path("nanobench").read_bytes())
    namespace: dict[str, object] = {"__name__": path.stem}
    for kind, body in cells(path.read_text(encoding="utf-8")):
        if kind == "code":
            exec(compile(body, str(path), "exec"), namespace)
    drawn = [plt.figure(n) for n in plt.get_fignums()]
    assert any(a.lines or a.collections for f in drawn for a in f.axes)
