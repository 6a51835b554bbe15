"""Physics with a network for what it misses of a step: the residual MLP and the residual LSTM of the
nano-drone benchmarks.

(Ullah and Baca 2026, NanoBench, arXiv:2603.09908; Busetto et al. 2026, arXiv:2512.14450.)

    x(t+1) = f(x(t), u(t)) (+) dt g(z(t), ..., z(t-w+1)),    z = [body velocity, rates, gravity, u]

f is the fitted model without its disturbance states: what lasts is the network's to find. g adds to
body velocity and rates [m/s^2, rad/s^2]. w = 1 is the MLP, w > 1 the LSTM. It is trained on what
open loop misses over `ahead` samples, from states that the filter knows: with one sample, as
published, this is mostly noise of the gyro; with ten it is the error that counts. It is a rival,
not for export. `greybox.residual` trains its learners by multi-step errors, with the disturbance
states kept.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.filter_predictor import FilterPredictor
from greybox.baselines.lstm_train import LSTMSettings, Network, Schedule, descend
from greybox.baselines.predictor_run import Run
from greybox.baselines.regressors import NetworkReport, NotMeasured, Space
from greybox.data import Dataset
from greybox.errors import DataError
from greybox.estimation.ahead import Between, run_ahead
from greybox.frames import numeric
from greybox.statistics.spread import spread_of
from greybox.symbolic import FloatArray
from greybox.validation.groups import GROUPS, error_vectors
from greybox.validation.open_loop import GroupReader, IntArray

JUDGED_STEPS, JUDGED_EVERY = 50, 5
"""Steps ahead, and samples between origins, by which candidates are chosen."""
LEARNED_EVERY = 4
"""Samples between origins that are trained on: neighbours share all samples of the window but one."""
TAUGHT = ("velocity", "rate")
MLP_SPACE: Space = {
    "hidden": (32, 64),
    "learning_rate": (1e-3, 3e-3),
    "ahead": (10, 1),
}
LSTM_SPACE: Space = {**MLP_SPACE, "window": (10, 20)}
"""What the search of a comparison draws from."""


@dataclass(frozen=True, kw_only=True)
class ResidualSettings(Schedule):
    """Choices of one training: samples that the network sees, samples ahead whose error it is
    trained on, hidden units (of both layers)."""

    window: int = 1
    ahead: int = 10
    hidden: int = 32
    learning_rate: float = 1e-3


class PhysicsAlone:
    """The fitted model without its disturbance states, open loop from what its filter knows."""

    def __init__(self, base: FilterPredictor) -> None:
        self.base, self.reader = base, GroupReader(base.model)
        self.velocity, self.rate, self.attitude = (
            self.reader.state_rows(b) for b in ("velocity", "rate", "attitude")
        )
        self.pushes = self.reader.state_rows("disturbance")

    def seen(self, run: Run, states: FloatArray, rows: IntArray) -> FloatArray:
        """z (..., n_z) of states (..., n_x) at rows (...) of a run."""
        flat = states.reshape(-1, states.shape[-1])
        q = flat[:, self.attitude]
        down = np.tile([0.0, 0.0, -1.0], (len(q), 1))
        u = run.inputs[np.minimum(rows + self.base.filter.engine.past, len(run.inputs) - 1)]
        own = [
            numeric("rotate_inverse", q, flat[:, self.velocity]),
            flat[:, self.rate],
            numeric("rotate_inverse", q, down),
        ]
        told = np.concatenate(own, axis=1).reshape(*states.shape[:-1], 9)
        return np.concatenate([told, u], axis=-1)

    def windows(self, run: Run, origins: IntArray, width: int) -> FloatArray:
        """z of the `width` samples up to the one after every origin (m, width, n_z)."""
        rows = np.maximum(origins[:, None] + 1 - np.arange(width)[::-1], 0)
        return self.seen(run, run.states[rows], rows)

    def rolled(
        self,
        run: Run,
        origins: IntArray,
        steps: int,
        added: Callable[[FloatArray], FloatArray] | None = None,
        width: int = 1,
    ) -> dict[str, FloatArray]:
        """Group -> predictions (m, steps, dimension) of samples k+1 .. k+steps from origins k (m,).

        `added`: windows (m, width, n_z) -> what g adds to body velocity and rates (m, 6) per
        second.
        """
        starts = run.states[origins + 1].copy()
        starts[:, self.pushes] = 0.0
        return self.reader.read(
            run_ahead(
                self.base.filter.engine,
                starts=starts,
                rows=origins + 1,
                steps=steps,
                inputs=run.inputs,
                p=run.p,
                dt=self.base.dt,
                want_states=True,
                between=self._pushed(run, origins, added, width) if added else None,
            )
        )

    def _pushed(
        self, run: Run, origins: IntArray, added: Callable[[FloatArray], FloatArray], width: int
    ) -> Between:
        """What g adds from sample to sample; it remembers the window that g sees."""
        window = self.windows(run, origins, width)

        def pushed(h: int, x: FloatArray, following: FloatArray) -> FloatArray:
            nonlocal window
            told = self.base.dt * added(window)
            q = x[:, self.attitude]
            following[:, self.velocity] += numeric("rotate", q, told[:, :3])
            following[:, self.rate] += told[:, 3:]
            new = self.seen(run, following, origins + 2 + h)
            window = np.concatenate([window[:, 1:], new[:, None]], axis=1)
            return following

        return pushed


class Perceptron(torch.nn.Module):
    """The newest sample of a window (N, width, n_z) -> (N, n_y): two hidden layers."""

    def __init__(self, n_z: int, hidden: int, n_y: int) -> None:
        super().__init__()
        self.layers = torch.nn.Sequential(
            torch.nn.Linear(n_z, hidden),
            torch.nn.Tanh(),
            torch.nn.Linear(hidden, hidden),
            torch.nn.Tanh(),
            torch.nn.Linear(hidden, n_y),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Rows of the newest sample."""
        return self.layers(x[:, -1])


