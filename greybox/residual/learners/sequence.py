"""What learners that remember share: inputs of the same name and successive lags are one sequence, a
memory sums it up, and a hidden layer joins that with the inputs of this sample.

The units of the hidden layer, and the inputs of this sample, are the features; the last layer is
Bayesian, as in `greybox.residual.learners.neural`. The network is a static function of the lags,
and in an export the earlier commands are its state. With no input that looks back it is `neural`
with one hidden layer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Generic, Self, TypeVar

import casadi as ca
import numpy as np
import scipy.optimize

from greybox.residual.features import lag_of
from greybox.residual.learners.learner import Features
from greybox.residual.learners.neural import DECAY, ITERATIONS, ROWS, STARTS
from greybox.symbolic import Expr, FloatArray, Numeric

MEMORY, MOST_LAGS = 0.14, 31
"""How far back [s] commands are looked at on physics: after it a lag of 70 ms has settled to a
seventh, and a wake of 4 m/s is half a metre away. Most earlier samples: with this one 32; each is a
state per input in an export."""
CHANNELS, MOST_UNITS = 8, 16
"""Channels of the memory, most units of the hidden layer."""
Tanh = Callable[[Numeric], Numeric]

Kept = TypeVar("Kept")
"""What a memory keeps of its way forward for the way back."""


@dataclass(frozen=True, kw_only=True)
class SequenceNetwork(Generic[Kept]):
    """`taps`: per lag, newest first, the places of every sequence's sample among the inputs; `now`:
    those of the rest and of the newest samples. A memory says its `memory_shapes`, what it has
    `remembered`, and the slopes of that (`back`)."""

    taps: tuple[tuple[int, ...], ...]
    now: tuple[int, ...]
    units: int
    outputs: int

    @classmethod
    def of(cls, names: Sequence[str], units: int, outputs: int) -> Self:
        """The network of inputs of these names; a shorter sequence goes on with its oldest
        sample."""
        places: dict[str, dict[int, int]] = {}
        for i, name in enumerate(names):
            channel, lag = lag_of(name)
            places.setdefault(channel, {})[lag] = i
        runs: list[list[int]] = []
        for found in places.values():
            lag = min(found)
            run = [found[lag]]
            while (lag := lag + 1) in found:
                run.append(found[lag])
            if len(run) > 1:
                runs.append(run)
        longest = max((len(r) for r in runs), default=0)
        later = {i for r in runs for i in r[1:]}
        return cls(
            taps=tuple(tuple(r[min(k, len(r) - 1)] for r in runs) for k in range(longest)),
            now=tuple(i for i in range(len(names)) if i not in later),
            units=units,
            outputs=outputs,
        )

    def memory_shapes(self) -> list[tuple[int, int]]:
        """Of the memory's matrices; none without a sequence."""
        raise NotImplementedError

    def remembered(
        self, taps: Sequence[Numeric], w: Sequence[Numeric], tanh: Tanh
    ) -> tuple[Numeric, Kept]:
        """(summary (CHANNELS, N), what `back` needs) of `taps`, newest first, NumPy columns or
        expressions alike."""
        raise NotImplementedError

    def back(
        self, kept: Kept, into: FloatArray, w: Sequence[FloatArray], g: Sequence[FloatArray]
    ) -> None:
        """Adds the slopes of the memory's matrices to `g`, for that of its summary `into`
        (CHANNELS, N)."""
        raise NotImplementedError

    def begin(self, w: Sequence[FloatArray]) -> None:
        """Changes random weights to begin with, in place."""

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """Those of the memory, then weights and offset of the hidden layer, then the last layer."""
        memory = self.memory_shapes()
        joined = len(self.now) + (CHANNELS if memory else 0)
        return [*memory, (self.units, joined), (self.units, 1), (self.outputs, self.units)]

    def views(self, v: FloatArray) -> list[FloatArray]:
        """The matrices as views of one vector."""
        ends = np.cumsum([a * b for a, b in self.shapes])
        return [
            part.reshape(s) for part, s in zip(np.split(v, ends[:-1]), self.shapes, strict=True)
        ]

    def trained(self, x: FloatArray, y: FloatArray, *, seed: int) -> FloatArray:
        """Weights as one vector, from rows x (N, n_in), y (N, n_out), by L-BFGS with weight
        decay."""
        rng = np.random.default_rng(seed)
        start = np.concatenate(
            [rng.standard_normal(a * b) / np.sqrt(2 * b) for a, b in self.shapes]
        )
        self.begin(self.views(start))
        found = scipy.optimize.minimize(
            self.loss,
            start,
            args=(x.T, y.T),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": ITERATIONS},
        )
        return np.asarray(found.x)

    def loss(self, v: FloatArray, x: FloatArray, y: FloatArray) -> tuple[float, FloatArray]:
        """Mean squared error with decay on columns x (n_in, N), y (n_out, N), and its gradient by
        back-propagation."""
        w, slope = self.views(v), np.zeros_like(v)
        g, n = self.views(slope), x.shape[1]
        summary, kept = self._summary([x[list(t)] for t in self.taps], w, np.tanh)
        joined = np.concatenate([*summary, x[list(self.now)]])
        hidden = np.tanh(w[-3] @ joined + w[-2])
        error = w[-1] @ hidden - y
        g[-1][:] = error @ hidden.T
        back = (w[-1].T @ error) * (1 - hidden**2)
        g[-3][:], g[-2][:] = back @ joined.T, back.sum(axis=1, keepdims=True)
        if kept is not None:
            self.back(kept, (w[-3].T @ back)[:CHANNELS], w, g)
        return float(np.sum(error**2) / n + DECAY * v @ v), 2 * slope / n + 2 * DECAY * v

    def _summary(
        self, taps: Sequence[Numeric], w: Sequence[Numeric], tanh: Tanh
    ) -> tuple[list[Numeric], Kept | None]:
        if not self.memory_shapes():
            return [], None
        summary, kept = self.remembered(taps, w, tanh)
        return [summary], kept

    def features(self, v: FloatArray) -> Features:
        """Units of the hidden layer and inputs of this sample, for weights v."""
        w = [ca.DM(m) for m in self.views(v)]

        def phi(s: Expr) -> Expr:
            summary, _ = self._summary([s[list(t)] for t in self.taps], w, ca.tanh)
            joined = ca.vertcat(*summary, s[list(self.now)])
            hidden = ca.tanh(w[-3] @ joined + w[-2])
            return ca.vertcat(
                hidden / np.sqrt(self.units), s[list(self.now)] / np.sqrt(len(self.now))
            )

        return phi


@dataclass(frozen=True)
class SequenceLearner:
    """A learner that looks back through the commands; `network` is what it trains, `label` names
    its candidates."""

    names: tuple[str, ...] = ()

    name: ClassVar[str]
    label: ClassVar[str]
    network: ClassVar[type[SequenceNetwork]]

    def lags(self, sample_time: float) -> int:
        """The samples in `MEMORY`, at least one and at most `MOST_LAGS`."""
        return min(max(round(MEMORY / sample_time), 1), MOST_LAGS)

    def of(self, names: Sequence[str]) -> Self:
        """The same for inputs of these names."""
        return type(self)(tuple(names))

    def features(
        self, x: FloatArray, y: FloatArray, *, points: int, seed: int
    ) -> Mapping[str, Features]:
        """One candidate per start."""
        rows = np.random.default_rng(seed).permutation(len(x))[:ROWS]
        net = self.network.of(
            self.names or [f"x{i}" for i in range(x.shape[1])], min(points, MOST_UNITS), y.shape[1]
        )
        return {
            f"{self.label}, start {k + 1}": net.features(
                net.trained(x[rows], y[rows], seed=seed + k)
            )
            for k in range(STARTS)
        }
