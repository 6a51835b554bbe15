"""A temporal convolution and a long short-term memory are those of PyTorch, and learn on the physics
what earlier commands still do.

In a hybrid it looks back through the command window; in an export the earlier commands are its
state.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import scipy.optimize

from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.filtering import Filter
from greybox.model.identified import IdentifiedModel
from greybox.residual.drawn_push import DrawnPush
from greybox.residual.feature_posterior import silent_features
from greybox.residual.features import feature_layout, lag_of, reach, with_lags
from greybox.residual.files import load_model, save_model
from greybox.residual.hybrid import HybridModel
from greybox.residual.learn import Learned, learn
from greybox.residual.learners.long_short_term_memory import Recurrence
from greybox.residual.learners.sequence import CHANNELS, MOST_LAGS, SequenceNetwork
from greybox.residual.learners.temporal_convolution import Convolution, TemporalConvolution
from greybox.residual.posterior import Domain
from greybox.symbolic import FloatArray, Layout
from mpc_export.functions import model_functions
from tests.residual.hybrid_cases import DT, pendulum, pendulum_model

LAGS = TemporalConvolution().lags(DT)
NAMES = ("p", "u1", "u2", *(f"u{i}[t-{k}]" for k in range(1, LAGS + 1) for i in (1, 2)))
LATE = 4
"""Samples after which a command still pushes."""


def late_push(seed: int, n: int = 400) -> Dataset:
    """A flight of a pendulum that also feels the square of the command of `LATE` samples ago."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-2, 2, -(-n // 3)), 3)[:n]
    x, rows = np.array([0.2, 0.0]), np.empty((n, 2))
    for k in range(n):
        rows[k] = x
        push = u[k] + 0.8 * u[max(k - LATE, 0)] ** 2 + 0.02 / np.sqrt(DT) * rng.standard_normal()
        for _ in range(4):
            rate = x[1] + DT / 4 * (push - 9.0 * np.sin(x[0]) - 0.3 * x[1])
            x = np.array([x[0] + DT / 4 * rate, rate])
    y = rows + rng.standard_normal((n, 2)) * [0.005, 0.01]
    return dataset_from_arrays(
        DT * np.arange(n), {"u": u, "y": y[:, 0], "w": y[:, 1]}, name=f"f{seed}"
    )


def flights(*seeds: int) -> Dataset:
    return Dataset(flights=tuple(f for s in seeds for f in late_push(s).flights))


@functools.cache
def learned(learner: str) -> Learned:
    train = flights(1, 2)
    base = replace(pendulum_model((0.3, 1.0)), trained_on=train.names, data_hash=train.hash)
    return learn(base, train, features=("rate", "u"), points=8, learner=learner, seed=0)


def squared(model: IdentifiedModel, ahead: int = 10) -> float:
    """Mean squared error of the rate on a flight that nobody has seen."""
    runner, segment = Filter(model), late_push(77).flights[0].segments[0]
    origins = np.arange(20, segment.n - ahead - 1, 3)
    found = runner.rollout(runner.run(segment), origins, ahead)[:, -1, 1]
    return float(np.mean((found - segment.channels["w"][origins + ahead]) ** 2))


def weights(net: SequenceNetwork, seed: int = 0) -> FloatArray:
    return 0.3 * np.random.default_rng(seed).standard_normal(sum(a * b for a, b in net.shapes))


def test_its_features_are_those_of_pytorchs_convolutions() -> None:
    torch = pytest.importorskip("torch")
    net = Convolution.of(NAMES, 5, 2)
    v, rows = weights(net), np.random.default_rng(1).standard_normal((6, len(NAMES)))
    w = [torch.from_numpy(m.copy()) for m in net.views(v)]
    oldest_first = torch.from_numpy(np.stack([rows[:, list(t)] for t in net.taps[::-1]], axis=2))
    h = oldest_first
    for k in range(3):
        kernel = torch.stack([w[3 * k + 1], w[3 * k]], dim=2)
        past = torch.nn.functional.pad(h, (2**k, 0))
        bent = torch.tanh(
            torch.nn.functional.conv1d(past, kernel, w[3 * k + 2].ravel(), dilation=2**k)
        )
        h = bent + h if k else bent
    joined = torch.cat([h[:, :, -1], torch.from_numpy(rows[:, list(net.now)])], dim=1)
    hidden = torch.tanh(joined @ w[-3].T + w[-2].T).numpy() / np.sqrt(5)
    s = ca.SX.sym("s", len(NAMES))
    phi = ca.Function("phi", [s], [net.features(v)(s)])
    for row, expected in zip(rows, hidden, strict=True):
        assert np.allclose(phi(row).full().ravel()[:5], expected, rtol=1e-12, atol=1e-14)


