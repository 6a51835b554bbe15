"""The output residual: causal to the last bit, right where the truth is known, honest in a free
run, kept in a file."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from greybox.baselines.decoupled import combined
from greybox.baselines.filter_predictor import FilterPredictor
from greybox.baselines.linear_predictor import LinearPredictor
from greybox.baselines.output_residual import OutputHybrid, fit_output_residual
from greybox.baselines.predictor_features import layout_of
from greybox.data import dataset_from_arrays
from greybox.errors import FileFormatError, ModelError, UnknownNameError
from greybox.estimation.filtering import Filter
from greybox.estimation.fit import fit
from greybox.estimation.propagation import Propagator
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.linear.prediction import k_step
from greybox.linear.records import Record
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices
from greybox.model.model import build_model
from greybox.residual.files import load_model
from greybox.symbolic import Layout, Signal
from tests.simulated import flights, vehicle

pytest.importorskip("gpytorch")

DT = 0.01


def linear(name="lin", output="p", inputs="roll", gain=0.3, noise=0.01, delay=1):
    """A first-order system in innovation form."""
    m = Matrices(*(np.array([[v]]) for v in (0.9, 0.5, 1.0, 0.0, gain)))
    return LinearModel(
        name=name,
        matrices=m,
        noise=np.array([[noise**2]]),
        dt=DT,
        inputs=Layout([Signal(name=inputs, unit="1")]),
        outputs=Layout([Signal(name=output, unit="rad/s")]),
        delays=(delay,),
        input_offset=np.array([0.2]),
        output_offset=np.array([0.1]),
    )


def bent(y):
    """What the linear model misses: the mean of its innovation."""
    return 0.1 * np.sin(3.0 * y)


def flight(seed=0, n=800, name="flight", noise=0.01, push=bent):
    """roll = u1 - u2 drives p through `linear`, whose innovation has the mean bent(predicted p)."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0, 1, (n // 20 + 1, 2)), 20, axis=0)[:n]
    moved = u[:, 0] - u[:, 1] - 0.2
    x, p = 0.0, np.zeros(n)
    for k in range(1, n):
        e = push(x + 0.1) + noise * rng.standard_normal()
        p[k] = x + 0.1 + e
        x = 0.9 * x + 0.5 * moved[k - 1] + 0.3 * e
    q = 0.05 * rng.standard_normal(n)
    return dataset_from_arrays(
        DT * np.arange(n), {"u1": u[:, 0], "u2": u[:, 1], "p": p, "q": q}, name=name
    )


CHANNELS = {"roll": ((1.0, "u1"), (-1.0, "u2"))}


@pytest.fixture(scope="module")
def trained():
    return fit_output_residual(
        linear(), flight(0, 2000), channels=CHANNELS, features=("p", "u1[t-1]"), points=30, seed=1
    )


def test_it_finds_what_the_linear_model_misses(trained):
    segment = flight(5, 2000).segments[0]
    y = segment.matrix(("p",))
    mean, variance = trained.one_step(segment)
    plain, _ = trained.base.one_step(segment)
    rows = slice(200, None)
    assert np.sqrt(np.mean((y - mean)[rows] ** 2)) < 1.05 * 0.01
    assert np.sqrt(np.mean((y - plain)[rows] ** 2)) > 3 * 0.01
    assert np.mean(np.abs(y - mean)[rows] < 1.96 * np.sqrt(variance[rows])) == pytest.approx(
        0.95, abs=0.02
    )


@pytest.mark.parametrize("at", [300, 301])
def test_a_replaced_measurement_leaves_its_own_prediction_unchanged(trained, at):
    segment = flight(6).segments[0]
    p = segment.channels["p"].copy()
    p[at] += 1.0
    before, after = trained.one_step(segment), trained.one_step(segment.replace({"p": p}))
    for a, b in zip(before, after):
        assert np.array_equal(a[: at + 1], b[: at + 1], equal_nan=True)
    assert not np.array_equal(before[0][at + 1], after[0][at + 1])


def test_a_free_run_knows_nothing_after_its_origin(trained):
    segment = flight(6).segments[0]
    changed = segment.replace(
        {"p": np.where(np.arange(segment.n) > 300, 9.0, segment.channels["p"])}
    )
    for a, b in zip(trained.free_run(segment, [300], 20), trained.free_run(changed, [300], 20)):
        assert np.array_equal(a, b)


