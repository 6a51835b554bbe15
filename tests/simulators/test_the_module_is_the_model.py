"""simulate.py is the model itself, generated: one craft, a thousand, each with its own parameters,
learned pushes and noise included; simulate_jax.py is the same (skips without JAX)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from greybox.model.identified import IdentifiedModel
from greybox.model.noise import with_disturbance
from greybox.simulators.make import twin
from scenarios.twins.written import load
from tests.simulators.identified import AERODYNAMICS, Array, identified

EVERYTHING = {
    **AERODYNAMICS,
    "battery_sag.c_V": 0.8,
    "ground_effect.k": 1.5,
    "rotational_damping.d_p": 0.01,
    "rotor_gyroscopic.J_r": 1e-5,
    "constant_force.f_x": 0.2,
    "motor_lag_asymmetry.a": 0.2,
    "motor_lag_speed.s": 0.4,
    "motor_lag_second.b": 0.6,
    "command_saturation.a_hi": 0.05,
    "gyro_bias.b_x": 0.02,
    "pose_delay.d": 0.013,
}


def pushed() -> IdentifiedModel:
    """Everything of the catalogue that moves the body, with states of disturbance."""
    model = identified(EVERYTHING)
    dynamics = with_disturbance(model.dynamics, ["force", "torque"], time=0.5)
    values = {**model.values, "disturbance.force.T": 0.5, "disturbance.torque.T": 0.2}
    extra = len(dynamics.noises) - len(model.dynamics.noises)
    return replace(
        model,
        dynamics=dynamics,
        values=type(model.values)(values),
        process_noise=np.concatenate([model.process_noise, np.full(extra, 0.01)]),
    )


def steps(model: IdentifiedModel, start: Array, u: Array, w: Array) -> tuple[Array, Array]:
    """States (steps, n_x) and outputs at the end, by the model's own CasADi functions."""
    d = model.dynamics
    past, future = d.window
    x, p = ca.SX.sym("x", len(d.states)), ca.SX.sym("p", len(d.parameters))
    window, noise = ca.SX.sym("u", len(d.inputs), past + 1 + future), ca.SX.sym("w", len(d.noises))
    args = [x, window, p, noise]
    step = ca.Function("step", args, [d.step(0.0, x, window, p, noise, model.sample_time)])
    output = ca.Function("output", args, [d.output(0.0, x, window, p, noise, model.sample_time)])
    values = model.parameter_vector()
    state, rows = start, []
    for k in range(u.shape[0] - past):
        held = u[k : k + past + 1].T
        state = np.asarray(step(state, held, values, w[k])).ravel()
        rows.append(state)
    return np.array(rows), np.asarray(output(state, held, values, 0 * w[0])).ravel()


def record(module: object, count: int = 12) -> tuple[Array, Array, Array]:
    """Commands with the hover command before them, noise, and a start that moves."""
    random = np.random.default_rng(3)
    past = module.PAST  # type: ignore[attr-defined]
    u = np.tile(module.HOVER, (past + count, 1))  # type: ignore[attr-defined]
    u[past:, :4] += 0.05 * random.standard_normal((count, 4))
    u[past:, 4:] = 11.4
    level = module.NOISE  # type: ignore[attr-defined]
    w = level * random.standard_normal((count, len(level)))
    start = module.START.copy()  # type: ignore[attr-defined]
    start[2:6] = 0.3, 2.0, -1.0, 0.5
    start[10:13] = 0.5, -0.4, 0.3
    return u, w, start


def test_numpy_flies_the_model_to_the_last_digits(tmp_path: Path) -> None:
    model = pushed()
    twin(model, ["numpy"], out=tmp_path)
    (module,) = load(tmp_path / "numpy", "simulate")
    u, w, start = record(module)
    expected, seen = steps(model, start, u, w)
    one, many = module.Simulator(x=start), module.Simulator(craft=3, x=start)
    for k in range(len(w)):
        x = one.step(u[module.PAST + k], w[k])
        batch = many.step(u[module.PAST + k], w[k])
        np.testing.assert_allclose(x, expected[k], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(batch, np.tile(x, (3, 1)), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(one.measure(), seen, rtol=1e-9, atol=1e-10)


def test_every_craft_of_a_batch_has_its_own_parameters(tmp_path: Path) -> None:
    model = identified({"motor_lag.tau": 0.05, "rotor_drag.k_x": 2e-5})
    twin(model, ["numpy"], out=tmp_path)
    (module,) = load(tmp_path / "numpy", "simulate")
    rows = np.tile(module.VALUES, (2, 1))
    rows[1, module.PARAMETERS.index("mass")] *= 1.1
    both = module.Simulator(craft=2, parameters=rows)
    alone = module.Simulator(parameters=rows[1])
    for _ in range(5):
        x, y = both.step(module.HOVER), alone.step(module.HOVER)
    np.testing.assert_allclose(x[1], y, rtol=1e-12)
    assert abs(x[0, 5]) < 1e-9 and x[1, 5] < -0.01, "the heavier one sinks"


def test_a_command_beyond_the_stated_range_does_what_its_end_does(tmp_path: Path) -> None:
    """A voltage has no range, and a command that is negative no thrust upwards."""
    model = identified({"motor_lag.tau": 0.02, "battery_sag.c_V": 0.5})
    twin(model, ["numpy"], out=tmp_path)
    (module,) = load(tmp_path / "numpy", "simulate")
    for beyond, end in ((-1.0, 0.0), (1.7, 1.0)):
        far, near = (module.Simulator(craft=n) for n in (None, 2))
        for _ in range(3):
            x = far.step(np.array([*[beyond] * 4, 11.0]))
            y = near.step(np.array([*[end] * 4, 11.0]))
        np.testing.assert_allclose(y, np.tile(x, (2, 1)), rtol=1e-12, atol=1e-13)
        assert (x[5] > 0) == (end > 0), "only full thrust lifts it"


def test_jax_limits_commands_as_numpy_does(tmp_path: Path) -> None:
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    twin(identified({"motor_lag.tau": 0.02}), ["jax"], out=tmp_path)
    (module,) = load(tmp_path / "jax", "simulate_jax")
    u = np.full((5, len(module.INPUTS)), -1.0)
    far, near = (np.asarray(module.rollout(module.START, v)) for v in (u, 0.0 * u))
    np.testing.assert_array_equal(far, near)


def test_jax_flies_the_model(tmp_path: Path) -> None:
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    model = pushed()
    twin(model, ["jax"], out=tmp_path)
    (module,) = load(tmp_path / "jax", "simulate_jax")
    u, w, start = record(module)
    expected, _ = steps(model, start, u, 0 * w)
    found = jax.jit(module.rollout)(start, u[module.PAST :])
    np.testing.assert_allclose(np.asarray(found), expected, rtol=1e-8, atol=1e-10)
