"""Random inputs of a simulated plant: sensor noise, process noise, slow disturbances, and the
seeded draws behind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from greybox.plants.vectors import ZERO, Number, Vector, exponential

ROTORS_MAX = 8
COLUMNS = 6 + 6 + 3 + 3 + 3 + 3 + 3 + 1 + ROTORS_MAX
"""Standard normals per sample: force, torque | drift force, torque | gyro, accelerometer, attitude,
position, velocity, voltage, rotor speeds. The layout is fixed, so that turning one source off
leaves every other sequence as it was."""
_NUMBERS_AHEAD = 2_000_000


def axes(value: Number | Vector) -> Vector:
    """One level per axis from a single level or from three."""
    return value if isinstance(value, tuple) else (value, value, value)


@dataclass(frozen=True, kw_only=True)
class SensorNoise:
    """White Gaussian noise, one standard deviation per sensor.

    gyro [rad/s], accelerometer [m/s^2], attitude [rad, small rotation in body axes], position [m],
    velocity [m/s], voltage [V], rotor_speed [rad/s]; a single number or one per axis.
    """

    gyro: Number | Vector = 0.0
    accelerometer: Number | Vector = 0.0
    attitude: Number | Vector = 0.0
    position: Number | Vector = 0.0
    velocity: Number | Vector = 0.0
    voltage: Number = 0.0
    rotor_speed: Number = 0.0


@dataclass(frozen=True, kw_only=True)
class ProcessNoise:
    """White force and torque, and slow (Gauss-Markov) force and torque, all in body axes and
    constant over one sample.

    force [N s^0.5] and torque [N m s^0.5] are spectral levels q: over a sample of length dt the
    discrete standard deviation is q / sqrt(dt). drift_force [N / s^0.5] and drift_torque [N m /
    s^0.5] drive first-order Gauss-Markov disturbances with correlation time drift_time [s]
    (infinite: random walks). Forces also reach the accelerometer.
    """

    force: Number | Vector = 0.0
    torque: Number | Vector = 0.0
    drift_force: Number | Vector = 0.0
    drift_torque: Number | Vector = 0.0
    drift_time: float = float("inf")


class Draws:
    """Standard normals, one row of COLUMNS numbers per sample and member; each member has its own
    generator.

    A member of a batch gets exactly the numbers that a single plant with the same seed gets.
    """

    def __init__(self, seeds: int | Sequence[int]) -> None:
        self._single = isinstance(seeds, int | np.integer)
        self._generators = [np.random.default_rng([int(s), 0]) for s in np.atleast_1d(seeds)]
        self._rows: list[list[Number]] = []
        self._next = 0

    def row(self) -> list[Number]:
        """The next sample's numbers: COLUMNS floats, or COLUMNS arrays of shape (B,)."""
        if self._next == len(self._rows):
            rows = max(1, min(256, _NUMBERS_AHEAD // (COLUMNS * len(self._generators))))
            block = np.stack(
                [g.standard_normal((rows, COLUMNS)) for g in self._generators], axis=-1
            )
            self._rows = block[:, :, 0].tolist() if self._single else [list(row) for row in block]
            self._next = 0
        self._next += 1
        return self._rows[self._next - 1]


class Disturbance:
    """Force and torque on the body during the present sample; `advance` moves on to the next
    one."""

    def __init__(self, process: ProcessNoise, sample_time: float) -> None:
        scale = sample_time**-0.5
        self._white = [scale * level for level in (*axes(process.force), *axes(process.torque))]
        if process.drift_time == float("inf"):
            self._keep, spread = 1.0, sample_time
        else:
            self._keep = exponential(-sample_time / process.drift_time)
            spread = 0.5 * process.drift_time * (1.0 - self._keep**2)
        self._drift_steps = [
            spread**0.5 * v for v in (*axes(process.drift_force), *axes(process.drift_torque))
        ]
        self._drift: list[Number] = [0.0] * 6
        self.force: Vector = ZERO
        self.torque: Vector = ZERO

    def calm(self) -> None:
        """Nothing new from the next sample on; what lasts fades."""
        self._white, self._drift_steps = [0.0] * 6, [0.0] * 6

    def advance(self, row: list[Number]) -> None:
        """Set force [N] and torque [N m] from one row of standard normals."""
        white = self._white
        drift = self._drift = [
            self._keep * d + s * n for d, s, n in zip(self._drift, self._drift_steps, row[6:12])
        ]
        total = [w * n + d for w, n, d in zip(white, row, drift)]
        self.force = (total[0], total[1], total[2])
        self.torque = (total[3], total[4], total[5])
