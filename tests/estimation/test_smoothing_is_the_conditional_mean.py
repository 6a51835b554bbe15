"""The smoother's states are the conditional mean of the linear Gaussian model, given the whole
record."""

import casadi as ca
import numpy as np
import pytest

from greybox.data import dataset_from_arrays
from greybox.errors import FitError
from greybox.estimation.engine import engine_for
from greybox.estimation.filtering import Filter
from greybox.estimation.gain import Linearisation
from greybox.estimation.smoothing import smooth, transitions
from greybox.examples import vehicle_path
from greybox.model.dynamics import StateSpaceModel
from greybox.model.identified import IdentifiedModel
from greybox.model.model import build_model
from greybox.model.noise import Augmented, Coloured, with_disturbance
from greybox.model.parameter import ParameterValues
from greybox.model.vehicle import read_vehicle
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


def craft() -> Augmented:
    """One with errors of its pose that last."""
    model = build_model(
        read_vehicle(vehicle_path("nanobench")),
        ("x", "y", "z", "qw", "qx", "qy", "qz", "p", "q", "r"),
    )
    return Augmented(core=model, parts=(Coloured(sensor="position"), Coloured(sensor="attitude")))


def test_errors_of_a_sensor_turn_no_slope_of_what_it_reads():
    """They are in the reading that is expected, and so in no innovation: however large they are,
    what the flight shows of an attitude stays that of the craft."""
    dynamics = craft()
    engine, names = engine_for(dynamics, ()), dynamics.states.names
    p = np.array([d.nominal for d in dynamics.parameters])
    u = np.full((2, len(dynamics.inputs.names)), 0.5)
    x = np.repeat(dynamics.reference(dict.fromkeys(dynamics.inputs.names, 0.5))[None], 2, axis=0)
    x[:, names.index("attitude.w")], x[:, names.index("attitude.x")] = np.cos(0.1), np.sin(0.1)
    for axis, size in zip("xyz", (0.1, -0.2, 0.3), strict=True):
        x[1, names.index(f"coloured.position.c.{axis}")] = size
        x[1, names.index(f"coloured.attitude.c.{axis}")] = 0.1 * size
    told = engine.rollout(starts=x, rows=np.arange(2), horizon=1, inputs=u, p=p, dt=DT)[0][:, 0]
    read = engine.expected(x, told)
    assert np.abs(read[0] - told[0]).max() < 1e-12 and np.abs(read[1] - told[1]).max() > 0.1
    e = [dynamics.innovation(*map(ca.DM, v)).full() for v in zip(read, told, x, strict=True)]
    assert np.abs(e).max() < 1e-12
    found = transitions(engine, x, np.arange(2), u, p, DT).sensitivity
    assert found[1] == pytest.approx(found[0], abs=0.02)


def test_what_is_smoothed_to_no_number_is_an_error(monkeypatch):
    model = oscillator()
    runner = Filter(model)
    data = dataset_from_arrays(DT * np.arange(N), {"u": np.ones(N), "y": np.ones(N)}, name="run")
    filtered = runner.run(data.flights[0].segments[0])
    wild = transitions(
        runner.engine,
        filtered.states,
        np.arange(N),
        filtered.record.inputs,
        filtered.p,
        DT,
        1e200 * np.repeat(np.eye(3)[None], N, axis=0),
    )
    monkeypatch.setattr("greybox.estimation.smoothing.transitions", lambda *_: wild)
    with pytest.raises(FitError, match="smoothed flight is not finite"):
        smooth(runner, filtered)


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
