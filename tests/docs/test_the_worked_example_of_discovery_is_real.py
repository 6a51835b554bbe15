"""docs/discovery.md is short, and the output that its worked example shows is what its commands
print."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs.pages import ROOT, blocks, run_console

PAGE = ROOT / "docs" / "discovery.md"
LINES = 130


def example() -> str:
    """The block of the worked example: commands and what they print."""
    (found,) = [b.text for b in blocks(PAGE.read_text(encoding="utf-8")) if b.text.startswith("$ ")]
    return found


def test_the_page_is_short_and_shows_one_example_and_one_figure_of_a_search():
    text = PAGE.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= LINES
    assert "\nMISSING: " in example()
    assert text.count("discovery_search.svg") == 1


@pytest.mark.slow
def test_the_worked_example_prints_what_is_shown(tmp_path: Path):
    pytest.importorskip("rotorpy", reason="RotorPy comes with the extra judge")
    run_console(example(), tmp_path)