def test_a_recurrence_has_the_features_of_pytorchs_lstm() -> None:
    torch = pytest.importorskip("torch")
    net = Recurrence.of(NAMES, 5, 2)
    v, rows = weights(net), np.random.default_rng(1).standard_normal((6, len(NAMES)))
    w = [torch.from_numpy(m.copy()) for m in net.views(v)]
    lstm = torch.nn.LSTM(2, CHANNELS, batch_first=True, dtype=torch.float64)
    lstm.load_state_dict(
        {
            "weight_ih_l0": w[0],
            "weight_hh_l0": w[1],
            "bias_ih_l0": w[2].ravel(),
            "bias_hh_l0": torch.zeros_like(w[2].ravel()),
        }
    )
    oldest_first = torch.from_numpy(np.stack([rows[:, list(t)] for t in net.taps[::-1]], axis=1))
    with torch.no_grad():
        h = lstm(oldest_first)[0][:, -1]
    joined = torch.cat([h, torch.from_numpy(rows[:, list(net.now)])], dim=1)
    hidden = torch.tanh(joined @ w[-3].T + w[-2].T).numpy() / np.sqrt(5)
    s = ca.SX.sym("s", len(NAMES))
    phi = ca.Function("phi", [s], [net.features(v)(s)])
    for row, expected in zip(rows, hidden, strict=True):
        assert np.allclose(phi(row).full().ravel()[:5], expected, rtol=1e-12, atol=1e-14)


def test_it_looks_back_for_a_time_not_for_a_number_of_samples() -> None:
    """140 ms: of motors and wakes, whatever the log's rate; from 222 Hz on the number of samples is
    bounded."""
    lags = TemporalConvolution().lags
    assert [lags(1 / rate) for rate in (50, 100, 200)] == [7, 14, 28]
    assert lags(1e-3) == MOST_LAGS and lags(1.0) == 1


