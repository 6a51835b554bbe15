"""Plants outside the catalogue: no relative of an effect that greybox knows, gone at their null,
felt away from it."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.model.effects import CATALOGUE
from greybox.plants.effects import PlantEffect
from greybox.plants.presets import controller_for, x250
from scenarios.plants import outside
from scenarios.studies import discovery_outside
from scenarios.studies.discovery_outside import CASES, affected, by_learning, flights, report

NULLS: dict[str, PlantEffect] = {
    "magnet": outside.Magnet(),
    "sloshing_mass": outside.SloshingMass(),
    "thrust_gap": outside.ThrustGap(),
    "wall": outside.Wall(),
    "warm_motors": outside.WarmMotors(),
    "tether": outside.Tether(),
    "power_drag": outside.PowerDrag(),
    "quadratic_damping": outside.QuadraticDamping(),
    "exponential_ground": outside.ExponentialGround(),
    "relaxing_drag": outside.RelaxingDrag(),
    "hysteretic_damping": outside.HystereticDamping(),
    "munk_moment": outside.MunkMoment(),
    "air_outlet": outside.AirOutlet(),
    "plate_in_wake": outside.PlateInWake(),
    "loose_arm": outside.LooseArm(),
    "returning_wake": outside.ReturningWake(),
}


def path(*effects: PlantEffect) -> np.ndarray:
    """Noise-free motion under open-loop commands for 0.5 s, (50, 13)."""
    plant = x250(effects)
    plant.reset(0, velocity=(1.0, -0.5, 0.3), rates=(0.4, -0.3, 0.5))
    rows = []
    for k in range(50):
        plant.step(0.54 + 0.03 * np.sin(0.3 * k + np.arange(4)), 0.01)
        row = plant.measure(noise=False)
        rows.append(
            [
                row[c]
                for c in ("x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "p", "q", "r")
            ]
        )
    return np.array(rows)


def test_every_effect_of_the_folder_is_a_case_and_has_a_name_of_its_own():
    assert set(NULLS) == set(CASES)
    assert {type(e) for e in NULLS.values()} == {getattr(outside, n) for n in outside.__all__}
    assert not {e.name for e in CATALOGUE} & {c.hidden.name for c in CASES.values()}
    assert {n for c in CASES.values() for n in c.family} <= {e.name for e in CATALOGUE}


@pytest.mark.parametrize("name", NULLS)
def test_it_vanishes_at_its_null_and_is_felt_away_from_it(name: str):
    bare = path()
    np.testing.assert_allclose(path(NULLS[name]), bare, atol=1e-12)
    assert np.abs(path(CASES[name].hidden) - bare).max() > 1e-4


@pytest.mark.parametrize("name", NULLS)
def test_the_controller_keeps_it_in_the_air_in_batches(name: str):
    plant = x250([CASES[name].hidden])
    assert controller_for(plant) is not None
    data = flights(plant, (1, 2), 1.0, "f")
    assert len(data.flights) == 2
    for flight in data:
        z = flight.segments[0].channels["z"]
        assert np.isfinite(z).all()
        assert z.min() > 0.1
        assert z.max() < 3.0


def test_the_share_is_of_what_the_effect_adds_to_the_least_error():
    least = {"position": 1.0, "rate": 0.5, "velocity": 1.0}
    rows = [
        {"group": "position", "before": 2.0, "floor": 0.5, "closed": 0.4, "with_proposals": 0.6},
        {"group": "rate", "before": 0.51, "floor": None, "closed": 0.0, "with_proposals": 0.0},
        {"group": "velocity", "before": 1.5, "floor": 0.1, "closed": 0.9, "with_proposals": None},
    ]
    assert affected(rows, least) == ("position", pytest.approx(0.6 * (4 - 0.25) / (4 - 1)))
    assert affected(rows[1:2], least) is None
    taught = {"learned": {"rmse": {"position": 1.2, "rate": 0.5}}}
    assert by_learning({"gap": rows, **taught}, least) == pytest.approx((4 - 1.44) / (4 - 1))
    assert by_learning({"gap": rows[1:2], **taught}, least) is None
    assert by_learning({"gap": rows}, least) is None


def test_the_table_counts_cases_and_families(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(discovery_outside, "least", lambda seed: {"position": 1.0})
    gap = [
        {"group": "position", "before": 2.0, "floor": 0.0, "closed": 0.5, "with_proposals": None}
    ]
    row = {
        "wrong": [],
        "flagged": ["force.x"],
        "right_axis": True,
        "gap": gap,
        "case": "wall",
        "seed": 1,
    }
    text = report(
        [row, {**row, "case": "power_drag", "wrong": ["ground_effect"], "right_axis": False}]
    )
    assert [line.split()[:3] for line in text.splitlines()[1:]] == [
        ["wall", "1", "0"],
        ["power_drag", "1", "1"],
        ["outside", "1", "0"],
        ["relatives", "1", "1"],
        ["all", "2", "1"],
    ]
    assert all("0.667, 0.667" in line for line in text.splitlines()[1:])
    taught = {"learned": {"rmse": {"position": 1.0}}}
    lines = report([{**row, **taught}, {**row, "case": "power_drag"}]).splitlines()
    assert lines[1].split()[-4:] == ["1.000,", "1.000", "(", "1)"]
    assert lines[2].split()[-3:] == ["-", "(", "0)"]
