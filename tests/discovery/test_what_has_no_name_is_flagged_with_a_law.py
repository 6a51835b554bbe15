"""A torque that no catalogue effect explains: no wrong name survives, and the proposed file closes
the gap if used."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from greybox.discovery.result import Discovery
from greybox.discovery.workflow import discover
from greybox.model.effects_file import load_effects
from greybox.plants.presets import x250
from scenarios.plants.outside import Magnet
from scenarios.studies.discovery_outside import flights
from tests.discovery.small_world import shorten, vehicle
from tests.discovery.test_discover_names_what_is_hidden import valid

HIDDEN = x250([Magnet(m=3e-3)])
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def found() -> Discovery:
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        return discover(
            vehicle(),
            flights(HIDDEN, (1, 2), 10.0, "train"),
            flights(HIDDEN, (11,), 10.0, "test"),
            attainable=True,
        )


def test_the_verdict_is_unnamed_on_the_axes_that_the_magnet_turns(found: Discovery):
    content = valid(found)
    assert content["verdict"] == "unnamed"
    assert content["effects"] == []
    flagged = {u["channel"]: u for u in content["unnamed"]}
    assert "torque.z" in flagged
    assert not any(c.startswith("force") for c in flagged)
    assert {"north.y", "east.x"} & set(flagged["torque.z"]["depends_on"])


def test_the_law_is_the_magnets(found: Discovery):
    law = next(a for a in found.left.laws if a.channel == "torque.z") if found.left else None
    assert law is not None
    assert law.terms.get("north.y", law.terms.get("east.x")) == pytest.approx(3e-3, rel=0.25)


def test_the_proposals_close_most_of_the_gap_and_load_as_a_users_effects(
    found: Discovery, tmp_path: Path
):
    half = [r for r in found.gap if r.horizon_s == 0.5 and r.group == "rotation"]
    assert half[0].closed == pytest.approx(0.0, abs=0.05)
    assert half[0].with_proposals is not None
    assert half[0].with_proposals > 0.7
    assert half[0].attainable is not None
    assert half[0].attainable < 1.1
    own = []
    for name, text in found.proposals().items():
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        own += load_effects(path)
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        again = discover(
            vehicle(),
            flights(HIDDEN, (1, 2), 10.0, "train"),
            flights(HIDDEN, (11,), 10.0, "test"),
            own=own,
        )
    names = {e["name"] for e in again.effects()}
    assert names
    assert all(n.startswith("proposal_torque") for n in names)


def test_the_command_writes_the_proposals_beside_the_result(found: Discovery):
    files = {u["file"] for u in found.unnamed() if u["proposal"]}
    assert files == set(found.proposals())
    assert json.dumps(found.to_dict()["unnamed"])
