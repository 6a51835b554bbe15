"""A move that lost is asked again only where nothing else gains, and a search still ends only
where no move gains: in linear worlds of known answers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import greybox.discovery.search
from greybox.discovery.search import Search
from tests.discovery.linear_world import World, scores

SAMPLES = 60
HIDDEN = {"a": 3.0, "b": 3.0, "there": 4.0}
UNSCORED = ("there", "nothing")


def world(seed: int) -> World:
    """Four causes, of which `HIDDEN` are there and one is at right angles to all that is."""
    rng = np.random.default_rng(seed)
    columns = {n: rng.standard_normal((SAMPLES, 1)) for n in HIDDEN}
    shared = rng.standard_normal((SAMPLES, 2))
    y = rng.standard_normal(SAMPLES)
    for name, size in HIDDEN.items():
        y = y + size * columns[name][:, 0]
    seen = np.column_stack([shared, *columns.values(), y])
    nothing = rng.standard_normal((SAMPLES, 1))
    columns["nothing"] = nothing - seen @ np.linalg.lstsq(seen, nothing, rcond=None)[0]
    return World(columns=columns, shared=shared, y=y)


@pytest.fixture(autouse=True)
def linear(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two causes that only a fit can judge, sensors that are white."""

    def scored(flights: Any, at: Any) -> Any:
        known = scores(flights, sorted(at.structure))
        own = tuple(n for n in known.absent if n in UNSCORED)
        return replace(known, absent=tuple(n for n in known.absent if n not in own), unscored=own)

    module: Any = greybox.discovery.search
    monkeypatch.setattr(module, "scored", scored)
    monkeypatch.setattr(module, "sensor_proposals", lambda *_: ([], 0.0))
    monkeypatch.setattr(module, "axis_gains", lambda *_: {})


def searched(seed: int, most: int = 8) -> tuple[World, Search, Any]:
    one = world(seed)
    search = Search(flights=one, most=most, say=lambda _text, _share: None)  # type: ignore[arg-type]
    return one, search, search.run()


def test_what_only_a_fit_can_judge_is_asked_first_and_last_when_it_lost():
    for seed in range(10):
        one, _, at = searched(seed)
        assert at.structure == set(HIDDEN)
        asked = sorted(len(s) for s in one.kept if "nothing" in s)
        assert asked == [1, 4], "next to nothing, and where nothing else gained"


def test_no_move_from_where_a_search_ends_gains():
    for seed in range(10):
        one, search, at = searched(seed)
        for name in one.columns:
            assert search.score(one.fit(at.structure ^ {name})) <= search.score(at)


def test_what_only_a_fit_can_judge_is_not_asked_beyond_the_most_that_there_may_be():
    one, _, _ = searched(0, most=1)
    assert max(len(s) for s in one.kept if s & set(UNSCORED)) == 1


def test_what_would_gain_next_to_a_full_structure_is_said_and_stands_in_for_nothing():
    one, search, at = searched(0)
    alone = one.fit({"a"})
    assert search.crowded_out(at) == [], "there is room"
    # "b" is "a" in part: it would take the place of "a" by what it gains besides.
    one.columns = {**one.columns, "b": one.columns["b"] + 3.0 * one.columns["a"]}
    one.kept.clear()
    full = Search(flights=one, most=1, say=lambda _text, _share: None)  # type: ignore[arg-type]
    assert full.crowded_out(alone) == ["b"]
    instead = {names for share, names, _ in full._scored(alone).instead("a") if share > 0.5}
    assert ("b",) in instead
    assert {r.instead for r in full.contest(alone)["a"]} == {()}
    full.most = 2
    assert ("b",) in {r.instead for r in full.contest(alone)["a"]}
