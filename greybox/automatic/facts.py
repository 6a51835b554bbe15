"""What the flights show before anything is fitted: the facts that the automatic fit decides
from."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from greybox.data import Dataset, Flight
from greybox.data.checks import CheckReport
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle
from greybox.symbolic import FloatArray

THIRD_DIFFERENCE = np.sqrt(20.0)
"""Standard deviation of the third difference of white noise of unit level: sqrt(1 + 9 + 9 + 1)."""
NORMAL = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Facts of a set of flights. `sensors` are those whose columns are all there (causal ones only)
    and `noise` the level of the fastest part of each of their innovation components, by sensor and
    component, in its unit. `loose`: the attitude of most flights is not the integral of the
    gyro. `wander` [samples] is how far their clocks drift apart within a flight, `axes_apart` by how
    much the gyro is later about one axis than about another (an estimator's attitude), `apart` the
    most of these and of how far they are apart in the middle (all 0 where the log has no attitude),
    `sample` [s] is one of these samples, `seconds` the time flown."""

    sensors: frozenset[str]
    noise: Mapping[tuple[str, str], float]
    loose: bool
    wander: float
    axes_apart: float
    apart: float
    sample: float = 0.0
    seconds: float
    flights: int
    rate: float
    voltage: bool

    def without(self, sensors: Collection[str]) -> Facts:
        """The same where these sensors measure nothing: they drive the model."""
        return replace(
            self,
            sensors=self.sensors - set(sensors),
            noise={at: level for at, level in self.noise.items() if at[0] not in sensors},
        )

    @property
    def has_pose(self) -> bool:
        """Whether position or attitude is measured."""
        return bool(self.sensors & {"position", "attitude"})

    @property
    def has_imu(self) -> bool:
        """Whether a gyro or an accelerometer is there."""
        return bool(self.sensors & {"gyro", "accelerometer"})


def facts_of(data: Dataset, vehicle: Vehicle, report: CheckReport) -> Facts:
    """The facts of `data`, with what the data-fault checks measured in `report`."""
    columns = set(data.channels) - set(data.noncausal)
    sensors = [s for s in SENSORS if columns.issuperset(x.name for x in s.signals(vehicle))]
    noise: dict[tuple[str, str], float] = {}
    for sensor in sensors:
        columns_of = [x.name for x in sensor.signals(vehicle)]
        components = [x.name for x in sensor.innovation_signals(vehicle)]
        fastest = [_fastest([s.column(c) for f in data for s in f.segments]) for c in columns_of]
        levels = sensor.noise_of_innovation(np.array(fastest)).tolist()
        for component, level in zip(components, levels, strict=True):
            if np.isfinite(level) and level > 0:
                noise[sensor.name, component] = level
    axes_apart = float(np.median(report.axes_apart)) if report.axes_apart else 0.0
    seen = [f.evidence for f in report.of("alignment") if "offset_samples" in f.evidence]
    middle = float(np.median([abs(e["offset_samples"]) for e in seen])) if seen else 0.0
    return Facts(
        sensors=frozenset(s.name for s in sensors),
        noise=noise,
        loose=report.loose,
        wander=report.wander,
        axes_apart=axes_apart,
        apart=max(report.wander, axes_apart, middle),
        sample=float(np.median([e["sample_s"] for e in seen])) if seen else 0.0,
        seconds=sum(f.duration for f in data),
        flights=len(data),
        rate=1.0 / data.flights[0].dt,
        voltage="vbat" in data.channels and _varies(data, "vbat"),
    )


def _fastest(columns: list[FloatArray]) -> float:
    """Level of white noise with the same third differences: what motion hardly reaches."""
    parts = [np.diff(c, n=3) for c in columns]
    step = np.concatenate(parts) if parts else np.zeros(0)
    step = step[np.isfinite(step)]
    if step.size < 10:
        return float("nan")
    return float(NORMAL * np.median(np.abs(step)) / THIRD_DIFFERENCE)


def _varies(data: Dataset, name: str) -> bool:
    values = np.concatenate([s.column(name) for f in data for s in f.segments])
    values = values[np.isfinite(values)]
    return bool(values.size and np.ptp(values) > 0)


def response_rate(flight: Flight) -> float:
    """Sample rate [Hz] that the response of a craft needs: ten times the frequency below which lie
    95 % of the power of the body's angular acceleration as the gyro shows it, white noise left
    out."""
    segment = max(flight.segments, key=lambda s: s.n)
    names = [n for n in ("p", "q", "r") if n in segment.channels] or [
        n for n in ("ax", "ay", "az") if n in segment.channels
    ]
    bands = []
    for n in names:
        known = np.flatnonzero(np.isfinite(segment.column(n)))
        if known.size < 64:
            continue
        x = segment.column(n)[known]
        # A gyro that is slower than the rows has a sample time of its own.
        step = segment.dt * float(known[-1] - known[0]) / (known.size - 1)
        power = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(x.size))) ** 2
        power = np.maximum(power - np.median(power[power.size // 2 :]), 0.0)
        total = power[1:].sum()
        if not total > 0:
            continue  # an axis that never moves
        at = min(int(np.searchsorted(np.cumsum(power[1:]) / total, 0.95)), power.size - 2)
        bands.append(float(np.fft.rfftfreq(x.size, step)[1 + at]))
    return 10.0 * max(bands) if bands else 100.0
