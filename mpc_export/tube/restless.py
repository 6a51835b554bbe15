"""Restless: by how much more than stated forces and torques walk, from the filter's own steps.

The settled filter moves a force or torque by s = K_d e a sample, e its innovation. As long as all
is as stated those steps are white. They are larger, but still white, where a sensor is noisier; a
force that has not been learned pushes them one way. Products of different samples tell the two
apart (Mehra 1970, IEEE Trans. Automatic Control 15(2), from correlations of innovations). With
steps in their standard deviations, forgotten by k = exp(-dt / MEMORY) a sample,

    m+ = k m + s,    v+ = k^2 v + s^2,    more = (1 - k^2) max(0, m^2 - v)

m^2 - v is twice the sum of those products: 0 in the mean for white noise of any size. The walk has
1 + more times its variance: it fades what is known as a strong tracking filter does (Zhou and Frank
1996, Int. J. Control 65(2)).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from greybox.symbolic import FloatArray
from mpc_export.functions import ModelFunctions

MEMORY = 0.1
"""Seconds over which steps are added up."""


class Restless:
    """Of the pushes in rows `at` (n_p,) of the error state of the filter of `functions`.

    Sums are (2, n_p): of steps, and of their squares.
    """

    def __init__(self, functions: ModelFunctions, at: Sequence[int]) -> None:
        noise = functions.noise
        gain = noise.gain[list(at)]
        stated = np.sqrt(np.einsum("ij,jk,ik->i", gain, noise.innovation, gain))
        self._steps = gain / np.where(stated > 0.0, stated, np.inf)[:, None]
        self._keep = math.exp(-functions.dt / MEMORY)

    def start(self) -> FloatArray:
        """Sums before the first step."""
        return np.zeros((2, len(self._steps)))

    def sees(self, sums: FloatArray, innovation: FloatArray) -> FloatArray:
        """Sums one sample later; innovation (n_e,), zero where nothing is believed."""
        step = self._steps @ innovation
        return np.stack([self._keep * sums[0] + step, self._keep**2 * sums[1] + step**2])

    def more(self, sums: FloatArray) -> FloatArray:
        """(n_p,): by how much the variance of the walk is larger than stated, as a multiple."""
        return np.asarray((1.0 - self._keep**2) * np.maximum(sums[0] ** 2 - sums[1], 0.0))