def test_the_first_step_of_a_free_run_is_the_one_step_prediction(trained):
    segment = flight(7).segments[0]
    mean, variance = trained.one_step(segment)
    ahead, spread = trained.free_run(segment, [100, 400], 3)
    assert ahead[:, 0] == pytest.approx(mean[[101, 401]], rel=1e-12)
    assert spread[:, 0] == pytest.approx(variance[[101, 401]], rel=1e-9)


def test_without_a_gp_it_is_the_linear_predictor():
    segment = flight(8).segments[0]
    base = LinearPredictor(model=linear(), channels=CHANNELS)
    record = Record(
        u=(segment.channels["u1"] - segment.channels["u2"])[:, None], y=segment.matrix(("p",))
    )
    one, far = k_step(linear(), record, [1, 10])
    mean, variance = base.free_run(segment, np.arange(10, 700), 10)
    # `k_step` counts from the end of the delay, one sample later.
    assert mean[:, 0] == pytest.approx(one.predicted[9:699], abs=1e-12)
    assert mean[:, 9] == pytest.approx(far.predicted[9:699], abs=1e-12)
    growth = 0.01**2 * (1 + 0.3**2 * np.cumsum(np.concatenate([[0], 0.81 ** np.arange(9)])))
    assert variance[0, :, 0] == pytest.approx(growth, rel=1e-9)


def test_the_spread_of_a_free_run_is_that_of_simulated_futures(trained):
    """Monte Carlo of the true recursion, whose pushes and noises the GP has learned."""
    segment, runs, horizon = flight(9).segments[0], 4000, 12
    mean, variance = trained.free_run(segment, [200], horizon)
    run = trained.base.run(segment)
    rng = np.random.default_rng(0)
    x, drawn = np.full(runs, run.states[201, 0]), np.empty((runs, horizon))
    u = segment.channels["u1"] - segment.channels["u2"] - 0.2
    for h in range(horizon):
        e = bent(x + 0.1) + 0.01 * rng.standard_normal(runs)
        drawn[:, h] = x + 0.1 + e
        x = 0.9 * x + 0.5 * u[200 + h] + 0.3 * e
    assert mean[0, :, 0] == pytest.approx(drawn.mean(axis=0), abs=0.01)
    assert variance[0, :, 0] == pytest.approx(drawn.var(axis=0), rel=0.2)


