"""Small hybrids for the tests: a quadrotor with a push in plain numbers, and a pendulum that hides
a damping."""

from __future__ import annotations

import functools

import casadi as ca
import numpy as np

from greybox.data import Dataset, dataset_from_arrays
from greybox.model.dynamics import Dynamics, StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel, build_model
from greybox.model.noise import with_disturbance
from greybox.model.parameter import Parameter, ParameterValues
from greybox.residual.features import feature_layout
from greybox.residual.hybrid import HybridModel
from greybox.residual.kernels import Kernel
from greybox.residual.posterior import Domain, GPPosterior
from greybox.residual.sparse import variational
from greybox.symbolic import Layout, Signal
from tests import simulated

FEATURES = ("body_velocity.x", "body_velocity.y", "p", "q")
CHANNELS = ("force.x", "force.y", "torque.x")
SIZES = {"force": 0.02, "torque": 2e-4}
DT = 0.02


@functools.cache
def craft(
    effects: tuple[str, ...] = ("motor_lag", "command_delay", "rotor_drag"),
) -> PhysicsModel:
    """A nano quadrotor with motor lag and delay, so that the command window is longer than one
    sample."""
    columns = (
        "u1",
        "u2",
        "u3",
        "u4",
        "p",
        "q",
        "r",
        "ax",
        "ay",
        "az",
        "qw",
        "qx",
        "qy",
        "qz",
        "x",
        "y",
        "z",
        "vbat",
    )
    return build_model(simulated.vehicle(), columns, effects, sample_time=0.01)


def push(
    dynamics: Dynamics,
    names: tuple[str, ...] = FEATURES,
    channels: tuple[str, ...] = CHANNELS,
    *,
    points: int = 6,
    seed: int = 0,
    silent: bool = False,
    kernel: str = "se",
) -> GPPosterior:
    """A process with random weights of unit variance and a random posterior covariance."""
    rng = np.random.default_rng(seed)
    n_in, n_out = len(names), len(channels)
    own = Kernel(
        family=kernel.removeprefix("linear+"),
        lengthscales=np.full(n_in, 2.0),
        variance=1.0,
        slopes=np.full(n_in, 0.3) if kernel.startswith("linear+") else None,
        reach=np.full(n_in, 4.0) if kernel.startswith("linear+") else None,
    )
    support = rng.standard_normal((points, n_in))
    outputs = Layout([dynamics.noises.signals[dynamics.noises[c]] for c in channels])
    theta = rng.standard_normal((n_out, points))
    numbers = []
    for j in range(n_out):
        root = 0.2 * np.tril(rng.standard_normal((points, points)), -1) + 0.3 * np.eye(points)
        numbers.append(variational(own, support.T, theta[j], root))
    zero = 0.0 if silent else 1.0
    return GPPosterior(
        inputs=feature_layout(dynamics, names),
        outputs=outputs,
        method="svgp",
        kernels=(own,) * n_out,
        input_mean=np.zeros(n_in),
        input_scale=np.ones(n_in),
        output_mean=np.zeros(n_out),
        output_scale=np.array([SIZES.get(c.split(".")[0], 1.0) for c in channels]),
        support=support,
        weights=zero * np.stack([n.weights for n in numbers], axis=1),
        explained=zero * np.stack([n.explained for n in numbers]),
        uncertain=zero * np.stack([n.uncertain for n in numbers]),
        noise=np.ones(n_out),
        domain=Domain(lower=-np.ones(n_in), upper=np.ones(n_in)),
    )


def drawn_weights(
    posterior: GPPosterior, output: int, size: int, rng: np.random.Generator
) -> np.ndarray:
    """`size` functions of the process as weights of its kernel values (size, M): mean plus the
    posterior's spread.

    uncertain' uncertain is the covariance of these weights, and the conditional variance between
    the support points is left out.
    """
    spread = posterior.uncertain[output]
    return posterior.weights[:, output] + rng.standard_normal((size, posterior.points)) @ spread


