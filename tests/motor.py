"""A DC motor as a user's own model, and records of the simulated motor: small, fast problems for
the estimation tests."""

from __future__ import annotations

import functools

import casadi as ca
import numpy as np

from greybox.data import Dataset, dataset_from_arrays
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, Layout, Signal
from scenarios.plants.dc_motor import DcMotor

TRUTH = {"R": 1.2, "L": 0.02, "k": 0.05, "J": 2.0e-4, "b": 1.0e-4, "c": 0.01}
START = {"R": 1.0, "L": 0.03, "k": 0.04, "J": 3.0e-4, "b": 2.0e-4, "c": 0.005}
UNITS = {"R": "ohm", "L": "H", "k": "V s/rad", "J": "kg m^2", "b": "N m s/rad", "c": "N m"}
CURRENT, SPEED = Signal(name="current", unit="A"), Signal(name="speed", unit="rad/s")


def _derivative(t: Expr, x: Expr, u: Expr, p: dict[str, Expr]) -> list[Expr]:
    friction = p["b"] * x[1] + p["c"] * ca.tanh(x[1])
    return [(u - p["R"] * x[0] - p["k"] * x[1]) / p["L"], (p["k"] * x[0] - friction) / p["J"]]


@functools.cache
def model() -> StateSpaceModel:
    """The motor with wrong nominal values (20-100 per cent off); torque noise acts on the speed
    alone."""
    return StateSpaceModel(
        name="motor",
        states=Layout([CURRENT, SPEED]),
        inputs=Layout([Signal(name="u", unit="V")]),
        outputs=Layout([CURRENT, SPEED]),
        parameters=tuple(
            Parameter(name=n, unit=UNITS[n], nominal=v, lower=0.02 * v, upper=50 * v, scale=v)
            for n, v in START.items()
        ),
        dynamics=_derivative,
        measurement=lambda t, x, u, p: [x[0], x[1]],
        noise_states=("speed",),
        initial_sigma={"current": 1.0, "speed": 10.0},
        sensor_sigma={"current": 0.05, "speed": 1.0},
        substeps=5,
    )


def voltage(n: int, seed: int = 1) -> np.ndarray:
    """Random steps of 20 samples between -6 and 6 V, (n,)."""
    return np.repeat(np.random.default_rng(seed).uniform(-6, 6, n // 20), 20)


@functools.cache
def record(n: int = 600, torque_noise: float = 0.0, seed: int = 0, name: str = "run") -> Dataset:
    """An open-loop experiment of n samples at 200 Hz."""
    log = DcMotor(torque_noise=torque_noise).run(voltage(n), 0.005, seed)
    return dataset_from_arrays(log.pop("t"), log, name=name)


def closed_loop(n: int = 3000, torque_noise: float = 0.002, seed: int = 0) -> Dataset:
    """A speed loop u = 0.3 (reference - measured speed): the voltage carries the noise of the
    speed. Channel `sp`."""
    plant = DcMotor(torque_noise=torque_noise, speed_noise=1.0)
    plant.reset(seed)
    reference = np.repeat(np.random.default_rng(7).uniform(-40, 40, n // 30), 30)
    rows = []
    for r in reference:
        seen = plant.measure()
        u = 0.3 * (r - seen["speed"])
        rows.append((seen["t"], u, seen["current"], seen["speed"], r))
        plant.step(u, 0.005)
    t, u, current, speed, sp = np.array(rows).T
    return dataset_from_arrays(t, {"u": u, "current": current, "speed": speed, "sp": sp})
