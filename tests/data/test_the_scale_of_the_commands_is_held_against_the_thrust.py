"""A range of the commands that is not the log's is found by the thrust: where the commands begin by
how steeply it grows, whatever thrust and mass the file states. Right ranges pass."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from faults import real, scaled, vehicle, with_channels

from greybox.data import read_table
from greybox.data.checks import check
from greybox.data.checks.ranges import FIXES
from greybox.data.readers.mapping import mapping_of
from greybox.examples import SETS, flight_paths
from greybox.excitation import FigureEight, rich_excitation
from greybox.model.vehicle import read_vehicle
from greybox.model.vehicle_parts import Quantity
from greybox.plants.effects import MotorLag
from greybox.plants.flight_log import fly, write_log
from greybox.plants.presets import controller_for, nano, x250
from greybox.plants.vehicle_file import write_vehicle

CRAFT = {"nano": nano, "x250": x250}
COMMANDS = ("u1", "u2", "u3", "u4")
GIVEN = mapping_of({"command": {"fields": list(COMMANDS), "limits": [0.0, 2000.0]}}, where="test")


@pytest.fixture(scope="module", params=sorted(CRAFT))
def flown(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("flown")
    plant = CRAFT[request.param]([MotorLag(tau=0.03)])
    log = fly(plant, controller_for(plant), FigureEight(), rich_excitation(), 12.0, seed=3)
    craft = read_vehicle(write_vehicle(folder / "vehicle.toml", plant) or folder / "vehicle.toml")
    return read_table(write_log(folder / "log.csv", log), craft), craft


def said(raw, craft):
    return check([raw], craft).of("thrust")


def in_range(raw, low, high):
    """The commands as they read where u = 0 is at low, and 1 at high."""
    return with_channels(raw, **{n: low + (high - low) * raw.channels[n] for n in COMMANDS})


def with_thrust(craft, factor, *, mass=1.0):
    thrust = tuple(Quantity(value=factor * q.value) for q in craft.actuator.thrust)
    weight = Quantity(value=mass * craft.mass.value)
    return replace(craft, mass=weight, actuator=replace(craft.actuator, thrust=thrust))


@pytest.mark.parametrize("factor", [0.75, 1.0, 1.3])
def test_a_right_range_passes_though_the_thrust_is_off(flown, factor):
    raw, craft = flown
    assert said(raw, with_thrust(craft, factor)) == ()


@pytest.mark.parametrize("factor", [0.75, 1.0, 1.3])
def test_commands_that_begin_elsewhere_name_their_range_whatever_the_thrust(flown, factor):
    raw, craft = flown
    craft = replace(with_thrust(craft, factor), columns=GIVEN)
    (found,) = said(in_range(raw, 0.5, 1.0), craft)
    assert found.severity == "blocking"
    assert found.evidence["begins_at"] == pytest.approx(0.5, abs=0.05)
    assert "limits = [1000, 2000]" in found.fix
    assert "in the log" in found.message


@pytest.mark.parametrize(("low", "high"), [(0.0, 100.0), (1000.0, 2000.0), (0.0, 65535.0)])
def test_a_range_that_nobody_stated_is_told_by_the_values_and_by_the_thrust(flown, low, high):
    raw, craft = flown
    report = check([in_range(raw, low, high)], craft)
    fixes = {f.fix for f in report.of("ranges") if "channel u" in f.where}
    assert fixes == {
        f"give the range of the commands: [columns.command] limits = [{low:g}, {high:g}]?"
    }
    for found in report.of("thrust"):
        assert "limits = [" not in found.fix or f"limits = [{low:g}, {high:g}]" in found.fix


@pytest.mark.parametrize(
    ("low", "high"), [(-1.0, 1.0), (0.0, 1.5), (0.0, 8.0), (0.0, 838.0), (900.0, 1900.0)]
)
def test_a_range_that_the_commands_do_not_fill_is_not_proposed(flown, low, high):
    """A range that merely holds the values makes every gain wrong, and the gyro is accused of it."""
    raw, craft = flown
    first = raw.channels["u1"]
    u = {n: np.clip(raw.channels[n], 0.0, 1.0) for n in COMMANDS}
    u["u1"] = np.where(np.arange(first.size) % 2, 1.0, 0.0)  # the whole range is used
    report = check([in_range(with_channels(raw, **u), low, high)], craft)
    fixes = {f.fix for f in report.of("ranges") if "channel u" in f.where}
    assert fixes == {FIXES["command"]}


def test_a_top_of_another_unit_is_found_too(flown):
    raw, craft = flown
    (found,) = said(in_range(raw, 1000 / 65535, 2000 / 65535), craft)
    assert found.severity == "blocking"
    assert found.evidence["begins_at"] == pytest.approx(1000 / 65535, rel=0.1)


@pytest.mark.parametrize(("thrust", "mass"), [(2.0, 1.0), (1.0, 2.0)])
def test_a_number_that_is_wrong_is_a_warning_and_no_range(flown, thrust, mass):
    raw, craft = flown
    (found,) = said(raw, with_thrust(craft, thrust, mass=mass))
    assert found.severity == "warning"
    assert found.evidence["thrust_over_promised"] == pytest.approx(mass / thrust, rel=0.1)
    assert "weigh the craft" in found.fix
    assert "begins_at" not in found.evidence


def test_a_file_that_is_unsure_of_its_thrust_is_not_held_to_it(flown):
    raw, craft = flown
    c0, c1, c2 = (Quantity(value=2.0 * q.value, sigma=q.value) for q in craft.actuator.thrust)
    unsure = replace(craft, actuator=replace(craft.actuator, thrust=(c0, c1, c2)))
    assert said(raw, unsure) == ()


@pytest.mark.parametrize("strength", [0.3, 0.5])
def test_a_curve_of_the_commands_is_no_range(flown, strength):
    raw, craft = flown
    root = (1.0 - strength) / (2.0 * strength)
    curved = {n: (raw.channels[n] / strength + root**2) ** 0.5 - root for n in COMMANDS}
    assert said(with_channels(raw, **curved), craft) == ()


def test_shares_of_thrust_are_no_rotor_speeds(flown):
    raw, craft = flown
    shares = with_channels(raw, **{n: raw.channels[n] ** 2 for n in COMMANDS})
    (found,) = said(shares, craft)
    assert found.severity == "warning"
    assert "shares of thrust" in found.message
    assert found.evidence["steepness"] == pytest.approx(0.5, abs=0.1)
    full = sum(q.value for q in craft.actuator.thrust)
    assert f"thrust = [0, {full:.4g}, 0], torque" in found.fix
    c0, c1, c2 = (replace(q, sigma=0.1 * q.value) for q in craft.actuator.thrust)
    unsure = replace(craft, actuator=replace(craft.actuator, thrust=(c0, c1, c2)))
    assert f", thrust_sigma = [0, {0.1 * full:.2g}, 0], torque" in said(shares, unsure)[0].fix
    mended = tuple(Quantity(value=v) for v in (0.0, full, 0.0))
    assert said(shares, replace(craft, actuator=replace(craft.actuator, thrust=mended))) == ()


def blind(raw, *groups):
    """The log without the accelerometer, and without these channels."""
    gone = {"ax", "ay", "az", *groups}
    return replace(raw, channels={k: v for k, v in raw.channels.items() if k not in gone})


@pytest.mark.parametrize("groups", [(), ("vx", "vy", "vz")])
def test_the_motion_weighs_the_thrust_where_no_accelerometer_does(flown, groups):
    """Before, thrust in newtons under a map of rotor speeds was a mass of several times the real
    one, and nothing was said of the commands."""
    raw, craft = flown
    assert said(blind(raw, *groups), craft) == ()
    shares = with_channels(raw, **{n: raw.channels[n] ** 2 for n in COMMANDS})
    (found,) = said(blind(shares, *groups), craft)
    assert "shares of thrust" in found.message
    assert found.evidence["steepness"] == pytest.approx(0.5, abs=0.1)
    assert found.where == f"u1.. against {'x, y, z' if groups else 'vx, vy, vz'} with qw..qz"


def test_a_position_in_millimetres_is_not_said_of_the_mass_alone(flown):
    raw, craft = flown
    found = said(scaled(blind(raw, "vx", "vy", "vz"), "x y z", 1000.0), craft)
    assert found and all("the unit in [columns.position]" in f.fix for f in found)


def test_a_motion_in_a_wrong_frame_weighs_no_thrust(flown):
    raw, craft = flown
    ned = blind(scaled(raw, "vy vz", -1.0), "x", "y", "z")
    report = check([ned], craft)
    assert report.blocking and not report.of("thrust")
    assert any(u.check == "thrust" and "motion" in u.reason for u in report.not_judged)


def test_a_map_that_takes_commands_for_shares_is_not_told_that_they_are(flown):
    """Before, the fix of a slope that feedback made smaller was the map of the file."""
    raw, craft = flown
    full = sum(q.value for q in craft.actuator.thrust)
    linear = tuple(Quantity(value=v) for v in (0.0, full, 0.0))
    taken = replace(craft, actuator=replace(craft.actuator, thrust=linear))
    shares = {n: raw.channels[n] ** 2 for n in COMMANDS}
    wide = {n: np.clip(u.mean() + 2.0 * (u - u.mean()), 0.01, 1.0) for n, u in shares.items()}
    heavy = replace(taken, mass=Quantity(value=2.0 * craft.mass.value))
    (found,) = said(with_channels(raw, **wide), heavy)
    assert "shares" not in found.message and "weigh the craft" in found.fix
    assert said(with_channels(raw, **wide), taken) == ()


def test_gusts_that_hide_the_slope_leave_it_enough_where_the_level_asks_for_shares(flown):
    """Before, a craft that 1.9 times the promised thrust carries had a wrong mass, no more."""
    raw, craft = flown
    gust = np.random.default_rng(0).normal(size=raw.channels["az"].size)
    gust = 0.6 * np.convolve(gust, np.ones(40) / np.sqrt(40), "same")
    shares = {n: raw.channels[n] ** 2 for n in COMMANDS}
    (found,) = said(with_channels(raw, **shares, az=raw.channels["az"] + gust), craft)
    assert "shares of thrust" in found.message and "log the square roots" in found.fix


@pytest.mark.slow
@pytest.mark.parametrize("set_name", SETS)
def test_real_flights_pass(set_name):
    """So does test_injected_faults_are_found_and_clean_flights_pass.py, of the same reports."""
    logs = [read_table(p, vehicle(set_name)) for p in flight_paths(set_name)]
    report = check(logs, vehicle(set_name))
    assert report.of("thrust") == ()
    assert not [u for u in report.not_judged if u.check == "thrust"]


@pytest.mark.parametrize("flight", ["log10", "log15"])
def test_real_flights_with_commands_that_begin_elsewhere(flight):
    (found,) = said(in_range(real("arpl_crazyflie", flight), 0.5, 1.0), vehicle("arpl_crazyflie"))
    assert found.severity == "blocking"
    assert found.evidence["begins_at"] == pytest.approx(0.5, abs=0.06)


def test_what_cannot_be_judged_is_said():
    raw = real("arpl_crazyflie", "log15")
    report = check([blind(raw)], vehicle("arpl_crazyflie"))
    (reason,) = [u.reason for u in report.not_judged if u.check == "thrust"]
    assert reason == "no accelerometer, and no attitude with velocity or position"


def test_an_accelerometer_of_a_wrong_unit_is_no_wrong_thrust():
    raw = real("arpl_crazyflie", "log15")
    report = check([scaled(raw, "ax ay az", 1 / 9.81)], vehicle("arpl_crazyflie"))
    assert report.of("gravity")
    assert not report.of("thrust")
    assert any(u.check == "thrust" and "unit" in u.reason for u in report.not_judged)
