"""The covariance that travels with an open-loop prediction is that of an ensemble of simulated
futures."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from greybox.data import dataset_from_arrays
from greybox.estimation.filtering import Filter
from greybox.estimation.propagation import Propagator
from greybox.model.dynamics import StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.noise import with_disturbance
from greybox.model.parameter import Parameter, ParameterValues
from greybox.symbolic import Layout, Signal

DT, N, H = 0.05, 60, 20


def pendulum() -> IdentifiedModel:
    """A driven pendulum with an uncertain stiffness and a correlated torque; its angle is
    measured."""
    inner = StateSpaceModel(
        name="pendulum",
        states=Layout([Signal(name="angle", unit="rad"), Signal(name="rate", unit="rad/s")]),
        inputs=Layout([Signal(name="u", unit="N m")]),
        outputs=Layout([Signal(name="y", unit="rad")]),
        parameters=(Parameter(name="k", unit="1/s^2", nominal=4.0, scale=4.0),),
        dynamics=lambda t, x, u, p: [x[1], u - p["k"] * ca.sin(x[0]) - 0.4 * x[1]],
        measurement=lambda t, x, u, p: [x[0]],
        noise_states=("rate",),
    )
    dynamics = with_disturbance(inner, ("rate",), time=0.4)
    return IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues({d.name: d.nominal for d in dynamics.parameters}),
        covariance_names=("k",),
        covariance=np.array([[0.6**2]]),
        process_noise=np.array([0.05, 0.05]),
        sensor_noise=np.array([0.01]),
        weak=np.full(3, 1e4),
        reference_state=np.zeros(3),
        reference_inputs=np.zeros(1),
        sample_time=DT,
    )


def propagated(model: IdentifiedModel, **choices):
    runner = Filter(model)
    t = DT * np.arange(N)
    u = 0.8 * np.sin(1.7 * t)
    data = dataset_from_arrays(t, {"u": u, "y": 0.1 * np.sin(1.7 * t)}, name="run")
    filtered = runner.run(data.flights[0].segments[0])
    origin = np.array([25])
    return filtered, u, list(Propagator(runner, **choices).run(filtered, origin, H))


@pytest.mark.parametrize("parameters", [True, False])
def test_ensemble_of_futures(parameters: bool):
    model = pendulum()
    filtered, u, ahead = propagated(model, parameters=parameters)
    rng, size = np.random.default_rng(0), 4000
    root = np.linalg.cholesky(filtered.state_covariance)
    x = filtered.states[26][:, None] + root @ rng.standard_normal((3, size))
    p = np.repeat(model.parameter_vector()[:, None], size, axis=1)
    if parameters:
        p[0] += 0.6 * rng.standard_normal(size)
    s = [ca.SX.sym(n, k) for n, k in (("x", 3), ("u", 1), ("p", 2), ("w", 2))]
    step = ca.Function("step", s, [model.dynamics.step(0, *s, DT)]).map(size)
    for a in ahead:
        spread = np.cov(x)
        stated = a.covariance[0]
        # 4000 members: 5 standard errors of a variance are 11 %.
        assert np.diag(stated) == pytest.approx(np.diag(spread), rel=0.12)
        scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
        assert np.abs((stated - spread) / scale).max() < 0.12
        assert a.innovation_covariance[0, 0, 0] == pytest.approx(stated[0, 0] + 0.01**2, rel=1e-9)
        w = model.process_noise[:, None] * rng.standard_normal((2, size))
        x = np.asarray(step(x, np.full((1, size), u[25 + a.h]), p, w).full())


def test_mean_path_is_the_rollout():
    model = pendulum()
    filtered, _, ahead = propagated(model)
    y = Filter(model).rollout(filtered, np.array([25]), H)
    assert np.array([a.states[0, 0] for a in ahead]) == pytest.approx(y[0, :, 0], abs=1e-12)


def test_extra_deviations_replace_those_of_the_fit():
    model = pendulum()
    with_fit = propagated(model)[2][-1].covariance[0, 0, 0]
    sharper = propagated(model, extra={"k": 1e-6})[2][-1].covariance[0, 0, 0]
    without = propagated(model, parameters=False)[2][-1].covariance[0, 0, 0]
    assert sharper == pytest.approx(without, rel=1e-6)
    assert with_fit > 1.2 * without


def scaled() -> StateSpaceModel:
    """The pendulum, of whose stiffness flights show only k (1 + s) / mass."""
    numbers = (("k", "N m", 4.0), ("mass", "kg", 1.0), ("s", "-", 0.0))
    return StateSpaceModel(
        name="pendulum",
        states=Layout([Signal(name="angle", unit="rad"), Signal(name="rate", unit="rad/s")]),
        inputs=Layout([Signal(name="u", unit="N m")]),
        outputs=Layout([Signal(name="y", unit="rad")]),
        parameters=tuple(Parameter(name=n, unit=u, nominal=v, scale=1.0) for n, u, v in numbers),
        dynamics=lambda t, x, u, p: [
            x[1],
            u - p["k"] * (1.0 + p["s"]) / p["mass"] * ca.sin(x[0]) - 0.4 * x[1],
        ],
        measurement=lambda t, x, u, p: [x[0]],
        noise_states=("rate",),
    )


@pytest.mark.parametrize(
    ("known", "extra"),
    [
        ({"considered": {"mass": (0.15, {"k": 4.0})}}, {}),
        (
            {
                "flight_spread": {"s": (0.0, 1e-6)},
                "flight_covariance": np.array([[-4.0 * 0.15**2], [0.15**2]]),
            },
            {"s": 1e-6},
        ),
    ],
)
def test_numbers_that_only_show_together_spread_no_prediction(known, extra):
    """The stiffness is known to 15 %, what it does to a thousandth: a mass that was held moves with
    it, or a flight's own level against it."""
    model = replace(
        pendulum(),
        dynamics=with_disturbance(scaled(), ("rate",), time=0.4),
        covariance=np.array([[0.6**2 + 0.004**2]]),
        **known,
    )
    model = replace(
        model, values=ParameterValues({d.name: d.nominal for d in model.dynamics.parameters})
    )
    without = propagated(model, parameters=False)[2][-1].covariance[0, 0, 0]
    alone = replace(model, considered={}, flight_covariance=np.zeros((0, 0)))
    assert propagated(alone, extra=extra)[2][-1].covariance[0, 0, 0] > 1.2 * without
    assert propagated(model, extra=extra)[2][-1].covariance[0, 0, 0] == pytest.approx(
        without, rel=1e-3
    )
