"""What real sensors and loggers do to a clean log: colour, quantisation, delay, lost rows, jitter,
drift, vibration.

Each function takes a log (columns of shape (N,) or (N, B)) and returns a new one; none changes its
argument. They act on the record only: the flight itself was flown on what the plant measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

Log = dict[str, NDArray[np.float64]]
Columns = Mapping[str, NDArray[np.float64]]

GYRO = ("p", "q", "r")
ACCELEROMETER = ("ax", "ay", "az")
POSE = ("qw", "qx", "qy", "qz", "x", "y", "z", "vx", "vy", "vz")


def _copy(log: Columns) -> Log:
    return {name: values.copy() for name, values in log.items()}


def _sample_time(log: Columns) -> float:
    return float(np.median(np.diff(log["t"])))


def coloured_noise(
    log: Columns,
    columns: Iterable[str],
    sigma: float,
    correlation_time: float,
    rng: np.random.Generator,
) -> Log:
    """Add stationary first-order Gauss-Markov noise: standard deviation sigma, correlation_time
    [s]."""
    out = _copy(log)
    keep = float(np.exp(-_sample_time(log) / correlation_time))
    for name in columns:
        noise = sigma * rng.standard_normal(out[name].shape)
        noise[1:] *= np.sqrt(1.0 - keep**2)
        for k in range(1, len(noise)):
            noise[k] += keep * noise[k - 1]
        out[name] += noise
    return out


def drifting_bias(
    log: Columns, columns: Iterable[str], rate: float, rng: np.random.Generator
) -> Log:
    """Add a random walk that starts at zero; rate is its standard deviation after one second."""
    out = _copy(log)
    for name in columns:
        steps = rate * np.sqrt(_sample_time(log)) * rng.standard_normal(out[name].shape)
        steps[0] = 0.0
        out[name] += np.cumsum(steps, axis=0)
    return out


def quantised(log: Columns, columns: Iterable[str], step: float) -> Log:
    """Round to multiples of `step`."""
    out = _copy(log)
    for name in columns:
        out[name] = step * np.round(out[name] / step)
    return out


def delayed(log: Columns, columns: Iterable[str], delay: float) -> Log:
    """Channels seen `delay` [s] late, by linear interpolation of the record; before its start the
    first value holds."""
    out = _copy(log)
    time = log["t"]
    for name in columns:
        flat = out[name].reshape(len(time), -1)
        moved = [np.interp(time - delay, time, column) for column in flat.T]
        out[name] = np.stack(moved, axis=-1).reshape(out[name].shape)
    return out


def low_passed(log: Columns, columns: Iterable[str], cutoff: float) -> Log:
    """First-order low-pass at `cutoff` [Hz], exact for inputs that are linear over the sample; slow
    signals come 1/(2 pi cutoff) late."""
    out = _copy(log)
    x = 2.0 * np.pi * cutoff * _sample_time(log)
    keep = float(np.exp(-x))
    new, old = 1.0 - (1.0 - keep) / x, (1.0 - keep) / x - keep
    for name in columns:
        raw = log[name]
        values = out[name]
        for k in range(1, len(values)):
            values[k] = keep * values[k - 1] + new * raw[k] + old * raw[k - 1]
    return out


def vibration(
    log: Columns,
    columns: Iterable[str],
    amplitude: float,
    rng: np.random.Generator,
    speed: str = "omega1",
) -> Log:
    """Add a line at the frequency of a rotor-speed column [rad/s], folded by the sampling as it is
    in a real log."""
    out = _copy(log)
    angle = np.cumsum(log[speed] * _sample_time(log), axis=0)
    for name in columns:
        out[name] += amplitude * np.sin(angle + rng.uniform(0.0, 2.0 * np.pi))
    return out


def uneven(
    log: Columns, columns: Iterable[str], delay: float, jitter: float, rng: np.random.Generator
) -> Log:
    """Rows of a stream that show what was `delay` [s] and, drawn for every row, up to `jitter`
    samples earlier.

    Linear interpolation of the record; before its start the first value holds. Quaternions keep
    unit length.
    """
    out = _copy(log)
    names = tuple(columns)
    time = log["t"]
    then = time - delay - jitter * _sample_time(log) * rng.random(time.size)
    for name in names:
        flat = out[name].reshape(len(time), -1)
        out[name] = np.stack([np.interp(then, time, c) for c in flat.T], axis=-1).reshape(
            out[name].shape
        )
    turns = [n for n in ("qw", "qx", "qy", "qz") if n in names]
    if len(turns) == 4:
        length = np.sqrt(sum(out[n] ** 2 for n in turns))
        for n in turns:
            out[n] = out[n] / length
    return out


def dropped_rows(log: Columns, fraction: float, rng: np.random.Generator) -> Log:
    """Lose each row, but the first and the last, with probability `fraction`."""
    keep = rng.random(log["t"].size) >= fraction
    keep[0] = keep[-1] = True
    return {name: values[keep].copy() for name, values in log.items()}
