"""Where names leave beside laws, laws are sought anew. Names that these do not need leave, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from greybox.discovery.certificate import Certificate
from greybox.discovery.left import Left
from greybox.discovery.name import Name
from greybox.discovery.workflow import _Run

CERTAIN = Name(
    name="",
    status="certified",
    certificate=Certificate(name="", rivals={(): 20.0}),
    worth=None,
)


def said(times: int) -> tuple[list[str], Any]:
    """The names that stay of three, and the structure with them, where every law that wins asks for
    one less, and the first `times` win."""
    laws = iter([Left(axes=(), written=structure("law"))] * times + [Left(axes=())])

    def beside(names: Sequence[Name], at: Any, _laws: Any) -> tuple[list[Name], Any]:
        needed = [n for n in names if n.status == "certified"][1:]
        return list(needed), structure(*(n.name for n in needed)) if len(needed) else at

    run: Any = SimpleNamespace(
        then=None,
        bent=lambda _at: False,
        warnings=[],
        flights=SimpleNamespace(causes=None, arrived=lambda at: at),
        say=lambda *_: None,
        _named=lambda at, _: ([replace(CERTAIN, name=n) for n in ("lag", "curve", "drag")], at),
        _keep=lambda *_: None,
        _left=lambda *_: next(laws),
        _beside_laws=beside,
        _by_errors_ahead=lambda *_: None,
    )
    search: Any = SimpleNamespace(
        run=lambda at: at,
        added=lambda at: at.names,
        contest=lambda _: {},
        every=lambda _: None,
        crowded_out=lambda _: [],
    )
    names, at, _ = _Run._answer(run, search, structure("lag", "curve", "drag"))
    return [n.name for n in names], at.names


def structure(*names: str) -> Any:
    return SimpleNamespace(names=names)


@pytest.mark.parametrize(
    ("times", "stay"),
    [(1, ["lag", "curve", "drag"]), (2, ["curve", "drag"]), (3, ["drag"])],
)
def test_until_no_name_leaves_beside_the_laws_or_none_win(times: int, stay: list[str]):
    names, at = said(times)
    assert names == stay
    assert list(at) == stay
