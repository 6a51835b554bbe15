"""An estimator's attitude that takes the pull of the rotors for gravity looks like an accelerometer
of other axes. The gyro tells: what it supports is not accused; without one both are named."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from faults import vehicle

from greybox.data import RawLog
from greybox.data.checks import Finding, check
from greybox.data.checks.witness import by_gyro
from greybox.frames import numeric

RATE = 100.0
PULL = 1.5
"""Seconds within which the estimator's attitude goes to what the accelerometer feels."""


def multiplied(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(numeric("multiply", a[None], b[None])[0])


@functools.cache
def flown(seed: int) -> tuple[RawLog, np.ndarray]:
    """(Thirty seconds of flight to and fro with little drag, the attitude (N, 4) of an estimator.)"""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 30.0, 1.0 / RATE)
    angles = np.zeros((t.size, 3))
    for axis, size in ((0, 0.25), (1, 0.25), (2, 0.4)):
        for frequency in rng.uniform(0.15, 0.8, 4):
            angles[:, axis] += 0.5 * size * np.sin(2 * np.pi * frequency * t + rng.uniform(0, 6))
    q = numeric("from_euler", angles)
    rate = np.zeros((t.size, 3))
    rate[1:-1] = numeric("difference", q[:-2], q[2:]) * 0.5 * RATE
    v, felt = np.zeros((t.size, 3)), np.zeros((t.size, 3))
    for k in range(t.size):
        body = numeric("rotate_inverse", q[k][None], v[k][None])[0]
        felt[k] = [-0.15 * body[0], -0.15 * body[1], 9.81]
        world = numeric("rotate", q[k][None], felt[k][None])[0] - [0.0, 0.0, 9.81]
        if k + 1 < t.size:
            v[k + 1] = v[k] + world / RATE
    rate += 0.01 * rng.standard_normal(rate.shape)
    felt += 0.1 * rng.standard_normal(felt.shape)
    seen = q.copy()
    for k in range(1, t.size):
        down = numeric("rotate_inverse", seen[k - 1][None], np.array([[0.0, 0.0, 1.0]]))[0]
        pull = np.cross(felt[k] / np.linalg.norm(felt[k]), down) / PULL
        turn = numeric("exp", ((rate[k] + pull) / RATE)[None])[0]
        seen[k] = multiplied(seen[k - 1], turn)
    v += 0.01 * rng.standard_normal(v.shape)
    channels = {f"u{i}": np.full(t.size, 0.6) for i in (1, 2, 3, 4)}
    for names, values in (("p q r", rate), ("ax ay az", felt), ("vx vy vz", v)):
        channels |= dict(zip(names.split(), values.T, strict=True))
    raw = RawLog(
        t=t,
        channels=with_attitude(channels, q),
        extra={},
        rows=np.arange(1, t.size + 1),
        flight="flown",
        source="flown.csv",
        sha256="0" * 64,
    )
    return raw, seen


def with_attitude(channels: dict[str, np.ndarray], q: np.ndarray) -> dict[str, np.ndarray]:
    return {**channels, **dict(zip(("qw", "qx", "qy", "qz"), q.T, strict=True))}


def said(seed: int, *, estimated: bool, turned: bool, gyro: bool = True) -> tuple[Finding, ...]:
    """Of the accelerometer's check, with the attitude that was `estimated` or flown, an
    accelerometer whose x and y are `turned` round, with the gyro or without."""
    raw, seen = flown(seed)
    channels = with_attitude(raw.channels, seen) if estimated else dict(raw.channels)
    if turned:
        channels |= {n: -channels[n] for n in ("ax", "ay")}
    if not gyro:
        channels = {n: v for n, v in channels.items() if n not in "pqr"}
    found = check([replace(raw, channels=channels)], vehicle("nanobench")).of("acceleration")
    return tuple(f for f in found if "agree only" in f.message)


SEEDS = (0, 2, 3)
"""Flights in which the attitude errs enough to accuse."""


@pytest.mark.parametrize(
    "seed", [SEEDS[0], *(pytest.param(s, marks=pytest.mark.slow) for s in SEEDS[1:])]
)
def test_an_attitude_that_errs_does_not_accuse_the_accelerometer(seed: int) -> None:
    (found,) = said(seed, estimated=True, turned=False)
    assert found.severity == "warning"
    assert "the attitude is what the gyro makes of it" in found.message
    assert "accelerometer" not in found.message + found.fix
    assert found.evidence["share_explained"] > found.evidence["share_as_given"]


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in range(1, 3))]
)
def test_an_accelerometer_that_is_wrong_is_accused(seed: int) -> None:
    (found,) = said(seed, estimated=False, turned=True)
    assert found.severity == "blocking"
    assert "the accelerometer's ax = -ax, ay = -ay" in found.message
    assert "the attitude errs" not in found.message


@pytest.mark.parametrize("seed", SEEDS)
def test_without_a_witness_both_are_named(seed: int) -> None:
    (found,) = said(seed, estimated=True, turned=False, gyro=False)
    assert "the accelerometer's a" in found.message and "or about as well when" in found.message
    assert "the attitude errs, which no gyro tells" in found.message


def test_as_flown_nothing_is_said() -> None:
    assert not said(0, estimated=False, turned=False)


def test_a_gyro_that_is_no_witness_clears_nobody() -> None:
    """Its axes are wrong, so that the attitude that it makes explains less than any reading."""
    raw, seen = flown(0)
    channels = with_attitude(raw.channels, seen) | {"p": raw.channels["q"], "q": raw.channels["p"]}
    found = check([replace(raw, channels=channels)], vehicle("nanobench")).of("acceleration")
    assert any("the attitude errs, which no gyro tells" in f.message for f in found)


def test_the_gyros_attitude_is_led_over_gaps_and_biases() -> None:
    raw, seen = flown(1)
    q = np.column_stack([raw.channels[n] for n in ("qw", "qx", "qy", "qz")])
    gyro = np.column_stack([raw.channels[n] for n in "pqr"]) + 0.02
    gyro[900:1000], seen = np.nan, seen.copy()
    found = by_gyro(seen, gyro, 1.0 / RATE, 5)
    assert np.isnan(found[905:995]).all() and np.isfinite(found[:895]).all()
    errors = [np.nanstd(numeric("difference", q[:890], a[:890])[:, :2]) for a in (seen, found)]
    assert errors[1] < 0.6 * errors[0]
    assert np.isnan(by_gyro(seen, np.full_like(gyro, np.nan), 1.0 / RATE, 5)).all()
