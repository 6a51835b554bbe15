"""Motion capture that tracks another point than the body origin moves the track, and no torque:
that is no centre of mass, and neither stands for the other."""

from __future__ import annotations

import pytest

from greybox.discovery.workflow import discover
from greybox.plants.effects import CenterOfMassOffset, PlantEffect, PoseLeverArm
from tests.discovery import small_world
from tests.discovery.small_world import shorten, vehicle

TRACKED = PoseLeverArm(r_x=0.02, r_y=-0.01, r_z=0.03)
OFF_CENTRE = CenterOfMassOffset(c_x=0.004, c_y=-0.003, c_z=0.0)


@pytest.mark.parametrize(
    ("hidden", "name"),
    [
        (TRACKED, "pose_lever_arm"),
        pytest.param(OFF_CENTRE, "center_of_mass_offset", marks=pytest.mark.slow),
    ],
    ids=["tracked point", "centre of mass"],
)
def test_the_one_is_not_named_for_the_other(
    hidden: PlantEffect, name: str, monkeypatch: pytest.MonkeyPatch
):
    shorten(monkeypatch, "pose_lever_arm")
    test = small_world.flown(hidden, seeds=(11,), name="test")
    found = discover(vehicle(), small_world.flown(hidden), test)
    assert [e["name"] for e in found.effects()] == [name]
    truth = hidden.parameters()
    for p, e in found.effects()[0]["parameters"].items():
        assert abs(e["value"] - truth[f"{name}.{p}"]) < 4 * e["std"]
