"""Pages and help texts use one word per thing: those of the glossary, which is short."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator

import pytest

from docs.tools.glossary import WORDS, table
from greybox.cli import build_parser
from tests.docs.pages import ROOT

PAGES = {
    p.relative_to(ROOT).as_posix(): p.read_text()
    for p in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md"))
}


def helps(parser: argparse.ArgumentParser) -> Iterator[str]:
    """All texts of a command line."""
    yield parser.format_help()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for child in action.choices.values():
                yield from helps(child)


def found(word: str, text: str) -> bool:
    """Whether a word, or its plural, stands in a text, in any case and over the ends of lines."""
    plain = r"\s+".join(map(re.escape, word.split()))
    return re.search(rf"(?<![\w-]){plain}(s|es)?(?![\w-])", text, re.IGNORECASE) is not None


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    glossary = table()
    assert glossary in PAGES["docs/reference.md"], "run make docs"
    pages = {name: text.replace(glossary, "") for name, text in PAGES.items()}
    return {**pages, "--help": "\n".join(helps(build_parser()))}


def test_there_are_at_most_sixty():
    assert 30 <= len(WORDS) <= 60
    assert list(WORDS) == sorted(WORDS, key=lambda w: w.replace("-", " "))


def test_every_word_is_used_outside_of_the_glossary(texts: dict[str, str]):
    assert [w for w in WORDS if not any(found(w, text) for text in texts.values())] == []


def test_no_other_word_is_used_for_the_same_thing(texts: dict[str, str]):
    others = [o for w in WORDS.values() for o in w.instead_of]
    assert others and not set(others) & set(WORDS)
    assert [(o, name) for o in others for name, text in texts.items() if found(o, text)] == []


def test_words_are_found_in_any_form():
    assert found("sampling time", "two Sampling\ntimes.") and not found(
        "log", "a logger, log-like, catalog"
    )
