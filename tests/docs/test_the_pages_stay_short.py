"""What is read can be read: words per page and in all, and no long sentence on the learning path.
Text only."""

from __future__ import annotations

import re
from collections import Counter
from itertools import pairwise

import pytest

from tests.docs.pages import ROOT, name_of

DOCS = ROOT / "docs"
GENERATED = tuple(DOCS / f"{name}.md" for name in ("reference", "functions", "types", "effects"))
"""Pages that a command writes from the code."""
WRITTEN = [ROOT / "README.md", *sorted(p for p in DOCS.rglob("*.md") if p not in GENERATED)]
ALL, PAGE, SENTENCE = 24_500, 2_000, 40
FIGURE = 25
"""Lines around a figure within which its command stands."""


def without_code(text: str) -> str:
    """The text of a page outside its fenced blocks."""
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def words(text: str) -> list[str]:
    """What has a letter or a digit, rules of tables aside."""
    return [w for w in text.split() if re.search(r"[^\W_]", w)]


def sentences(text: str) -> list[str]:
    """The sentences of paragraphs, items of lists and cells of tables; lines that are indented by
    four are code."""
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", without_code(text))
    pieces, open_ = [""], False
    for line in text.splitlines():
        bare = line.strip()
        if line.startswith("    ") or not bare or line.startswith(("#", "|")):
            pieces += [cell.strip() for cell in bare.split("|")] if line.startswith("|") else []
            open_ = False
        elif open_ and not re.match(r"([-*]|\d+\.) ", bare):
            pieces[-1] += f" {bare}"
        else:
            pieces.append(bare)
            open_ = True
    return [s for piece in pieces for s in re.split(r"(?<=[.!?])\)?\s+(?=[^a-z])", piece) if s]


def learning_path() -> list[str]:
    """The pages that docs/README.md numbers under its first title, in order."""
    index = (
        (DOCS / "README.md")
        .read_text(encoding="utf-8")
        .split("## Learning path")[1]
        .split("\n## ")[0]
    )
    return re.findall(r"^\d\. .*?\]\((\w+\.md)\)", index, flags=re.MULTILINE)


def test_all_pages_together_are_a_short_book() -> None:
    count = {name_of(p): len(words(without_code(p.read_text(encoding="utf-8")))) for p in WRITTEN}
    assert sum(count.values()) <= ALL, f"shorten before you add: {count}"
    assert max(count.values()) <= PAGE, count


def test_the_learning_path_has_five_pages_and_each_leads_to_the_next() -> None:
    path = learning_path()
    assert len(path) == 5
    for page, following in pairwise(path):
        last = (DOCS / page).read_text(encoding="utf-8").strip().splitlines()[-3:]
        assert f"]({following})" in " ".join(last), (
            f"{page} does not end with a link to {following}"
        )


@pytest.mark.parametrize("page", learning_path())
def test_sentences_of_the_learning_path_are_short(page: str) -> None:
    long = [
        s for s in sentences((DOCS / page).read_text(encoding="utf-8")) if len(words(s)) > SENTENCE
    ]
    assert not long


def test_sentences_are_told_apart() -> None:
    prose = "# T\n\nOne two. Three\nfour (five.) Six?\n\n- a [link](x.md)\n  goes on\n- b\n\n"
    text = f"{prose}| c | d e |\n\n    code\n\n```text\nno\n```\n"
    assert sentences(text) == [
        "One two.",
        "Three four (five.",
        "Six?",
        "- a link goes on",
        "- b",
        "c",
        "d e",
    ]
    assert words("| --- | a 1.5 += `b`") == ["a", "1.5", "`b`"]
    assert without_code("x\n```c\nint y;\n```\nz\n").split() == ["x", "z"]


def test_no_page_is_linked_more_often_than_what_to_do_with_a_bad_fit() -> None:
    links = Counter(
        name_of((page.parent / link).resolve())
        for page in WRITTEN
        for link in re.findall(r"\]\(([\w./]+\.md)[#)]", page.read_text(encoding="utf-8"))
    )
    assert links.most_common(1)[0][0] == "docs/bad_fit.md", links.most_common(3)


def test_every_figure_stands_by_the_command_that_makes_it() -> None:
    alone = []
    for page in WRITTEN:
        lines = page.read_text(encoding="utf-8").splitlines()
        for k, line in enumerate(lines):
            near = "\n".join(lines[max(0, k - FIGURE) : k + FIGURE + 1])
            if line.startswith("![") and not re.search(r"python -m |greybox \w|make \w", near):
                alone.append(f"{name_of(page)}: {line}")
    assert alone == []
