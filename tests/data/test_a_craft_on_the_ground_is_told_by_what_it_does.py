"""A craft that stands with its motors near hover is told by its turns, which do not follow the
commands as they do in flight. A hover that keeps as still is flight, with noise and without."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.data.airborne import airborne

RATE = 100.0
SECONDS, UP, DOWN = 18.0, 2.0, 16.0
"""The log begins at rest, leaves the place after `UP` and is back at `DOWN` [s]."""
MIX = np.array([[-1, -1, 1], [1, 1, 1], [1, -1, -1], [-1, 1, -1]]) / 4.0
"""What each rotor gives to roll, pitch and yaw."""
STRENGTH = np.array([220.0, 200.0, 25.0])
"""Angular acceleration for the squared commands of each axis [rad/s^2]."""
LAG = 0.03


def flown(*, standing: bool, noise: float, seed: int = 0) -> dict[str, np.ndarray]:
    """A craft whose rates are controlled, by a gyro of so much noise [rad/s]: on the ground at both
    ends, or still in the air there."""
    rng = np.random.default_rng(seed)
    dt = 1.0 / RATE
    t = np.arange(0.0, SECONDS, dt)
    rise = np.clip((t - UP) / 2.0, 0.0, 1.0) * np.clip((DOWN - t) / 2.0, 0.0, 1.0)
    rise = rise**2 * (3.0 - 2.0 * rise)
    tones = [2 * np.pi * np.array(f) for f in ((0.4, 0.9, 1.7), (0.5, 1.1, 1.5), (0.2, 0.5, 0.8))]
    wanted = np.column_stack([rise * np.sin(np.outer(t, f) + f).sum(axis=1) for f in tones])
    omega, pushed, wound = np.zeros(3), np.zeros(3), np.zeros(3)
    rates, measured, squared = (np.zeros((t.size, n)) for n in (3, 3, 4))
    for k in range(t.size):
        rates[k], measured[k] = omega, omega + noise * rng.standard_normal(3)
        wound = np.clip(wound + 5.0 * dt * (wanted[k] - measured[k]), -3.0, 3.0)
        torque = (np.array([18.0, 18.0, 9.0]) * (wanted[k] - measured[k]) + wound) / STRENGTH
        squared[k] = 0.33 + MIX @ torque
        pushed = pushed + (4.0 * MIX.T @ squared[k] - pushed) * (1.0 - np.exp(-dt / LAG))
        held = standing and not UP <= t[k] <= DOWN
        omega = np.zeros(3) if held else omega + dt * STRENGTH * pushed
    z = (0.02 if standing else 1.0) + 1.6 * rise
    logged = rates + 0.01 * rng.standard_normal(rates.shape) * (noise > 0.0)
    channels = {f"u{i + 1}": np.sqrt(squared[:, i]) for i in range(4)}
    channels |= dict(zip("pqr", logged.T, strict=True))
    z = z + 0.001 * rng.standard_normal(t.size) * (noise > 0.0)
    return {"t": t, "z": z, **channels}


def kept(log: dict[str, np.ndarray]) -> np.ndarray:
    channels = {n: v for n, v in log.items() if n != "t"}
    return airborne(log["t"], channels, driving=("u1", "u2", "u3", "u4"))[0]


@pytest.mark.parametrize("seed", range(4))
def test_motors_near_hover_on_the_ground_are_no_flight(seed: int) -> None:
    log = flown(standing=True, noise=0.01, seed=seed)
    share = np.mean([log[f"u{i}"] for i in range(1, 5)], axis=0)
    assert 0.9 < np.median(share[:150]) / np.median(share) < 1.1
    rows, t = kept(log), log["t"]
    assert not rows[(t < UP) | (t > DOWN)].any()
    assert rows[(t > UP + 1.5) & (t < DOWN - 1.5)].all()


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.01])
@pytest.mark.parametrize("seed", range(4))
def test_a_still_hover_is_flight(noise: float, seed: int) -> None:
    assert kept(flown(standing=False, noise=noise, seed=seed)).all()


def test_without_rates_the_commands_alone_tell_as_before() -> None:
    log = flown(standing=True, noise=0.01)
    others = {n: v for n, v in log.items() if n not in ("p", "q", "r")}
    assert kept(others).all()
    weak = {n: np.where(log["t"] < UP, 0.8 * v, v) for n, v in others.items() if n[0] == "u"}
    assert not kept({**others, **weak})[log["t"] < UP].any()
