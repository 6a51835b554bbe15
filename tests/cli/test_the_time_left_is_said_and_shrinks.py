"""How long is left: by the share that is done, and of a solver by how fast its promise falls; in a
notebook as a line."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable

import pytest

import greybox as gb
from greybox import progress
from greybox.progress import FIRST, TimeLeft, in_notebooks, in_words
from tests import motor

LONG = {
    "fit": "progress",
    "discover": "progress",
    "learn": "progress",
    "identify": "say",
    "plan": "say",
    "compare": "say",
}
"""Public functions that may take more than two seconds, with the keyword by which a caller hears of
them."""


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (3, "about 10 s left"),
        (44, "about 40 s left"),
        (95, "about 2 min left"),
        (7000, "about 1.9 h left"),
    ],
)
def test_it_is_rounded_as_a_person_would(seconds: float, said: str):
    assert in_words(seconds) == said


def test_the_share_gives_the_rest_at_the_pace_so_far():
    clock = Clock()
    left = TimeLeft(clock)
    clock.now += 0.5 * FIRST
    assert left.after(0.5) == ""  # too early to tell
    clock.now = 130.0
    assert left.after(0.5) == ", about 30 s left"
    assert left.after(0.25) == ", about 90 s left" or left.after(0.25) == ", about 2 min left"
    assert left.after(0.0) == left.after(1.0) == ""


def test_a_solver_that_converges_is_told_to_the_right_iteration():
    clock = Clock()
    left = TimeLeft(clock)
    told = []
    for k in range(1, 13):  # a tenth of the promise each second; 1e-6 after the twelfth
        clock.now += 10.0
        told.append(left.after_step(k, 10.0 ** (6 - k)))
    said = [int(m[1]) for t in told if (m := re.search(r"about (\d+) s", t))]
    true = [10 * (12 - k) for k in range(1, 13)]
    for k, t in enumerate(told, start=1):
        if m := re.search(r"about (\d+) s", t):
            assert int(m[1]) == pytest.approx(true[k - 1], abs=10)
    assert len(said) >= 7
    assert said == sorted(said, reverse=True)


def test_a_solver_that_does_not_converge_promises_nothing():
    clock = Clock()
    left = TimeLeft(clock)
    for k in range(1, 20):
        clock.now += 5.0
        assert left.after_step(k, 3.0) == ""


def test_another_fit_begins_anew():
    clock = Clock()
    left = TimeLeft(clock)
    for k in range(1, 8):
        clock.now += 5.0
        left.after_step(k, 10.0 ** (4 - k))
    clock.now += 5.0
    assert left.after_step(1, 1e4) == ""


class Notebook:
    """What IPython is to a kernel, as far as it is asked: a shell with a kernel and a display that
    can be updated."""

    def __init__(self) -> None:
        self.kernel = object()
        self.shown: list[tuple[dict[str, str], str, bool]] = []

    def get_ipython(self) -> Notebook:
        return self

    def display(self, data: dict[str, str], *, raw: bool, display_id: str, update: bool) -> None:
        assert raw
        self.shown.append((data, display_id, update))


@pytest.fixture
def notebook(monkeypatch: pytest.MonkeyPatch) -> Notebook:
    found = Notebook()
    monkeypatch.setitem(sys.modules, "IPython", found)
    monkeypatch.setitem(sys.modules, "IPython.display", found)
    monkeypatch.setattr(progress, "OFTEN", 0.0)
    return found


@in_notebooks(progress="share")
def work(
    steps: int, *, fails: bool = False, progress: Callable[[str, float], None] | None = None
) -> int:
    for k in range(steps):
        if progress is not None:
            progress(f"step <{k}>", k / steps)
    if fails:
        raise KeyboardInterrupt
    return steps


def test_in_a_notebook_one_line_moves_and_says_how_it_ended(notebook: Notebook):
    assert work(3) == 3
    texts = [data["text/plain"] for data, _, _ in notebook.shown]
    assert texts == ["work: step <0>", "work: step <1>", "work: step <2>", "work: done after 0 s"]
    assert [update for _, _, update in notebook.shown] == [False, True, True, True]
    assert len({name for _, name, _ in notebook.shown}) == 1
    page = notebook.shown[1][0]["text/html"]
    assert '<progress value="0.333" aria-label="work"' in page and "step &lt;1&gt;" in page
    with pytest.raises(KeyboardInterrupt):
        work(1, fails=True)
    assert notebook.shown[-1][0]["text/plain"] == "work: stopped after 0 s"
    assert "<progress" not in notebook.shown[-1][0]["text/html"]


def test_who_listens_himself_gets_no_line_and_outside_of_a_notebook_there_is_none(
    notebook: Notebook, monkeypatch: pytest.MonkeyPatch
):
    heard: list[str] = []
    work(2, progress=lambda text, _share: heard.append(text))
    assert len(heard) == 2 and not notebook.shown
    del notebook.kernel  # an IPython at a terminal
    assert work(2) == 2 and not notebook.shown
    monkeypatch.delitem(sys.modules, "IPython")
    assert work(2) == 2 and not notebook.shown


def test_a_fit_in_a_notebook_shows_its_iterations(notebook: Notebook):
    gb.fit(motor.model(), motor.record(200), free=("R", "J"), use_compiler=False)
    texts = [data["text/plain"] for data, _, _ in notebook.shown]
    assert re.match(r"fit: iteration 1, cost ", texts[0])
    assert texts[-1].startswith("fit: done after ")


def test_long_public_functions_show_a_line_and_keep_their_signatures():
    for name, way in LONG.items():
        function = getattr(gb, name)
        assert function.__wrapped__ is not None
        assert way in inspect.signature(function).parameters
