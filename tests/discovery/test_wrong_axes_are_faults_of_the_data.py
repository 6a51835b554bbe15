"""Axes that are wrong are refused as a fault of the data before any search, and are no wind and no
mounting angle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from greybox.data import Dataset
from greybox.discovery.workflow import discover
from tests.discovery.small_world import flown, vehicle

Channels = Mapping[str, np.ndarray]
ATTITUDE = ("qw", "qx", "qy", "qz")


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of quaternions (4, n)."""
    (w, x, y, z), (i, j, k, m) = a, b
    return np.array(
        [
            w * i - x * j - y * k - z * m,
            w * j + x * i + y * m - z * k,
            w * k - x * m + y * i + z * j,
            w * m + x * k - y * j + z * i,
        ]
    )


def yawed(degrees: float, world: bool) -> Callable[[Channels], Channels]:
    """The attitude about the vertical of the world, or about that of the body."""
    half = np.deg2rad(degrees) / 2

    def change(channels: Channels) -> Channels:
        q = np.array([channels[n] for n in ATTITUDE])
        turn = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])[:, None] * np.ones(q.shape[1])
        return dict(zip(ATTITUDE, product(turn, q) if world else product(q, turn), strict=True))

    return change


def in_world_axes(channels: Channels) -> Channels:
    """The rates of the body, given along the axes of the world: q (0, rate) q*."""
    q = np.array([channels[n] for n in ATTITUDE])
    rate = np.array([np.zeros(q.shape[1]), *(channels[n] for n in "pqr")])
    back = q * np.array([[1.0], [-1.0], [-1.0], [-1.0]])
    return dict(zip("pqr", product(product(q, rate), back)[1:], strict=True))


def changed(change: Callable[[Channels], Channels]) -> Dataset:
    """The short flights with channels that are changed."""
    flights = [
        replace(f, segments=tuple(s.replace(change(s.channels)) for s in f.segments))
        for f in flown()
    ]
    return Dataset(flights=tuple(flights))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (yawed(90.0, world=False), "gyro and attitude agree only when"),
        (yawed(90.0, world=True), "world's x = y"),
        (yawed(28.0, world=False), "turned by 28 deg"),
        (in_world_axes, "the gyro is in world axes"),
    ],
    ids=[
        "markers by 90 degrees",
        "world by 90 degrees",
        "markers by 28 degrees",
        "rates in world axes",
    ],
)
def test_they_stop_the_search_before_it_begins(change: Callable[[Channels], Channels], said: str):
    found = discover(vehicle(), changed(change))
    assert found.verdict == "bad_data"
    assert found.effects() == []
    assert any(said in fault for fault in found.faults)
