"""Where names leave beside laws, laws are sought anew. Names that these do not need leave, too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from greybox.discovery.certificate import Certificate
from greybox.discovery.left import Left, _raced
from greybox.discovery.name import Name
from greybox.discovery.workflow import _Run
from greybox.residual.laws.axis import Axis

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
        null=structure("lag", "curve", "drag"),
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
    names, at, _ = _Run._answer(run, search)
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


def instead(
    unsure: Sequence[str] = (), beside: Any = None, **evidence: float
) -> tuple[Any, list[bool]]:
    """(What is said of drag, wind and lag, of which a law in the place of each has this log
    evidence where all three have 100, or what they have `beside` laws, and whether laws were held
    against names)."""
    flights = SimpleNamespace(causes="offered", fit=lambda names, _: structure(*sorted(names)))
    held_against: list[bool] = []

    def left(bare: Any, next_to: Any) -> Left:
        flights.causes = "with laws"
        gone = "_".join(sorted({"drag", "wind", "lag"} - set(bare.names)))
        law: Any = SimpleNamespace(log_evidence=evidence.get(gone, -1e9))
        held_against.append(next_to is (beside or at))
        return Left(axes=(), written=law if gone in evidence else None)

    told = {f"{n}.c": SimpleNamespace(value=1.0, std=0.1) for n in ("drag", "wind", "lag")}
    own = SimpleNamespace(parameters=[SimpleNamespace(name=n) for n in told])
    settled: Any = SimpleNamespace(parameters=told, model=SimpleNamespace(dynamics=own))
    run: Any = SimpleNamespace(flights=flights, bar=5.0, _left=left, settled=lambda _: settled)
    sure = {"drag": 80.0, "wind": 15.0, "lag": 40.0}
    names = [
        replace(
            CERTAIN,
            name=n,
            status="not certified" if n in unsure else "certified",
            certificate=Certificate(name=n, rivals={(): e}),
        )
        for n, e in sure.items()
    ]
    at: Any = SimpleNamespace(structure=frozenset(sure), known={}, log_evidence=100.0)
    found = _Run._laws_instead(run, names, at, Left(axes=(), written=beside))
    assert flights.causes == ("offered" if found is None else "with laws")
    return found, held_against


def test_a_name_in_whose_place_laws_say_more_stood_in_for_them() -> None:
    """A drag that is linear in the velocity was a quadratic one in a strong wind: both had a name."""
    (names, bare, left), against = instead(wind=600.0, drag=900.0)
    assert [(n.name, n.status) for n in names] == [
        ("drag", "certified"),
        ("wind", "not certified"),
        ("lag", "certified"),
    ]
    assert "laws in its place" in names[1].reason
    assert bare.names == ("drag", "lag")
    assert left.written is not None
    assert against == [True], "laws must foretell no worse than a name"


def test_what_has_no_name_leaves_together_for_laws() -> None:
    (names, bare, _), against = instead(unsure=("wind", "drag"), drag_wind=600.0)
    assert {n.name for n in names if "laws in its place" in n.reason} == {"wind", "drag"}
    assert bare.names == ("lag",)
    assert against == [False]


def test_laws_that_say_hardly_more_take_no_name() -> None:
    found, against = instead(wind=104.0)
    assert found is None
    assert len(against) == 3


@pytest.mark.parametrize(
    ("moved", "evidence", "gone"), [(0.0, 900.0, True), (0.9, 900.0, False), (0.0, 504.0, False)]
)
def test_a_name_that_laws_take_over_is_asked_whether_they_want_all_of_it(
    moved: float, evidence: float, gone: bool
) -> None:
    """A drag that is linear in the velocity was said by laws along x and y, and was a quadratic
    one along z: what the laws took over was the name's."""
    known = {("drag.c", None): moved, ("wind.c", None): 1.0, ("lag.c", None): 1.0}
    laws: Any = SimpleNamespace(log_evidence=500.0, known=known)
    found, against = instead(beside=laws, drag=evidence, wind=900.0, lag=900.0)
    assert (found is not None) == gone
    assert against == ([] if moved else [True]), "the others stand where they stood"
    if found:
        assert [n.name for n in found[0] if n.status == "certified"] == ["wind", "lag"]


@pytest.mark.parametrize(("arrives", "won"), [(903.0, True), (101.0, False), (-np.inf, False)])
def test_laws_that_win_are_fitted_to_their_end(arrives: float, won: bool) -> None:
    """Laws made a gap in the thrust likelier by far, and their fit ended on the way, at more than
    twice the mass; who foretells, and what is said, is the fit that arrived."""
    far: Any = SimpleNamespace(
        log_evidence=900.0, known={("law.c_1", None): 5.0, ("mass", None): 80}
    )
    near: Any = SimpleNamespace(
        log_evidence=arrives, known={("law.c_1", None): 2.0, ("mass", None): 36}
    )
    causes = SimpleNamespace(
        model=None,
        effects=(),
        of_laws=lambda *_: [SimpleNamespace(name="law")],
        with_cause=lambda *_: "with laws",
        law_file=None,
    )
    flights: Any = SimpleNamespace(
        causes=causes,
        forget=lambda _names: None,
        contest=lambda *_: [far],
        arrived=lambda f: near if f is far else f,
    )
    axis = Axis(
        channel="force.z",
        unit="N",
        rms=0.2,
        gain=1e4,
        lasts=11.0,
        needed=True,
        terms={"up.z": 5.0},
        codes=("flow.rotation[2, 2]",),
        shapes=(None,),
        lawful=True,
    )
    at: Any = SimpleNamespace(structure=frozenset(), known={}, log_evidence=100.0)
    held: list[Any] = []
    left = _raced(flights, at, (axis,), [axis], 5.0, lambda f: held.append(f) or True)
    if not won:
        assert left.written is None and flights.causes is causes
        return
    assert left.written is near and held == [near]
    assert left.laws[0].terms == {"up.z": 2.0}
