"""What only a sensor does is said of the sensor: coloured noise, drifts and filters are found with their numbers."""

from __future__ import annotations

import numpy as np
import pytest

import greybox.discovery.candidates
from greybox.data import Dataset, dataset_from_arrays
from greybox.discovery import imu_filter
from greybox.discovery import sensor_noise as noise
from greybox.discovery.candidates import candidates
from greybox.discovery.gap import squares
from greybox.discovery.lead import led
from greybox.discovery.nested import Nest
from greybox.discovery.workflow import discover
from greybox.estimation.fit import fit
from greybox.model.model import build_model
from greybox.model.noise import Augmented, Coloured, Drift, LowPass, sensor_parts
from greybox.model.vehicle import read_vehicle
from scenarios.excitation.injection import rich_excitation
from scenarios.excitation.waypoints import RandomWaypoints
from scenarios.plants.flight_log import fly
from scenarios.plants.noise import ProcessNoise
from scenarios.plants.presets import controller_for, x250
from scenarios.plants.sensor_faults import coloured_noise, low_passed
from scenarios.plants.vehicle_file import write_vehicle

COLUMNS = ("p", "q", "r", "ax", "ay", "az", "qw", "qx", "qy", "qz")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """(vehicle with exact values, log of 8 s with attitude and IMU)."""
    plant = x250()
    log = fly(plant, controller_for(plant), RandomWaypoints(), rich_excitation(), 8.0, seed=5, warm_up=1.0)
    vehicle = read_vehicle(write_vehicle(tmp_path_factory.mktemp("v") / "v.toml", plant, sigma={"thrust.c2": 0.1}))
    return vehicle, {k: v for k, v in log.items() if k in ("t", *COLUMNS) or k[:1] == "u"}


def white_fit(vehicle, log):
    data = dataset_from_arrays(log["t"], {k: v for k, v in log.items() if k != "t"})
    return fit(build_model(vehicle, data.channels, (), sample_time=0.01), data, initialisation="noise"), data


def searched(flown, cutoff):
    """All candidates on the log, its IMU filtered at `cutoff` [Hz] (None: not)."""
    vehicle, log = flown
    if cutoff is not None:
        log = low_passed(log, ["p", "q", "r", "ax", "ay", "az"], cutoff)
    data = dataset_from_arrays(log["t"], {k: v for k, v in log.items() if k != "t"})
    return Nest(candidates=candidates(vehicle, data.channels, sample_time=0.01), data=data)


def test_white_sensors_are_not_suspected(flown):
    found, data = white_fit(*flown)
    assert noise.suspicious(found) == ()
    assert noise.coloured_sensors(found, data) is None
    table = noise.sensor_table(found, {})
    assert {(s["channel"], s["kind"]) for s in table} >= {("p", "white"), ("ax", "white")}
    assert next(s for s in table if s["channel"] == "p")["parameters"]["sigma"] == pytest.approx(0.01, rel=0.15)


@pytest.mark.slow
def test_coloured_noise_of_one_sensor_is_found_with_its_numbers(flown):
    vehicle, log = flown
    dirty = coloured_noise(log, ["p", "q", "r"], 0.02, 0.08, np.random.default_rng(0))
    found, data = white_fit(vehicle, dirty)
    chosen = noise.coloured_sensors(found, data)
    assert chosen is not None
    assert [p.name for p in chosen.parts] == ["coloured.gyro"]
    assert chosen.parts[0].time == pytest.approx(0.08, rel=0.4)
    assert chosen.gains["coloured.gyro"] > 50


def test_the_gap_is_that_of_the_model_that_is_handed_out(flown, monkeypatch):
    """Nothing was added, so nothing closed: the sensors' colour serves the search, files have white sensors."""
    monkeypatch.setattr(greybox.discovery.candidates, "CATALOGUE", ())
    vehicle, log = flown
    dirty = coloured_noise(log, ["p", "q", "r"], 0.02, 0.08, np.random.default_rng(0))
    data = dataset_from_arrays(dirty["t"], {k: v for k, v in dirty.items() if k != "t"})
    found = discover(vehicle, data)
    assert "coloured" in {s["kind"] for s in found.sensors}
    reached = squares(found.model, led(data))[0]
    assert found.gap
    for row in found.gap:
        assert row.after == pytest.approx(np.sqrt(np.concatenate(reached[row.group, row.horizon_s]).mean()))
        assert row.after == pytest.approx(row.before, rel=0.05)


def test_a_disturbed_vehicle_does_not_blame_its_sensors(tmp_path):
    """Slow torque and force reach every channel; sensors stay white."""
    gusty = ProcessNoise(force=0.005, torque=1e-4, drift_force=0.3, drift_torque=6e-3, drift_time=0.3)
    plant = x250(process=gusty)
    log = fly(plant, controller_for(plant), RandomWaypoints(), rich_excitation(), 8.0, seed=6, warm_up=1.0)
    log = {k: v for k, v in log.items() if k in ("t", *COLUMNS, "vx", "vy", "vz") or k[:1] == "u"}
    found, data = white_fit(read_vehicle(write_vehicle(tmp_path / "v.toml", plant, sigma={"thrust.c2": 0.1})), log)
    assert noise.suspicious(found)
    assert noise.coloured_sensors(found, data) is None


