"""The posterior's expressions: SX, MX, C and arrays agree, Jacobians are derivatives, variances are
never negative."""

from __future__ import annotations

import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.build import MODEL_FLAGS, build, compiler
from greybox.residual import sparse
from greybox.residual.posterior import QUANTITIES
from tests.residual.gp_cases import make_kernel, posterior_of, sparse_case

KERNELS = ("se", "matern32", "matern52", "linear+se", "linear+matern32")


@pytest.mark.parametrize("share", [False, True])
@pytest.mark.parametrize("name", KERNELS)
def test_sx_mx_and_arrays_agree(name, share):
    posterior = sparse_case(name, share=share)
    z = (
        np.random.default_rng(5).standard_normal((30, 3)) * posterior.input_scale
        + posterior.input_mean
    )
    mean, variance = posterior.evaluate(z, noise=True)
    functions = [posterior.function(which=QUANTITIES, noise=True, symbol=s) for s in (ca.MX, ca.SX)]
    for i, row in enumerate(z):
        mx, sx = ([v.full() for v in f(row)] for f in functions)
        for a, b in zip(mx, sx):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(mx[0].ravel(), mean[i], rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(mx[1].ravel(), variance[i], rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(
            posterior.mean(row).full().ravel(), mean[i], rtol=1e-12, atol=1e-12
        )
    np.testing.assert_allclose(posterior.evaluate_mean(z), mean, rtol=1e-13, atol=1e-13)
    assert functions[0].name_in() == ["z"] and tuple(functions[0].name_out()) == QUANTITIES


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("name", KERNELS)
def test_generated_c_agrees(name):
    posterior = sparse_case(name, n_out=1)
    f = posterior.function("gp_c", QUANTITIES)
    generator = ca.CodeGenerator("gp_c.c")
    generator.add(f)
    library = build([("gp_c.c", generator.dump(), MODEL_FLAGS)])
    g = ca.external("gp_c", str(library))
    for row in np.random.default_rng(6).standard_normal((10, 3)):
        for a, b in zip(f(row), g(row)):
            np.testing.assert_allclose(a.full(), b.full(), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("name", KERNELS)
def test_jacobians_are_derivatives(name):
    posterior = sparse_case(name)
    z = ca.SX.sym("z", 3)
    f = ca.Function(
        "f",
        [z],
        [
            posterior.mean_jacobian(z),
            ca.jacobian(posterior.mean(z), z),
            posterior.variance_jacobian(z),
            ca.jacobian(posterior.variance(z), z),
        ],
    )
    rng = np.random.default_rng(7)
    for spread in (0.5, 1.0, 3.0, 30.0):
        jm, am, jv, av = (
            v.full()
            for v in f(
                rng.standard_normal(3) * spread * posterior.input_scale + posterior.input_mean
            )
        )
        np.testing.assert_allclose(jm, am, rtol=1e-9, atol=1e-10 * (1 + np.abs(am).max()))
        np.testing.assert_allclose(jv, av, rtol=1e-8, atol=1e-9 * (1 + np.abs(av).max()))


def test_jacobians_agree_with_finite_differences():
    posterior = sparse_case("matern52")
    z, h = np.array([0.3, -0.2, 0.8]), 1e-6
    steps = h * posterior.input_scale * np.eye(3)
    up, down = posterior.evaluate(z + steps), posterior.evaluate(z - steps)
    for jacobian, a, b in zip(
        (posterior.mean_jacobian(z), posterior.variance_jacobian(z)), up, down
    ):
        expected = (a - b).T / (2 * h * posterior.input_scale)
        np.testing.assert_allclose(jacobian.full(), expected, rtol=1e-5, atol=1e-7)


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(KERNELS),
    st.integers(0, 10_000),
    st.floats(1e-9, 1.0),
    st.floats(0.1, 30.0),
    st.floats(1e-3, 1e3),
)
def test_the_variance_is_never_negative(name, seed, noise, scale, spread):
    """Nearly singular covariances, doubled support points and far queries included."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((40, 2))
    kernel = make_kernel(name, 2, rng)
    kernel = type(kernel)(**{**kernel.to_dict(), "lengthscales": scale * kernel.lengthscales})
    support = np.concatenate([x[:10], x[:3] + 1e-7])
    numbers = [sparse.collapsed(kernel, support.T, x.T, x[:, 0], noise)]
    posterior = posterior_of(numbers, [kernel], support)
    queries = np.concatenate([support, x, spread * rng.standard_normal((20, 2))])
    mean, variance = posterior.evaluate(queries)
    prior = kernel.prior_variance(queries.T).ravel()
    assert np.isfinite(mean).all()
    assert (variance >= 0).all()
    # A posterior knows no less than the prior, but for what rounding does to nearly singular
    # matrices.
    assert (variance[:, 0] <= prior * (1 + 1e-4)).all()
    distance = posterior.evaluate_distance(queries)
    assert (distance >= 0).all() and (distance <= 1).all()


@pytest.mark.parametrize("name", KERNELS)
def test_far_away_only_the_physics_is_left(name):
    """The mean goes to the output's mean, the variance to the kernel's, the distance to one: a
    linear part as well."""
    posterior = sparse_case(name)
    for direction in np.eye(3):
        far = posterior.input_mean + 400.0 * posterior.input_scale * direction
        mean, variance = posterior.evaluate(far[None, :])
        np.testing.assert_allclose(
            mean[0], posterior.output_mean, atol=1e-6 * posterior.output_scale.max()
        )
        limit = [k.variance for k in posterior.kernels] * posterior.output_scale**2
        np.testing.assert_allclose(variance[0], limit, rtol=1e-6)
        assert posterior.evaluate_distance(far[None, :])[0] == pytest.approx(1.0, abs=1e-6)


def test_distance_tells_inside_from_outside():
    posterior = sparse_case(points=60, n=300)
    rng = np.random.default_rng(1)
    inside = rng.standard_normal((50, 3)) * 0.7 * posterior.input_scale + posterior.input_mean
    outside = inside + 8.0 * posterior.input_scale
    assert np.quantile(posterior.evaluate_distance(inside), 0.9) < 0.3
    assert posterior.evaluate_distance(outside).min() > 0.9


def test_noise_is_counted_only_when_asked():
    posterior = sparse_case()
    z = np.zeros(3)
    latent, noisy = posterior.variance(z).full(), posterior.variance(z, noise=True).full()
    np.testing.assert_allclose(noisy - latent, posterior.noise[:, None], rtol=1e-12)
    with pytest.raises(UnknownNameError):
        posterior.variance(z, noise="flight 7")


def test_outputs_without_information_are_constant():
    rng = np.random.default_rng(0)
    kernels = [make_kernel("se", 2, rng) for _ in range(2)]
    x = rng.standard_normal((30, 2))
    numbers = [sparse.collapsed(k, x[:8].T, x.T, x[:, 0], 0.1) for k in kernels]
    silent = sparse.Numbers(
        weights=np.zeros(8),
        explained=np.zeros((8, 8)),
        uncertain=np.zeros((8, 8)),
        jitter=0.0,
        log_likelihood=None,
    )
    posterior = posterior_of([numbers[0], silent], kernels, x[:8])
    assert posterior.active == (True, False)
    mean, variance = posterior.evaluate(x)
    assert (mean[:, 1] == 0).all() and np.allclose(variance[:, 1], kernels[1].variance)
    assert np.abs(mean[:, 0]).max() > 0.1
    alone = posterior_of([numbers[0]], kernels[:1], x[:8])
    np.testing.assert_array_equal(posterior.evaluate_distance(x), alone.evaluate_distance(x))
    assert not posterior.mean_jacobian(x[0]).full()[1].any()


def test_wrong_lengths_are_said():
    posterior = sparse_case()
    with pytest.raises(ModelError, match="expected 3 values"):
        posterior.mean([1.0, 2.0])
    with pytest.raises(ModelError, match=r"expected \(N, 3\)"):
        posterior.evaluate(np.zeros((4, 2)))
    with pytest.raises(UnknownNameError):
        posterior.expressions(np.zeros(3), ("median",))


def test_predicting_imports_no_torch():
    code = (
        "import sys, greybox.residual.posterior, greybox.residual.train;"
        "assert not {'torch', 'gpytorch'} & set(sys.modules), 'torch was imported'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
