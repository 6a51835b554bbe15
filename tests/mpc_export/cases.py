"""Small models to export: the craft of the residual tests with a delay, disturbances and a random
push."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from greybox.model.dynamics import Dynamics, StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices
from greybox.model.noise import Coloured, LowPass, with_disturbance, with_parts
from greybox.model.parameter import Parameter, ParameterValues
from greybox.residual.hybrid import HybridModel
from greybox.symbolic import Layout, Signal
from tests.residual import hybrid_cases

FEATURES = ("body_velocity.x", "gravity.x", "gravity.y", "p", "q", "nu1")


def identified(dynamics: Dynamics, **changes: float) -> IdentifiedModel:
    """With the noise levels that fit the model, an uncertain mass, delay and lag, and a training
    domain."""
    model = hybrid_cases.craft_model(dynamics).with_values(changes)
    names = ("mass", "command_delay.d", "motor_lag.tau")
    return replace(
        model,
        covariance_names=names,
        covariance=np.diag([1e-8, 1e-6, 1e-6]),
        domain={"u1": (0.2, 0.9), "p": (-3.0, 3.0), "az": (5.0, 15.0), "qw": (-1.0, 1.0)},
    )


def physics(delay: float = 0.013) -> IdentifiedModel:
    """Motor lag, a delay of more than one sample, rotor drag."""
    return identified(
        hybrid_cases.craft(),
        **{"command_delay.d": delay, "motor_lag.tau": 0.04, "rotor_drag.k_x": 1e-5},
    )


def disturbed() -> IdentifiedModel:
    """The same with disturbance force and torque."""
    dynamics = with_disturbance(hybrid_cases.craft(), ("force", "torque"), time=2.0)
    return identified(dynamics, **{"command_delay.d": 0.013, "motor_lag.tau": 0.04})


def filtered() -> IdentifiedModel:
    """The same with a filtered gyro and a coloured accelerometer besides."""
    parts = (LowPass(sensor="gyro"), Coloured(sensor="accelerometer"))
    dynamics = with_disturbance(
        with_parts(hybrid_cases.craft(), parts), ("force", "torque"), time=2.0
    )
    return identified(dynamics, **{"command_delay.d": 0.013, "motor_lag.tau": 0.04})


@functools.cache
def hybrid(points: int = 8, kernel: str = "linear+se") -> IdentifiedModel:
    """The same with torque disturbances and a random push on three channels."""
    dynamics = with_disturbance(hybrid_cases.craft(), ("torque",), time=2.0)
    push = hybrid_cases.push(hybrid_cases.craft(), FEATURES, points=points, kernel=kernel)
    return identified(
        HybridModel(inner=dynamics, posterior=push),
        **{"command_delay.d": 0.013, "motor_lag.tau": 0.04},
    )


def linear(delays: tuple[int, ...] = (2, 0)) -> LinearModel:
    """Three states, two inputs with different delays, two outputs."""
    rng = np.random.default_rng(4)
    a = np.array([[0.9, 0.1, 0.0], [-0.1, 0.8, 0.05], [0.0, 0.1, 0.7]])
    return LinearModel(
        name="box",
        matrices=Matrices(
            a,
            rng.normal(size=(3, 2)),
            rng.normal(size=(2, 3)),
            np.zeros((2, 2)),
            0.1 * np.ones((3, 2)),
        ),
        noise=np.array([[0.04, 0.01], [0.01, 0.09]]),
        dt=0.02,
        inputs=Layout([Signal(name="u", unit="V"), Signal(name="v", unit="V")]),
        outputs=Layout([Signal(name="a", unit="m"), Signal(name="b", unit="m")]),
        delays=delays,
        input_offset=np.array([0.5, -0.2]),
        output_offset=np.array([1.0, 2.0]),
    )


def own() -> IdentifiedModel:
    """A user's own cart of one command; names that differ in letters alone."""
    dynamics = StateSpaceModel(
        name="cart",
        states=Layout([Signal(name="V", unit="m/s"), Signal(name="v", unit="m/s")]),
        inputs=Layout([Signal(name="u", unit="V")]),
        outputs=Layout([Signal(name="v", unit="m/s")]),
        parameters=(
            Parameter(name="M", unit="kg", nominal=2.0),
            Parameter(name="m", unit="kg/s", nominal=0.5),
        ),
        dynamics=lambda t, x, u, p: [(u[0] - p["m"] * x[0]) / p["M"], 5.0 * (x[0] - x[1])],
        measurement=lambda t, x, u, p: [x[1]],
    )
    return IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues({"M": 2.0, "m": 0.5}),
        process_noise=np.array([0.05, 0.05]),
        sensor_noise=np.array([0.01]),
        weak=np.full(2, 1e3),
        reference_state=np.zeros(2),
        reference_inputs=np.zeros(1),
        sample_time=0.02,
        covariance_names=("M", "m"),
        covariance=np.diag([1e-4, 1e-4]),
        domain={"u": (-1.0, 1.0), "v": (-2.0, 2.0)},
    )


def point(functions, rng: np.random.Generator, spread: float = 1.0) -> dict[str, np.ndarray]:
    """A random point of flight: x, u, p and values for every other argument that a function may
    take."""
    n = functions.sizes
    x = functions.reference[0] + 0.2 * spread * rng.standard_normal(n["n_x"])
    names = functions.states.names
    if "attitude.w" in names:
        at = [names.index(f"attitude.{a}") for a in "wxyz"]
        x[at] = rng.standard_normal(4)
        x[at] /= np.linalg.norm(x[at])
    for i, name in enumerate(names):
        if name.startswith(("history", "rotor")):
            x[i] = rng.uniform(0.1, 0.9)
        if name.startswith("disturbance"):
            x[i] = functions.scales[0][i] * rng.standard_normal()
    root = 0.1 * rng.standard_normal((n["n_d"], n["n_d"]))
    u, y = rng.uniform(0.1, 0.9, n["n_u"]), rng.standard_normal(n["n_y"])
    if "qw" in functions.outputs:  # what has another length is no measurement
        at = [functions.outputs[f"q{a}"] for a in "wxyz"]
        y[at] /= np.linalg.norm(y[at])
    return {
        "x": x,
        "u": u,
        "p": functions.parameter_values.copy(),
        "y": y,
        "there": (rng.random(n["n_e"]) < 0.7).astype(float),
        "S": root @ root.T,
        "K": 0.1 * rng.standard_normal((n["n_u"], n["n_d"])),
        "r": rng.standard_normal(n["n_r"]),
        "c": 0.01 * rng.standard_normal((n["n_d"], n["n_g"])),
        "b": rng.standard_normal((n["n_d"], n["n_theta"])),
        "lam": rng.standard_normal(n["n_x"]),
        "z": spread * rng.standard_normal(n["n_z"]),
        "d": 0.1 * rng.standard_normal(n["n_d"]),
        "x1": x,
        "x2": functions["boxplus"](x, 0.1 * rng.standard_normal(n["n_d"])).full().ravel(),
    }
