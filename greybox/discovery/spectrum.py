"""Spectrum: in which frequency band, and in which channel, the one-step errors hold more than white noise.

The innovations of a model without error are white (Ljung, System Identification, 2nd ed., section 16.6): their spectral
density is flat. Densities are Welch's (IEEE Trans. Audio Electroacoustics 15(2), 1967), averaged over flights and over
bands of equal width on a logarithmic axis, relative to the mean density of the last model's innovations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.signal

from greybox.estimation.fit import Fit
from greybox.symbolic import FloatArray

BANDS = 12
WINDOW_SECONDS = 4.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Spectrum:
    """`before` and `after` (n_e, B): density of the innovations of `channels` (n_e) in bands around `frequency` (B) [Hz],
    1 = the mean density of that channel after the last addition; NaN where a channel has no measurement."""

    channels: tuple[str, ...]
    frequency: FloatArray
    before: FloatArray
    after: FloatArray

    def to_dict(self) -> dict[str, Any]:
        """As in discovery.json."""
        return {
            "frequency_hz": self.frequency.tolist(),
            "channels": [
                {"name": n, "before": b.tolist(), "after": a.tolist()}
                for n, b, a in zip(self.channels, self.before, self.after, strict=True)
            ],
        }


def spectrum(before: Fit, after: Fit) -> Spectrum:
    """Innovation spectra of two fits on the same flights."""
    dt = after.model.sample_time
    longest = max((len(e) for es in after.innovations.values() for e in es), default=0)
    window = int(min(max(round(WINDOW_SECONDS / dt), 8), max(longest, 8)))
    frequency = np.fft.rfftfreq(window, dt)[1:]
    edges = np.geomspace(frequency[0] * 0.999, frequency[-1] * 1.001, BANDS + 1)
    band = np.digitize(frequency, edges) - 1
    used = np.unique(band)
    old, new = (_densities(f, window, dt)[:, 1:] for f in (before, after))
    with np.errstate(invalid="ignore", divide="ignore"):
        level = new.mean(axis=1, keepdims=True)
        rows = [np.stack([(d / level)[:, band == b].mean(axis=1) for b in used], axis=1) for d in (old, new)]
    centre = np.array([np.exp(np.log(frequency[band == b]).mean()) for b in used])
    return Spectrum(
        channels=tuple(after.model.dynamics.innovations.names), frequency=centre, before=rows[0], after=rows[1]
    )


def _densities(fit: Fit, window: int, dt: float) -> FloatArray:
    """(n_e, F) densities, weighted by the length of the records; missing samples count as no error."""
    total: Any = 0.0
    weight = 0
    for records in fit.innovations.values():
        for e in records:
            if len(e) < window:
                continue
            clean = np.where(np.isfinite(e), e, 0.0)
            clean[:, ~np.isfinite(e).any(axis=0)] = np.nan
            _, density = scipy.signal.welch(clean, 1 / dt, nperseg=window, detrend=False, axis=0)
            total = total + len(e) * density.T
            weight += len(e)
    return np.asarray(total / max(weight, 1), dtype=np.float64)
