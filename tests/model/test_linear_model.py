import json
from dataclasses import replace

import casadi as ca
import control
import numpy as np
import pytest

from greybox.errors import FileFormatError, ModelError
from greybox.linear.prediction import simulate
from greybox.model.dynamics import Dynamics
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices, balanced, truncated
from greybox.symbolic import Layout, Signal


def example(delays=(0, 0)):
    rng = np.random.default_rng(0)
    a = np.diag([0.9, 0.7, -0.3]) + 0.05 * rng.normal(size=(3, 3))
    return LinearModel(
        name="rig",
        matrices=Matrices(
            a,
            rng.normal(size=(3, 2)),
            rng.normal(size=(2, 3)),
            rng.normal(size=(2, 2)),
            0.1 * rng.normal(size=(3, 2)),
        ),
        noise=np.diag([0.1, 0.2]),
        dt=0.02,
        inputs=Layout([Signal(name="u1", unit="1"), Signal(name="u2", unit="V")]),
        outputs=Layout([Signal(name="p", unit="rad/s"), Signal(name="q", unit="rad/s")]),
        delays=delays,
        input_offset=np.array([0.5, 0.1]),
        output_offset=np.array([0.0, 1.0]),
    )


@pytest.mark.parametrize("delays", [(0, 0), (2, 1)])
def test_casadi_dynamics_step_like_the_numpy_simulation(delays):
    model = example(delays)
    assert isinstance(model, Dynamics)
    rng = np.random.default_rng(1)
    u, e = rng.normal(size=(12, 2)), rng.normal(size=(12, 2))
    expected = simulate(model, u, e=e)
    past, future = model.window
    p = ca.DM([d.nominal for d in model.parameters])
    x, out = ca.DM.zeros(3), []
    padded = np.vstack([np.repeat(u[:1], past, axis=0), u])
    for k in range(12):
        window = ca.DM(padded[k : k + past + 1 + future].T)
        w = ca.DM(e[k])
        out.append(np.asarray(model.output(0, x, window, p, w, 0.02)).ravel())
        x = model.step(0, x, window, p, w, 0.02)
    np.testing.assert_allclose(out, expected, atol=1e-12)


def test_names_with_dots_are_names_that_control_takes():
    signals = [Signal(name=n, unit="1") for n in ("position.x", "attitude.y")]
    system = replace(example(), outputs=Layout(signals)).to_control()
    assert list(system.output_labels) == ["position_x", "attitude_y"]


def test_control_round_trip_keeps_gain_names_and_sample_time():
    model = example()
    system = model.to_control()
    assert system.dt == model.dt
    assert list(system.output_labels) == ["p", "q"]
    back = LinearModel.from_control(system, gain=model.matrices.k, noise=model.noise)
    for z in (1.0, np.exp(0.3j)):
        np.testing.assert_allclose(back.matrices.gain(z), model.matrices.gain(z), atol=1e-10)
        np.testing.assert_allclose(np.asarray(system(z)), model.matrices.gain(z), atol=1e-10)


def test_delays_become_states_or_are_refused():
    model = example((2, 1))
    with pytest.raises(ModelError, match="delays"):
        model.to_control()
    system = model.to_control(include_delays=True)
    assert system.nstates == 6
    z = np.exp(0.4j)
    expected = model.matrices.gain(z) * np.array([z**-2, z**-1])
    np.testing.assert_allclose(np.asarray(system(z)), expected, atol=1e-10)


def test_a_continuous_system_is_sampled_exactly():
    model = LinearModel.from_control(
        control.StateSpace([[-2.0]], [[3.0]], [[1.0]], [[0.0]]), dt=0.1
    )
    assert model.matrices.a[0, 0] == pytest.approx(np.exp(-0.2))
    assert model.matrices.gain(1.0)[0, 0] == pytest.approx(1.5)
    with pytest.raises(ModelError, match="sample time"):
        LinearModel.from_control(control.StateSpace([[-2.0]], [[3.0]], [[1.0]], [[0.0]]))


def test_json_round_trip_is_exact_and_guarded(tmp_path):
    model = example((1, 0))
    path = model.save(tmp_path / "m.json")
    back = LinearModel.load(path)
    for a, b in zip(model.matrices, back.matrices):
        np.testing.assert_array_equal(a, b)
    assert back.inputs == model.inputs
    assert back.delays == model.delays
    value = json.loads(path.read_text())
    value["A"][0][0] += 1e-6
    path.write_text(json.dumps(value))
    with pytest.raises(FileFormatError, match="checksum"):
        LinearModel.load(path)


def test_balanced_truncation_keeps_the_predictor_stable_and_close():
    m = example().matrices
    b, values = balanced(m)
    assert (np.diff(values) <= 0).all()
    np.testing.assert_allclose(b.gain(np.exp(0.2j)), m.gain(np.exp(0.2j)), atol=1e-9)
    small = truncated(m, 2)
    assert np.abs(np.linalg.eigvals(small.predictor)).max() < 1


def test_shapes_that_do_not_fit_are_refused():
    m = example()
    with pytest.raises(ModelError, match="B has shape"):
        LinearModel(
            name="x",
            matrices=m.matrices._replace(b=np.ones((3, 5))),
            noise=m.noise,
            dt=0.1,
            inputs=m.inputs,
            outputs=m.outputs,
        )
