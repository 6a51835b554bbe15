"""OutputController on a fitted model of the user's own: it plans with the exported model, its tube
is the spread of the closed loop, and tightened plans stay that far inside."""

from dataclasses import replace

import numpy as np
import pytest

from greybox.errors import ModelError
from greybox.model.dynamics import StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.parameter import Parameter, ParameterValues
from greybox.symbolic import Layout, Signal
from mpc_export.functions import model_functions
from mpc_export.noise import parameter_covariance
from mpc_export.outputs.controller import OutputController, OutputProblem, typical_problem
from mpc_export.outputs.machine import ModelMachine

DT, HORIZON = 0.05, 10
SPREAD = {"drag": 0.15, "gauge": 0.05}


def cart() -> IdentifiedModel:
    """A cart that its drag slows; of its place and speed a gauge shows the speed, by a factor."""
    names = Layout([Signal(name="s", unit="m"), Signal(name="v", unit="m/s")])
    dynamics = StateSpaceModel(
        name="cart",
        states=names,
        inputs=Layout([Signal(name="u", unit="m/s^2")]),
        outputs=Layout([Signal(name="place", unit="m"), Signal(name="speed", unit="m/s")]),
        parameters=tuple(Parameter(name=n, unit="1", nominal=1.0, scale=1.0) for n in SPREAD),
        dynamics=lambda t, x, u, p: [x[1], u[0] - p["drag"] * x[1]],
        measurement=lambda t, x, u, p: [x[0], p["gauge"] * x[1]],
        noise_states=("v",),
    )
    return IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues(dict.fromkeys(SPREAD, 1.0)),
        covariance_names=tuple(SPREAD),
        covariance=np.diag(np.array(list(SPREAD.values())) ** 2),
        process_noise=np.array([0.5]),
        sensor_noise=np.array([0.01, 0.02]),
        weak=np.full(2, 1e4),
        reference_state=np.zeros(2),
        reference_inputs=np.zeros(1),
        sample_time=DT,
        flight_spread={},
        per_flight={},
    )


@pytest.fixture(scope="module")
def controller() -> OutputController:
    model = cart()
    f = model_functions(
        model,
        with_=("covariance", "filter"),
        runtime_parameters=parameter_covariance(model)[0],
    )
    problem = typical_problem(
        f,
        held=("speed",),
        lower=np.array([-np.inf, -1.0]),
        upper=np.array([np.inf, 1.0]),
        u_min=np.array([-4.0]),
        u_max=np.array([4.0]),
        horizon=HORIZON,
    )
    return OutputController(f, problem)


def settled(controller: OutputController, kappa: float, speed: float):
    """The plan after some samples on its own noiseless prediction."""
    controller.kappa = kappa
    controller.start()
    y = np.zeros(2)
    for _ in range(40):
        controller.answer(y, np.array([0.0, speed]))
        y = controller.plan.y[0]
    return controller.plan


def test_the_plan_is_what_the_exported_model_foretells(controller):
    plan, f = settled(controller, 0.0, 0.6), controller.functions
    x, found = controller.x, []
    for u in plan.u:
        found.append(f["h"](x, u, controller.p).full().ravel())
        x = f["f_d"](x, u, controller.p)
    assert plan.solved and plan.y == pytest.approx(np.array(found), abs=1e-6)
    assert plan.y[-1, 1] == pytest.approx(0.6, abs=0.02)


def test_a_tightened_plan_stays_that_many_deviations_inside(controller):
    loose, tight = (settled(controller, k, 1.0) for k in (0.0, 2.0))
    assert loose.y[1:, 1].max() == pytest.approx(1.0, abs=0.01)
    assert (tight.y[1:, 1] + 2.0 * tight.sigma[1:, 1]).max() == pytest.approx(1.0, abs=0.01)


