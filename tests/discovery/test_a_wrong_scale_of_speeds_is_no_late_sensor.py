"""Rotor speeds that are logged beside commands with a wrong scale, or turn slower than commands say
as the battery empties, certify nothing else: every model has their scale."""

from __future__ import annotations

import pytest

from greybox.data import Dataset
from greybox.discovery.cause import offer
from greybox.discovery.workflow import discover
from greybox.plants.effects import MotorLag, PlantEffect, RotorSpeedScale
from scenarios.studies import discovery_cells, discovery_grid
from tests.discovery.small_world import plant, shorten

LAG = MotorLag(tau=0.03)
TRUE = (0.05, 0.04, 0.05, 0.06)
SCALES = [f"rotor_speed_scale.s_{i}" for i in range(1, 5)]


def flown(*effects: PlantEffect, seeds: tuple[int, ...], name: str) -> Dataset:
    """Flights with rotor speeds."""
    return discovery_cells.dataset(discovery_cells.logs(plant(*effects), seeds, 4.0), name, ())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rivals", "seeds"), [(("sensor_delay",), (1,)), (("pose_delay", "sensor_delay"), (1, 2))]
)
def test_speeds_that_are_five_per_cent_too_large_name_nothing(
    rivals: tuple[str, ...], seeds: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
):
    shorten(monkeypatch, "rotor_speed_scale", "motor_lag", *rivals)
    craft = discovery_grid.vehicle_of(plant(LAG))
    wrong = (LAG, RotorSpeedScale(s=TRUE))
    test = flown(*wrong, seeds=(11,), name="test")
    found = discover(craft, flown(*wrong, seeds=seeds, name="train"), test)
    assert ([e["name"] for e in found.effects()], found.traces()) == (["motor_lag"], [])
    lag = found.effects()[0]["parameters"]["tau"]
    assert abs(lag["value"] - LAG.tau) < 4 * lag["std"]
    rows = {b["name"]: b["parameters"] for b in found.to_dict()["base"]}["rotor_speed_scale"]
    for (name, row), true in zip(rows.items(), TRUE, strict=True):
        assert abs(row["value"] - true) < 4 * row["std"] < 0.004, name
    assert "rotor_speed_scale (s_1 = 0.05" in found.summary()


def test_every_flight_has_its_own_scale_where_no_log_shows_the_battery():
    columns = flown(LAG, seeds=(1,), name="one").channels
    craft = discovery_grid.vehicle_of(plant(LAG))
    shown = offer(craft, columns, sample_time=0.01)
    assert {"thrust_level", "rotor_speed_scale"} <= shown.base
    assert not set(SCALES) & set(shown.per_flight)
    blind = offer(craft, set(columns) - {"vbat"}, sample_time=0.01)
    assert {"thrust_level.s", *SCALES} <= set(blind.per_flight)
    without = offer(craft, [c for c in columns if not c.startswith("omega")], sample_time=0.01)
    assert "rotor_speed_scale" in without.unjudged
    assert not set(SCALES) & set(without.per_flight)
