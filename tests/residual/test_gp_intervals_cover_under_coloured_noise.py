"""With noise correlated in time, intervals of the function cover only if the noise is inflated by
its correlation time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from greybox.residual.inflation import autocorrelation_time
from tests.residual.gp_cases import layout


def coloured(rng, n, phi):
    """AR(1) of unit variance, from its stationary distribution."""
    e = rng.standard_normal(n) * np.sqrt(1 - phi**2)
    return lfilter([1.0], [1.0, -phi], e, zi=[phi * rng.standard_normal()])[0]


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9])
def test_the_correlation_time_of_a_known_process(phi):
    rng = np.random.default_rng(0)
    n, groups = 5000, 4
    e = np.concatenate([coloured(rng, n, phi) for _ in range(groups)])
    place, group = np.arange(e.size), np.repeat(np.arange(groups), n)
    truth = (1 + phi) / (1 - phi)
    assert autocorrelation_time(e, place, group) == pytest.approx(truth, rel=0.15)
    # A tenth of the rows missing changes nothing but the scatter.
    keep = rng.uniform(size=e.size) > 0.1
    assert autocorrelation_time(e[keep], place[keep], group[keep]) == pytest.approx(truth, rel=0.25)


def test_groups_do_not_leak_into_each_other():
    """Two groups whose ends happen to match: the product across the border does not count."""
    e = np.concatenate([np.ones(50), np.ones(50)]) * np.tile([1.0, -1.0], 50)
    assert autocorrelation_time(e, np.arange(100), np.repeat([0, 1], 50)) == 1.0


def test_intervals_cover():
    pytest.importorskip("gpytorch")
    from greybox.residual.train import train_gp

    def run(seed, inflation):
        rng = np.random.default_rng(seed)
        t, flights = 0.01 * np.arange(1000), 3
        z = np.concatenate(
            [
                np.stack(
                    [
                        sum(
                            np.sin(2 * np.pi * f * t + p)
                            for f, p in zip(rng.uniform(0.05, 1.0, 5), rng.uniform(0, 6, 5))
                        )
                        for _ in range(2)
                    ],
                    axis=1,
                )
                for _ in range(flights)
            ]
        )
        truth = np.sin(z[:, 0]) + 0.5 * z[:, 1] * np.tanh(z[:, 0])
        y = truth + 0.4 * np.concatenate([coloured(rng, t.size, 0.9) for _ in range(flights)])
        posterior = train_gp(
            z,
            y[:, None],
            inputs=layout("z", 2),
            outputs=layout("y", 1),
            points=30,
            restarts=1,
            subset=120,
            hold_out=0,
            groups=np.repeat(range(flights), t.size),
            noise_inflation=inflation,
            guard=False,
        ).posterior
        mean, variance = posterior.evaluate(z)
        return np.mean(
            np.abs(mean[:, 0] - truth) < 1.96 * np.sqrt(variance[:, 0])
        ), posterior.noise_inflation[0]

    honest, naive = [run(seed, "auto") for seed in range(4)], [run(seed, 1.0) for seed in range(2)]
    assert np.mean([c for c, _ in naive]) < 0.7
    assert 0.88 <= np.mean([c for c, _ in honest]) <= 1.0
    assert all(tau == pytest.approx(19.0, rel=0.5) for _, tau in honest)
