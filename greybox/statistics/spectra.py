"""Spectra of several signals with windows that follow the frequency, and the response between
them with its error.

Welch's method (P. D. Welch, IEEE Trans. Audio Electroacoust. 15(2), 1967) at any frequencies: Hann
windows that overlap by half, a straight line taken out of each, averaged over all stretches of all
flights. Low frequencies need long windows, high ones have more averages with short ones ("composite
windows": Tischler and Remple, Aircraft and Rotorcraft System Identification, 2nd ed., 2012, chapter
10). Here the window holds `CYCLES` periods where it can: window lengths are octaves, and the
spectra of the two nearest are mixed, so that the matrix stays positive and coherences stay within
0..1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.statistics.distributions import fisher_quantile, student_quantile
from greybox.symbolic import FloatArray

ComplexArray = npt.NDArray[np.complex128]

CYCLES = 8.0
"""Periods of a frequency in its window: about four independent estimates per octave."""
FEWEST_CYCLES = 3.0
"""Periods of the lowest frequency in the longest window: the straight line that is taken out of
each window must not look like it."""
SHORTEST = 2.0
"""Shortest window [s]: input and late output must stand under the same part of it. With 1 s and a
delay of 60 ms the circles at high frequencies hold the truth in 75 % instead of 95 %."""
BANDWIDTH = 1.5
"""Equivalent noise bandwidth of the Hann window, in frequencies of one period per window."""
NEIGHBOURS = 1 / 6
"""Correlation of Hann windows that overlap by half."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Spectra:
    """`matrix` (K, c, c): one-sided cross spectra S_ab = E[a b*] of c signals at `frequency` (K,)
    [Hz]; `averages` (K,): independent averages in each; `window` (K,) [s]."""

    frequency: FloatArray
    matrix: ComplexArray
    averages: FloatArray
    window: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """Responses (K, p, q) of p outputs to q inputs and, of each, `error` (standard deviation of its
    real and of its imaginary part), `coherence` (partial: of output and input, what the other
    inputs explain taken out); `dof` (K,) degrees of freedom of the errors; `shared` (K, q)
    coherence of an input with all others; `instrument` (K, q): F statistic of what the references
    explain of an input, infinite without references."""

    value: ComplexArray
    error: FloatArray
    coherence: FloatArray
    dof: FloatArray
    shared: FloatArray
    instrument: FloatArray


def averages_in(lengths: Sequence[int], window: int) -> float:
    """Independent averages that stretches of `lengths` samples give with windows of `window`
    samples that overlap by half (Welch 1967)."""
    total = 0.0
    for n in lengths:
        pieces = (n - window) // (window // 2) + 1 if n >= window else 0
        if pieces:
            total += pieces / (1 + 2 * (1 - 1 / pieces) * NEIGHBOURS**2)
    return total


def frequencies(low: float, high: float, longest: float) -> FloatArray:
    """Frequencies [Hz] from `low` to `high` that are a window's bandwidth apart, so that the
    estimates are nearly independent; at high ones a twelfth of their value."""
    out = [low]
    while True:
        f = out[-1]
        step = max(BANDWIDTH / float(_window_for(np.array(f), longest)), f / 12)
        if f + step > high:
            return np.array(out)
        out.append(f + step)


def spectra(
    stretches: Sequence[FloatArray], dt: float, frequency: FloatArray, longest: float
) -> Spectra:
    """Cross spectra of the columns of `stretches` (N_i, c), which have no gaps, at `frequency`
    (K,); `longest` [s] is the longest window."""
    wanted = _window_for(frequency, longest)
    octave = np.log2(longest / wanted)
    c = stretches[0].shape[1]
    matrix = np.zeros((frequency.size, c, c), dtype=np.complex128)
    averages = np.zeros(frequency.size)
    for step in range(int(np.ceil(octave.max() - 1e-9)) + 1):
        weight = np.maximum(1 - np.abs(octave - step), 0.0)
        chosen = weight > 1e-9
        n = max(2 * round(longest * 0.5**step / dt / 2), 4)
        part, count = _welch([s for s in stretches if len(s) >= n], dt, frequency[chosen], n)
        matrix[chosen] += weight[chosen, None, None] * part
        averages[chosen] += weight[chosen] * count
    return Spectra(frequency=frequency, matrix=matrix, averages=averages, window=wanted)


