"""Linearised physics predicts like the physics for small inputs, and PEM on it finds physical
parameters."""

import casadi as ca
import numpy as np
import pytest

from greybox.errors import FitError, ModelError
from greybox.linear.prediction import simulate
from greybox.linear.records import Record
from greybox.linear.structured import fit_structured
from greybox.model.dynamics import StateSpaceModel
from greybox.model.linearise import StructuredLinear, linearise, structured_from, trim
from greybox.model.parameter import Parameter
from greybox.symbolic import Layout, Signal

DT = 0.02


def pendulum():
    def dynamics(t, x, u, p):
        return [x[1], -p["stiffness"] * ca.sin(x[0]) - p["damping"] * x[1] + p["gain"] * u[0]]

    return StateSpaceModel(
        name="pendulum",
        states=Layout([Signal(name="angle", unit="rad"), Signal(name="rate", unit="rad/s")]),
        inputs=Layout([Signal(name="torque", unit="N m")]),
        outputs=Layout([Signal(name="angle", unit="rad")]),
        parameters=(
            Parameter(name="stiffness", unit="1/s^2", nominal=20.0),
            Parameter(name="damping", unit="1/s", nominal=0.8),
            Parameter(name="gain", unit="1/(kg m^2)", nominal=5.0),
        ),
        dynamics=dynamics,
        measurement=lambda t, x, u, p: [x[0]],
        substeps=2,
    )


def flown(model, u, x0, p=(20.0, 0.8, 5.0)):
    x, w, window = ca.SX.sym("x", 2), ca.SX.zeros(2), ca.SX.sym("u", 1)
    step = ca.Function("step", [x, window], [model.step(0, x, window, ca.DM(list(p)), w, DT)])
    out, here = [], np.asarray(x0, dtype=float)
    for k in range(len(u)):
        out.append(here[0])
        here = np.asarray(step(here, u[k])).ravel()
    return np.array(out)[:, None]


def test_trim_finds_the_torque_that_holds_an_angle():
    point = trim(pendulum(), DT, start=np.array([0.6, 0.0]), fixed_states=("angle",))
    assert point.x[0] == 0.6
    assert point.u[0] == pytest.approx(20.0 * np.sin(0.6) / 5.0, rel=1e-6)


def test_trim_that_does_not_exist_is_said():
    with pytest.raises(ModelError, match="no trim point"):
        trim(
            pendulum(),
            DT,
            start=np.array([0.6, 0.0]),
            fixed_states=("angle", "rate"),
            free_commands=(),
        )


@pytest.mark.parametrize("angle", [0.0, 0.6])
def test_linearised_model_predicts_like_the_nonlinear_one_for_small_inputs(angle):
    model = pendulum()
    point = trim(model, DT, start=np.array([angle, 0.0]), fixed_states=("angle",))
    linear = linearise(model, point, DT)
    rng = np.random.default_rng(0)
    errors = []
    for size in (0.2, 0.02):
        u = point.u + size * rng.choice([-1.0, 1.0], size=(300, 1))
        exact = flown(model, u, point.x)
        errors.append(np.abs(simulate(linear, u) - exact).max() / np.abs(exact - point.x[0]).max())
    assert errors[1] < 0.01
    assert (
        errors[1] < 0.3 * errors[0]
    )  # the error of a linearisation is of second order (third at the bottom)


def records(seed, angle=0.0, noise=0.002, count=1500, process=0.0):
    model = pendulum()
    rng = np.random.default_rng(seed)
    u = 5.0 * np.sin(angle) * 20.0 / 25.0 + 0.3 * rng.choice([-1.0, 1.0], size=(count, 1)).repeat(
        1, axis=1
    )
    y = flown(model, u, [angle, 0.0])
    return model, [Record(u=u, y=y + noise * rng.normal(size=y.shape))]


