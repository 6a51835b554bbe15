"""A temporal convolution over earlier commands with a Bayesian last layer: a learner that
remembers.

A push may come late: a wake that trails, a motor that yields, air that still moves. Causal dilated
convolutions of width two look at the commands of this sample and of `MEMORY` before it (Bai, Kolter
and Koltun 2018, arXiv:1803.01271), layer by layer and with what they started from added:

    h_1[t] = tanh(V_1 u[t] + W_1 u[t-1] + b_1),   h_l[t] = h_{l-1}[t] + tanh(V_l h_{l-1}[t] + W_l h_{l-1}[t-2^(l-1)] + b_l)

Only what reaches the last h[t] is computed, pair by pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from greybox.residual.learners.sequence import CHANNELS, SequenceLearner, SequenceNetwork, Tanh
from greybox.symbolic import FloatArray, Numeric

Layers = list[list[Numeric]]
"""The sequence before and after every convolution, newest first."""


@dataclass(frozen=True, kw_only=True)
class Convolution(SequenceNetwork[Layers]):
    """The memory is the last h[t] of the convolutions."""

    def memory_shapes(self) -> list[tuple[int, int]]:
        """V, W, b of every convolution."""
        out: list[tuple[int, int]] = []
        for k in range((len(self.taps) - 1).bit_length() if self.taps else 0):
            width = CHANNELS if k else len(self.taps[0])
            out += [(CHANNELS, width), (CHANNELS, width), (CHANNELS, 1)]
        return out

    def remembered(
        self, taps: Sequence[Numeric], w: Sequence[Numeric], tanh: Tanh
    ) -> tuple[Numeric, Layers]:
        """Keeps the sequence before and after every convolution, newest first."""
        layers = [list(taps)]
        while len(layers[-1]) > 1:
            k, h = len(layers) - 1, layers[-1]
            layers.append(
                [
                    tanh(w[3 * k] @ h[j] + w[3 * k + 1] @ h[min(j + 1, len(h) - 1)] + w[3 * k + 2])
                    + (h[j] if k else 0.0)
                    for j in range(0, len(h), 2)
                ]
            )
        return layers[-1][0], layers

    def back(
        self, kept: Layers, into: FloatArray, w: Sequence[FloatArray], g: Sequence[FloatArray]
    ) -> None:
        """From the last convolution to the first."""
        slopes = [into]
        for k in range(len(kept) - 2, -1, -1):
            h, after = kept[k], [np.zeros_like(a) for a in kept[k]]
            for j, (ahead, b) in enumerate(zip(kept[k + 1], slopes, strict=True)):
                early = min(2 * j + 1, len(h) - 1)
                bent = b * (1 - (ahead - h[2 * j] if k else ahead) ** 2)
                g[3 * k][:] += bent @ h[2 * j].T
                g[3 * k + 1][:] += bent @ h[early].T
                g[3 * k + 2][:] += bent.sum(axis=1, keepdims=True)
                after[2 * j] += w[3 * k].T @ bent + (b if k else 0.0)
                after[early] += w[3 * k + 1].T @ bent
            slopes = after


class TemporalConvolution(SequenceLearner):
    """`greybox learn --learner tcn`."""

    name: ClassVar[str] = "tcn"
    label: ClassVar[str] = "convolution"
    network: ClassVar[type[SequenceNetwork]] = Convolution
