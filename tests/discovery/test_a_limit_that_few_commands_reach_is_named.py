"""A limit of the commands is felt in a few bursts, in which a test of block scores cannot see it, however large it is."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import greybox.discovery.candidates
from greybox.discovery.name import PLAIN
from greybox.discovery.workflow import discover
from greybox.model.effects import CATALOGUE
from scenarios.plants.effects import CommandSaturation
from tests.discovery.small_world import flown, vehicle

SOME = ("command_saturation", "thrust_curve", "battery_sag")


@pytest.fixture(scope="module", autouse=True)
def some() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(greybox.discovery.candidates, "CATALOGUE", tuple(e for e in CATALOGUE if e.name in SOME))
        yield


def test_it_is_named_though_block_scores_are_silent():
    hidden = CommandSaturation(a_hi=0.31)
    found = discover(vehicle(), flown(hidden), flown(hidden, seeds=(11,), name="test"))
    (addition,) = found.additions
    tested = {s.name: s for s in addition.scores}
    limit = tested["command_saturation"]
    assert limit.threshold
    assert not tested["thrust_curve"].threshold
    assert limit.burst
    assert limit.p_family < 1e-6 < 0.05 < limit.p
    samples = addition.before.fit.n_samples
    assert addition.delta_bic > 2 * PLAIN * samples
    assert addition.p_value < 1e-6
    (effect,) = found.effects()
    assert effect["name"] == "command_saturation"
    assert effect["parameters"]["a_hi"]["value"] == pytest.approx(0.31, abs=0.002)


def test_a_limit_that_is_not_reached_is_not_named():
    hidden = CommandSaturation(a_hi=0.1)
    found = discover(vehicle(), flown(hidden), flown(hidden, seeds=(11,), name="test"))
    assert found.verdict == "nothing_missing"
    assert any(s.threshold for s in found.last_scores)