def test_without_limits_it_holds_what_it_is_asked(controller):
    o, free = controller.outputs, np.full(2, np.inf)
    loose = OutputController(controller.functions, replace(o, lower=-free, upper=free))
    plan = settled(loose, 3.0, 2.0)
    assert plan.solved and plan.y[-1, 1] == pytest.approx(2.0, abs=0.05)
    assert np.isposinf(loose.margins()).all()


def test_its_tube_is_the_spread_of_the_closed_loop(controller):
    """An ensemble that draws parameters and noise, filters, and adds the tube's feedback to the
    plan, about the speed that the plan keeps, so that errors of drag and gauge count."""
    f, rng, n = controller.functions, np.random.default_rng(0), 4000
    x, u = np.array([0.0, 0.8]), np.array([0.8])
    controller.start(u)
    controller.x = x.copy()
    sigma = controller._linearised(np.tile(u, (HORIZON, 1)))[2]
    _, a, b, _ = (v.full() for v in f["f_d_jac"](x, u, f.parameter_values))
    gain = controller._ancillary(np.zeros((0, 1)))
    noise = f.noise
    root = np.linalg.cholesky(noise.process + 1e-15 * np.eye(2))
    drag, gauge = (1.0 + s * rng.standard_normal(n) for s in SPREAD.values())
    slope = f["f_d_jac"](x, u, f.parameter_values)[3].full()[:, f.parameters["drag"]]
    off = np.linalg.cholesky(noise.covariance + 1e-15 * np.eye(2)) @ rng.standard_normal((2, n))
    told = np.zeros((2, n))  # what the filter thinks to be off the plan; off is the truth
    for _ in range(400):  # the same errors before: of its estimate nothing but what they made of it
        shown = np.stack([off[0], gauge * (x[1] + off[1]) - x[1]])
        off = (
            a @ off
            + np.outer(slope, drag - 1.0)
            + root @ rng.standard_normal((2, n))
            - noise.gain @ (shown + np.array([[0.01], [0.02]]) * rng.standard_normal((2, n)))
        )
    for k in range(HORIZON):
        shown = np.stack([off[0], gauge * (x[1] + off[1]) - x[1]])
        assert shown.std(axis=1) == pytest.approx(sigma[k], rel=0.06), k
        e = shown + np.array([[0.01], [0.02]]) * rng.standard_normal((2, n)) - told
        feedback = b @ (gain @ told)
        told, off = (
            a @ told + feedback + noise.gain @ e,
            a @ off + feedback + np.outer(slope, drag - 1.0) + root @ rng.standard_normal((2, n)),
        )


def test_the_machine_without_noise_is_the_exported_step(controller):
    quiet = replace(
        cart(),
        covariance=np.zeros((2, 2)),
        process_noise=np.zeros(1),
        sensor_noise=np.full(2, 1e-9),
    )
    machine, f = ModelMachine(quiet), controller.functions
    machine.reset(3)
    x, u = f.reference[0], np.array([1.0])
    for _ in range(5):
        assert list(machine.truth(u).values()) == pytest.approx(
            f["h"](x, u, f.parameter_values).full().ravel(), abs=1e-12
        )
        machine.step(u, DT)
        x = f["f_d"](x, u, f.parameter_values).full().ravel()
    first = [(machine.reset(s), machine.measure(u)["speed"])[1] for s in (1, 1, 2)]
    assert first[0] == first[1] != first[2]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"lower": np.array([2.0])}, "room between its limits"),
        ({"horizon": 1}, "2 stages"),
        ({"change": np.array([-1.0])}, "not negative"),
        ({"u_max": np.array([np.inf])}, "must be finite"),
    ],
)
def test_a_problem_that_makes_no_sense_is_refused(wrong, said):
    good = {n: np.array([v]) for n, v in (("lower", -1.0), ("upper", 1.0), ("u_min", -1.0))}
    good |= {"u_max": np.ones(1), "weights": np.ones(1), "change": np.ones(1)}
    with pytest.raises(ModelError, match=said):
        OutputProblem(**(good | wrong))
