"""A force that depends on the place, as beside a wall or over a fan, is a law of bumps whose place
and width the refit frees."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from greybox.discovery.workflow import discover
from greybox.model.effect import Flow
from greybox.plants.presets import x250
from greybox.residual.laws.effect_file import proposed
from greybox.residual.laws.terms import Bump, Term, terms
from scenarios.plants.outside.wall import Wall
from scenarios.studies.discovery_outside import flights
from tests.discovery.small_world import law_of, shorten, vehicle

NAMES = (*(f"attitude.{a}" for a in "wxyz"), *(f"position.{a}" for a in "xyz"))


def offered(channel: str, n: int = 300) -> list[Term]:
    """Terms of a craft that moves and turns about."""
    z = np.random.default_rng(0).standard_normal((n, len(NAMES)))
    z[:, :4] /= np.linalg.norm(z[:, :4], axis=1, keepdims=True)
    return terms(channel, NAMES, z, vehicle())


def fields(channel: str) -> list[Term]:
    return [t for t in offered(channel) if isinstance(t.shape, Bump)]


def wall() -> Term:
    """A force along x that depends on x."""
    return next(t for t in fields("force.x") if t.uses == ("east.x", "position.x"))


def test_a_force_points_along_its_coordinate_or_up_and_a_torque_is_its_moment():
    assert {t.uses for t in fields("force.x")} == {
        ("east.x", "position.x"),
        ("north.x", "position.y"),
        ("up.x", "position.x"),
        ("up.x", "position.y"),
        ("up.x", "height"),
    }
    assert {t.uses[0] for t in fields("torque.x") if t.uses[1] == "position.x"} == {
        "east.y",
        "east.z",
        "up.y",
        "up.z",
    }


def test_the_file_frees_place_and_width():
    term = wall()
    assert isinstance(term.shape, Bump)
    (effect,) = proposed([law_of("force.x", term)])
    c, place, width = effect.parameters(vehicle())
    assert (c.name, place.name, width.name) == ("c_1", "place_1", "width_1")
    assert place.lower < term.shape.place < place.upper
    assert 0 < width.lower < term.shape.width < width.upper
    flow = Flow(vehicle=vehicle(), rotation=ca.DM.eye(3), position=ca.DM([0.7, 0.0, 0.0]))
    (force,) = effect.apply(flow, {"c_1": 2.0, "place_1": 0.5, "width_1": 0.4}).values()
    np.testing.assert_allclose(
        np.array(ca.DM(force)).ravel(), [2.0 * np.exp(-0.25), 0.0, 0.0], rtol=1e-9
    )


def test_a_law_is_told_with_the_place_that_its_refit_found():
    found = law_of("force.x", wall()).refitted(
        "own", {"own.c_1": 3.0, "own.place_1": 0.25, "own.width_1": 0.1}
    )
    (text,) = found.terms
    assert text == "east.x (position.x near 0.25, 0.1 wide)"
    assert found.terms[text] == 3.0
    assert found.shapes[0] == (Bump(signal="position.x", place=0.25, width=0.1), 0.3)


def test_a_coordinate_that_stands_still_offers_none():
    z = np.random.default_rng(1).standard_normal((50, len(NAMES)))
    z[:, NAMES.index("position.x")] = 1.0
    uses = {t.uses[-1] for t in terms("force.x", NAMES, z, vehicle()) if t.shape is not None}
    assert "position.x" not in uses
    assert "position.y" in uses


@pytest.mark.slow
def test_the_pull_of_a_wall_is_found_where_it_is(monkeypatch: pytest.MonkeyPatch):
    shorten(monkeypatch)
    plant = x250([Wall(pull=0.15, place=0.6)])
    train, test = (
        flights(plant, s, 10.0, n) for n, s in {"train": (51, 52), "test": (53,)}.items()
    )
    found = discover(vehicle(), train, test)
    assert not [n.name for n in found.names if n.status in ("certified", "supported")]
    assert found.left is not None
    assert {a.channel for a in found.left.laws} == {"force.x", "force.y", "force.z"}
    for law in found.left.laws:  # its flank, which is no bell, may have a smaller bump of its own
        rows = zip(law.terms.values(), law.shapes, strict=True)
        bumps = [(abs(c), s[0]) for c, s in rows if s and isinstance(s[0], Bump)]
        strongest = max(bumps, key=lambda row: row[0])[1]
        assert strongest.signal == "position.x"
        assert strongest.place == pytest.approx(0.6, abs=0.05)
    row = next(r for r in found.gap if r.group == "velocity" and r.horizon_s == 0.5)
    assert row.with_proposals is not None
    assert row.with_proposals > 0.9
