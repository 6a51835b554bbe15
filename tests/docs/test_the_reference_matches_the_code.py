"""The pages of reference are what the code says; all that is public is described, and pages execute
every public name."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import pkgutil

import pytest

import greybox
import mpc_export
from docs.tools.reference import JOBS, commands, members, pages
from greybox.cli import COMMANDS, build_parser
from tests.docs.pages import PAGES, ROOT, blocks


def test_the_pages_are_up_to_date() -> None:
    for file, text in pages().items():
        assert (ROOT / "docs" / file).read_text() == text, f"{file}: run make docs"


def test_every_public_function_is_described_once_by_what_it_is_for() -> None:
    named = [name for names in JOBS.values() for name in names]
    public = [n for n in greybox.__all__ if not inspect.isclass(getattr(greybox, n))]
    assert sorted(named) == sorted(public)


def test_every_command_and_option_is_described() -> None:
    found = list(commands(build_parser()))
    assert {name.split()[0] for name, _, _ in found} == set(COMMANDS)
    bare = [name for name, summary, child in found if not summary or not child.description]
    bare += [
        f"{name} {a.dest}"
        for name, _, child in found
        for a in child._actions
        if a.help is None and a.choices is None
    ]
    assert not bare


def test_every_public_name_and_member_has_a_docstring() -> None:
    bare = []
    for name in greybox.__all__:
        thing = getattr(greybox, name)
        bare += [name] if not inspect.getdoc(thing) else []
        for member, value in members(thing):
            function = (
                value.fget if isinstance(value, property) else getattr(value, "__func__", value)
            )
            bare += [f"{name}.{member}"] if not inspect.getdoc(function) else []
    assert not bare


def used_names(source: str) -> set[str]:
    """Names that Python text takes from the package: `greybox.NAME`, under any alias, or `from
    greybox import NAME`."""
    tree = ast.parse(source)
    aliases = {
        a.asname or a.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for a in node.names
        if a.name == "greybox"
    }
    found = {
        a.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "greybox"
        for a in node.names
    }
    return found | {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id in aliases
    }


def test_every_public_name_is_executed_by_some_page() -> None:
    sources = [
        "".join(b.text for b in blocks(p.read_text()) if b.language == "python") for p in PAGES
    ]
    executed = set().union(*(used_names(s) for s in sources))
    assert sorted(set(greybox.__all__) - executed) == []


def test_names_are_found_under_an_alias() -> None:
    assert used_names("import greybox as gb\ngb.fit(x.check)\nfrom greybox import learn as l") == {
        "fit",
        "learn",
    }


def _modules_with_examples() -> list[str]:
    found = []
    for package in (greybox, mpc_export):
        folder = ROOT / package.__name__
        for info in pkgutil.walk_packages([str(folder)], f"{package.__name__}."):
            file = (ROOT / info.name.replace(".", "/")).with_suffix(".py")
            if file.exists() and ">>> " in file.read_text():
                found.append(info.name)
    return found


@pytest.mark.parametrize("name", _modules_with_examples())
def test_examples_in_docstrings_give_what_they_show(name: str) -> None:
    result = doctest.testmod(
        importlib.import_module(name), optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    )
    assert result.attempted > 0 and result.failed == 0
