"""What a plan steers is what commands move and the motion feels, whatever noise a model has; what a
feedback costs is never negative; and no routine's word for a matrix reaches a user."""

import numpy as np
import pytest
import scipy.linalg

from greybox.cli import main
from greybox.errors import ModelError
from greybox.model.noise import Coloured, Delay, Drift, Line, LowPass, with_disturbance, with_parts
from mpc_export import bundle, feedback
from mpc_export.feedback import lqr, steered
from mpc_export.functions import model_functions
from mpc_export.semidefinite import half, positive, upper_half
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.solver import TubeSolver
from mpc_export.tube.stages import stages
from tests.mpc_export import cases
from tests.residual import hybrid_cases

MOTION = ("d_position", "d_velocity", "d_attitude", "d_rate", "d_rotor", "d_history")
NOISE = {
    "colour": (Coloured(sensor="position", time=0.004), Coloured(sensor="attitude")),
    "filters": (LowPass(sensor="gyro"), Delay(sensor="accelerometer")),
    "lines and drift": (Line(sensor="gyro"), Drift(sensor="accelerometer")),
}


def noisy(parts, disturbed=True):
    dynamics = with_parts(hybrid_cases.craft(), parts)
    if disturbed:
        dynamics = with_disturbance(dynamics, ("force", "torque"), time=2.0)
    return cases.identified(dynamics, **{"command_delay.d": 0.013, "motor_lag.tau": 0.04})


def planned(parts):
    return model_functions(noisy(parts), with_=("covariance", "target"))


@pytest.mark.parametrize("kind", NOISE)
def test_noise_of_sensors_is_no_state_of_a_plan(kind):
    f = planned(NOISE[kind])
    made = stages(f, TubeProblem(dt=f.dt, horizon=3, planes=1))
    kept = {f.error_states.names[i].split(".")[0] for i in made.keep}
    assert kept <= set(MOTION) and {"d_rotor", "d_rate"} <= kept
    assert (np.linalg.eigvalsh(made.terminal) > 0).all()
    noise = [
        i
        for i, n in enumerate(f.error_states.names)
        if n.split(".")[0] not in (*MOTION, "d_disturbance")
    ]
    assert noise and not made.gain[:, noise].any(), "no command answers the noise of a sensor"


def test_noise_changes_neither_gain_nor_cost_of_what_is_steered():
    bare, noise = planned(()), planned((*NOISE["colour"], *NOISE["filters"]))
    one, other = (stages(f, TubeProblem(dt=f.dt, horizon=3, planes=1)) for f in (bare, noise))
    names = [[f.error_states.names[i] for i in m.keep] for f, m in ((bare, one), (noise, other))]
    assert names[0] == names[1]
    np.testing.assert_allclose(one.terminal, other.terminal, rtol=1e-7, atol=1e-9)
    same = [noise.error_states.names.index(n) for n in bare.error_states.names]
    np.testing.assert_allclose(one.gain, other.gain[:, same], rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_the_tube_plans_with_a_coloured_pose():
    f = planned(NOISE["colour"])
    solver = TubeSolver(f, TubeProblem(dt=f.dt, horizon=5, planes=1))
    solver.reset()
    solver.data["kappa"][:] = 1.0
    solver.data["plane"][:, 0] = [1.0, 0.0, 0.0, 1.0]
    assert solver.solve().status == 0


def test_what_pushes_is_answered_and_what_only_listens_is_not():
    f = planned(NOISE["filters"])
    names, split = f.error_states.names, steered(f.functions, f.error_states)
    assert {names[i].split(".")[0] for i in split.pushing} == {"d_disturbance"}


def test_the_cost_of_a_feedback_is_the_riccati_equations_and_not_negative():
    rng = np.random.default_rng(0)
    split = feedback.Steered(keep=tuple(range(6)), pushing=())
    for size in (1.0, 1e4, 1e8):
        a, b = rng.normal(size=(6, 6)) / 2, rng.normal(size=(6, 2))
        q, r = np.diag([size, size, 1.0, 1e-6, 1e-6, 1e-6]), np.eye(2)
        _, p = lqr(a, b, q, r, split)
        np.testing.assert_allclose(p, scipy.linalg.solve_discrete_are(a, b, q, r), rtol=1e-4)
        assert np.linalg.eigvalsh(p)[0] >= -1e-15 * np.abs(p).max()


def test_a_model_that_no_command_brings_back_is_said_to_be_one():
    with pytest.raises(ModelError, match="no feedback about hover"):
        lqr(
            np.diag([1.1, 0.5]),
            np.array([[0.0], [1.0]]),
            np.eye(2),
            np.eye(1),
            feedback.Steered(keep=(0, 1), pushing=()),
        )


def test_halves_hold_for_what_rounding_made_negative():
    m = np.diag([2877.0, 1.0, -5.4e-4])
    assert np.linalg.eigvalsh(positive(m))[0] >= 0
    for root in (half(m).T, upper_half(m)):
        np.testing.assert_allclose(root.T @ root, np.diag([2877.0, 1.0, 0.0]), atol=1e-12)
    sound = np.array([[4.0, 1.0], [1.0, 3.0]])
    np.testing.assert_allclose(upper_half(sound), np.linalg.cholesky(sound).T, rtol=1e-12)


def test_no_routines_word_for_a_matrix_reaches_a_user(tmp_path, monkeypatch, capsys):
    file = tmp_path / "model.json"
    noisy((), disturbed=False).save(file)

    def singular(*_):
        raise np.linalg.LinAlgError("Matrix is not positive definite")

    monkeypatch.setattr(bundle, "_functions", singular)
    monkeypatch.setattr("greybox.commands.mpc._prepared", singular)
    out = ["--out", str(tmp_path / "out"), "--even-so"]
    for command in (["export", str(file), "--no-cache"], ["mpc", str(file)]):
        assert main([*command, *out]) == 2
        said = capsys.readouterr().err
        assert "cannot be solved" in said and "Traceback" not in said
