"""IPOPT on the CasADi form and the Gauss-Newton polish end at the same likelihood."""

import numpy as np
import pytest

from greybox.errors import DataError, UnknownNameError
from greybox.linear.fit import Options, Settings, fit_linear
from greybox.linear.records import Record
from scenarios.plants.linear_systems import random_system, simulate


def records(seed=0, n=2, size=1, counts=(260, 200), coloured=True):
    rng = np.random.default_rng(seed)
    truth = random_system(rng, n, size, size, coloured=coloured)
    return [
        Record(u=u, y=y + 0.5 * i, name=f"r{i}")
        for i, (u, y) in enumerate(simulate(rng, truth, c) for c in counts)
    ]


@pytest.mark.parametrize(("size", "noise_model"), [(1, True), (1, False), (2, True)])
def test_the_optimum_is_that_of_gauss_newton(size, noise_model):
    data = records(seed=0 if noise_model else 2, size=size, coloured=noise_model)
    options = Options(
        noise_model=noise_model, settings=Settings(tolerance=1e-9, stable=not noise_model)
    )
    ours = fit_linear(data, 2, options=options)
    other = fit_linear(data, 2, options=options, solver="ipopt")
    assert other.converged
    assert other.iterations > 0
    samples = sum(len(r) for r in data)
    assert abs(ours.criterion - other.criterion) / samples < 1e-6
    assert abs(ours.log_det - other.log_det) < 1e-6
    np.testing.assert_allclose(
        ours.model.matrices.gain(1.0), other.model.matrices.gain(1.0), rtol=1e-3
    )
    np.testing.assert_allclose(
        ours.uncertainty.poles().covariance,
        other.uncertainty.poles().covariance,
        rtol=0.1,
        atol=1e-9,
    )


def test_what_it_cannot_do_is_said():
    data = records()
    y = data[0].y.copy()
    y[50] = np.nan
    with pytest.raises(DataError, match="missing outputs"):
        fit_linear([Record(u=data[0].u, y=y)], 2, solver="ipopt")
    with pytest.raises(UnknownNameError, match="solver"):
        fit_linear(data, 2, solver="ipop")
