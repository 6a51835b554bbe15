"""The smoother's states are the conditional mean of the linear Gaussian model, given the whole
record."""

import numpy as np
import pytest

from greybox.data import dataset_from_arrays
from greybox.estimation.filtering import Filter
from greybox.estimation.gain import Linearisation
from greybox.estimation.smoothing import smooth, transitions
from greybox.model.dynamics import StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.noise import with_disturbance
from greybox.model.parameter import ParameterValues
from greybox.symbolic import Layout, Signal

DT, N = 0.05, 60


def oscillator() -> IdentifiedModel:
    """A damped oscillator with a disturbance force; position is measured."""
    inner = StateSpaceModel(
        name="oscillator",
        states=Layout([Signal(name="pos", unit="m"), Signal(name="vel", unit="m/s")]),
        inputs=Layout([Signal(name="u", unit="N")]),
        outputs=Layout([Signal(name="y", unit="m")]),
        parameters=(),
        dynamics=lambda t, x, u, p: [x[1], u - 4 * x[0] - 0.4 * x[1]],
        measurement=lambda t, x, u, p: [x[0]],
        noise_states=("vel",),
    )
    dynamics = with_disturbance(inner, ("vel",), time=0.5)
    return IdentifiedModel(
        dynamics=dynamics,
        values=ParameterValues({d.name: d.nominal for d in dynamics.parameters}),
        process_noise=np.array([0.3, 0.4]),
        sensor_noise=np.array([0.02]),
        weak=np.full(3, 1e6),
        reference_state=np.zeros(3),
        reference_inputs=np.zeros(1),
        sample_time=DT,
    )


def test_smoothed_states_and_their_variance_equal_the_dense_solution():
    model = oscillator()
    runner = Filter(model)
    p = model.parameter_vector()
    a, g, c, _ = Linearisation(model.dynamics, ()).values(np.zeros(3), np.zeros((1, 1)), p, DT)
    rng = np.random.default_rng(0)
    x, y, u = np.zeros(3), np.zeros(N), rng.standard_normal(N)
    step = model.dynamics
    for k in range(N):
        w = model.process_noise * rng.standard_normal(2)
        y[k] = x[0] + 0.02 * rng.standard_normal()
        x = np.asarray(step.step(0, x, u[k], p, w, DT).full()).ravel()
    data = dataset_from_arrays(DT * np.arange(N), {"u": u, "y": y}, name="run")
    start = np.array([0.1, 0.0, 0.0])
    filtered = runner.run(data.flights[0].segments[0], x0=start)
    found = smooth(runner, filtered)

    # The same conditional mean from one big Gaussian: x0 ~ N(start, P), all noises independent.
    prior = filtered.state_covariance
    size = 3 + 2 * N
    cov = np.zeros((size, size))
    cov[:3, :3] = prior
    cov[3:, 3:] = np.diag(np.tile(model.process_noise**2, N))
    rows = np.zeros((N, 3, size))
    mean = np.zeros((N, 3))
    row, m = np.eye(3, size), start
    for k in range(N):
        rows[k], mean[k] = row, m
        row = a @ row
        row[:, 3 + 2 * k : 5 + 2 * k] += g
        m = np.asarray(step.step(0, m, u[k], p, np.zeros(2), DT).full()).ravel()
    h = np.einsum("ij,kjl->kl", c, rows)
    gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + 0.02**2 * np.eye(N))
    posterior = gain @ (y - mean @ c[0])
    after = cov - gain @ h @ cov
    assert np.abs(found.states - (mean + rows @ posterior)).max() < 1e-9
    variance = np.einsum("kij,jl,kil->ki", rows, after, rows)
    assert found.variance == pytest.approx(variance, rel=1e-6)
    assert np.all(found.variance <= np.diag(prior) + 1e-12)


def test_transitions_are_the_derivatives_of_the_step():
    model = oscillator()
    runner = Filter(model)
    x = np.random.default_rng(1).standard_normal((5, 3))
    u = np.zeros((5, 1))
    found = transitions(runner.engine, x, np.arange(5), u, model.parameter_vector(), DT)
    wanted = Linearisation(model.dynamics, ()).values(
        x[0], np.zeros((1, 1)), model.parameter_vector(), DT
    )
    assert found.end_sensitivity[3] == pytest.approx(wanted[0], abs=1e-12)
    assert -found.sensitivity[3] == pytest.approx(wanted[2], abs=1e-12)
