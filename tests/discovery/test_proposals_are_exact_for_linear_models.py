"""Predicted gains and what stands in for a cause: exact where the model is linear, whatever is
collinear is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.discovery.propose import proposals
from greybox.discovery.rules import RULES
from tests.discovery.linear_world import World, drawn, scores


@pytest.mark.parametrize("names", [("a",), ("c",), ("a", "c"), ("a", "b", "c")])
def test_the_predicted_gain_is_the_gain_in_evidence(names: tuple[str, ...]):
    world, _ = drawn(2, {"a": np.array([0.8]), "c": np.array([0.3, 0.0, -0.4])})
    exact = world.fit(names).log_evidence - world.fit(()).log_evidence
    predicted = scores(world).proposal(*names)
    assert predicted.gain == pytest.approx(exact, abs=1e-5)
    assert predicted.start == pytest.approx(
        {k: v for k, v in world.fit(names).known.items() if k[0][:2] != "b_"}
    )


@pytest.mark.parametrize("there", [("a",), ("b",), ("a", "b")])
def test_what_is_there_moves_where_something_is_added(there: tuple[str, ...]):
    world, _ = drawn(2, {"a": np.array([0.8]), "c": np.array([0.3, 0.0, -0.4])})
    world.columns["c"] = world.columns["c"] + world.columns["a"]
    exact = world.fit((*there, "c")).log_evidence - world.fit(there).log_evidence
    assert scores(world, there).gain("c") == pytest.approx(exact, abs=1e-5)


def test_a_bound_keeps_a_cause_from_gaining_on_the_wrong_side():
    world, _ = drawn(2, {"a": np.array([-1.5])})
    free = scores(world)
    assert free.gain("a") > 10
    assert replace(free, lower=np.zeros_like(free.lower)).gain("a") == 0.0


def test_exact_collinearity_is_found_alone_and_in_pairs():
    world, _ = drawn(4, {"a": np.array([2.0])})
    half = np.random.default_rng(5).standard_normal((len(world.y), 1))
    world.columns = {
        **world.columns,
        "one": half,
        "rest": world.columns["a"] - half,
        "twin": -2 * world.columns["a"],
    }
    found = {frozenset(names): share for share, names, _ in scores(world, ("a",)).instead("a")}
    best = scores(world, ("a",)).instead("a")[0]
    assert best[1] == ("twin",)
    assert best[0] > 0.9
    # Two halves together are the cause, and neither alone is.
    assert found[frozenset({"one", "rest"})] > 0.85
    assert found[frozenset({"one"})] < 0.6
    assert found[frozenset({"c"})] < 0.3


def test_who_takes_over_enough_alone_is_asked_before_it_is_asked_with_a_partner():
    world, _ = drawn(4, {"a": np.array([9.0])})
    rng = np.random.default_rng(6)
    partner = rng.standard_normal((len(world.y), 1))
    # Nearly the cause; what it leaves is what the partner has, as the curve of a large delay is.
    world.columns = {
        **world.columns,
        "near": world.columns["a"] - 0.3 * partner,
        "partner": partner,
        "other": partner + 0.1 * rng.standard_normal((len(world.y), 1)),
    }
    rows = scores(world, ("a",)).instead("a")
    shares = {names: share for share, names, _ in rows}
    order = [names for _, names, _ in rows]
    assert shares[order[0]] < shares[order[1]]
    assert order[0] == ("near",) and "near" in order[1]
    assert order.count(("near",)) == 1 and len(order) == len(set(order))


def test_pairs_are_proposed_where_each_leaves_room_for_the_other():
    rng = np.random.default_rng(0)
    n = 400
    one = rng.standard_normal((n, 1))
    two = one + 0.2 * rng.standard_normal((n, 1))
    y = 3 * (two - one)[:, 0] + rng.standard_normal(n)
    world = World(
        columns={"one": one, "two": two, "other": rng.standard_normal((n, 1))},
        shared=np.ones((n, 1)),
        y=y,
    )
    best = proposals(scores(world), price=3.0)[0]
    assert set(best.causes) == {"one", "two"}


def test_what_would_be_certified_shrinks_with_the_flights():
    few, many = (
        scores(drawn(1, {}, samples=n)[0]).smallest("a", 6.0, 0.5)["a.k_0"] for n in (60, 960)
    )
    assert many == pytest.approx(few / 4, rel=0.3)


def test_what_would_be_certified_is_worth_a_name_and_within_bounds():
    """A centre of mass off by 10 nm is certain on exact flights, and worth nothing."""
    found = scores(drawn(1, {}, samples=960)[0])
    size = found.smallest("a", 6.0, 0.5)["a.k_0"]
    weighed = replace(found, readings=100_000).smallest("a", 6.0, 0.5)["a.k_0"]
    (row,) = found.places["a"]
    share = found.information[row, row] * (weighed / found.sigma[row]) ** 2 / 100_000
    assert weighed > 2 * size and share == pytest.approx(RULES.trace, rel=0.01)
    near = replace(found, lower=found.null - size / 2, upper=found.null + size / 2)
    assert near.smallest("a", 6.0, 0.5) == {}