@dataclass(frozen=True, kw_only=True, eq=False)
class ResidualNetwork:
    """A trained network on `physics`. `middle`, `scale` (n_z,) and `size` (6,) standardise; `error`
    is that of the free run on the held-back flights; `report` says how it was trained."""

    physics: PhysicsAlone
    network: torch.nn.Module
    window: int
    middle: FloatArray
    scale: FloatArray
    size: FloatArray
    error: float
    report: NetworkReport

    @property
    def parameters(self) -> int:
        """Number of weights."""
        return sum(p.numel() for p in self.network.parameters())

    def added(self, windows: FloatArray) -> FloatArray:
        """What g adds to body velocity and rates per second (m, 6)."""
        with torch.no_grad():
            told = self.network(_single((windows - self.middle) / self.scale)).numpy()
        return np.asarray(told * self.size, dtype=np.float64)

    def rolled(self, run: Run, origins: IntArray, steps: int) -> dict[str, FloatArray]:
        """As `PhysicsAlone.rolled`, with the network."""
        return self.physics.rolled(run, origins, steps, self.added, self.window)


@dataclass(frozen=True, kw_only=True, eq=False)
class Known:
    """One segment that the filter went through, and references (n, dimension) by group (they may be
    smoothed)."""

    run: Run
    references: dict[str, FloatArray]

    def origins(self, first: int, steps: int, every: int) -> IntArray:
        """Samples from `first` on with velocity and rate at every sample up to `steps` ahead."""
        there = np.all([np.isfinite(self.references[g]).all(axis=1) for g in TAUGHT], axis=0)
        there &= self.run.known
        total = np.concatenate([[0], np.cumsum(there)])
        k = np.arange(first, len(there) - steps - 1, every)
        return np.asarray(k[total[k + steps + 1] - total[k] == steps + 1])


def known(base: BasePredictor, data: Dataset) -> list[Known]:
    """Filter the segments of training flights. Raises `NotMeasured` without velocity or rates."""
    found = []
    for segment in data.segments:
        references = {
            g: segment.matrix(d.columns, missing_ok=True) for g, d in GROUPS.items() if not d.own
        }
        references = {g: r for g, r in references.items() if np.isfinite(r).any()}
        if lacking := [g for g in TAUGHT if g not in references]:
            raise NotMeasured(
                "a network on physics learns from velocity and rates",
                needs=lacking,
                where=f"flight {segment.flight}",
                fix="leave this method out",
            )
        run = base.run(segment.without(data.noncausal))
        found.append(Known(run=run, references=references))
    return found


