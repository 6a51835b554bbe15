"""The comparison with mujoco.sysid and AeroID is fair: from flights of its own kind each finds the
numbers that made them, and both are the same craft."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.sysid_windows import Window, difference, squared
from greybox.examples import vehicle_path
from greybox.model.vehicle import Vehicle, read_vehicle

DT, STEPS = 0.01, 50


def mujoco_peer(vehicle: Vehicle) -> Any:
    pytest.importorskip("mujoco")
    pytest.importorskip("absl", reason="mujoco.sysid needs the extra of MuJoCo: mujoco[sysid]")
    from benchmarks.sysid_mujoco import MuJoCoPeer

    return MuJoCoPeer(vehicle, DT)


def aeroid_peer(vehicle: Vehicle) -> Any:
    pytest.importorskip("aeroid", reason="pip install aeroid")
    from benchmarks.sysid_aeroid import AeroidPeer

    return AeroidPeer(vehicle, DT)


def asked(vehicle: Vehicle, count: int, seed: int, wiggle: float = 0.05) -> list[Window]:
    """Starts and commands, nothing flown."""
    rng = np.random.default_rng(seed)
    rotors = vehicle.n_rotors
    hover = vehicle.mass.value * vehicle.gravity / rotors
    out = []
    for _ in range(count):
        commands = hover * (1.0 + wiggle * rng.standard_normal((STEPS + 51, rotors)))
        start = np.concatenate(
            [
                np.zeros(3),
                [1.0, 0.0, 0.0, 0.0],
                rng.standard_normal(3),
                0.5 * rng.standard_normal(3),
            ]
        )
        held = np.repeat(start[None], STEPS + 1, axis=0)
        out.append(Window(measured=held, commanded=commands[50:], before=commands[:50]))
    return out


def flown(peer: Any, windows: list[Window]) -> list[Window]:
    """Flights of the peer's own present model, free of noise."""
    return [
        Window(measured=np.vstack([w.measured[:1], told]), commanded=w.commanded, before=w.before)
        for w, told in zip(windows, peer.predict(windows), strict=True)
    ]


@pytest.mark.slow
def test_mujoco_finds_the_numbers_that_made_its_flights(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into the working folder
    vehicle = read_vehicle(vehicle_path("nanobench"))
    true, found = mujoco_peer(vehicle), mujoco_peer(vehicle)
    true.params["lag"].value[:] = 0.06
    true.params["gain"].value[:] = [1.05, 0.97, 1.0, 0.98]
    true.params["damping"].value[:] *= 2.0
    true.params["inertia"].value[:] *= [1.2, 0.9, 1.1]
    flights = flown(true, asked(vehicle, 12, seed=3))
    before = squared(found.predict(flights), flights)["rotation"].mean()
    found.fit(flights)
    assert squared(found.predict(flights), flights)["rotation"].mean() < 1e-4 * before
    np.testing.assert_allclose(found.params["lag"].value, 0.06, rtol=0.01)
    np.testing.assert_allclose(
        found.params["inertia"].value, true.params["inertia"].value, rtol=0.02
    )
    assert all(e["std"] > 0.0 for e in found.estimates().values())


@pytest.mark.slow
def test_aeroid_finds_the_numbers_that_made_its_flights():
    vehicle = read_vehicle(vehicle_path("nanobench"))
    true, found = aeroid_peer(vehicle), aeroid_peer(vehicle)
    true.values |= {"lag": 0.06, "gain0": 1.05, "gain1": 0.97, "gain3": 0.98}
    true.values["damping.along"] *= 2.0
    for axis, factor in zip("xyz", (1.2, 0.9, 1.1)):
        true.values[f"inertia.{axis}"] *= factor
    flights = flown(true, asked(vehicle, 6, seed=3))
    before = squared(found.predict(flights), flights)["rotation"].mean()
    found.fit(flights)
    assert squared(found.predict(flights), flights)["rotation"].mean() < 1e-4 * before
    for name in ("lag", "inertia.x", "inertia.y", "inertia.z"):
        assert found.values[name] == pytest.approx(true.values[name], rel=0.02), name
    assert all(e["std"] > 0.0 for e in found.estimates().values())


@pytest.mark.slow
def test_both_peers_are_the_same_craft(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    vehicle = read_vehicle(vehicle_path("nanobench"))
    peers = mujoco_peer(vehicle), aeroid_peer(vehicle)
    peers[0].spec.option.density = peers[0].spec.option.viscosity = 0.0  # MuJoCo's own air
    windows = asked(vehicle, 3, seed=5, wiggle=0.0)  # constant: both hold commands alike
    for w in windows:
        w.commanded[:] *= [1.04, 1.0, 0.98, 1.0]
    told = [p.predict(windows) for p in peers]
    apart, moved = difference(*told), difference(told[0], told[0][:, :1])
    assert np.abs(apart).max() < 0.01 * np.abs(moved).max()
    assert np.abs(moved[:, -1, 6:9]).max() > 0.1


def test_errors_are_angles_and_distances():
    at_rest = np.zeros(13)
    at_rest[3] = 1.0
    turned = at_rest.copy()
    turned[:3] = 1.0, 2.0, 3.0
    turned[3:7] = np.cos(0.1), 0.0, 0.0, -np.sin(0.1)
    np.testing.assert_allclose(difference(at_rest[None], turned[None])[0, :3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(np.linalg.norm(difference(at_rest[None], turned[None])[0, 6:9]), 0.2)
