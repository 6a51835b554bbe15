"""docs/architecture.md draws what the code does: its table of imports is the one that the files
give."""

from __future__ import annotations

import re
from collections import defaultdict

from tests.architecture.test_imports import BASE, ROOMS, ROOT, files, imports

PAGE = ROOT / "docs" / "architecture.md"
BESIDE = (
    "statistics",
    "plants",
    "excitation",
    "examples",
    "linear",
    "automatic",
    "baselines",
    "simulators",
    "report",
)
"""Rooms that are no step on the way of the data: below all of them, beside the fit, and behind all
of them."""
SCENARIOS = ("plants", "foreign")


def package_of(module: str) -> str | None:
    """The row of the table that a module belongs to."""
    parts = module.split(".")
    if parts[0] == "mpc_export":
        return "mpc_export"
    if len(parts) > 1 and parts[0] == "scenarios" and parts[1] in SCENARIOS:
        return ".".join(parts[:2])
    return parts[1] if len(parts) > 1 and parts[0] == "greybox" and parts[1] in ROOMS else None


def drawn() -> dict[str, set[str]]:
    text = PAGE.read_text(encoding="utf-8")
    table = text[text.index("| package | holds | imports |") :].split("\n\n")[0].splitlines()[2:]
    cells = [[c.strip() for c in row.strip("|").split("|")] for row in table]
    return {row[0]: {n.strip() for n in row[2].split(",") if n.strip()} for row in cells}


def real() -> dict[str, set[str]]:
    found: dict[str, set[str]] = defaultdict(set)
    for top in ("greybox", "mpc_export", "scenarios"):
        for path in files(top):
            own = package_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
            if own is None:
                continue
            found[own] |= set()
            for one in imports(path):
                other = package_of(one.module)
                # The vehicle file is plain numbers, which readers of logs may use (see
                # test_imports).
                if other not in (None, own) and one.module != "greybox.model.vehicle":
                    found[own].add(str(other))
    return dict(found)


def test_the_table_is_what_the_files_import():
    assert drawn() == real()


def test_the_picture_names_every_room_in_order():
    picture = re.findall(r"```text\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)[0]
    line = next(row for row in picture.splitlines() if "data ---" in row)
    assert re.findall(r"[a-z]+", line) == [r for r in ROOMS if r not in BESIDE]
    assert not set(re.findall(r"[a-z]+", line)) & set(BASE)


def test_folders_that_the_page_sends_you_to_are_there():
    text = PAGE.read_text(encoding="utf-8")
    named = re.findall(r"`((?:greybox|mpc_export|scenarios)/[\w/.]+)`", text)
    assert named
    assert [n for n in named if not (ROOT / n).exists()] == []
