"""The shipped Crazyflie's physics, trimmed in hover and linearised there, predicts like the physics
for small inputs."""

import casadi as ca
import numpy as np
import pytest

from greybox.examples import vehicle_path
from greybox.linear.prediction import simulate
from greybox.linear.records import Record
from greybox.linear.structured import fit_structured
from greybox.model.linearise import linearise, structured_from, trim
from greybox.model.model import build_model
from greybox.model.parameter import nominal_values
from greybox.model.vehicle import read_vehicle

DT = 0.01
COLUMNS = ("qw", "qx", "qy", "qz", "p", "q", "r", "vx", "vy", "vz", "ax", "ay", "az")
COMMANDS = ("u1", "u2", "u3", "u4")
VALUES = {
    "motor_lag.tau": 0.04,
    "rotational_damping.d_p": 2e-5,
    "rotational_damping.d_q": 2e-5,
    "rotor_drag.k_x": 0.005,
}

DAMPED = {"rotational_damping.d_p": 2e-5, "rotational_damping.d_q": 2e-5}


@pytest.fixture(scope="module")
def craft():
    vehicle = read_vehicle(vehicle_path("nanobench"))
    model = build_model(
        vehicle, (*COMMANDS, *COLUMNS), ("motor_lag", "rotational_damping", "rotor_drag")
    )
    return model, trim(model, DT, values=VALUES, command=np.full(4, 0.6))


def flown(model, point, u, chosen=VALUES):
    """Innovation components (N, n_e) of the nonlinear outputs about the trim outputs."""
    values = nominal_values(model.parameters).replace(chosen)
    p = ca.DM([values[q.name] for q in model.parameters])
    x, window = ca.SX.sym("x", len(model.states)), ca.SX.sym("u", 4)
    w = ca.SX.zeros(len(model.noises))
    y0 = ca.DM(_output(model, point, p))
    y = model.output(0.0, x, window, p, w, DT)
    step = ca.Function(
        "step",
        [x, window],
        [model.step(0.0, x, window, p, w, DT), model.innovation(y, y0, ca.DM(point.x))],
    )
    here, out = ca.DM(point.x), []
    for row in u:
        here, e = step(here, row)
        out.append(np.asarray(e).ravel())
    return np.array(out)


def _output(model, point, p):
    x, window = ca.SX.sym("x", len(model.states)), ca.SX.sym("u", 4)
    y = model.output(0.0, x, window, p, ca.SX.zeros(len(model.noises)), DT)
    return ca.Function("y", [x, window], [y])(point.x, point.u)


def test_hover_trim_balances_weight(craft):
    model, point = craft
    vehicle = read_vehicle(vehicle_path("nanobench"))
    thrust = nominal_values(model.parameters)["thrust.c2"] * point.u**2
    assert thrust.sum() == pytest.approx(
        nominal_values(model.parameters)["mass"] * vehicle.gravity, rel=1e-8
    )
    np.testing.assert_allclose(point.u, point.u[0], rtol=1e-8)
    assert point.residual < 1e-9


def test_error_of_the_linear_model_is_of_second_order(craft):
    model, point = craft
    linear = linearise(model, point, DT, values=VALUES)
    assert linear.outputs == model.innovations
    pattern = np.random.default_rng(0).choice([-1.0, 1.0], size=(60, 4))
    errors = []
    for size in (1e-3, 1e-4):
        u = point.u + size * pattern
        exact = flown(model, point, u)
        found = simulate(linear, u) - linear.output_offset
        errors.append(
            np.abs(found - exact).max(axis=0) / np.maximum(np.abs(exact).max(axis=0), 1e-9)
        )
    assert (errors[1] < 0.06).all()
    assert (errors[1] < 0.2 * errors[0] + 1e-6).all()


def test_inertia_and_damping_come_back_from_the_linearised_craft():
    # without motor lag: the four rotors of one axis would be states that cannot be told apart
    model = build_model(
        read_vehicle(vehicle_path("nanobench")), (*COMMANDS, *COLUMNS), ("rotational_damping",)
    )
    point = trim(model, DT, values=DAMPED, command=np.full(4, 0.6))
    names = ("inertia.xx", "rotational_damping.d_p")
    structured = structured_from(model, point, DT, names, values=DAMPED)
    rng = np.random.default_rng(1)
    roll = np.repeat(rng.choice([-1.0, 1.0], size=150), 4)
    # opposite signs left and right, and back again, so that the craft stays near hover
    u = point.u + 2e-3 * np.outer(np.diff(roll, prepend=0.0), [-1.0, -1.0, 1.0, 1.0])
    y = flown(
        model, point, u + 2e-4 * rng.normal(size=u.shape), DAMPED
    )  # gusts, as noise on the commands
    y = y + 2e-4 * rng.normal(size=y.shape)
    keep = [model.innovations.names.index(n) for n in ("p",)]
    small = _only(structured, keep)
    combined = Record(u=u @ np.array([[-1.0], [-1.0], [1.0], [1.0]]) / 4.0, y=y[:, keep])
    fit = fit_structured(small, [combined], {"inertia.xx": 2.4e-5, "rotational_damping.d_p": 1e-5})
    assert fit.converged, (fit.status, fit.values, fit.std)
    assert abs(fit.values["inertia.xx"] - 3e-5) < 4 * fit.std["inertia.xx"] + 3e-7
    assert (
        abs(fit.values["rotational_damping.d_p"] - 2e-5)
        < 4 * fit.std["rotational_damping.d_p"] + 1e-6
    )


def _only(structured, outputs):
    """The roll rate driven by one differential command."""
    import dataclasses

    from greybox.symbolic import Layout, Signal

    mix = ca.DM([[-1.0], [-1.0], [1.0], [1.0]])
    states = [6]
    return dataclasses.replace(
        structured,
        a=structured.a[states, states],
        b=structured.b[states, :] @ mix,
        c=structured.c[outputs, states],
        d=structured.d[outputs, :] @ mix,
        inputs=Layout([Signal(name="roll", unit="1")]),
        outputs=Layout([structured.outputs.signals[i] for i in outputs]),
    )
