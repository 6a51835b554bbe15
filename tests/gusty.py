"""Carts in gusts that blew before the ride began, and the model that knows them: in the estimator's
and in the search's tests."""

from __future__ import annotations

import functools

import numpy as np

from greybox.data import Dataset, dataset_from_arrays
from greybox.model.dynamics import StateSpaceModel
from greybox.model.noise import Augmented, with_disturbance
from greybox.model.parameter import Parameter
from greybox.symbolic import FloatArray, Layout, Signal

DT, SIGMA, TIME, ROWS = 0.05, 12.0, 2.0, 60
"""Sample time [s], standard deviation [m/s^2] and time constant [s] of the gusts, samples of a
ride. They are twelve times the white noise that a model of this scale is thought to have."""
KEPT = float(np.exp(-DT / TIME))
LEVELS = {"noise.process.v": 1e-3, "noise.process.disturbance.v": SIGMA * (1 - KEPT**2) ** 0.5}
"""The gusts as noise levels."""


@functools.cache
def model() -> Augmented:
    """Position and speed of a cart without friction are seen; b [m/s^2] pushes it all the time, its
    null is 0."""
    seen = Layout([Signal(name="x", unit="m"), Signal(name="v", unit="m/s")])
    cart = StateSpaceModel(
        name="cart in gusts",
        states=seen,
        inputs=Layout([Signal(name="f", unit="N")]),
        outputs=seen,
        parameters=(
            Parameter(
                name="b",
                unit="m/s^2",
                nominal=0.0,
                null=0.0,
                scale=SIGMA,
                sigma=3 * SIGMA,
                scope="flight",
            ),
        ),
        dynamics=lambda t, x, u, p: [x[1], u[0] + p["b"]],
        measurement=lambda t, x, u, p: [x[0], x[1]],
        noise_states=("v",),
        initial={"x": 0.0, "v": 0.0},
        initial_sigma={"x": 2.0, "v": 1.0},
        sensor_sigma={"x": 0.2, "v": 0.3},
    )
    blown = with_disturbance(cart, ["v"], time=TIME)
    assert isinstance(blown, Augmented)
    return blown


def rides(count: int, push: float = 0.0, sigma: float = SIGMA) -> Dataset:
    """Rides from unknown starts, in gusts of `sigma` and under a steady `push` [m/s^2]."""
    flights = []
    for seed in range(700, 700 + count):
        rng = np.random.default_rng(seed)
        gust, x = sigma * rng.normal(), rng.normal(size=2) * [2.0, 1.0]
        seen: FloatArray = np.zeros((ROWS, 2))
        for row in seen:
            row[:] = x + [0.2, 0.3] * rng.normal(size=2)
            felt = gust + push
            x = np.array([x[0] + DT * x[1] + 0.5 * DT**2 * felt, x[1] + DT * felt])
            gust = KEPT * gust + sigma * (1 - KEPT**2) ** 0.5 * rng.normal()
        columns = {"f": np.zeros(ROWS), "x": seen[:, 0], "v": seen[:, 1]}
        flights += dataset_from_arrays(DT * np.arange(ROWS), columns, name=f"ride{seed}").flights
    return Dataset(flights=tuple(flights))
