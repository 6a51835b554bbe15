"""What is left over is called a law only where a few signals explain it on stretches that were left out."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.discovery.leftover import SHARE, Leftover, _law

NAMES = ("velocity.x", "velocity.y", "p", "q", "height", "psi", "u1")


def signals(n: int = 400, seed: int = 0) -> tuple[np.ndarray, tuple[str, ...]]:
    """Slow signals of two flights, (n, 7), and the flight of every row."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((n + 40, len(NAMES)))
    z = np.stack([np.convolve(c, np.ones(40) / 40, "valid")[:n] for c in white.T], axis=1) * 5
    z[:, NAMES.index("height")] = 1.0 + 0.4 * np.tanh(z[:, NAMES.index("height")])
    z[:, NAMES.index("psi")] *= 3
    return z, ("a",) * (n // 2) + ("b",) * (n - n // 2)


def law(y: np.ndarray, z: np.ndarray, flights: tuple[str, ...], seed: int = 0) -> Leftover:
    return _law("torque.z", "N m", z, y, NAMES, flights, seed)


def column(z: np.ndarray, name: str) -> np.ndarray:
    return np.asarray(z[:, NAMES.index(name)])


def test_a_planted_law_is_written_down_with_its_coefficients():
    z, flights = signals()
    noise = 0.02 * np.random.default_rng(1).standard_normal(len(z))
    found = law(0.3 * np.sin(column(z, "psi")) - 0.2 * column(z, "p") * np.abs(column(z, "p")) + noise, z, flights)
    assert found.lawful
    assert found.share > 0.9
    assert set(found.depends_on) == {"psi", "p"}
    assert found.terms["sin(psi)"] == pytest.approx(0.3, abs=0.02)
    assert found.terms["p |p|"] == pytest.approx(-0.2, abs=0.02)
    assert found.to_dict()["proposal"].startswith("torque.z = ")


def test_a_product_of_two_signals_is_found():
    z, flights = signals(seed=4)
    y = column(z, "velocity.x") * column(z, "u1") + 0.1 * np.random.default_rng(2).standard_normal(len(z))
    found = law(y, z, flights)
    assert found.lawful
    assert set(found.depends_on) == {"velocity.x", "u1"}


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
