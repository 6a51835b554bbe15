"""A first-order system of the user's own whose candidates are known: small and fast problems for
the score tests.

    x' = -a x + b u + q u^2 + s1 sin(2 x) + s2 x |x|,    y = x + e

a and b are free, `square` = {q} and `bend` = {s1, s2} are candidates with null 0, `copy` = {g}
enters like b does and cannot be told from it.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

import casadi as ca
import numpy as np

from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.fit import Fit, fit
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, Layout, Signal

GROUPS = {"square": ("q",), "bend": ("s1", "s2"), "copy": ("g",)}
NULL = {"q": 0.0, "s1": 0.0, "s2": 0.0, "g": 0.0}
CORE = ("a", "b")
EVERY = (*CORE, *NULL)
DT, NOISE, PROCESS, BLOCK = 0.05, 0.05, 0.02, 10


def _derivative(t: Expr, x: Expr, u: Expr, p: dict[str, Expr]) -> list[Expr]:
    bend = p["s1"] * ca.sin(2 * x[0]) + p["s2"] * x[0] * ca.fabs(x[0])
    return [-p["a"] * x[0] + (p["b"] + p["g"]) * u + p["q"] * u * u + bend]


@functools.cache
def model() -> StateSpaceModel:
    """Nominal values twenty per cent off."""
    x = Signal(name="x", unit="m")
    core = {"a": 1.2, "b": 1.6}
    return StateSpaceModel(
        name="toy",
        states=Layout([x]),
        inputs=Layout([Signal(name="u", unit="N")]),
        outputs=Layout([Signal(name="y", unit="m")]),
        parameters=(
            *(
                Parameter(name=n, unit="1/s", nominal=v, lower=0.1 * v, upper=10 * v, scale=v)
                for n, v in core.items()
            ),
            *(
                Parameter(name=n, unit="1/s", nominal=0.0, lower=-5, upper=5, null=0.0, scale=0.1)
                for n in NULL
            ),
        ),
        dynamics=_derivative,
        measurement=lambda t, x, u, p: [x[0]],
        noise_states=("x",),
        initial_sigma={"x": 1.0},
        sensor_sigma={"y": NOISE},
        substeps=1,
    )


def record(
    seed: int, truth: Mapping[str, float] | None = None, n: int = 400, bursts: bool = False
) -> Dataset:
    """n samples under random steps, white process and sensor noise; `truth` sets candidates. With
    `bursts` the steps are small but for two stretches of 20 samples, in which alone u^2 is felt."""
    p = {"a": 1.0, "b": 2.0, **NULL, **(truth or {})}
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1, 1, n // 10), 10)
    if bursts:
        u *= 0.2
        for at, sign in ((n // 4, 1.0), (3 * n // 4, -1.0)):
            u[at : at + 20] = sign
    push, error = PROCESS * np.sqrt(DT) * rng.standard_normal(n), NOISE * rng.standard_normal(n)
    x, seen = 0.0, np.empty(n)
    for k in range(n):
        seen[k] = x
        for _ in range(5):
            slope = -p["a"] * x + (p["b"] + p["g"]) * u[k] + p["q"] * u[k] ** 2
            x += DT / 5 * (slope + p["s1"] * np.sin(2 * x) + p["s2"] * x * abs(x))
        x += push[k]
    return dataset_from_arrays(DT * np.arange(n), {"u": u, "y": seen + error}, name=f"run{seed}")


def null_fit(data: Dataset) -> Fit:
    """Fit of the core; every candidate at its null."""
    return fit(model(), data, free=CORE, values=NULL, build=EVERY, initialisation="noise")