def response(
    s: Spectra, outputs: Sequence[int], inputs: Sequence[int], references: Sequence[int] = ()
) -> Response:
    """Response of `outputs` to `inputs` (columns of the spectra), all inputs at once.

    Without `references` it is least squares, S_yu / S_uu. With them only what they explain of the
    inputs counts (the joint input-output estimate, S_yr / S_ur, of a loop that is closed: Pintelon
    and Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., 2012, section 2.5);
    more references than inputs are weighed as two-stage least squares does. Errors are those of
    averaged spectra of Gaussian noise (Bendat and Piersol, Random Data, 4th ed., 2010, section
    9.2).
    """
    y, u, z = list(outputs), list(inputs), list(references or inputs)
    q = len(u)
    size = np.sqrt(np.maximum(np.einsum("kii->ki", s.matrix).real.mean(axis=0), 1e-300))
    m = s.matrix / (size[:, None] * size)
    blocks = {
        (a, b): m[:, i][:, :, j] for a, i in zip("yuz", (y, u, z)) for b, j in zip("yuz", (y, u, z))
    }
    project = _hermitian(blocks["u", "z"] @ _inverse(blocks["z", "z"]))  # (K, z, u)
    if references:
        explained = blocks["u", "z"] @ project
        cross = blocks["y", "z"] @ project
    else:
        explained, cross = blocks["u", "u"], blocks["y", "u"]
    inverse = _inverse(explained)
    h = cross @ inverse
    left = np.einsum(
        "kii->ki",
        blocks["y", "y"]
        - h @ blocks["u", "y"]
        - blocks["y", "u"] @ _hermitian(h)
        + h @ blocks["u", "u"] @ _hermitian(h),
    ).real
    left = np.maximum(left, 1e-12)
    alone = np.maximum(np.einsum("kii->ki", inverse).real, 1e-300)
    own = np.einsum("kii->ki", explained).real
    dof = np.maximum(s.averages - len(z), 1e-9)
    signal = np.abs(h) ** 2 / alone[:, None, :]
    variance = left[:, :, None] / dof[:, None, None] * alone[:, None, :]
    gamma = np.clip(own / np.maximum(np.einsum("kii->ki", blocks["u", "u"]).real, 1e-300), 0, 1)
    strength = gamma * dof[:, None] / (len(z) * np.maximum(1 - gamma, 1e-12))
    scale = size[y][:, None] / size[u]
    return Response(
        value=h * scale,
        error=np.sqrt(variance / 2) * scale,
        coherence=signal / (signal + left[:, :, None]),
        dof=dof,
        shared=np.clip(1 - 1 / np.maximum(own * alone, 1.0), 0, 1) if q > 1 else 0 * own,
        instrument=strength if references else np.full_like(own, np.inf),
    )


def band(r: Response, level: float = 0.95) -> FloatArray:
    """Half width (K, p, q) of the interval of the magnitude at `level`, from Student's t; that of
    the phase is arcsin(half width / magnitude)."""
    t = student_quantile(0.5 + level / 2, 2 * r.dof)
    return np.asarray(t[:, None, None] * r.error)


def circle(r: Response, level: float = 0.95) -> FloatArray:
    """Radius (K, p, q) of the circle that holds the complex response at `level`, from F."""
    radius = np.sqrt(2 * fisher_quantile(level, 2, 2 * r.dof))
    return np.asarray(radius[:, None, None] * r.error)


def by_chance(averages: FloatArray, others: int, level: float = 0.95) -> FloatArray:
    """Coherence (K,) that two independent signals stay below at `level`; `others` inputs
    besides."""
    left = np.maximum(averages - 1 - others, 1e-9)
    return np.asarray(1 - (1 - level) ** (1 / left))


def _window_for(frequency: FloatArray, longest: float) -> FloatArray:
    return np.clip(CYCLES / frequency, min(SHORTEST, longest), longest)


def _welch(
    stretches: Sequence[FloatArray], dt: float, frequency: FloatArray, n: int
) -> tuple[ComplexArray, float]:
    """Spectra (K, c, c) with windows of `n` samples, and how many independent averages."""
    taper = np.hanning(n + 1)[:n]
    turn = np.exp(-2j * np.pi * np.outer(frequency, np.arange(n) * dt)) * taper
    line = np.linalg.qr(np.stack([np.ones(n), np.linspace(-1.0, 1.0, n)], axis=1))[0]
    turn = turn - (turn @ line) @ line.T  # a straight line in a window counts as nothing
    total, pieces = np.zeros((), dtype=np.complex128), 0
    for s in stretches:
        for start in range(0, len(s) - n + 1, n // 2):
            x = turn @ s[start : start + n]
            total = total + x[:, :, None] * x[:, None, :].conj()
            pieces += 1
    scale = 2 * dt / (np.sum(taper**2) * max(pieces, 1))
    return np.asarray(total * scale), averages_in([len(s) for s in stretches], n)


def _hermitian(m: ComplexArray) -> ComplexArray:
    return np.asarray(m.conj().transpose(0, 2, 1))


def _inverse(m: ComplexArray) -> ComplexArray:
    """Of positive matrices (K, n, n) of any scale; what nothing excites gets a huge one."""
    d = np.sqrt(np.maximum(np.einsum("kii->ki", m).real, 1e-300))
    unit = m / (d[:, :, None] * d[:, None, :]) + 1e-10 * np.eye(m.shape[1])
    return np.asarray(np.linalg.inv(unit) / (d[:, :, None] * d[:, None, :]))
