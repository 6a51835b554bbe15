"""What is left over is called a law only where a few signals explain it on flights that were left out."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.discovery.leftover import SHARE, Leftover, _law
from greybox.discovery.terms import terms
from tests.discovery.small_world import vehicle

NAMES = (
    "body_velocity.x", "body_velocity.y", "p", "q", "position.z",
    "attitude.w", "attitude.x", "attitude.y", "attitude.z", "u1", "u2", "u3", "u4",
)  # fmt: skip


def signals(n: int = 400, seed: int = 0) -> tuple[np.ndarray, tuple[str, ...]]:
    """Slow signals of two flights that yaw on the spot, (n, 13), and the flight of every row."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((n + 40, len(NAMES)))
    z = np.stack([np.convolve(c, np.ones(40) / 40, "valid")[:n] for c in white.T], axis=1) * 5
    z[:, NAMES.index("position.z")] = 1.0 + 0.4 * np.tanh(z[:, NAMES.index("position.z")])
    half = 1.5 * z[:, NAMES.index("attitude.z")]
    z[:, 5:9] = np.column_stack([np.cos(half), 0 * half, 0 * half, np.sin(half)])
    z[:, 9:] = 0.6 + 0.05 * np.tanh(z[:, 9:])
    return z, ("a",) * (n // 2) + ("b",) * (n - n // 2)


def law(y: np.ndarray, z: np.ndarray, flights: tuple[str, ...], seed: int = 0) -> Leftover:
    return _law("torque.z", "N m", terms("torque.z", NAMES, z, vehicle()), y, flights, seed)


def column(z: np.ndarray, name: str) -> np.ndarray:
    return np.asarray(z[:, NAMES.index(name)])


def test_a_planted_law_is_written_down_with_its_coefficients():
    z, flights = signals()
    noise = 0.02 * np.random.default_rng(1).standard_normal(len(z))
    north = 1 - 2 * column(z, "attitude.z") ** 2
    found = law(0.3 * north - 0.2 * column(z, "p") * np.abs(column(z, "p")) + noise, z, flights)
    assert found.lawful
    assert found.share > 0.9
    assert "p" in found.depends_on
    assert {"north.y", "east.x"} & set(found.depends_on)  # the same thing, of a level craft
    assert max(found.terms.get("north.y", 0), found.terms.get("east.x", 0)) == pytest.approx(0.3, abs=0.02)
    assert found.terms["p |p|"] == pytest.approx(-0.2, abs=0.02)
    assert found.to_dict()["proposal"].startswith("torque.z = ")


def test_a_product_of_two_signals_is_found():
    z, flights = signals(seed=4)
    y = column(z, "body_velocity.x") * column(z, "q") + 0.1 * np.random.default_rng(2).standard_normal(len(z))
    found = law(y, z, flights)
    assert found.lawful
    assert set(found.depends_on) == {"velocity.x", "q"}


@pytest.mark.parametrize("colour", [1, 4])
def test_noise_has_no_law(colour: int):
    called = 0
    for seed in range(20):
        z, flights = signals(seed=seed)
        white = np.random.default_rng(500 + seed).standard_normal(len(z) + colour)
        found = law(np.convolve(white, np.ones(colour), "valid")[: len(z)], z, flights, seed)
        assert found.lawful == (bool(found.terms) and found.share >= SHARE)
        called += found.lawful
    assert called <= 1


def test_what_turns_its_sign_between_flights_is_no_law():
    called = 0
    for seed in range(10):
        z, flights = signals(n=2000, seed=seed)
        y = np.where(np.array(flights) == "a", 1.0, -1.0) * column(z, "q")
        called += law(y, z, flights).lawful
    # By chance another signal may change its sign along.
    assert called <= 1


def test_nothing_left_is_nothing():
    z, flights = signals()
    found = law(np.zeros(len(z)), z, flights)
    assert (found.rms, found.terms, found.lawful) == (0.0, {}, False)
    assert found.to_dict()["proposal"] is None


def test_the_same_seed_gives_the_same_law():
    z, flights = signals()
    y = column(z, "q") + np.random.default_rng(3).standard_normal(len(z))
    assert law(y, z, flights, 5).to_dict() == law(y, z, flights, 5).to_dict()
