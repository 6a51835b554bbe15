"""A temporal convolution over earlier commands with a Bayesian last layer: a learner that
remembers.

A push may come late: a wake that trails, a motor that yields, air that still moves. Causal dilated
convolutions of width two look at the commands of this sample and of `MEMORY` before it (Bai, Kolter
and Koltun 2018, arXiv:1803.01271), layer by layer and with what they started from added:

    h_1[t] = tanh(V_1 u[t] + W_1 u[t-1] + b_1),   h_l[t] = h_{l-1}[t] + tanh(V_l h_{l-1}[t] + W_l h_{l-1}[t-2^(l-1)] + b_l)

A hidden layer joins the last h[t] with the other inputs; its units, and the inputs of this sample,
are the features. Only what reaches the present is computed, pair by pair, so that the network is a
static function of the lags, and in an export the earlier commands are its state. Trained as
`greybox.residual.learners.neural`; with no input that looks back it is one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import scipy.optimize

from greybox.residual.features import lag_of
from greybox.residual.learners.learner import Features
from greybox.residual.learners.neural import DECAY, ITERATIONS, ROWS, STARTS
from greybox.symbolic import Expr, FloatArray

MEMORY, MOST_LAGS = 0.14, 31
"""How far back [s] commands are looked at on physics: after it a lag of 70 ms has settled to a
seventh, and a wake of 4 m/s is half a metre away. Most earlier samples: with this one 32, five
convolutions; each is a state per input in an export."""
CHANNELS, MOST_UNITS = 8, 16
"""Channels of every convolution, most units of the hidden layer."""


@dataclass(frozen=True)
class TemporalConvolution:
    """Inputs of the same name and successive lags are one sequence; all others are of this
    sample."""

    names: tuple[str, ...] = ()

    name: ClassVar[str] = "tcn"

    def lags(self, sample_time: float) -> int:
        """The samples in `MEMORY`, at least one and at most `MOST_LAGS`."""
        return min(max(round(MEMORY / sample_time), 1), MOST_LAGS)

    def of(self, names: Sequence[str]) -> TemporalConvolution:
        """The same for inputs of these names."""
        return TemporalConvolution(tuple(names))

    def features(
        self, x: FloatArray, y: FloatArray, *, points: int, seed: int
    ) -> Mapping[str, Features]:
        """One candidate per start."""
        rows = np.random.default_rng(seed).permutation(len(x))[:ROWS]
        net = Network.of(
            self.names or [f"x{i}" for i in range(x.shape[1])], min(points, MOST_UNITS), y.shape[1]
        )
        return {
            f"convolution, start {k + 1}": net.features(
                net.trained(x[rows], y[rows], seed=seed + k)
            )
            for k in range(STARTS)
        }


@dataclass(frozen=True, kw_only=True)
class Network:
    """`taps`: per lag, newest first, the places of every sequence's sample among the inputs; `now`:
    those of the rest and of the newest samples."""

    taps: tuple[tuple[int, ...], ...]
    now: tuple[int, ...]
    units: int
    outputs: int

    @classmethod
    def of(cls, names: Sequence[str], units: int, outputs: int) -> Network:
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

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """V, W, b of every convolution, then weights and offset of the hidden layer, then the last
        layer."""
        convolutions = (len(self.taps) - 1).bit_length() if self.taps else 0
        out: list[tuple[int, int]] = []
        for k in range(convolutions):
            width = CHANNELS if k else len(self.taps[0])
            out += [(CHANNELS, width), (CHANNELS, width), (CHANNELS, 1)]
        joined = len(self.now) + (CHANNELS if convolutions else 0)
        return [*out, (self.units, joined), (self.units, 1), (self.outputs, self.units)]

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
        layers = self.convolved([x[list(t)] for t in self.taps], w, np.tanh)
        joined = np.concatenate([*(h[0] for h in layers[-1:]), x[list(self.now)]])
        hidden = np.tanh(w[-3] @ joined + w[-2])
        error = w[-1] @ hidden - y
        g[-1][:] = error @ hidden.T
        back = (w[-1].T @ error) * (1 - hidden**2)
        g[-3][:], g[-2][:] = back @ joined.T, back.sum(axis=1, keepdims=True)
        into = [(w[-3].T @ back)[:CHANNELS]] if layers else []
        for k in range(len(layers) - 2, -1, -1):
            h, after = layers[k], [np.zeros_like(a) for a in layers[k]]
            for j, (ahead, b) in enumerate(zip(layers[k + 1], into, strict=True)):
                early = min(2 * j + 1, len(h) - 1)
                bent = b * (1 - (ahead - h[2 * j] if k else ahead) ** 2)
                g[3 * k][:] += bent @ h[2 * j].T
                g[3 * k + 1][:] += bent @ h[early].T
                g[3 * k + 2][:] += bent.sum(axis=1, keepdims=True)
                after[2 * j] += w[3 * k].T @ bent + (b if k else 0.0)
                after[early] += w[3 * k + 1].T @ bent
            into = after
        return float(np.sum(error**2) / n + DECAY * v @ v), 2 * slope / n + 2 * DECAY * v

    def convolved(self, taps: Sequence[Any], w: Sequence[Any], tanh: Any) -> list[list[Any]]:
        """The sequence before and after every convolution, newest first, of NumPy columns or of
        expressions alike."""
        layers = [list(taps)] if taps else []
        while layers and len(layers[-1]) > 1:
            k, h = len(layers) - 1, layers[-1]
            layers.append(
                [
                    tanh(w[3 * k] @ h[j] + w[3 * k + 1] @ h[min(j + 1, len(h) - 1)] + w[3 * k + 2])
                    + (h[j] if k else 0.0)
                    for j in range(0, len(h), 2)
                ]
            )
        return layers

    def features(self, v: FloatArray) -> Features:
        """Units of the hidden layer and inputs of this sample, for weights v."""
        w = [ca.DM(m) for m in self.views(v)]

        def phi(s: Expr) -> Expr:
            last = self.convolved([s[list(t)] for t in self.taps], w, ca.tanh)[-1:]
            joined = ca.vertcat(*(h[0] for h in last), s[list(self.now)])
            hidden = ca.tanh(w[-3] @ joined + w[-2])
            return ca.vertcat(
                hidden / np.sqrt(self.units), s[list(self.now)] / np.sqrt(len(self.now))
            )

        return phi
