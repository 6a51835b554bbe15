"""The data-fault gate is no tuning to two craft: simulated ones of other size and layout pass,
their faults are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from faults import conjugated, exchanged, late

from greybox.data import read_table
from greybox.data.checks import check, ranges
from greybox.data.checks.view import View
from greybox.excitation import FigureEight, rich_excitation
from greybox.model.vehicle import read_vehicle
from greybox.plants.effects import MotorLag
from greybox.plants.flight_log import fly, write_log
from greybox.plants.presets import controller_for, duckiedrone, nano, x250
from greybox.plants.vehicle_file import write_vehicle

CRAFT = {"nano": nano, "x250": x250, "duckiedrone": duckiedrone}


@pytest.fixture(scope="module", params=sorted(CRAFT))
def flown(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("flown")
    plant = CRAFT[request.param]([MotorLag(tau=0.03)])
    log = fly(plant, controller_for(plant), FigureEight(), rich_excitation(), 12.0, seed=3)
    vehicle = read_vehicle(write_vehicle(folder / "vehicle.toml", plant) or folder / "vehicle.toml")
    return read_table(write_log(folder / "log.csv", log), vehicle), vehicle


def test_as_flown_nothing_blocks_and_the_lag_is_seen(flown):
    raw, vehicle = flown
    report = check([raw], vehicle)
    assert report.blocking == ()
    answers = [f.evidence for f in report.of("alignment") if "p_s" in f.evidence]
    assert 0.01 <= answers[0]["p_s"] <= 0.05


def test_an_accelerometer_that_points_down_asks_for_its_frame(flown):
    raw, vehicle = flown
    down = {n: -raw.channels[n] for n in ("ay", "az")}
    (found,) = check([replace(raw, channels={**raw.channels, **down})], vehicle).of("gravity")
    assert found.severity == "blocking"
    assert "frame = 'FRD'" in found.fix


def test_a_clock_that_is_a_little_off_is_no_unit_though_the_accelerometer_has_a_scale(flown):
    raw, vehicle = flown
    own = with_scale(raw, 0.99)
    report = check([replace(own, t=raw.t / 1.05)], vehicle)
    (found,) = report.of("clock")
    assert "the time may run 0.95" in found.message
    assert any("the velocity changes" in f.message for f in report.of("acceleration"))
    assert not check([with_scale(raw, 0.94)], vehicle).of("clock")


@pytest.mark.parametrize(("rows", "severity"), [(0, "info"), (1, "warning")])
def test_rotors_that_obey_at_once_lag_by_half_a_row_or_commands_are_late(rows, severity, tmp_path):
    """Many simulators have no motor lag: a command is held for a row, and answered in its middle."""
    plant = nano([])
    log = fly(plant, controller_for(plant), FigureEight(), rich_excitation(), 8.0, seed=3)
    write_vehicle(tmp_path / "vehicle.toml", plant)
    vehicle = read_vehicle(tmp_path / "vehicle.toml")
    raw = read_table(write_log(tmp_path / "log.csv", log), vehicle)
    commands = {f"u{i}": np.roll(raw.channels[f"u{i}"], rows) for i in range(1, 5)}
    logged = replace(raw, channels={**raw.channels, **commands})
    found = check([logged], vehicle)
    answers = [f for f in found.of("alignment") if "against the commands" in f.where]
    assert [f.severity for f in answers] == [severity]


def with_scale(raw, factor):
    scaled = {n: factor * raw.channels[n] for n in ("ax", "ay", "az")}
    return replace(raw, channels={**raw.channels, **scaled})


@pytest.mark.parametrize(
    ("a", "b"),
    [(1, 2), (1, 3), *(pytest.param(a, 4, marks=pytest.mark.slow) for a in (2, 3))],
)
def test_exchanged_motors(flown, a, b):
    raw, vehicle = flown
    messages = [f.message for f in check([exchanged(raw, f"u{a}", f"u{b}")], vehicle).of("motors")]
    assert len(messages) == 1
    assert f"u{a} drives rotor {b}, u{b} drives rotor {a} " in messages[0]


def test_spins_and_quaternion(flown):
    raw, vehicle = flown
    turned = replace(vehicle, rotors=tuple(replace(r, spin=-r.spin) for r in vehicle.rotors))
    assert any("spins" in f.message for f in check([raw], turned).blocking)
    assert any("world into body" in f.message for f in check([conjugated(raw)], vehicle).blocking)


@pytest.mark.parametrize("rows", [-9, 4, pytest.param(10, marks=pytest.mark.slow)])
def test_shifts_are_recovered_within_half_a_sample(flown, rows):
    raw, vehicle = flown
    found = check([late(raw, rows, "p q r")], vehicle).of("alignment")
    offsets = [f.evidence["offset_samples"] for f in found if "offset_samples" in f.evidence]
    assert offsets[0] == pytest.approx(rows, abs=0.5)


def test_rotor_speeds_in_rpm_block_where_the_top_speed_is_stated(flown):
    raw, vehicle = flown
    speeds = [n for n in raw.channels if n.startswith("omega")]
    assert len(speeds) == 4
    top = max(float(raw.channels[n].max()) for n in speeds)
    known = replace(vehicle, actuator=replace(vehicle.actuator, speed_max=top))
    rpm = replace(raw, channels={**raw.channels, **{n: 9.5493 * raw.channels[n] for n in speeds}})
    assert list(ranges.run(View(raw=raw, vehicle=known))) == []
    found = list(ranges.run(View(raw=rpm, vehicle=known)))
    assert [f.severity for f in found] == ["blocking"] * 4
    assert "unit = 'rpm' in [columns.rotor_speed]" in found[0].fix
