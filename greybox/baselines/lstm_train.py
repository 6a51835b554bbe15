"""Train the LSTM baseline: the only file of it that imports PyTorch.

As in Ghoul et al. 2026: two layers, dropout between them, Adam (Kingma and Ba 2015) with weight
decay, a schedule that lowers the learning rate where the validation error stands still, early
stopping on validation data. Hidden size, learning rate, window and target come from a random search
of a stated budget; the model with the lowest validation error wins.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch

from greybox.baselines.lstm import LSTMModel, WindowedNetwork
from greybox.baselines.regressors import Data, Descent, Lags, Space, segments_of
from greybox.data import Segment
from greybox.errors import DataError
from greybox.statistics.spread import spread_of
from greybox.symbolic import FloatArray

HORIZON = 50
"""Horizons for which the variance of the free run is measured on validation data."""
ORIGINS = 400
"""At most so many origins measure it."""


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How `descend` goes down: batches of so many rows, `epochs` at most, stopped after `patience`
    without a better one."""

    weight_decay: float = 1e-6
    learning_rate: float = 3e-3
    batch: int = 64
    epochs: int = 200
    patience: int = 25


@dataclass(frozen=True, kw_only=True)
class LSTMSettings(Schedule):
    """Choices of one training. `increments`: the target is the change since the last sample, not
    the value."""

    n_a: int = 10
    n_b: int = 10
    newest: int = 1
    hidden: int = 64
    layers: int = 2
    dropout: float = 0.1
    increments: bool = False


SPACE: Space = {
    "hidden": (32, 64),
    "learning_rate": (1e-3, 3e-3),
    "window": (5, 10),
    "dropout": (0.0, 0.1),
    "increments": (False, True),
}
"""What the search draws from; `window` sets n_a and n_b."""


