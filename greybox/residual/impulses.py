"""How a push at one sample moves what comes later, and what features make of it.

Along a path S+ = A S + G s psi(z) the sensitivity to the weights at its end is a sum over the
samples of the push: (products of the A that follow) G, times the features there. The responses to a
unit push know nothing of the features, so that all candidates share them, and no candidate carries
a matrix of all its weights from sample to sample. Outputs of a push have weights of their own: the
response to each meets its own features only.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greybox.symbolic import FloatArray


def impulses(
    seen: FloatArray, transition: FloatArray, entry: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Responses (m, r, n_out, L) of what is seen at the end of each path to a unit push at every
    one of its L samples, and (m, r, n_d) to its start.

    seen (m, r, n_d) of the state at the end; transition (m, L, n_d, n_d) and entry (m, L, n_d,
    n_out) of every sample.
    """
    m, length, _, n_out = entry.shape
    out = np.empty((m, seen.shape[1], n_out, length))
    for s in range(length - 1, -1, -1):
        out[..., s] = seen @ entry[:, s]
        seen = seen @ transition[:, s]
    return out, seen


def pushed(responses: FloatArray, features: Sequence[FloatArray], out: FloatArray) -> None:
    """Put into `out` (m, r, n_out M) what `responses` (m, r, n_out, L) make of the first L samples
    of the features (m, L or more, M) of every output."""
    m, r, n_out, length = responses.shape
    first = features[0]
    if all(psi is first for psi in features):  # one product for all outputs
        np.matmul(
            responses.reshape(m, r * n_out, length),
            first[:, :length],
            out=out.reshape(m, r * n_out, -1),
        )
        return
    size = first.shape[2]
    for j, psi in enumerate(features):
        np.matmul(responses[:, :, j], psi[:, :length], out=out[:, :, j * size : (j + 1) * size])
