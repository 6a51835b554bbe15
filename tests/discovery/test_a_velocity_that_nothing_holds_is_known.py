"""Which effects bring a velocity into a log that has none, and whether a filter at rest sees it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from greybox.data import Dataset
from greybox.discovery.candidates import candidates
from greybox.discovery.lead import led
from greybox.discovery.nested import Nest
from greybox.discovery.velocity import drifts
from scenarios.studies.discovery_cells import Cell, flown, nominal
from tests.discovery.small_world import flown as seen
from tests.discovery.small_world import vehicle

DRAGS = {"axial_inflow", "blade_flapping", "parasitic_drag", "rotor_drag", "translational_lift"}


def test_only_logs_without_a_velocity_have_effects_that_bring_one():
    whole = seen()
    imu = [c for c in whole.channels if c in ("p", "q", "r", "ax", "ay", "az", "vbat") or c.startswith("u")]
    assert set(candidates(vehicle(), imu, sample_time=0.01).moving) == DRAGS
    assert candidates(vehicle(), whole.channels, sample_time=0.01).moving == ()
    turned = [*imu, "qw", "qx", "qy", "qz"]
    assert set(candidates(vehicle(), turned, sample_time=0.01).moving) == DRAGS


def search(hidden: str) -> Nest:
    seed, plant, _, train, _ = next(flown(Cell(hidden=(hidden,), columns="imu", seconds=4.0), [2]))
    return Nest(candidates=candidates(nominal(plant, "off", seed), train.channels, sample_time=0.01), data=led(train))


@pytest.mark.parametrize(
    ("effect", "unseen"),
    [
        ("rotor_drag", False), ("axial_inflow", False), ("blade_flapping", False), ("parasitic_drag", True),
        ("translational_lift", True),
    ],
)  # fmt: skip
def test_a_law_that_is_flat_at_rest_does_not_hold_the_velocity(effect: str, unseen: bool):
    nest = search(effect)
    null = nest.refit(())
    assert not drifts(null.fit.model)
    size = {d.name: d.scale for d in nest.candidates.model.parameters}
    first = {(p, None): size[p] for p in nest.candidates.parameters[effect]}
    found = nest.refits([nest.from_each(nest.task((effect,), start=null, first=first))])[0]
    assert null.bic - found.bic > 100
    assert drifts(nest.settle(found).fit.model) is unseen


def test_a_measured_position_holds_it_without_any_drag():
    train = seen()
    kept = {"x", "y", "z", "qw", "qx", "qy", "qz", "p", "q", "r"} | {c for c in train.channels if c.startswith("u")}
    placed = Dataset(
        flights=tuple(
            replace(f, segments=tuple(s.without([c for c in s.channels if c not in kept]) for s in f.segments))
            for f in train
        )
    )
    offered = candidates(vehicle(), placed.channels, sample_time=0.01)
    assert offered.moving == ()
    assert not drifts(Nest(candidates=offered, data=placed).refit(()).fit.model)