def train_lstm(
    train: Data,
    validation: Data,
    *,
    outputs: Sequence[str],
    inputs: Sequence[str],
    settings: LSTMSettings | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> LSTMModel:
    """A network trained on `train`, stopped by `validation`. Deterministic for one seed on one
    machine.

    The validation error is the mean over outputs of the squared one-step error in units of the
    training variance. `report` holds settings, epochs, validation error and whether early stopping
    was reached ("stopped" or "epochs used up"). Raises `DataError` where a part has no complete
    window.
    """
    s = settings or LSTMSettings()
    began = time.perf_counter()
    lags = Lags(outputs=tuple(outputs), inputs=tuple(inputs), n_a=s.n_a, n_b=s.n_b, newest=s.newest)
    z, y, _ = lags.pairs(segments_of(train))
    zv, yv, _ = lags.pairs(segments_of(validation))
    n_y = len(lags.outputs)
    target, base = (y - z[:, :n_y], zv[:, :n_y]) if s.increments else (y, np.zeros_like(yv))
    scaling = {
        "input_mean": z.mean(axis=0),
        "input_scale": spread_of(z),
        "target_mean": target.mean(axis=0),
        "target_scale": spread_of(target),
    }
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = Network(n_y + len(lags.inputs), s, n_y)
            x = _single(sequences(lags, (z - scaling["input_mean"]) / scaling["input_scale"]))
            t = _single((target - scaling["target_mean"]) / scaling["target_scale"])
            xv = _single(sequences(lags, (zv - scaling["input_mean"]) / scaling["input_scale"]))
            scales = _single(scaling["target_scale"] / spread_of(y))
            wanted = _single((yv - base - scaling["target_mean"]) / scaling["target_scale"])
            best, report = descend(network, x, t, xv, wanted, scales, s, progress)
    finally:
        torch.set_num_threads(threads)
    model = LSTMModel(
        lags=lags,
        increments=s.increments,
        **scaling,
        layers=tuple(_layer(best, i) for i in range(s.layers)),
        head=(best["head.weight"], best["head.bias"]),
        variance=np.ones((1, n_y)),
        report={**report, "settings": asdict(s), "seed": seed, "samples": len(z)},
        dt=segments_of(train)[0].dt,
    )
    model = replace(model, variance=residual_variance(model, segments_of(validation)))
    return replace(model, train_seconds=time.perf_counter() - began)


def residual_variance(
    model: WindowedNetwork, segments: Sequence[Segment], horizon: int = HORIZON
) -> FloatArray:
    """Mean squared error (horizon, n_y) of the free run over up to `ORIGINS` origins of the
    segments. Raises `DataError` for segments without a sample to measure it on."""
    total: FloatArray = np.zeros((horizon, len(model.outputs)))
    count: FloatArray = np.zeros_like(total)
    for segment in segments:
        last = segment.n - 2
        every = max(1, last * len(segments) // ORIGINS)
        origins = np.arange(min(model.lags.history, last), last + 1, every)
        mean, _ = model.free_run(segment, origins, horizon)
        y = np.vstack(
            [model.lags.measured(segment), np.full((horizon, len(model.outputs)), np.nan)]
        )
        square = (y[origins[:, None] + 1 + np.arange(horizon)] - mean) ** 2
        total += np.nansum(square, axis=0)
        count += np.isfinite(square).sum(axis=0)
    if not count[0].all():
        raise DataError(
            "no validation sample to measure the variance on", fix="validate on longer segments"
        )
    # A horizon that the validation data never reach takes the one before it.
    for h in range(1, horizon):
        empty = count[h] == 0
        total[h, empty], count[h, empty] = total[h - 1, empty], count[h - 1, empty]
    return total / count


class Network(torch.nn.Module):
    """Layers of `torch.nn.LSTM` and a linear head on the last state."""

    def __init__(self, width: int, s: LSTMSettings, n_y: int) -> None:
        super().__init__()
        dropout = s.dropout if s.layers > 1 else 0.0
        self.lstm = torch.nn.LSTM(
            width, s.hidden, num_layers=s.layers, dropout=dropout, batch_first=True
        )
        self.head = torch.nn.Linear(s.hidden, n_y)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(N, steps, width) -> (N, n_y)."""
        states, _ = self.lstm(x)
        return self.head(states[:, -1])


def descend(
    network: torch.nn.Module,
    x: torch.Tensor,
    t: torch.Tensor,
    xv: torch.Tensor,
    tv: torch.Tensor,
    scales: torch.Tensor,
    s: Schedule,
    progress: Callable[[str], None] | None,
) -> tuple[dict[str, FloatArray], Descent]:
    """Weights at the lowest validation error, and what happened: Adam on batches of rows x -> t;
    errors of xv -> tv, times `scales`, lower the learning rate and stop. Raises `DataError` where
    it diverges at once."""
    optimiser = torch.optim.Adam(
        network.parameters(), lr=s.learning_rate, weight_decay=s.weight_decay
    )
    schedule = torch.optim.lr_scheduler.ReduceLROnPlateau(
        optimiser, factor=0.5, patience=max(2, s.patience // 3)
    )
    lowest, since, best, history = float("inf"), 0, network.state_dict(), []
    ended = "epochs used up"
    for epoch in range(s.epochs):
        network.train()
        order = torch.randperm(len(x))
        for at in range(0, len(x), s.batch):
            rows = order[at : at + s.batch]
            optimiser.zero_grad()
            loss = torch.mean((network(x[rows]) - t[rows]) ** 2)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
        network.eval()
        with torch.no_grad():
            error = float(torch.mean(((network(xv) - tv) * scales) ** 2))
        history.append(error)
        schedule.step(error)
        if progress and epoch % 20 == 0:
            progress(f"epoch {epoch}: validation {error:.3e}")
        if not np.isfinite(error):
            ended = "diverged"
            break
        if error < lowest * (1.0 - 1e-4):
            lowest, since = error, 0
            best = {k: v.clone() for k, v in network.state_dict().items()}
        else:
            since += 1
        if since >= s.patience:
            ended = "stopped"
            break
    if not np.isfinite(lowest):
        raise DataError(
            "the training of the network diverged at once", fix="lower the learning rate"
        )
    return {k: v.numpy().astype(np.float64) for k, v in best.items()}, {
        "validation": lowest,
        "epochs": len(history),
        "ended": ended,
        "history": history,
    }


def _layer(weights: dict[str, FloatArray], i: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Input weights, recurrent weights, bias of one layer; PyTorch has two biases that only ever
    add."""
    bias = weights[f"lstm.bias_ih_l{i}"] + weights[f"lstm.bias_hh_l{i}"]
    return weights[f"lstm.weight_ih_l{i}"], weights[f"lstm.weight_hh_l{i}"], bias


def sequences(lags: Lags, x: FloatArray) -> FloatArray:
    """Standardised regressors (N, n_z) as sequences (N, steps, n_y + n_u), oldest step first, zero
    beyond the window."""
    n_y, n_u = len(lags.outputs), len(lags.inputs)
    steps = max(lags.n_a, lags.n_b)
    out = np.zeros((len(x), steps, n_y + n_u))
    past = x[:, : lags.n_a * n_y].reshape(len(x), lags.n_a, n_y)
    moved = x[:, lags.n_a * n_y :].reshape(len(x), lags.n_b, n_u)
    out[:, steps - lags.n_a :, :n_y] = past[:, ::-1]
    out[:, steps - lags.n_b :, n_y:] = moved[:, ::-1]
    return out


def _single(values: FloatArray) -> torch.Tensor:
    """Single precision: half the time, and far finer than what the noise lets a network learn."""
    return torch.from_numpy(values.astype(np.float32))