def train_residual(
    physics: PhysicsAlone,
    train: Sequence[Known],
    validation: Sequence[Known],
    *,
    settings: ResidualSettings,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> ResidualNetwork:
    """A network trained on `train`, stopped by `validation`. Deterministic for one seed on one
    machine. Raises `DataError` where a part has no stretch that is long enough."""
    s = settings
    x, t = _lessons(physics, train, s)
    xv, tv = _lessons(physics, validation, s)
    flat = x.reshape(-1, x.shape[-1])
    middle, scale, size = flat.mean(axis=0), spread_of(flat), spread_of(t)
    n_z, n_y = x.shape[-1], t.shape[1]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network: torch.nn.Module = (
                Perceptron(n_z, s.hidden, n_y)
                if s.window == 1
                else Network(n_z, LSTMSettings(hidden=s.hidden), n_y)
            )
            began = time.perf_counter()
            best, report = descend(
                network,
                _single((x - middle) / scale),
                _single(t / size),
                _single((xv - middle) / scale),
                _single(tv / size),
                torch.ones(1),
                s,
                progress,
            )
        network.load_state_dict({k: _single(v) for k, v in best.items()})
        found = ResidualNetwork(
            physics=physics,
            network=network.eval(),
            window=s.window,
            middle=middle,
            scale=scale,
            size=size,
            error=np.inf,
            report={**report, "seconds": time.perf_counter() - began},
        )
        error = free_run_error(found, validation)
    finally:
        torch.set_num_threads(threads)
    return replace(found, error=error)


def free_run_errors(
    model: ResidualNetwork, flights: Sequence[Known], steps: int
) -> dict[str, FloatArray]:
    """Group -> error vectors (m, steps, dimension) of the free run. Raises `DataError`."""
    found: dict[str, list[FloatArray]] = {}
    for flight in flights:
        k = flight.origins(model.window, steps, JUDGED_EVERY)
        if not len(k):
            continue
        told = model.rolled(flight.run, k, steps)
        at = k[:, None] + 1 + np.arange(steps)
        for g in set(told) & set(flight.references):
            found.setdefault(g, []).append(error_vectors(g, told[g], flight.references[g][at]))
    if not found:
        raise DataError("no stretch is long enough to judge the network", fix="longer flights")
    return {g: np.concatenate(e) for g, e in found.items()}


def free_run_error(model: ResidualNetwork, flights: Sequence[Known]) -> float:
    """Mean squared error of velocity and rates over `JUDGED_STEPS`, in units of their variance."""
    errors = free_run_errors(model, flights, JUDGED_STEPS)
    scale = {g: np.nanvar(np.concatenate([f.references[g] for f in flights])) for g in TAUGHT}
    error = float(np.mean([np.mean(errors[g] ** 2) / scale[g] for g in TAUGHT]))
    return error if np.isfinite(error) else float("inf")


def spread(errors: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Group -> second moments (steps, dimension, dimension) of error vectors (m, steps,
    dimension)."""
    return {
        g: np.nanmean(e[..., :, None] * e[..., None, :], axis=0) + 1e-12 * np.eye(e.shape[-1])
        for g, e in errors.items()
    }


def _lessons(
    physics: PhysicsAlone, flights: Sequence[Known], s: ResidualSettings
) -> tuple[FloatArray, FloatArray]:
    """Windows (N, window, n_z), and what physics alone misses of body velocity and rates after
    `ahead` steps, per second (N, 6)."""
    x, t = [], []
    for flight in flights:
        k = flight.origins(s.window, s.ahead + 1, LEARNED_EVERY if s.ahead > 1 else 1)
        if not len(k):
            continue
        told = physics.rolled(flight.run, k, s.ahead + 1)
        at = k + 1 + s.ahead
        missed = [error_vectors(g, told[g][:, s.ahead], flight.references[g][at]) for g in TAUGHT]
        q = flight.run.states[k + 1][:, physics.attitude]
        missed[0] = numeric("rotate_inverse", q, missed[0])
        x.append(physics.windows(flight.run, k, s.window))
        t.append(np.concatenate(missed, axis=1) / (s.ahead * physics.base.dt))
    if not x:
        raise DataError(
            "no stretch is long enough for a network on physics",
            expected=f"{s.window + s.ahead + 2} samples in a row",
            fix="longer flights",
        )
    return np.concatenate(x), np.concatenate(t)


def _single(values: FloatArray) -> torch.Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float32))
