"""Every fenced block of README.md and docs/ is executed (tests/docs/pages.py says how), and every
link leads somewhere."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

import greybox as gb
from greybox.cli import build_parser
from greybox.data import Dataset
from tests.docs.pages import (
    LANGUAGES,
    PAGES,
    ROOT,
    blocks,
    commands_and_output,
    first_missing,
    name_of,
    run_console,
    run_page,
    same_line,
)


def _has_code(page: Path) -> bool:
    return any(b.language not in ("text", "") for b in blocks(page.read_text()))


LONG = (
    "README.md",
    "docs/automatic.md",
    "docs/howto.md",
    "docs/own_model.md",
    "docs/plan.md",
    "docs/tutorial.md",
)
"""Pages that fit and plan for minutes: with the slow checks."""


RUN = [
    pytest.param(page, id=name_of(page), marks=[pytest.mark.slow] if name_of(page) in LONG else [])
    for page in PAGES
    if _has_code(page)
]


@pytest.mark.parametrize("page", RUN)
def test_every_block_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_page(page, tmp_path) > 0


def test_the_first_page_runs_on_the_first_seconds_of_its_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = gb.read_logs

    def begun(*given: Any, **how: Any) -> Dataset:
        cut = [f.between(t := float(f.segments[0].t[0]), t + 6.0) for f in read(*given, **how)]
        return Dataset(flights=tuple(f for f in cut if f is not None))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(gb, "read_logs", begun)
    assert run_page(ROOT / "README.md", tmp_path) > 0
    assert (tmp_path / "fit" / "model.json").exists()


def test_what_a_sketch_imports_is_there() -> None:
    ours = re.compile(r"^\s*((?:from|import) (?:greybox|mpc_export)\b[^(\n]*)$", re.MULTILINE)
    told = {
        line.split("  #")[0]
        for page in PAGES
        for block in blocks(page.read_text())
        if block.language == "text"
        for line in ours.findall(block.text)
    }
    assert any("TubeController" in line for line in told)
    for line in told:
        exec(line, {})


def test_every_block_says_what_it_is() -> None:
    strange = [
        f"{page.relative_to(ROOT)}:{block.line - 1}: '{block.language}'"
        for page in PAGES
        for block in blocks(page.read_text())
        if block.language not in LANGUAGES
    ]
    assert not strange, f"expected one of {', '.join(LANGUAGES)} after the fence"


def shown_commands(page: str) -> list[str]:
    """Lines `greybox ...` of sketches: of blocks that are only text, and of paragraphs that are
    indented by four."""
    text = "".join(b.text for b in blocks(page) if b.language == "text")
    indented = re.sub(r"^```.*?^```", "", page, flags=re.MULTILINE | re.DOTALL)
    text += (
        "".join(f"{line[4:]}\n" for line in indented.splitlines() if line.startswith("    ")) + "\n"
    )
    lines = re.sub(r"\\\n\s*", " ", text).splitlines()
    parts = [part.partition("  #")[0].strip() for line in lines for part in line.split(";")]
    return [p for p in parts if p.startswith("greybox ") and "[" not in p]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_that_are_only_shown_are_understood(
    page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = build_parser()
    wrong = []
    for command in shown_commands(page.read_text()):
        try:
            parser.parse_args(shlex.split(command)[1:])
        except SystemExit:
            wrong.append(f"{command}: {capsys.readouterr().err.splitlines()[-1]}")
    assert not wrong


def _anchors(text: str) -> set[str]:
    titles = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_leads_somewhere(page: Path) -> None:
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith(("http:", "https:", "mailto:")):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name) if name else page
        if not file.exists() or (
            anchor and file.suffix == ".md" and anchor not in _anchors(file.read_text())
        ):
            broken.append(target)
    assert not broken


def test_every_page_is_in_the_index() -> None:
    index = (ROOT / "docs" / "README.md").read_text()
    docs = [p.relative_to(ROOT / "docs").as_posix() for p in PAGES if ROOT / "docs" in p.parents]
    absent = [name for name in docs if name != "README.md" and f"({name})" not in index]
    assert not absent


def test_a_console_block_fails_where_it_should(tmp_path: Path) -> None:
    run_console("$ printf 'mass  0.0334 kg\\nend\\n'\nmass 0.033 kg\n...\nend\n", tmp_path)
    for wrong in (
        "$ false\n",
        "$ false | cat\n",
        "$ echo mass 1.2 kg\nmass 1.4 kg\n",
        "$ echo a; echo b\nb\na\n",
    ):
        with pytest.raises(AssertionError):
            run_console(wrong, tmp_path)


WRONG = {
    "python": "assert 1 > 2",
    "console": "$ greybox check --vehicle nowhere.toml nowhere.csv",
    "toml": 'schema = "greybox.vehicle/1"\nname = "without rotors"\nmass = 1.0',
    "json": '{"a": }',
    "c": "int broken(void) { return nothing; }",
}


@pytest.mark.parametrize("language", WRONG)
def test_a_wrong_block_of_any_kind_fails(language: str, tmp_path: Path) -> None:
    if language == "c" and shutil.which("cc") is None:
        pytest.skip("no C compiler")
    page = tmp_path / "page.md"
    page.write_text(f"```text\nfree\n```\n\n```{language}\n{WRONG[language]}\n```\n")
    assert [(b.language, b.line) for b in blocks(page.read_text())] == [("text", 2), (language, 6)]
    with pytest.raises((AssertionError, ValueError)):
        run_page(page, tmp_path)


def test_shown_output_is_compared_word_by_word() -> None:
    assert commands_and_output("$ a \\\n    b\nout\n$ c\n") == ("a \\\n    b\nc", ["out"])
    assert same_line("x = 1.00 ± 0.10", "x  = 1.04 ± 0.11") and not same_line(
        "x = 1.00", "x = 1.06"
    )
    assert same_line(
        "iteration ... decrease ...", "iteration 3 cost 5 decrease 1e-3"
    ) and not same_line("a b", "a b c")
    assert same_line("p: 1e-3,", "p: 1.02e-3,") and not same_line("+1", "-1")
    assert not same_line("3 files", "4 files") and same_line("100 ms", "104 ms")
    assert (
        first_missing(["b", "a"], ["a", "b"]) == "a"
        and first_missing(["a", "..."], ["0", "a"]) is None
    )
