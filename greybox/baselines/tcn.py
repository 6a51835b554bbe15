"""A decoupled temporal convolution with history, trained on multi-step errors: the black box of Rao
et al. 2024.

(Rao, Saviolo, Castiglione Ferrari and Loianno 2024, Learning long-horizon predictions for quadrotor
dynamics, arXiv:2407.12964.) One network tells rotation, another translation; both see the same
window of past samples. Causal dilated convolutions of width two, with what they started from added,
of which only what reaches the present is computed. In training the networks run on with their own
predictions, and the error of all `unroll` steps counts. It is a rival, not for export: PyTorch
predicts, too.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
import torch

from greybox.baselines.kinematics import GRAVITY_DIRECTION, IMU
from greybox.baselines.lstm import WindowedNetwork
from greybox.baselines.lstm_train import Schedule, descend, residual_variance
from greybox.baselines.regressors import Lags, NetworkReport, Space
from greybox.data import Segment
from greybox.errors import DataError
from greybox.symbolic import FloatArray

ROTATION = (*IMU[:3], *GRAVITY_DIRECTION)
"""Channels of the network of rotation; all others belong to translation."""
JUDGED_STEPS, JUDGED_EVERY = 50, 5
"""Steps ahead, and samples between origins, by which training stops and candidates are chosen,
whatever `unroll` is."""
MOST = 6000
"""Windows that training sees, evenly spaced: neighbours share all samples but one."""
SPACE: Space = {
    "channels": (32, 64),
    "learning_rate": (1e-3, 3e-3),
    "unroll": (10, 25),
    "increments": (False, True),
}
"""What the search of a comparison draws from."""


@dataclass(frozen=True, kw_only=True)
class TCNSettings(Schedule):
    """Choices of one training. The window has 2^`levels` samples. `increments`: the networks tell
    the change since the last sample, not the value."""

    levels: int = 4
    channels: int = 32
    unroll: int = 10
    increments: bool = True
    learning_rate: float = 1e-3


class Branch(torch.nn.Module):
    """(N, 2^levels, width), oldest sample first -> (N, outputs)."""

    def __init__(self, width: int, outputs: int, s: TCNSettings) -> None:
        super().__init__()
        self.convolutions = torch.nn.ModuleList(
            torch.nn.Linear(2 * (s.channels if level else width), s.channels)
            for level in range(s.levels)
        )
        self.head = torch.nn.Linear(s.channels, outputs)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Pairs of samples 2^level apart, of which the newer one is added again."""
        h = x
        for level, convolution in enumerate(self.convolutions):
            told = torch.relu(convolution(h.reshape(len(h), h.shape[1] // 2, -1)))
            h = told + h[:, 1::2] if level else told
        return torch.as_tensor(self.head(h[:, -1]))


class Decoupled(torch.nn.Module):
    """Regressors of `lags` in standard units, then the inputs of the samples that follow -> the
    outputs of every step."""

    def __init__(self, lags: Lags, moved: FloatArray, s: TCNSettings) -> None:
        super().__init__()
        self.lags, self.increments = lags, s.increments
        self.register_buffer("moved", torch.as_tensor(moved, dtype=torch.float32))
        parts = [
            [i for i, n in enumerate(lags.outputs) if (n in ROTATION) == turning]
            for turning in (True, False)
        ]
        self.parts = [p for p in parts if p]
        self.order = np.argsort(np.concatenate(self.parts)).tolist()
        width = len(lags.outputs) + len(lags.inputs)
        self.branches = torch.nn.ModuleList(Branch(width, len(p), s) for p in self.parts)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(N, n_z + (steps - 1) n_u) -> (N, steps n_y)."""
        lags, n_u = self.lags, len(self.lags.inputs)
        past = x[:, : lags.n_a * len(lags.outputs)].reshape(len(x), lags.n_a, -1).flip(1)
        moved = x[:, past[0].numel() : lags.width].reshape(len(x), lags.n_b, n_u).flip(1)
        later = x[:, lags.width :].reshape(len(x), -1, n_u)
        told: list[torch.Tensor] = []
        for step in range(later.shape[1] + 1):
            if step:
                past = torch.cat([past[:, 1:], told[-1][:, None]], dim=1)
                moved = torch.cat([moved[:, 1:], later[:, step - 1 : step]], dim=1)
            window = torch.cat([past, moved], dim=2)
            new = torch.cat([branch(window) for branch in self.branches], dim=1)[:, self.order]
            told.append(past[:, -1] + new * self.moved if self.increments else new)
        return torch.cat(told, dim=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class TCNModel(WindowedNetwork):
    """A trained network: predicts `lags.outputs` from `lags`. `middle` and `scale` (n_y + n_u,)
    standardise; `variance` (h_max, n_y) as that of `LSTMModel`; `report` says how it was
    trained."""

    lags: Lags
    network: Decoupled
    middle: FloatArray
    scale: FloatArray
    variance: FloatArray
    train_seconds: float = 0.0
    report: NetworkReport = field(default_factory=NetworkReport)

    @property
    def parameters(self) -> int:
        """Number of weights."""
        return sum(p.numel() for p in self.network.parameters())

    def mean(self, z: FloatArray) -> FloatArray:
        """Predicted outputs (N, n_y) for rows of regressors (N, n_z); NaN where a regressor is
        missing."""
        n_y = len(self.outputs)
        out, whole = np.full((len(z), n_y), np.nan), np.isfinite(z).all(axis=1)
        if whole.any():
            with torch.no_grad():
                told = self.network(
                    _single(_standard(z[whole], self.lags, self.middle, self.scale))
                ).numpy()
            out[whole] = told * self.scale[:n_y] + self.middle[:n_y]
        return out


def train_tcn(
    train: Sequence[Segment],
    validation: Sequence[Segment],
    *,
    outputs: Sequence[str],
    inputs: Sequence[str],
    settings: TCNSettings,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> TCNModel:
    """A network trained on `train`, stopped by `validation`. Deterministic for one seed on one
    machine.

    The validation error is the mean squared error over outputs, in units of the training variance,
    and over `JUDGED_STEPS` steps. Raises `DataError` where a part has no window with its steps, or
    training diverges at once.
    """
    began, s = time.perf_counter(), settings
    lags = Lags(outputs=tuple(outputs), inputs=tuple(inputs), n_a=2**s.levels, n_b=2**s.levels)
    y, u = (
        np.concatenate([part.matrix(names) for part in train])
        for names in (lags.outputs, lags.inputs)
    )
    steps = np.concatenate([np.diff(part.matrix(lags.outputs), axis=0) for part in train])
    values = np.hstack([y, u])
    middle, scale = np.nanmean(values, axis=0), np.nanstd(values, axis=0)
    scale = np.where(scale > 1e-9 * (1.0 + np.abs(middle)), scale, 1.0)
    every = max(1, sum(part.n for part in train) // MOST)
    x, t = (_single(a) for a in _windows(train, lags, s.unroll, every, middle, scale))
    xv, tv = (
        _single(a) for a in _windows(validation, lags, JUDGED_STEPS, JUDGED_EVERY, middle, scale)
    )
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = Decoupled(lags, np.nanstd(steps, axis=0) / scale[: len(lags.outputs)], s)
            best, report = descend(network, x, t, xv, tv, torch.ones(1), s, progress)
    finally:
        torch.set_num_threads(threads)
    network.load_state_dict({k: torch.as_tensor(v, dtype=torch.float32) for k, v in best.items()})
    found = TCNModel(
        lags=lags,
        network=network.eval(),
        middle=middle,
        scale=scale,
        variance=np.ones((1, len(lags.outputs))),
        report={**report, "settings": asdict(s), "seed": seed, "samples": len(x)},
    )
    return replace(
        found,
        variance=residual_variance(found, validation),
        train_seconds=time.perf_counter() - began,
    )


def _windows(
    segments: Sequence[Segment],
    lags: Lags,
    steps: int,
    every: int,
    middle: FloatArray,
    scale: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Inputs (N, n_z + (steps - 1) n_u) and targets (N, steps n_y) of the network, all in standard
    units."""
    n_y, n_u = len(lags.outputs), len(lags.inputs)
    rows, targets = [], []
    for segment in segments:
        origins = np.arange(lags.history - 1, segment.n - steps, every)
        past, moved = lags.starts(segment, origins, steps)
        measured = (lags.measured(segment) - middle[:n_y]) / scale[:n_y]
        told = measured[origins[:, None] + 1 + np.arange(steps)].reshape(len(origins), steps * n_y)
        later = (moved[:, 1:, :n_u] - middle[n_y:]) / scale[n_y:]
        first = _standard(Lags.joined(past, moved[:, 0]), lags, middle, scale)
        row = np.hstack([first, later.reshape(len(origins), (steps - 1) * n_u)])
        whole = np.isfinite(row).all(axis=1) & np.isfinite(told).all(axis=1)
        rows.append(row[whole])
        targets.append(told[whole])
    if not sum(map(len, rows)):
        raise DataError(
            "no stretch is long enough for the temporal convolution",
            expected=f"{lags.history + steps} samples in a row without missing cells",
            fix="longer flights",
        )
    return np.concatenate(rows), np.concatenate(targets)


def _standard(z: FloatArray, lags: Lags, middle: FloatArray, scale: FloatArray) -> FloatArray:
    """Regressors (N, n_z) in standard units."""
    n_y = len(lags.outputs)

    def lagged(v: FloatArray) -> FloatArray:
        return np.concatenate([np.tile(v[:n_y], lags.n_a), np.tile(v[n_y:], lags.n_b)])

    return np.asarray((z - lagged(middle)) / lagged(scale))


def _single(values: FloatArray) -> torch.Tensor:
    return torch.from_numpy(values.astype(np.float32))