@pytest.mark.parametrize("kind", [Convolution, Recurrence])
def test_its_gradient_is_that_of_differences(kind: type[SequenceNetwork]) -> None:
    """Two sequences of different length, one shorter than a power of two."""
    net = kind.of((*NAMES[:-4], "q[t-1]", "q[t-2]", "q[t-3]"), 3, 1)
    rng = np.random.default_rng(2)
    x, y = rng.standard_normal((len(NAMES) - 1, 7)), rng.standard_normal((1, 7))
    assert len(net.taps) == LAGS - 1 and net.shapes[0][1] == 3
    slope = scipy.optimize.approx_fprime(weights(net), lambda v: net.loss(v, x, y)[0], 1e-6)
    assert np.allclose(net.loss(weights(net), x, y)[1], slope, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("learner", ["tcn", "lstm"])
def test_it_learns_what_an_earlier_command_still_does_and_what_has_no_memory_cannot(
    learner: str,
) -> None:
    found, blind = learned(learner), learned("neural")
    assert not found.null and found.fit.held_out_gain > 0.2
    assert squared(found.model) < 0.5 * squared(found.base)
    assert squared(found.model) < 0.7 * squared(blind.model)
    posterior = found.fit.posterior
    assert posterior.inputs.names == ("rate", "u", *(f"u[t-{k}]" for k in range(1, LAGS + 1)))


def drawn(kind: type[SequenceNetwork]) -> IdentifiedModel:
    """The pendulum with a memory of random weights on top."""
    base, rng = pendulum_model(), np.random.default_rng(3)
    names = with_lags(base.dynamics, ("rate",), LAGS)
    net, x = kind.of(names, 5, 1), ca.SX.sym("x", len(names))
    phi = ca.Function("phi", [x], [net.features(weights(net))(x)])
    inputs, one, m = feature_layout(base.dynamics, names), np.ones(len(names)), phi.numel_out(0)
    noises = base.dynamics.noises
    silent = silent_features(
        phi,
        method="tcn",
        inputs=inputs,
        outputs=Layout([noises.signals[noises["rate"]]]),
        input_mean=0 * one,
        input_scale=one,
        output_scale=np.ones(1),
        domain=Domain(lower=-one, upper=one),
    )
    posterior = replace(
        silent, weights=rng.standard_normal((m, 1)), root=0.1 * rng.standard_normal((1, m, m))
    )
    return replace(base, dynamics=HybridModel(inner=base.dynamics, posterior=posterior))


@pytest.mark.parametrize("kind", [Convolution, Recurrence])
def test_its_file_and_its_export_are_the_same_model(
    kind: type[SequenceNetwork], tmp_path: Path
) -> None:
    """The exported step, fed its own history, walks as the model with its command window does."""
    model = load_model(save_model(drawn(kind), tmp_path / "hybrid.json"))
    dynamics = model.dynamics
    assert (
        isinstance(dynamics, HybridModel)
        and dynamics.window == (LAGS, 0)
        and dynamics.inner.window == (0, 0)
    )
    functions = model_functions(model)
    assert functions.states.names[-LAGS:] == tuple(f"history.u.{k}" for k in range(1, LAGS + 1))
    rng, n = np.random.default_rng(4), len(dynamics.states)
    u, p = rng.uniform(-2, 2, LAGS + 12), model.flight_vector(None)
    x, own = np.concatenate([0.1 * np.ones(n), u[LAGS - 1 :: -1]]), 0.1 * np.ones(n)
    for k in range(LAGS, len(u)):
        x = functions["f_d"](x, u[k], functions.parameter_values).full().ravel()
        window = ca.DM(u[k - LAGS : k + 1][None])
        own = np.asarray(
            ca.DM(dynamics.step(0, ca.DM(own), window, p, np.zeros(len(dynamics.noises)), DT))
        ).ravel()
        assert np.allclose(x[:n], own, rtol=1e-9, atol=1e-12)
        assert np.array_equal(x[n:], u[k : k - LAGS : -1])
    held = ca.DM(u[0] * np.ones((1, LAGS + 1)))
    z = dynamics.learned_inputs(ca.DM(own), held)
    rate = functions["f"](own, u[0], functions.parameter_values).full().ravel()
    assert np.allclose(rate, dynamics.f(0, ca.DM(own), ca.DM(u[0]), p).full().ravel(), rtol=1e-10)
    assert np.allclose(z.full().ravel()[1:], u[0])
    twin = DrawnPush(hybrid=dynamics)
    past, whole = ca.DM(u[: LAGS + 1][None]), [d.nominal for d in twin.parameters]
    steps = [
        d.step(0, ca.DM(own), past, q, np.zeros(len(dynamics.noises)), DT)
        for d, q in ((dynamics, p), (twin, whole))
    ]
    assert np.allclose(*(ca.DM(v).full() for v in steps), rtol=1e-10)
    with pytest.raises(ModelError, match="earlier commands, sample by sample"):
        model_functions(model, dt=2 * DT)


def test_lags_are_names_of_inputs_only() -> None:
    assert (
        lag_of("u1[t-12]") == ("u1", 12)
        and lag_of("u1[t]") == ("u1", 0)
        and reach(("p", "u1[t-3]", "u2[t-2]")) == 3
    )
    assert pendulum().window == (0, 0)
    with pytest.raises(UnknownNameError, match="feature"):
        learn(pendulum_model(), flights(1), features=("rate[t-1]",), learner="sparse")


@pytest.mark.slow
def test_any_learner_may_look_back() -> None:
    found = learn(
        pendulum_model((0.3, 1.0)),
        flights(1, 2),
        features=(f"u[t-{LATE}]",),
        points=6,
        learner="sparse",
    )
    assert not found.null and squared(found.model) < 0.5 * squared(found.base)
