"""Flights of a small system for black boxes: two outputs that follow one input."""

from __future__ import annotations

import numpy as np

from greybox.data import Dataset, dataset_from_arrays


def flight(seed: int = 0, n: int = 400, name: str = "flight") -> Dataset:
    """A stable second-order system, y1 and y2, driven by noise-like u, with a little measurement
    noise."""
    rng = np.random.default_rng(seed)
    u = np.convolve(rng.standard_normal(n + 9), np.ones(10) / 10, "valid")
    y = np.zeros((n, 2))
    for k in range(1, n):
        y[k, 0] = 0.9 * y[k - 1, 0] + 0.1 * y[k - 1, 1]
        y[k, 1] = 0.8 * y[k - 1, 1] - 0.2 * y[k - 1, 0] + np.tanh(2.0 * u[k - 1])
    y += 0.01 * rng.standard_normal(y.shape)
    return dataset_from_arrays(
        0.01 * np.arange(n), {"y1": y[:, 0], "y2": y[:, 1], "u": u}, name=name
    )
