"""The comparison with mujoco.sysid is fair: from flights of its own kind it finds the numbers that
made them."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("absl", reason="mujoco.sysid needs the extra of MuJoCo: mujoco[sysid]")

from benchmarks.sysid_peers import Peer, Window, difference, squared
from greybox.examples import vehicle_path
from greybox.model.vehicle import read_vehicle

DT, STEPS = 0.01, 50


def windows(peer: Peer, count: int, seed: int) -> list[Window]:
    """Flights of the peer's own present model, free of noise."""
    rng = np.random.default_rng(seed)
    hover = peer.values["mass"] * 9.81 / peer.count
    asked = []
    for _ in range(count):
        commands = hover * (1.0 + 0.05 * rng.standard_normal((STEPS + 51, peer.count)))
        start = np.concatenate(
            [
                np.zeros(3),
                [1.0, 0.0, 0.0, 0.0],
                rng.standard_normal(3),
                0.5 * rng.standard_normal(3),
            ]
        )
        held = np.repeat(start[None], STEPS + 1, axis=0)
        asked.append(Window(measured=held, commanded=commands[50:], before=commands[:50]))
    return [
        Window(measured=np.vstack([w.measured[:1], flown]), commanded=w.commanded, before=w.before)
        for w, flown in zip(asked, peer.predict(asked), strict=True)
    ]


@pytest.mark.slow
def test_the_peer_finds_the_numbers_that_made_its_flights(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into the working folder
    vehicle = read_vehicle(vehicle_path("nanobench"))
    true, found = Peer(vehicle, DT), Peer(vehicle, DT)
    true.params["lag"].value[:] = 0.06
    true.params["gain"].value[:] = [1.05, 0.97, 1.0, 0.98]
    true.params["damping"].value[:] *= 2.0
    true.params["inertia"].value[:] *= [1.2, 0.9, 1.1]
    flown = windows(true, 12, seed=3)
    before = squared(found.predict(flown), flown)["rotation"].mean()
    found.fit(flown)
    assert squared(found.predict(flown), flown)["rotation"].mean() < 1e-4 * before
    np.testing.assert_allclose(found.params["lag"].value, 0.06, rtol=0.01)
    np.testing.assert_allclose(
        found.params["inertia"].value, true.params["inertia"].value, rtol=0.02
    )
    assert all(e["std"] > 0.0 for e in found.estimates().values())


def test_errors_are_angles_and_distances():
    at_rest = np.zeros(13)
    at_rest[3] = 1.0
    turned = at_rest.copy()
    turned[:3] = 1.0, 2.0, 3.0
    turned[3:7] = np.cos(0.1), 0.0, 0.0, -np.sin(0.1)
    np.testing.assert_allclose(difference(at_rest[None], turned[None])[0, :3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(np.linalg.norm(difference(at_rest[None], turned[None])[0, 6:9]), 0.2)
