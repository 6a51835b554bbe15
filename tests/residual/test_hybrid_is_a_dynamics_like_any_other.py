"""A hybrid is a Dynamics: one set of numbers in SX, MX and C, the physics where it is silent or far
from its data."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.build import compiler
from greybox.estimation.engine import engine_for
from greybox.residual.features import features
from greybox.residual.hybrid import HybridModel
from greybox.symbolic import Layout, Signal
from greybox.validation.open_loop import GroupReader
from tests.residual.hybrid_cases import (
    CHANNELS,
    FEATURES,
    SIZES,
    craft,
    craft_model,
    hybrid,
    pendulum,
    push,
)

DT = 0.01


def arguments(dynamics, symbol):
    past, future = dynamics.window
    return {
        "x": symbol.sym("x", len(dynamics.states)),
        "U": symbol.sym("U", len(dynamics.inputs), past + 1 + future),
        "p": symbol.sym("p", len(dynamics.parameters)),
        "w": symbol.sym("w", len(dynamics.noises)),
    }


def functions(dynamics, symbol) -> ca.Function:
    s = arguments(dynamics, symbol)
    u = s["U"][:, 0]
    values = {
        "f": dynamics.f(0, s["x"], u, s["p"], s["w"]),
        "h": dynamics.h(0, s["x"], u, s["p"], s["w"]),
        "step": dynamics.step(0, s["x"], s["U"], s["p"], s["w"], DT),
        "output": dynamics.output(0, s["x"], s["U"], s["p"], s["w"], DT),
    }
    return ca.Function(
        "all", list(s.values()), [ca.densify(v) for v in values.values()], list(s), list(values)
    )


def points(dynamics, count: int = 4, seed: int = 1, speed: float = 1.0):
    """States, windows, parameters and noises around hover."""
    rng = np.random.default_rng(seed)
    past, future = dynamics.window
    names = dynamics.states.names
    p = np.array([d.nominal for d in dynamics.parameters])
    for _ in range(count):
        x = dynamics.reference({"u1": 0.7}) + 0.1 * rng.standard_normal(len(names))
        x[[i for i, n in enumerate(names) if n.startswith("velocity")]] *= 10 * speed
        q = [i for i, n in enumerate(names) if n.startswith("attitude")]
        x[q] /= np.linalg.norm(x[q])
        u = np.repeat(
            [[3.8] if n == "vbat" else [0.7] for n in dynamics.inputs.names],
            past + 1 + future,
            axis=1,
        )
        w = dynamics.noise_scale(DT) * rng.standard_normal(len(dynamics.noises))
        yield x, u + 0.05 * rng.standard_normal(u.shape), p, w


@pytest.mark.parametrize("kernel", ["se", "linear+matern52"])
def test_sx_and_mx_give_the_same_numbers(kernel: str):
    model = hybrid(kernel=kernel)
    sx, mx = functions(model, ca.SX), functions(model, ca.MX)
    for at in points(model):
        for a, b in zip(sx(*at), mx(*at)):
            assert np.asarray(a) == pytest.approx(np.asarray(b), rel=1e-12, abs=1e-12)


@pytest.mark.skipif(compiler() is None, reason="no C compiler here")
def test_the_compiled_rollout_is_the_step_repeated():
    model = HybridModel(inner=pendulum(), posterior=push(pendulum(), ("angle", "rate"), ("rate",)))
    engine = engine_for(model, (), use_compiler=True)
    assert engine.compiled
    call = functions(model, ca.SX)
    n, x, p, w = 12, np.array([0.4, -1.0]), np.array([9.0]), np.zeros(1)
    inputs = np.random.default_rng(3).standard_normal((n, 1))
    got, _ = engine.rollout(
        starts=x[None], rows=np.array([0]), horizon=n, inputs=inputs, p=p, dt=DT
    )
    for k in range(n):
        values = call(x=x, U=inputs[k], p=p, w=w)
        assert got[0, k] == pytest.approx(np.asarray(values["output"])[:, 0], rel=1e-12, abs=1e-12)
        x = np.asarray(values["step"])[:, 0]


def test_a_silent_posterior_leaves_the_physics_to_the_last_bit():
    silent = functions(hybrid(silent=True), ca.SX)
    physics = functions(craft(), ca.SX)
    for at in points(craft()):
        for a, b in zip(silent(*at), physics(*at)):
            assert np.array_equal(np.asarray(a), np.asarray(b))


def test_the_learned_push_is_process_noise_of_its_channel():
    model = hybrid()
    own, physics = functions(model, ca.SX), functions(craft(), ca.SX)
    s = arguments(model, ca.SX)
    mean = ca.Function("g", [s["x"], s["U"]], [ca.densify(model.learned_mean(s["x"], s["U"]))])
    rows = [craft().noises[c] for c in CHANNELS]
    assert model.learned_rows == tuple(rows)
    for x, u, p, w in points(model):
        pushed = w.copy()
        pushed[rows] += np.asarray(mean(x, u))[:, 0]
        assert not np.allclose(pushed, w)
        for name in ("step", "output"):
            a, b = own(x=x, U=u, p=p, w=w)[name], physics(x=x, U=u, p=p, w=pushed)[name]
            assert np.asarray(a) == pytest.approx(np.asarray(b), rel=1e-13, abs=1e-13)


def test_the_step_starts_along_f():
    # Of a model without a command window: f and step see the same command.
    model = HybridModel(inner=pendulum(), posterior=push(pendulum(), ("angle", "rate"), ("rate",)))
    s = arguments(model, ca.SX)
    h = 1e-5
    after = model.step(0, s["x"], s["U"], s["p"], s["w"], h)
    call = ca.Function(
        "c", list(s.values()), [(after - s["x"]) / h, model.f(0, s["x"], s["U"], s["p"], s["w"])]
    )
    slope, f = call([0.4, -1.0], [0.3], [9.0], [0.1])
    assert np.asarray(slope) == pytest.approx(np.asarray(f), rel=1e-3)
    plain = pendulum().f(0, ca.DM([0.4, -1.0]), ca.DM([0.3]), ca.DM([9.0]), ca.DM([0.1]))
    assert abs(float(f[1]) - float(plain[1])) > 0.05


def test_far_away_it_is_the_physics_and_says_so():
    model = hybrid(kernel="linear+se")
    s = arguments(model, ca.SX)
    z = model.learned_inputs(s["x"], s["U"])
    look = ca.Function(
        "d", [s["x"], s["U"]], [model.learned_mean(s["x"], s["U"]), model.posterior.distance(z)]
    )
    near, far = (
        look(x, u)
        for x, u in ((a[0], a[1]) for s in (1.0, 300.0) for a in points(model, 1, speed=s))
    )
    sizes = np.array([SIZES[c.split(".")[0]] for c in CHANNELS])
    assert np.max(np.abs(np.asarray(near[0])[:, 0]) / sizes) > 0.1
    assert np.max(np.abs(np.asarray(far[0])[:, 0]) / sizes) < 1e-9
    assert float(far[1]) > 0.999 > float(near[1])


def test_its_variance_is_the_posteriors_and_zero_where_nothing_was_learned():
    model = hybrid()
    weights = model.posterior.weights.copy()
    weights[:, 1] = 0.0
    some = HybridModel(inner=craft(), posterior=replace(model.posterior, weights=weights))
    s = arguments(model, ca.SX)
    call = ca.Function("v", [s["x"], s["U"]], [ca.densify(some.learned_variance(s["x"], s["U"]))])
    look = ca.Function("z", [s["x"], s["U"]], [ca.densify(some.learned_inputs(s["x"], s["U"]))])
    for x, u, _, _ in points(model):
        value = np.asarray(call(x, u))[:, 0]
        expected = model.posterior.evaluate(np.asarray(look(x, u)).T)[1][0]
        assert value[[0, 2]] == pytest.approx(expected[[0, 2]], rel=1e-12)
        assert value[1] == 0.0


def test_what_does_not_fit_is_refused():
    with pytest.raises(UnknownNameError, match="force"):
        HybridModel(inner=pendulum(), posterior=push(craft()))
    posterior = push(craft())
    wrong = Layout([Signal(name=s.name, unit="kg") for s in posterior.outputs])
    with pytest.raises(ModelError, match="unit"):
        HybridModel(inner=craft(), posterior=replace(posterior, outputs=wrong))
    wrong = Layout([Signal(name=n, unit="-") for n in ("airspeed", *FEATURES[1:])])
    with pytest.raises(UnknownNameError, match="feature"):
        HybridModel(inner=craft(), posterior=replace(posterior, inputs=wrong))


def test_an_identified_hybrid_keeps_its_physics():
    model = craft_model(hybrid())
    assert model.physics is craft()
    assert model.effects == craft_model(craft()).effects
    assert "GP(force.x" in model.name


def test_a_feature_beyond_the_command_window_is_refused():
    """A negative place would count from the end: a later command under the name of an earlier
    one."""
    dynamics, x, window = pendulum(), ca.SX.sym("x", 2), ca.SX.sym("U", 1, 3)
    assert str(features(dynamics, ("u[t-2]",), x, window)) == "U_0"
    with pytest.raises(
        ModelError, match="further back than the command window; expected 3 earlier samples; got 2"
    ):
        features(dynamics, ("u[t-3]",), x, window)


def test_its_velocity_is_read_however_far_it_looks_back():
    """`validate` reads the velocity from the state where only the position is measured."""
    names = ("p", f"u1[t-{3 * craft().window[0] + 5}]")
    model = craft_model(HybridModel(inner=craft(), posterior=push(craft(), names)))
    reader, d = GroupReader(model), model.dynamics
    states = np.array([model.reference_state])
    states[0, 3:6] = 0.4, -0.2, 0.1
    values = reader.values(
        np.zeros((1, len(d.outputs))),
        states,
        model.parameter_vector(),
        model.reference_inputs[None],
    )
    np.testing.assert_allclose(values["velocity"][0], [0.4, -0.2, 0.1], atol=1e-9)
