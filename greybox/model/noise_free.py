"""Noise-free: flights of a simulator that no sensor measured.

A filter has no noise to weigh there. Errors of integration are then the only errors, every number
is certain, and the search ends nowhere. So each such sensor gets the white noise of the best of its
kind, and what is fitted and compared is a flight as a good laboratory would log it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from greybox.data import Dataset, Flight
from greybox.data.segment import Segment
from greybox.model.model import sensors_for
from greybox.model.sensor import Sensor
from greybox.model.vehicle import Vehicle
from greybox.symbolic import FloatArray

BEST = 0.1
"""Noise of the best sensor of a kind over what is typical: motion capture of 0.1 mm, a gyro of
0.1 deg/s."""
NONE = 0.005
"""Share of what is typical below which a channel has no noise: a simulator's have 0.0001 and less
at 100 Hz, a gyro behind a low-pass at a tenth of the rate 0.011, an estimator's velocity 0.015."""
DIFFERENCES = 2
"""Differences before the spectrum is taken: a craft that flies metres leaks through any window, by
a millionth of its way, and slow motion hardly shows in differences (prewhitening: Percival and
Walden 1993, sec. 6.5)."""
WINDOW = 64
"""Samples of a window of the spectrum."""
QUIET = 0.25
"""Share of the windows that tell: noise is there at all times, and a step of a command, which no
window keeps apart from noise, is not."""
TINY = 1e-300
"""A power that has a logarithm."""


@dataclass(frozen=True, kw_only=True)
class NoiseAdded:
    """White noise that a sensor of some flights got: one standard deviation `level` of each
    innovation component, in its `unit`."""

    sensor: str
    level: tuple[float, ...]
    unit: str

    def described(self) -> str:
        """Its name and its size."""
        low, high = min(self.level), max(self.level)
        size = f"{low:.2g}" if low == high else f"{low:.2g} to {high:.2g}"
        return f"{self.sensor} {size} {self.unit}".rstrip()


REASON = (
    "none of their channels has any, as a simulator's; the best sensors have a tenth of what is "
    "typical"
)
"""Why noise was added."""


def with_sensor_noise(data: Dataset, vehicle: Vehicle) -> tuple[Dataset, tuple[NoiseAdded, ...]]:
    """The flights with white noise, the same ones each time, on every sensor that has none in any
    of its channels; and what was added. Flights of real sensors are as they were."""
    sensors = sensors_for(data.channels, vehicle)
    silent = [s for s in sensors if s.usual and _has_none(s, data, vehicle)]
    if not silent:
        return data, ()
    added = tuple(
        NoiseAdded(
            sensor=s.name,
            level=tuple(_best(s, vehicle).tolist()),
            unit=s.innovation_signals(vehicle)[0].unit,
        )
        for s in silent
    )
    return Dataset(flights=tuple(_noisy(f, silent, vehicle) for f in data)), added


def as_measured(
    train: Dataset, tested: Dataset | None, vehicle: Vehicle
) -> tuple[Dataset, Dataset | None, list[str]]:
    """Flights that teach and judge with noise on sensors that have none, and what was added."""
    train, added = with_sensor_noise(train, vehicle)
    said = [f"{said_of_added(added)}: {REASON}"] if added else []
    return train, None if tested is None else with_sensor_noise(tested, vehicle)[0], said


def said_of_added(added: Sequence[NoiseAdded]) -> str:
    """What was added, in one line."""
    return f"white noise added to {', '.join(a.described() for a in added)}"


def _best(sensor: Sensor, vehicle: Vehicle) -> FloatArray:
    """Noise of the best of its kind, one per innovation component."""
    count = len(sensor.innovation_signals(vehicle))
    return np.broadcast_to(BEST * np.asarray(sensor.typical_noise(vehicle), dtype=float), (count,))


def _of_columns(sensor: Sensor, vehicle: Vehicle) -> FloatArray:
    """The same per column."""
    return sensor.noise_of_columns(_best(sensor, vehicle))


def _has_none(sensor: Sensor, data: Dataset, vehicle: Vehicle) -> bool:
    """Whether no channel has any noise; one that does not change at all has none to tell."""
    for signal, best in zip(sensor.signals(vehicle), _of_columns(sensor, vehicle), strict=True):
        levels = [_level(s.column(signal.name)) for f in data for s in f.segments]
        known = [v for v in levels if np.isfinite(v)]
        if not known or max(known) > NONE / BEST * best:
            return False
    return True


def _level(column: FloatArray) -> float:
    """Standard deviation of white noise whose spectrum is as high as the upper half of this one's,
    which motion hardly reaches, in the mean of its logarithm: what nobody can foretell of a sample
    (Kolmogorov's formula), and a filter's stop band has some. The quiet windows tell. NaN of a
    record that is too short."""
    from scipy.signal import spectrogram

    x = np.diff(column[np.isfinite(column)], DIFFERENCES)
    if x.size < WINDOW:
        return float("nan")
    cycles, _, power = spectrogram(
        x, window=np.hanning(WINDOW), noverlap=WINDOW // 2, detrend="linear"
    )
    upper = slice(cycles.size // 2, -1)
    of_differences = (2.0 * np.sin(np.pi * cycles[upper])) ** (2 * DIFFERENCES)
    both_sides = power[upper] / 2 / of_differences[:, None]
    of_windows = np.log(both_sides + TINY).mean(axis=0)
    return float(np.exp(0.5 * np.quantile(of_windows, QUIET)))


def _noisy(flight: Flight, sensors: Sequence[Sensor], vehicle: Vehicle) -> Flight:
    """The flight with noise of its own on these sensors."""
    random = np.random.default_rng([*flight.name.encode()])
    segments = [_noisy_segment(s, sensors, vehicle, random) for s in flight.segments]
    return replace(flight, segments=tuple(segments), fingerprint=flight.known_by)


def _noisy_segment(
    segment: Segment, sensors: Sequence[Sensor], vehicle: Vehicle, random: np.random.Generator
) -> Segment:
    found: dict[str, FloatArray] = {}
    for sensor in sensors:
        names = [x.name for x in sensor.signals(vehicle)]
        rows = np.column_stack([segment.column(n) for n in names])
        noisy = rows + _of_columns(sensor, vehicle) * random.standard_normal(rows.shape)
        if sensor.length is not None:  # it turns, and stays as long as it was
            long = np.linalg.norm(rows, axis=1) / np.linalg.norm(noisy, axis=1)
            noisy *= long[:, None]
        found.update(zip(names, noisy.T, strict=True))
    return segment.replace(found)