def test_an_accelerometer_alone_is_not_blamed_for_what_may_be_force(flown, monkeypatch):
    """Without velocity or position nobody can tell: colour is not offered."""
    vehicle, log = flown
    dirty = coloured_noise(log, ["ax", "ay", "az"], 0.3, 0.1, np.random.default_rng(0))
    found, data = white_fit(vehicle, dirty)
    offered = []

    def note(had, parts, *rest):
        offered.extend(p.sensor for p in parts)
        raise KeyError

    monkeypatch.setattr(noise, "_coloured", note)
    with pytest.raises(KeyError):
        noise.coloured_sensors(found, data)
    assert set(offered) == {"gyro", "attitude"}


def test_a_low_pass_is_recovered_and_has_the_gain_of_a_filter(flown):
    vehicle, log = flown
    found, data = white_fit(vehicle, low_passed(log, ["p", "q", "r", "ax", "ay", "az"], 20.0))
    parts = tuple(LowPass(sensor=s, time=imu_filter.FILTER) for s in ("gyro", "accelerometer"))
    model = Augmented(core=found.model.dynamics, parts=parts)
    filtered = fit(
        model, data, free=["thrust.c2", *(f"{p.name}.T" for p in parts)], values=dict(found.model.values),
        noise=noise.noise_of(found.model), initialisation="nominal",
    )  # fmt: skip
    assert found.bic - filtered.bic > 1000
    assert filtered.parameters["low_pass.gyro.T"].value == pytest.approx(1 / (2 * np.pi * 20.0), rel=0.1)
    table = noise.sensor_table(filtered, {"low_pass.gyro": 7.0})
    entry = next(s for s in table if s["channel"] == "q" and s["kind"] == "low_pass")
    assert entry["parameters"]["cutoff"] == pytest.approx(20.0, rel=0.1)
    assert entry["delta_bic"] == 7.0


def test_model_files_have_white_sensors(flown, tmp_path):
    vehicle, log = flown
    found, data = white_fit(vehicle, log)
    parts = (Coloured(sensor="gyro", time=0.05),)
    dressed = fit(
        Augmented(core=found.model.dynamics, parts=parts), data, free=["thrust.c2"], values=dict(found.model.values),
        noise=noise.noise_of(found.model), initialisation="nominal",
    )  # fmt: skip
    plain = noise.plain_model(dressed, data)
    assert plain.values["thrust.c2"] == dressed.model.values["thrust.c2"]
    assert plain.covariance_names == dressed.model.covariance_names
    assert plain.save(tmp_path / "model.json").exists()
    assert isinstance(data, Dataset)


@pytest.mark.parametrize("cutoff", [None, 20.0])
def test_a_filter_is_asked_again_when_everything_else_is_known(flown, cutoff):
    plain = searched(flown, cutoff)
    start = plain.refit(())
    parts = tuple(LowPass(sensor=s, time=imu_filter.FILTER) for s in ("gyro", "accelerometer"))
    filtered = noise.with_parts(plain, parts)
    first = {(f"{p.name}.T", None): imu_filter.FILTER for p in parts}
    at = filtered.refit((), start=start, first=first)
    lean = imu_filter.unfiltered(plain, start, at)
    if cutoff is None:
        assert lean is not None
        assert lean.effects == ()
        assert not sensor_parts(lean.fit.model.dynamics)
    else:
        assert lean is None


@pytest.mark.parametrize("cutoff", [None, 20.0])
def test_a_lag_that_was_named_in_place_of_a_filter_makes_room_for_it(flown, cutoff):
    plain = searched(flown, cutoff)
    at = plain.refit(("motor_lag",), start=plain.refit(()), first={("motor_lag.tau", None): 0.006})
    found = imu_filter.filtered_after_all(plain, at)
    if cutoff is None:
        assert found is None
    else:
        assert found is not None
        nest, now, gains = found
        assert now.effects == ()
        assert sensor_parts(nest.candidates.model) == sensor_parts(now.fit.model.dynamics)
        assert now.fit.parameters["low_pass.gyro.T"].value == pytest.approx(1 / (2 * np.pi * 20.0), rel=0.1)
        assert min(gains.values()) == pytest.approx(at.bic - now.bic)
        assert at.bic - now.bic > 100


def test_where_only_the_imu_is_logged_a_lag_stays_a_lag(flown):
    # A filter of everything that is measured and a lag of everything that is commanded are the same to a linear model.
    vehicle, log = flown
    plain = searched((vehicle, {k: v for k, v in log.items() if k[0] != "q" or k == "q"}), 20.0)
    assert plain.candidates.blind
    at = plain.refit(("motor_lag",), start=plain.refit(()), first={("motor_lag.tau", None): 0.006})
    assert noise.suspicious(at.fit)
    assert imu_filter.filtered_after_all(plain, at) is None


def test_what_a_gyro_is_off_by_from_the_start_is_no_drift(flown):
    vehicle, log = flown
    rng = np.random.default_rng(1)
    walk = {a: 0.02 + 2e-4 * np.cumsum(rng.standard_normal(len(log["t"]))) for a in "pqr"}
    plain = searched((vehicle, log | {a: log[a] + walk[a] for a in "pqr"}), None)
    drifting = noise.with_parts(plain, (Drift(sensor="gyro"),))
    nothing = drifting.refit(())
    biased = drifting.refit(("gyro_bias",), start=nothing)
    assert nothing.bic - biased.bic > 10
    for a in "xyz":
        estimate = biased.fit.parameters[f"gyro_bias.b_{a}"]
        assert abs(estimate.value - 0.02) < 3 * estimate.std < 0.015