def test_physical_parameters_come_back_from_the_linearised_model():
    model, data = records(1)
    point = trim(model, DT, start=np.zeros(2), fixed_states=("angle",))
    structured = structured_from(model, point, DT, ("stiffness", "damping", "gain"))
    fit = fit_structured(
        structured, data, {"stiffness": 14.0, "damping": 0.4, "gain": 8.0}, noise_model=False
    )
    assert fit.converged
    for name, truth in (("stiffness", 20.0), ("damping", 0.8), ("gain", 5.0)):
        assert abs(fit.values[name] - truth) < 4 * fit.std[name] + 0.01 * truth
        assert fit.std[name] < 0.05 * truth


def test_intervals_of_a_structured_fit_cover_with_process_noise_and_a_free_gain():
    theta = ca.SX.sym("theta", 2)
    a = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-theta[0], -theta[1]))
    model = StructuredLinear(
        name="oscillator",
        names=("stiffness", "damping"),
        theta=theta,
        a=a,
        b=ca.DM([[0.0], [1.0]]),
        c=ca.DM([[1.0, 0.0]]),
        d=ca.DM([[0.0]]),
        dt=0.1,
    )
    ad, bd, cd, _ = model.matrices(np.array([4.0, 1.0]))
    hits = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=(1200, 1))
        x, y = np.zeros(2), np.zeros((1200, 1))
        for k in range(1200):
            y[k] = cd @ x + 0.02 * rng.normal()
            x = ad @ x + bd @ u[k] + np.array([0.0, 0.05]) * rng.normal()
        fit = fit_structured(model, [Record(u=u, y=y)], {"stiffness": 3.0, "damping": 0.6})
        assert fit.converged
        for name, truth in (("stiffness", 4.0), ("damping", 1.0)):
            hits.append(abs(fit.values[name] - truth) < 1.96 * fit.std[name])
    assert np.sum(hits) >= 19  # of 24; fewer has probability below 1 %


def test_structured_tangent_is_the_derivative():
    from greybox.linear.predictor import full_vector
    from greybox.linear.structured import StructuredPoint

    model, _ = records(2)
    point = trim(model, DT, start=np.zeros(2), fixed_states=("angle",))
    for structured in (
        structured_from(model, point, DT, ("stiffness", "damping", "gain")),
        _continuous(),
    ):
        here = StructuredPoint(
            model=structured,
            theta=np.array([0.9, 1.1, 1.2]),
            unit=np.array([20.0, 0.8, 5.0]),
            gain=np.array([[0.3], [0.2]]),
            free_gain=True,
            input_scale=np.array([0.5]),
            output_scale=np.array([0.1]),
        )
        tangent = here.tangent()
        for i in range(5):
            h = np.zeros(5)
            h[i] = 1e-6
            slope = (full_vector(here.moved(h).system) - full_vector(here.moved(-h).system)) / 2e-6
            np.testing.assert_allclose(tangent[:, i], slope, rtol=1e-5, atol=1e-8)


def _continuous():
    theta = ca.SX.sym("theta", 3)
    a = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-theta[0], -theta[1]))
    return StructuredLinear(
        name="c",
        names=("s", "d", "g"),
        theta=theta,
        a=a,
        b=ca.vertcat(0, theta[2]),
        c=ca.DM([[1.0, 0.0]]),
        d=ca.DM([[0.0]]),
        dt=DT,
    )


def test_a_combination_that_the_data_cannot_split_is_named():
    theta = ca.SX.sym("theta", 3)
    model = StructuredLinear(
        name="motor",
        names=("pole", "gain", "arm"),
        theta=theta,
        a=-theta[0],
        b=theta[1] * theta[2],
        c=ca.DM(1.0),
        d=ca.DM(0.0),
        dt=0.1,
    )
    rng = np.random.default_rng(3)
    u = rng.normal(size=(500, 1))
    a, b, c, _ = model.matrices(np.array([2.0, 3.0, 0.5]))
    x, y = np.zeros(1), np.zeros((500, 1))
    for k in range(500):
        y[k] = c @ x + 0.05 * rng.normal()
        x = a @ x + b @ u[k]
    with pytest.raises(FitError, match="gain, arm"):
        fit_structured(
            model, [Record(u=u, y=y)], {"pole": 1.5, "gain": 2.0, "arm": 0.5}, noise_model=False
        )
