"""OutputController on a fitted model of the user's own: it plans with the exported model, its tube
is the spread of the closed loop, and tightened plans stay that far inside."""

import importlib
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from greybox.errors import ModelError
from greybox.model.dynamics import StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.parameter import Parameter, ParameterValues
from greybox.symbolic import Layout, Signal
from mpc_export.functions import model_functions
from mpc_export.noise import parameter_covariance
from mpc_export.outputs.campaign import _controller, format_table, sources, verdict
from mpc_export.outputs.controller import OutputController, OutputProblem, typical_problem
from mpc_export.outputs.machine import Asked, ModelMachine, run

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


class Broken(ModelMachine):
    """Its gauge shows nothing any more from the sixth sample on."""

    def reset(self, seed: int = 0) -> None:
        super().reset(seed)
        self.left = 6

    def step(self, u, dt=None) -> None:
        super().step(u, dt)
        self.left -= 1

    def truth(self, u):
        return {n: v if self.left > 0 else np.nan for n, v in super().truth(u).items()}


ASKED = Asked(
    held={"speed": (0.5,)},
    limits={"speed": (-1.0, 1.0)},
    ranges={"u": (-4.0, 4.0)},
    seconds=20 * DT,
)


def test_an_output_that_is_no_number_is_beyond_its_limits(controller):
    machine = Broken(cart())
    row = run(controller, machine, ASKED, 1)
    assert row["beyond"] == 14 and row["excess"] == {"speed": None}
    good = run(controller, ModelMachine(cart()), ASKED, 1)
    own = SimpleNamespace(asked=ASKED, kappa={"tube": 0.0, "mean": 0.0}, level=0.05)
    both, lost = (_controller("tube", rows, own) for rows in ([row, good], [row]))
    assert both["settled"] == good["settled"] and both["excess"] == good["excess"]
    assert lost["settled"] == lost["rmse"] == lost["excess"] == {"speed": None}
    content = {"held": {"speed": [0.5]}, "units": {"speed": "m/s"}, "level": 0.05}
    content["controllers"] = {"tube": lost, "mean": lost}
    content["controllers"]["tube"]["failures"] = 0
    assert "speed to - m/s" in verdict(content) and "solved" not in verdict(content)
    content["controllers"]["tube"] = {**lost, "failures": 3}
    assert "3 plans were not solved" in verdict(content)
    assert format_table(content).splitlines()[1].split()[-2] == "-"


def test_runs_of_a_plant_count_by_the_text_of_its_file(tmp_path, monkeypatch):
    """A factory whose class is elsewhere counts by both files; what is not Python by none."""
    (tmp_path / "my_own_rig.py").write_text("from collections import Counter\n")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("my_own_rig")
    first = sources("my_own_rig:Counter", Counter())
    assert len(first) == 2 and sources("sys:flags", 1) == []
    (tmp_path / "my_own_rig.py").write_text("from collections import Counter\nGAIN = 2\n")
    assert len(set(first) & set(sources("my_own_rig:Counter", Counter()))) == 1


def test_a_state_that_is_no_number_is_neither_solved_with_nor_kept(controller):
    """A gauge of the square root of the speed, and a cart that rolls backwards."""
    rooted = cart()
    dynamics = replace(
        rooted.dynamics, measurement=lambda t, x, u, p: [x[0], p["gauge"] * ca.sqrt(x[1])]
    )
    model = replace(rooted, dynamics=dynamics, reference_state=np.array([0.0, 1.0]))
    f = model_functions(
        model, with_=("covariance", "filter"), runtime_parameters=parameter_covariance(model)[0]
    )
    rooting = OutputController(f, controller.outputs)
    rooting.kappa = 2.0
    rooting.start(np.ones(1))
    rooting.x = np.array([0.0, -0.2])
    solved = []
    for _ in range(20):
        u = rooting.answer(np.array([0.0, np.nan]), np.array([0.0, 0.8]))
        assert np.isfinite(u).all() and np.isfinite(rooting.x).all()
        solved.append(rooting.plan.solved)
    assert not solved[0] and solved[-1]
    assert rooting.failures == solved.count(False)


def test_no_command_leaves_its_range_not_even_the_first(controller):
    o = replace(controller.outputs, u_min=np.array([0.5]), u_max=np.array([2.0]))
    ranged = OutputController(controller.functions, o)  # the typical command is 0
    row = run(ranged, ModelMachine(cart()), ASKED, 2, watch=True)
    commands = np.array(row["trace"]["commands"])
    assert commands.min() >= 0.5 and commands.max() <= 2.0


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
