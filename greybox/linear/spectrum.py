"""Spectral error: how much of a channel's power the innovations still carry, by frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import trapezoid
from scipy.signal import welch

from greybox.errors import DataError
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True)
class SpectralError:
    """`share` (p,) = integral of S_ee over integral of S_yy between `low` and `high` Hz; the
    spectra (k, p) at `frequency` [Hz].
    """

    share: FloatArray
    low: float
    high: float
    frequency: FloatArray
    error_spectrum: FloatArray
    output_spectrum: FloatArray


def spectral_error(
    innovations: Sequence[FloatArray],
    outputs: Sequence[FloatArray],
    dt: float,
    *,
    low: float = 0.1,
    high: float = 20.0,
) -> SpectralError:
    """Welch spectra (Hann windows of 4 s, or the longest that gives three, half overlapping) pooled
    over records.

    Arrays (N_i, p) of equal shape; missing samples count as the channel's mean. `high` is cut at
    the Nyquist frequency. Raises `DataError` where the records are too short to resolve the band.
    """
    high = min(high, 0.5 / dt)
    longest = max(len(e) for e in innovations)
    segment = min(round(4.0 / dt), longest // 2)
    if segment < 16 or high <= low:
        raise DataError(
            f"{longest} samples of {dt:g} s cannot resolve {low:g} .. {high:g} Hz",
            fix="pass a longer record",
        )
    p = innovations[0].shape[1]
    total_e = total_y = np.zeros((segment // 2 + 1, p))
    weight, frequency = 0.0, np.zeros(0)
    for e, y in zip(innovations, outputs):
        if len(e) < segment:
            continue
        frequency, see = welch(_filled(e), 1 / dt, nperseg=segment, axis=0)
        _, syy = welch(_filled(y), 1 / dt, nperseg=segment, axis=0)
        total_e, total_y = total_e + len(e) * see, total_y + len(e) * syy
        weight += len(e)
    see, syy = total_e / weight, total_y / weight
    band = (frequency >= low) & (frequency <= high)
    if band.sum() < 2:
        raise DataError(
            f"records are too short to resolve {low:g} .. {high:g} Hz", fix="pass a longer record"
        )
    share = trapezoid(see[band], frequency[band], axis=0) / trapezoid(
        syy[band], frequency[band], axis=0
    )
    return SpectralError(
        share=share,
        low=float(low),
        high=float(high),
        frequency=frequency,
        error_spectrum=see,
        output_spectrum=syy,
    )


def _filled(values: FloatArray) -> FloatArray:
    centred = values - np.nanmean(values, axis=0)
    return np.where(np.isfinite(centred), centred, 0.0)