def craft_model(dynamics: Dynamics) -> IdentifiedModel:
    """The craft as an identified model with the noise levels that its effects suggest."""
    physics = craft()
    values = ParameterValues({d.name: d.nominal for d in dynamics.parameters})
    return IdentifiedModel(
        dynamics=dynamics,
        values=values,
        covariance_names=("mass",),
        covariance=np.array([[1e-8]]),
        process_noise=dynamics.noise_scale(0.01),
        sensor_noise=dynamics.sensor_scale(),
        weak=np.full(len(dynamics.error_states), 1e3),
        reference_state=dynamics.reference({"u1": 0.7}),
        reference_inputs=np.array([3.8 if n == "vbat" else 0.7 for n in physics.inputs.names]),
        sample_time=0.01,
        trained_on=("run0",),
        data_hash="0" * 64,
    )


def hybrid(**choices: object) -> HybridModel:
    """The craft with a random push."""
    return HybridModel(inner=craft(), posterior=push(craft(), **choices))  # type: ignore[arg-type]


def pendulum() -> StateSpaceModel:
    """A driven pendulum with linear damping; angle and rate are measured."""
    return StateSpaceModel(
        name="pendulum",
        states=Layout([Signal(name="angle", unit="rad"), Signal(name="rate", unit="rad/s")]),
        inputs=Layout([Signal(name="u", unit="N m")]),
        outputs=Layout([Signal(name="y", unit="rad"), Signal(name="w", unit="rad/s")]),
        parameters=(Parameter(name="k", unit="1/s^2", nominal=9.0, scale=9.0),),
        dynamics=lambda t, x, u, p: [x[1], u - p["k"] * ca.sin(x[0]) - 0.3 * x[1]],
        measurement=lambda t, x, u, p: [x[0], x[1]],
        noise_states=("rate",),
    )


def pendulum_model(levels: tuple[float, float] = (0.3, 0.3)) -> IdentifiedModel:
    """The pendulum with a correlated torque disturbance."""
    dynamics = with_disturbance(pendulum(), ("rate",), time=0.5)
    return IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues({d.name: d.nominal for d in dynamics.parameters}),
        process_noise=np.array(levels),
        sensor_noise=np.array([0.005, 0.01]),
        weak=np.full(3, 1e4),
        reference_state=np.zeros(3),
        reference_inputs=np.zeros(1),
        sample_time=DT,
    )


def swings(
    count: int,
    seed: int,
    *,
    hidden: float,
    period: float,
    seconds: float = 16.0,
    name: str = "swing",
    gusts: float = 0.05,
) -> Dataset:
    """Flights of the true pendulum, with -hidden rate |rate| on top; `period` [s] is that of the
    drive's slowest part, `gusts` the level of white pushes [N m sqrt(s)]."""
    rng = np.random.default_rng(seed)
    n, fine = round(seconds / DT), 4
    whole: Dataset | None = None
    for i in range(count):
        t = DT * np.arange(n)
        phase = rng.uniform(0, 2 * np.pi, 3)
        u = sum(
            a * np.sin(2 * np.pi * m * t / period + f)
            for a, m, f in zip((2.0, 1.5, 1.0), (1, 2.3, 3.7), phase)
        )
        x, rows = np.array([0.2, 0.0]), []

        def slope(x: np.ndarray, push: float) -> np.ndarray:
            return np.array(
                [x[1], push - 9.0 * np.sin(x[0]) - 0.3 * x[1] - hidden * x[1] * abs(x[1])]
            )

        for k in range(n):
            rows.append(x)
            gust = u[k] + gusts / np.sqrt(DT) * rng.standard_normal()
            h = DT / fine
            for _ in range(fine):
                a = slope(x, gust)
                b = slope(x + h / 2 * a, gust)
                c = slope(x + h / 2 * b, gust)
                d = slope(x + h * c, gust)
                x = x + h / 6 * (a + 2 * b + 2 * c + d)
        seen = np.array(rows) + [0.005, 0.01] * rng.standard_normal((n, 2))
        one = dataset_from_arrays(t, {"u": u, "y": seen[:, 0], "w": seen[:, 1]}, name=f"{name}{i}")
        whole = one if whole is None else whole + one
    assert whole is not None
    return whole