def test_last_errors_foretell_coloured_noise_and_their_spread_runs_on():
    """A sensor with memory: the innovation is 0.8 of the last one plus white noise. Free runs
    against Monte Carlo."""

    def coloured(seed, n=1500):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.uniform(0, 1, (n // 20, 2)), 20, axis=0)
        x, e, p = 0.0, 0.0, np.zeros(n)
        for k in range(n):
            e = 0.8 * e + 0.01 * rng.standard_normal()
            p[k] = x + 0.1 + e
            x = 0.9 * x + 0.5 * ((u[k - 1] if k else u[0]) @ [1, -1] - 0.2) + 0.3 * e
        return dataset_from_arrays(
            DT * np.arange(n), {"u1": u[:, 0], "u2": u[:, 1], "p": p}, name=f"f{seed}"
        )

    model = replace(linear(), delays=(1,))
    hybrid = fit_output_residual(
        model,
        coloured(1) + coloured(2),
        channels=CHANNELS,
        features=("error.p[t-1]",),
        kernel="linear+se",
        points=20,
    )
    segment = coloured(7).segments[0]
    y, (mean, _) = segment.matrix(("p",)), hybrid.one_step(segment)
    assert np.sqrt(np.nanmean((y - mean)[100:] ** 2)) == pytest.approx(0.01, rel=0.08)
    horizon, runs, rng = 12, 4000, np.random.default_rng(0)
    ahead, spread = hybrid.free_run(segment, [300], horizon)
    assert ahead[0, 0] == pytest.approx(mean[301])
    run = hybrid.base.run(segment)
    x, e = np.full(runs, run.states[301, 0]), np.full(runs, y[300, 0] - run.mean[300, 0])
    u, drawn = segment.channels["u1"] - segment.channels["u2"] - 0.2, np.empty((runs, horizon))
    for h in range(horizon):
        e = 0.8 * e + 0.01 * rng.standard_normal(runs)
        drawn[:, h] = x + 0.1 + e
        x = 0.9 * x + 0.5 * u[300 + h] + 0.3 * e
    assert ahead[0, :, 0] == pytest.approx(drawn.mean(axis=0), abs=0.01)
    assert spread[0, :, 0] == pytest.approx(drawn.var(axis=0), rel=0.25)


def test_decoupled_models_are_one(trained):
    both, channels = combined([linear("a", "p"), linear("b", "q", gain=0.1, delay=3)], CHANNELS)
    assert both.inputs.names == ("roll.p", "roll.q")
    base = LinearPredictor(model=both, channels=channels)
    segment = flight(10).segments[0]
    alone, _ = LinearPredictor(
        model=linear("b", "q", gain=0.1, delay=3), channels=CHANNELS
    ).one_step(segment)
    mean, _ = base.one_step(segment)
    assert mean[4:, 1] == pytest.approx(alone[4:, 0], abs=1e-12)
    assert base.commands == ("u1", "u2")
    assert base.parameters == 2 * 3


def test_a_file_keeps_it_and_says_what_it_is(trained, tmp_path):
    path = trained.save(tmp_path / "hybrid.json")
    segment = flight(11).segments[0]
    again = OutputHybrid.load(path)
    assert all(
        np.array_equal(a, b, equal_nan=True)
        for a, b in zip(again.one_step(segment), trained.one_step(segment))
    )
    assert again.parameters == trained.parameters
    with pytest.raises(FileFormatError, match="a predictor of outputs"):
        load_model(path)
    body = json.loads(path.read_text())
    body["outputs"] = ["q"]
    path.write_text(json.dumps(body))
    with pytest.raises(FileFormatError, match="checksum"):
        OutputHybrid.load(path)


def test_what_it_may_not_see_is_refused():
    base = LinearPredictor(model=linear(), channels=CHANNELS)
    with pytest.raises(ModelError, match="measurement of the predicted instant"):
        layout_of(base, ("q[t]",))
    for name in ("height", "error.q[t-1]"):
        with pytest.raises(UnknownNameError):
            layout_of(base, (name,))
    assert layout_of(base, ("u1[t]", "q[t-1]", "x1", "p")).units[1] == "rad/s"


@pytest.fixture(scope="module")
def physics():
    data = flights(2, 6.0)
    model = build_model(vehicle(), data.channels, ("motor_lag",), sample_time=DT)
    found = fit(
        model, data, disturbance=("torque",), solver=replace(LevenbergMarquardt(), max_iterations=4)
    )
    return found.model, data


def test_on_a_physical_model_it_starts_from_the_filters_prediction(physics):
    model, data = physics
    base = FilterPredictor(model=model)
    assert base.outputs == ("p", "q", "r", "ax", "ay", "az")
    segment = data.segments[0]
    runner = Filter(model)
    filtered = runner.run(segment)
    at = [model.dynamics.outputs[n] for n in base.outputs]
    mean, variance = base.one_step(segment)
    assert np.isnan(mean[:9]).all()
    assert mean[20:] == pytest.approx(filtered.outputs[20:][:, at], abs=1e-12)
    origins = np.array([50, 200])
    far, spread = base.free_run(segment, origins, 15)
    assert far == pytest.approx(runner.rollout(filtered, origins, 15)[:, :, at], rel=1e-9, abs=1e-9)
    assert spread[:, 0] == pytest.approx(variance[origins + 1], rel=1e-9)
    # The same uncertainty as the state-space form with its parameters known, written in
    # innovations.
    told = list(Propagator(runner, parameters=False).run(filtered, origins, 15))[
        -1
    ].innovation_covariance
    rows = base.rows
    assert spread[:, -1] == pytest.approx(np.array([np.diag(c)[rows] for c in told]), rel=0.05)


def test_a_hybrid_of_a_physical_model_is_causal_and_kept_in_a_file(physics, tmp_path):
    model, data = physics
    hybrid = fit_output_residual(
        model, data, outputs=("p", "q"), features=("p", "q", "phi", "u1[t-1]"), points=20
    )
    segment = data.segments[0]
    changed = {
        n: np.where(np.arange(segment.n) == 150, 1.01 * v + 0.1, v)
        for n, v in segment.channels.items()
        if n[0] != "u"
    }
    before, after = hybrid.one_step(segment), hybrid.one_step(segment.replace(changed))
    for a, b in zip(before, after):
        assert np.array_equal(a[:151], b[:151], equal_nan=True)
    assert not np.array_equal(before[0][151], after[0][151])
    again = OutputHybrid.load(hybrid.save(tmp_path / "h.json"))
    assert np.array_equal(
        again.free_run(segment, [100], 5)[1], hybrid.free_run(segment, [100], 5)[1]
    )
