"""Training: what is dropped is counted, what did not converge says so, what explains nothing is set
to zero."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("gpytorch")
from greybox.errors import ModelError, UnknownNameError
from greybox.residual import hyper_parameters, torch_gp
from greybox.residual.candidates import broad_posterior
from greybox.residual.discrepancy import Discrepancy
from greybox.residual.judgement import CHANCE, better_by_chance
from greybox.residual.kernels import Kernel
from greybox.residual.train import train_gp
from tests.residual.gp_cases import layout

QUICK = {"points": 25, "restarts": 1, "subset": 150}


def flights(seed=0, groups=4, n=150, noise=0.1):
    """(Z, Y, truth, groups): a curved output and one of pure noise."""
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((groups * n, 2)) * [3.0, 0.2] + [10.0, -1.0]
    truth = np.stack([np.sin(z[:, 0] - 10.0) * 5.0, np.zeros(len(z))], axis=1)
    y = truth + [5.0 * noise, 1.0] * rng.standard_normal(truth.shape)
    return z, y, truth, np.repeat([f"f{i}" for i in range(groups)], n)


def train(z, y, **more):
    return train_gp(
        z, y, inputs=layout("z", z.shape[1]), outputs=layout("y", y.shape[1]), **(QUICK | more)
    )


def test_a_curve_is_learnt_and_noise_is_not():
    z, y, truth, group = flights()
    trained = train(z, y, groups=group)
    curve, nothing = trained.report.outputs
    assert curve.status == "converged" and nothing.status == "null"
    assert trained.posterior.active == (True, False)
    mean, variance = trained.posterior.evaluate(z)
    assert np.sqrt(np.mean((mean[:, 0] - truth[:, 0]) ** 2)) < 0.1 * truth[:, 0].std()
    assert (mean[:, 1] == 0).all()
    # The leftover and the noise together are what the data show.
    np.testing.assert_allclose(
        variance[:, 1] + trained.posterior.noise[1], np.mean(y[:, 1] ** 2), rtol=1e-9
    )
    assert curve.noise_std == pytest.approx(0.5, rel=0.1)
    assert curve.rmse < 0.5 * curve.rmse_constant and curve.gain > curve.gain_error
    assert any("y1" in w for w in trained.report.warnings)
    assert curve.lengthscales[1] > 5 * curve.lengthscales[0] / 15  # the idle input does not matter


def test_a_gain_in_few_blocks_counts_and_luck_does_not():
    """Ten blocks that all gain, one of them most of it: less than two standard errors, and yet no
    accident."""
    block = np.repeat(np.arange(10), 20)
    level = np.array([0.4, 0.2, 0.1, 0.1, 1.0, 3.5, 0.5, 0.1, 0.3, 0.3])
    assert level.mean() < 2.0 * level.std(ddof=1) / np.sqrt(10)
    assert better_by_chance(level[block], block) == pytest.approx(2.0**-10)
    assert better_by_chance(np.where(level > 3, level, -0.2)[block], block) > 0.2
    rng = np.random.default_rng(0)
    for blocks in (10, 30):
        block = np.repeat(np.arange(blocks), 20)
        passed = [
            better_by_chance(rng.standard_normal(block.size), block) <= CHANCE for _ in range(400)
        ]
        assert 0.01 < np.mean(passed) < 0.08


def test_rows_with_nan_are_dropped_and_counted():
    z, y, _, group = flights()
    z[3, 0], y[7, 1], y[8] = np.nan, np.nan, np.nan
    with_gaps = train(z, y, groups=group, hold_out=0)
    keep = np.isfinite(z).all(1) & np.isfinite(y).all(1)
    assert with_gaps.report.rows_dropped == 3 and with_gaps.report.rows_used == keep.sum()
    without = train(z[keep], y[keep], groups=group[keep], hold_out=0, noise_inflation=1.0)
    again = train(z, y, groups=group, hold_out=0, noise_inflation=1.0)
    np.testing.assert_array_equal(again.posterior.weights, without.posterior.weights)


def test_the_same_seed_gives_the_same_numbers():
    z, y, _, group = flights()
    a, b = (train(z, y, groups=group, seed=3).posterior for _ in range(2))
    for name, values in a.parts()[1].items():
        np.testing.assert_array_equal(values, b.parts()[1][name])


def test_scalings_change_nothing():
    """Inputs and outputs in other units give the same predictions in those units."""
    z, y, _, group = flights()
    a = train(z, y, groups=group, hold_out=0).posterior
    b = train(z * [1e3, 1e-3] + 7.0, y * 1e-4, groups=group, hold_out=0).posterior
    mean_a, variance_a = a.evaluate(z)
    mean_b, variance_b = b.evaluate(z * [1e3, 1e-3] + 7.0)
    np.testing.assert_allclose(mean_b * 1e4, mean_a, atol=1e-5 * np.abs(mean_a).max())
    np.testing.assert_allclose(variance_b * 1e8, variance_a, rtol=1e-3)


def test_an_input_that_stood_still_changes_nothing_where_it_moves_a_little():
    """By rounding, the standard deviation of a column of 15.8 is not zero."""
    z, y, _, group = flights()
    z[:, 1] = 15.8
    learned = train(z, y[:, :1], groups=group, hold_out=0).posterior
    broad = broad_posterior(
        Discrepancy(
            inputs=layout("z", 2), outputs=layout("y", 1), z=z, y=y[:, :1], flights=tuple(group)
        ),
        points=20,
        seed=0,
    )
    assert learned.input_scale[1] == broad.input_scale[1] == 1.0
    before = learned.evaluate_mean(z)
    np.testing.assert_allclose(learned.evaluate_mean(z + np.array([0.0, 0.01])), before, atol=0.01)


@pytest.mark.parametrize("method", ["exact", "svgp"])
def test_all_methods_learn_the_same(method):
    z, y, truth, group = flights()
    z, y = z[:300], y[:300, :1]
    sgpr = train(z, y, groups=group[:300], hold_out=0)
    other = train(z, y, groups=group[:300], hold_out=0, method=method)
    assert other.report.outputs[0].status in ("converged", "iteration limit")
    difference = sgpr.posterior.evaluate_mean(z) - other.posterior.evaluate_mean(z)
    assert np.sqrt(np.mean(difference**2)) < 0.05 * truth[:, 0].std()
    assert other.posterior.method == method


@pytest.mark.parametrize("kernel", ["matern32", "matern52", "linear+se"])
def test_all_kernels_learn(kernel):
    z, y, truth, group = flights(n=80)
    trained = train(z, y[:, :1], groups=group, kernel=kernel, hold_out=0)
    mean = trained.posterior.evaluate_mean(z)[:, 0]
    assert np.sqrt(np.mean((mean - truth[:, 0]) ** 2)) < 0.15 * truth[:, 0].std()


def test_shared_kernels_are_one():
    z, y, _, group = flights()
    trained = train(z, y + [0.0, 1.0] * z[:, [0]], groups=group, share_kernel=True)
    assert len({id(k) for k in trained.posterior.kernels}) == 1


def test_a_constant_prior_mean_is_the_training_mean():
    z, y, _, group = flights()
    y = y + 50.0
    far = z[:1] + 1e4
    constant = train(z, y[:, :1], groups=group, prior_mean="constant", hold_out=0).posterior
    assert constant.evaluate_mean(far)[0, 0] == pytest.approx(y[:, 0].mean())
    zero = train(z, y[:, :1], groups=group, hold_out=0).posterior
    assert zero.evaluate_mean(far)[0, 0] == 0.0


def test_noise_per_flight_is_found_where_it_is():
    z, y, truth, group = flights(n=200)
    loud = group == "f2"
    rng = np.random.default_rng(0)
    y = truth[:, :1] + np.where(loud, 2.0, 0.4)[:, None] * rng.standard_normal((len(z), 1))
    trained = train(z, y, groups=group, noise="auto", hold_out=0)
    assert trained.report.outputs[0].noise_per_group
    levels = {k: float(np.sqrt(v[0])) for k, v in trained.posterior.group_noise.items()}
    assert levels["f2"] == pytest.approx(2.0, rel=0.15) and levels["f0"] == pytest.approx(
        0.4, rel=0.15
    )
    assert trained.posterior.variance(z[0], noise="f2") > trained.posterior.variance(
        z[0], noise="f0"
    )
    even = train(
        z,
        truth[:, :1] + 0.4 * rng.standard_normal((len(z), 1)),
        groups=group,
        noise="auto",
        hold_out=0,
    )
    assert not even.report.outputs[0].noise_per_group and not even.posterior.group_noise


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_noise_per_flight_needs_no_flight_that_is_held_out(seed):
    z, y, _, group = flights(n=60)
    trained = train(z, y[:, :1], groups=group, noise="per-group", hold_out=0.3, seed=seed)
    assert set(trained.posterior.group_noise) == {"f0", "f1", "f2", "f3"}


def test_an_unfinished_search_does_not_look_converged():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((80, 3))
    y = np.sin(2 * x[:, :1]) + 0.1 * rng.standard_normal((80, 1))
    like = Kernel(family="se", lengthscales=np.ones(3), variance=1.0)
    start = np.zeros(5)
    assert hyper_parameters._search(x, y, like, start, 2).status == "iteration limit"
    done = hyper_parameters._search(x, y, like, start, 200)
    assert done.status == "converged"
    assert done.log_likelihood > hyper_parameters._search(x, y, like, start, 2).log_likelihood


def test_a_diverging_likelihood_is_aborted(monkeypatch):
    original = hyper_parameters._likelihood_of
    calls = []

    def poisoned(*arguments):
        function = original(*arguments)

        def value(theta):
            calls.append(1)
            if len(calls) > 4:
                raise hyper_parameters.TrainingAborted("the likelihood is not finite")
            return function(theta)

        return value

    monkeypatch.setattr(hyper_parameters, "_likelihood_of", poisoned)
    rng = np.random.default_rng(0)
    x = rng.standard_normal((60, 2))
    like = Kernel(family="se", lengthscales=np.ones(2), variance=1.0)
    hyper = hyper_parameters._search(x, x[:, :1], like, np.zeros(4), 100)
    assert hyper.status == "diverged" and np.isfinite(hyper.log_likelihood) and len(calls) == 5


def test_progress_goes_from_none_to_all():
    z, y, _, group = flights(n=40)
    seen = []
    train(z, y, groups=group, progress=lambda text, share: seen.append((text, share)))
    shares = [s for _, s in seen]
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(seen) > 5


def test_polish_does_not_lose_likelihood():
    rng = np.random.default_rng(0)
    x = rng.uniform(-2, 2, (200, 1))
    y = np.sin(3 * x) + 0.05 * rng.standard_normal(x.shape)
    kernel = Kernel(family="matern52", lengthscales=[0.5], variance=1.0)
    support = x[:8]
    from greybox.residual import sparse

    before = sparse.collapsed(
        kernel, support.T, x.T, y[:, 0], 0.01, correction=False
    ).log_likelihood
    kernels, noise, moved, status = torch_gp.polish(
        x, y, [kernel], np.array([0.01]), support, iterations=50
    )
    after = sparse.collapsed(
        kernels[0], moved.T, x.T, y[:, 0], noise[0], correction=False
    ).log_likelihood
    assert status in ("converged", "iteration limit") and after > before + 1.0


def test_wrong_arguments_are_said():
    z, y, _, _ = flights(n=20)
    with pytest.raises(ModelError, match="do not fit the layouts"):
        train_gp(z, y[:, :1], inputs=layout("z", 2), outputs=layout("y", 2))
    with pytest.raises(ModelError, match="too few"):
        train(z[:10], y[:10])
    with pytest.raises(UnknownNameError, match="did you mean se"):
        train(z, y, kernel="sse")
    with pytest.raises(ModelError, match="hold-out"):
        train(z, y, points="auto", hold_out=0)
    with pytest.raises(ModelError, match="infinite"):
        train(np.where(z > 12, np.inf, z), y)
