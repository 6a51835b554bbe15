"""A sparse posterior at 50-100 support points: RMSE close to the full GP's, variance not below it,
points that pay."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.residual import sparse
from greybox.residual.kernels import Kernel
from greybox.residual.selection import Curve, blocks_of, choose, held_out, place_points, stratified


def smooth_inputs(seed, n, n_in=6):
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(n)
    columns = [
        sum(
            np.sin(2 * np.pi * f * t + p)
            for f, p in zip(rng.uniform(0.1, 3, 4), rng.uniform(0, 6.28, 4))
        )
        for _ in range(n_in)
    ]
    return np.stack(columns, axis=1) / np.sqrt(2.0)


def draw(kernel, x, rng):
    """A sample of the process at x (N, n_in)."""
    matrix = kernel.covariance(x.T, x.T) + 1e-8 * np.eye(len(x))
    return np.linalg.cholesky(matrix) @ rng.standard_normal(len(x))


def moments(kernel, numbers, support, x):
    k = kernel.covariance(support.T, x.T)
    conditional = kernel.prior_variance(x.T).ravel() - ((numbers.explained @ k) ** 2).sum(0)
    return numbers.weights @ k, np.maximum(conditional, 0.0) + ((numbers.uncertain @ k) ** 2).sum(0)


@pytest.mark.parametrize("points", [50, 100])
def test_error_and_variance_of_the_full_gp_are_kept(points):
    """Functions drawn from the prior, noise of 0.3 standard deviations; 5 % in the median, 7 % at
    worst, 1 % of variance."""
    ratios, shares = [], []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        x = smooth_inputs(seed, 1200)
        scales = np.where(rng.permutation(6) < 3, rng.uniform(2.5, 4.0, 6), 30.0)
        kernel = Kernel(family="se", lengthscales=scales, variance=1.0)
        f = draw(kernel, x, rng)
        train, test = np.arange(0, 800), np.arange(800, 1200)
        y = f + 0.3 * rng.standard_normal(len(f))
        full = sparse.exact(kernel, x[train].T, y[train], 0.09)
        support = place_points([kernel], np.array([0.09]), x[train], points, seed=seed)
        few = sparse.collapsed(kernel, support.T, x[train].T, y[train], 0.09)
        guard = sparse.variance_guard(kernel, support.T, few, x[train].T, 0.09, seed=seed)
        mean_full, variance_full = moments(kernel, full, x[train], x[test])
        mean, variance = moments(kernel, few, support, x[test])
        ratios.append(np.sqrt(np.mean((mean - y[test]) ** 2) / np.mean((mean_full - y[test]) ** 2)))
        shares.append((guard * variance / variance_full).min())
        assert 1.0 <= guard < 1.5
    assert np.median(ratios) <= 1.05 and max(ratios) <= 1.07
    assert min(shares) >= 0.99


def test_placed_points_beat_random_ones():
    x = smooth_inputs(0, 1500, 3)
    kernel = Kernel(family="se", lengthscales=np.full(3, 1.0), variance=1.0)

    def left(support):
        numbers = sparse.collapsed(kernel, support.T, x.T, np.zeros(len(x)), 0.01)
        return (1.0 - ((numbers.explained @ kernel.covariance(support.T, x.T)) ** 2).sum(0)).sum()

    placed = place_points([kernel], np.array([0.01]), x, 60, seed=0)
    random = [left(x[np.random.default_rng(s).permutation(len(x))[:60]]) for s in range(5)]
    assert left(placed) < 0.7 * min(random)


def test_points_are_nested_and_deterministic():
    x = smooth_inputs(0, 600, 3)
    kernels = [Kernel(family="se", lengthscales=np.full(3, s), variance=1.0) for s in (1.0, 2.0)]
    noise = np.array([0.1, 0.01])
    many, few, again = (place_points(kernels, noise, x, m, seed=4) for m in (40, 15, 40))
    np.testing.assert_array_equal(many[:15], few)
    np.testing.assert_array_equal(many, again)


def test_repeated_samples_give_no_repeated_points():
    x = np.repeat(smooth_inputs(0, 12, 2), 5, axis=0)
    kernel = Kernel(family="matern32", lengthscales=np.ones(2), variance=1.0)
    support = place_points([kernel], np.array([0.1]), x, 40, seed=0)
    assert len(support) == 12 and len(np.unique(support, axis=0)) == 12


def test_held_out_samples_are_whole_flights():
    group = np.repeat([0, 1, 2, 3, 4], [50, 100, 150, 50, 60])
    for seed in range(10):
        mask = held_out(group, 0.25, seed)
        assert set(group[mask]).isdisjoint(group[~mask]) and mask.any() and not mask.all()
    alone = held_out(np.zeros(100, dtype=int), 0.25, 0)
    assert alone[75:].all() and not alone[:75].any()


def test_subsets_hold_every_flight_in_proportion():
    group = np.repeat([0, 1, 2], [100, 300, 600])
    rows = stratified(group, 100, seed=1)
    assert len(set(rows.tolist())) == 100
    np.testing.assert_allclose(np.bincount(group[rows]), [10, 30, 60], atol=1)


def test_the_smallest_number_as_good_as_the_best_is_chosen():
    rng = np.random.default_rng(0)
    block = blocks_of(np.zeros(1000, dtype=int))
    assert len(np.unique(block)) == 10
    common = rng.standard_normal(1000)
    levels = {10: 1.0, 20: 0.3, 50: 0.005, 100: 0.0}
    nlpd = [common + level + 0.001 * rng.standard_normal(1000) for level in levels.values()]
    curve = choose(list(levels), nlpd, [1.0] * 4, block, inputs=3, outputs=1, seconds=[0.0] * 4)
    assert isinstance(curve, Curve) and curve.chosen == 50
    assert [t.points for t in curve.trials] == list(levels)
    assert all(a.flops < b.flops for a, b in zip(curve.trials, curve.trials[1:]))


def test_auto_points_come_with_their_curve():
    pytest.importorskip("gpytorch")
    from greybox.residual.train import train_gp
    from tests.residual.gp_cases import layout

    x = smooth_inputs(3, 900, 2)
    y = np.sin(2 * x[:, :1]) + 0.1 * np.random.default_rng(0).standard_normal((900, 1))
    trained = train_gp(
        x,
        y,
        inputs=layout("z", 2),
        outputs=layout("y", 1),
        points="auto",
        restarts=1,
        subset=150,
        groups=np.repeat(range(6), 150),
        noise_inflation=1.0,
    )
    curve = trained.report.curve
    assert curve is not None and trained.posterior.points == curve.chosen
    best = min(curve.trials, key=lambda t: t.nlpd)
    chosen = next(t for t in curve.trials if t.points == curve.chosen)
    assert chosen.nlpd <= best.nlpd + max(0.01, chosen.behind_error)
