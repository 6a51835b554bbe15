"""Draws of a learned push have the posterior's mean and variance, near its support and far from it,
and are functions: the same place, the same push."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.residual.drawn_push import DrawnPush
from greybox.residual.feature_posterior import silent_features
from greybox.residual.features import feature_layout
from greybox.residual.hybrid import HybridModel
from greybox.simulators.draws import draw
from greybox.simulators.make import twin
from scenarios.twins.written import load
from tests.residual.hybrid_cases import (
    CHANNELS,
    FEATURES,
    craft,
    craft_model,
    hybrid,
    pendulum,
    pendulum_model,
    push,
)

PLACES = np.array(
    [[0.0, 0.0, 0.0, 0.0], [0.5, -0.3, 0.2, 0.1], [1.0, 1.0, -1.0, 0.5], [6.0, -5.0, 4.0, 5.0]]
)


def drawn(model: HybridModel, count: int = 1500) -> np.ndarray:
    """Pushes (count, places, n_out)."""
    push = DrawnPush(hybrid=model)
    weights = push.draw(count, np.random.default_rng(0))
    z, w = ca.SX.sym("z", len(FEATURES)), ca.SX.sym("w", weights.shape[1])
    function = ca.Function("push", [z, w], [push._push(z, w)]).map(count)
    return np.stack(
        [np.array(function(np.tile(p[:, None], count), weights.T)).T for p in PLACES], axis=1
    )


@pytest.mark.parametrize("kernel", ["se", "matern32", "linear+matern52"])
def test_draws_of_a_gaussian_process_have_its_moments(kernel: str) -> None:
    model = hybrid(kernel=kernel)
    model = replace(model, posterior=replace(model.posterior, variance_factor=(1.0, 1.0, 2.0)))
    found = drawn(model)
    mean, variance = model.posterior.evaluate(PLACES)
    sigma = np.sqrt(variance)
    assert np.abs((found.mean(axis=0) - mean) / sigma).max() < 0.12
    share = found.std(axis=0) / sigma
    np.testing.assert_allclose(share, 1.0, atol=0.3)  # waves are few
    assert np.sqrt(np.mean((share - 1.0) ** 2)) < 0.12


def test_at_a_support_point_a_draw_is_that_of_its_weights() -> None:
    model = hybrid()
    post = model.posterior
    sure = replace(model, posterior=replace(post, uncertain=0.0 * post.uncertain))
    push = DrawnPush(hybrid=sure)
    weights = push.draw(50, np.random.default_rng(1))
    z, w = ca.SX.sym("z", len(FEATURES)), ca.SX.sym("w", weights.shape[1])
    function = ca.Function("push", [z, w], [push._push(z, w)]).map(50)
    at = np.array(function(np.tile(post.support_points[2][:, None], 50), weights.T))
    assert (at.std(axis=1) < 1e-3 * post.output_scale).all(), "known there"
    away = np.array(function(np.full((4, 50), 5.0), weights.T))
    assert (away.std(axis=1) > 0.5 * post.output_scale).all(), "unknown there"


def test_draws_of_an_exact_process_know_no_more_than_its_noise_lets() -> None:
    """60 noisy samples of one number, sigma 1: as uncertain as the posterior, not as if they were
    exact."""
    base = pendulum_model()
    post = push(base.dynamics, ("rate",), ("rate",), points=4)
    at, kernel = np.linspace(-3.0, 3.0, 60)[:, None], post.kernels[0]
    first = np.linalg.inv(np.linalg.cholesky(kernel.covariance(at.T, at.T) + np.eye(60)))
    weights = first.T @ first @ np.sin(at)
    exact = replace(
        post,
        method="exact",
        support=at,
        weights=weights,
        explained=first[None],
        uncertain=np.zeros((1, 60, 60)),
    )
    drawn = DrawnPush(hybrid=HybridModel(inner=base.dynamics, posterior=exact))
    numbers = drawn.draw(2000, np.random.default_rng(1))
    z, w = ca.SX.sym("z"), ca.SX.sym("w", numbers.shape[1])
    function = ca.Function("push", [z, w], [drawn._push(z, w)]).map(2000)
    for place in (-2.0, 0.0, 2.5, 8.0):
        found = np.array(function(np.full((1, 2000), place), numbers.T))
        sigma = np.sqrt(exact.evaluate(np.array([[place]]))[1]).item()
        assert found.std() == pytest.approx(sigma, rel=0.12)


def test_draws_of_features_have_the_covariance_of_their_weights() -> None:
    x = ca.SX.sym("x", len(FEATURES))
    phi = ca.Function("phi", [x], [ca.vertcat(x[0], x[1], x[0] * x[2])])
    dynamics, rng = craft(), np.random.default_rng(2)
    from_process = hybrid().posterior
    post = silent_features(
        phi,
        method="sparse",
        inputs=feature_layout(dynamics, FEATURES),
        outputs=from_process.outputs,
        input_mean=np.zeros(4),
        input_scale=np.ones(4),
        output_scale=from_process.output_scale,
        domain=from_process.domain,
    )
    post = replace(
        post, weights=rng.standard_normal((3, 3)), root=0.3 * rng.standard_normal((3, 3, 3))
    )
    model = HybridModel(inner=dynamics, posterior=post)
    found = drawn(model)[:, 1:]
    mean, variance = post.evaluate(PLACES[1:])
    np.testing.assert_allclose(found.std(axis=0), np.sqrt(variance), rtol=0.08)
    assert np.abs((found.mean(axis=0) - mean) / np.sqrt(variance)).max() < 0.1


def looking_back(inner: Dynamics, channel: str, beyond: int) -> HybridModel:
    """A push by the first input, now and so many samples before all that the physics looks at."""
    u = inner.inputs.names[0]
    post = push(inner, (u, f"{u}[t-{inner.window[0] + beyond}]"), (channel,))
    # hover in the middle of the support: the push changes with the command
    return HybridModel(
        inner=inner,
        posterior=replace(post, input_mean=np.full(2, 0.6), input_scale=np.full(2, 0.1)),
    )


@pytest.mark.parametrize(
    ("inner", "channel"), [(pendulum(), "rate"), (craft(), "force.x")], ids=["no window", "delay"]
)
def test_draws_look_back_as_far_as_the_hybrid(inner: Dynamics, channel: str) -> None:
    """At its nominal weights a draw is the hybrid, and its oldest command pushes."""
    model = looking_back(inner, channel, 3)
    push = DrawnPush(hybrid=model)
    assert push.window == model.window == (inner.window[0] + 3, inner.window[1])
    rng = np.random.default_rng(4)
    window = rng.uniform(0.5, 0.7, (len(inner.inputs), sum(model.window) + 1))
    x, w = rng.uniform(0.1, 0.5, len(inner.states)), np.zeros(len(inner.noises))

    def after(dynamics: Dynamics, commands: np.ndarray) -> list[np.ndarray]:
        p = ca.DM([q.nominal for q in dynamics.parameters])
        given = (0.0, ca.DM(x), ca.DM(commands), p, ca.DM(w), 0.01)
        return [
            np.array(ca.DM(value)) for value in (dynamics.step(*given), dynamics.output(*given))
        ]

    for mine, its in zip(after(push, window), after(model, window), strict=True):
        np.testing.assert_allclose(mine, its, rtol=1e-12, atol=1e-13)
    other = window.copy()
    other[0, 0] += 0.1
    assert np.abs(after(push, other)[0] - after(push, window)[0]).max() > 1e-6


def bodied(dynamics: HybridModel | None = None) -> IdentifiedModel:
    """The craft with a random push and the inertia of a body."""
    model = craft_model(dynamics or hybrid())
    return replace(model, values=model.values.replace({"inertia.zz": 2.8e-5}))


def test_simulate_flies_every_draw_with_its_own_push(tmp_path: Path) -> None:
    model = bodied()
    twin(model, ["numpy"], out=tmp_path, draws=40, seed=3)
    (module,) = load(tmp_path / "numpy", "simulate")
    stored = np.load(tmp_path / "draws" / "draws.npz")
    assert tuple(stored["names"]) == module.PARAMETERS
    assert [n for n in module.PARAMETERS if n.startswith("learned.")]
    window = np.tile(module.HOVER, (module.PAST + 1 + module.FUTURE, 1))
    x = module.START.copy()
    x[3:6] = 0.4, -0.2, 0.1
    d = model.dynamics
    state, u, p = (
        ca.SX.sym("x", len(d.states)),
        ca.SX.sym("u", *window.T.shape),
        model.parameter_vector(),
    )
    w = np.zeros(len(d.noises))
    step = ca.Function("step", [state, u], [d.step(0.0, state, u, p, w, model.sample_time)])
    mean = module.step(x, window)
    np.testing.assert_allclose(mean, np.array(step(x, window.T)).ravel(), rtol=1e-10, atol=1e-12)
    pushed = module.step(x, window, stored["values"])
    only_mass = stored["values"].copy()
    learned = [i for i, n in enumerate(module.PARAMETERS) if n.startswith("learned.")]
    only_mass[:, learned] = module.VALUES[learned]
    rate = module.STATES.index("rate.x")
    apart = (pushed - module.step(x, window, only_mass))[:, rate].std()
    z = np.array([0.4, -0.2, 0.0, 0.0])
    sigma = np.sqrt(model.dynamics.posterior.evaluate(z[None])[1])[0, CHANNELS.index("torque.x")]
    expected = sigma / p[[q.name for q in d.parameters].index("inertia.xx")] * model.sample_time
    assert apart == pytest.approx(expected, rel=0.4)


def test_simulate_remembers_the_commands_that_the_push_looks_at(tmp_path: Path) -> None:
    model = bodied(looking_back(craft(), "force.x", 1))
    twin(model, ["numpy"], out=tmp_path)
    (module,) = load(tmp_path / "numpy", "simulate")
    d = model.dynamics
    assert d.window == (module.PAST, module.FUTURE)
    rng, sim = np.random.default_rng(5), module.Simulator()
    window, x = np.tile(module.HOVER, (module.PAST + 1, 1)), module.START
    p, w = ca.DM(model.parameter_vector()), ca.DM.zeros(len(d.noises))
    for _ in range(module.PAST + 3):
        u = module.HOVER + np.append(rng.uniform(-0.1, 0.1, 4), 0.0)[: len(module.INPUTS)]
        window = np.vstack([window[1:], u])
        x = np.array(ca.DM(d.step(0.0, ca.DM(x), ca.DM(window.T), p, w, model.sample_time))).ravel()
        np.testing.assert_allclose(sim.step(u), x, rtol=1e-10, atol=1e-12)


def test_the_summary_says_how_far_learned_pushes_lie_apart() -> None:
    text = draw(bodied(), 30, seed=1).summary()
    assert "learned torque.x" in text and "N m" in text
