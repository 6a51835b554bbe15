"""Sensor: all that the rest of the house knows of one. A new sensor is one class like those in
`greybox.model.sensors`.

It declares the columns that it fills and its ideal reading, the innovation that belongs to it, its
noise, the instant that it shows (`greybox.model.clock`), what its first readings say of the start
of a flight, and a bias where it drifts.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import casadi as ca
import numpy as np

from greybox.model.clock import STATE_CLOCK
from greybox.model.flow import Flow, Remembered
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr, FloatArray, Signal


@dataclass(frozen=True, kw_only=True)
class Start:
    """What the first readings say of a state block (position, velocity, attitude, rate) when a
    flight begins.

    `value` has the size of the block (NaN: says nothing of this component), `spread` one standard
    deviation per error component, of which an attitude has three. Of several sensors the one with
    the smaller spread counts.
    """

    block: str
    value: Sequence[float] | FloatArray
    spread: Sequence[float] | FloatArray


class Sensor(ABC):
    """Base of all sensors. A sensor takes part when the log has all of its columns; the others are
    not needed.

    `name` is its key in [noise] of a vehicle file, `group` what its channels are called in tables.
    It shows the instant of its `clock`, or of `delay` seconds before. Those that are `usual` are in
    a model that nobody gave any.
    `noisiest` is more noise than such a sensor has [innovation unit], `noisiest_hint` the unit that
    was meant. `shows` is the state block that it measures as it is, None where it measures anything
    else. `colour_time` [s] is where a search for coloured noise begins, None where none is looked
    for; colour is told from forces only where one of the sensors `witnesses` sees the motion too
    (empty: always). `length` is what its columns together are at least and at most long, None where that
    is open: what is shorter or longer is no reading. A sensor of a `world` vector has its
    innovation in body axes, and its own errors that last in those of the world, where they stay
    while the craft turns.
    """

    name: ClassVar[str]
    group: ClassVar[str]
    summary: ClassVar[str]
    clock: ClassVar[str] = STATE_CLOCK
    delay: ClassVar[float] = 0.0
    usual: ClassVar[bool] = True
    noisiest: ClassVar[float] = math.inf
    noisiest_hint: ClassVar[str] = ""
    shows: ClassVar[str | None] = None
    colour_time: ClassVar[float | None] = None
    witnesses: ClassVar[frozenset[str]] = frozenset()
    length: ClassVar[tuple[float, float] | None] = None
    world: ClassVar[bool] = False

    @abstractmethod
    def signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """Columns of the log, with units."""

    @abstractmethod
    def innovation_signals(self, vehicle: Vehicle) -> tuple[Signal, ...]:
        """Components of the innovation, with units."""

    @abstractmethod
    def typical_noise(self, vehicle: Vehicle) -> float | Sequence[float]:
        """One standard deviation [innovation unit], where a fit begins that knows no other: of all
        components, or each."""

    @abstractmethod
    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """Ideal reading of the sensor at its own point, before the sensor-stage effects."""

    def innovation(self, y: Expr, y_hat: Expr, rotation: Expr) -> Expr:
        """e = y - y_hat, in body axes where the sensor measures a `world` vector.

        `rotation` is the predicted attitude, body to world. A filter has one gain for all headings:
        an innovation should depend on its error alike at all of them.
        """
        return rotation.T @ (y - y_hat) if self.world else y - y_hat

    def noise_of_columns(self, innovation: FloatArray) -> FloatArray:
        """White noise of each column (standard deviation, its unit) that is noise `innovation` of
        each innovation component. One column belongs to each where nothing else is declared."""
        return innovation

    def noise_of_innovation(self, columns: FloatArray) -> FloatArray:
        """The reverse: what white noise of each column is in each innovation component."""
        return columns

    def starts(self, readings: FloatArray, t: FloatArray) -> tuple[Start, ...]:
        """What the first samples say of the states: `readings` (n, columns), NaN = missing, at the
        times `t` [s]."""
        return ()

    def memory(self, vehicle: Vehicle) -> tuple[Remembered, ...]:
        """States of its own, as a bias that drifts; `flow.memory` has them in this order."""
        return ()

    def remember(self, flow: Flow) -> Expr:
        """d memory / dt [unit / s] without noise, one value per state of `memory`: 0 for a random
        walk."""
        return ca.DM.zeros(len(self.memory(flow.vehicle)))

    def __repr__(self) -> str:
        return f"<sensor {self.name}>"


def axes(prefix: str, letters: str, unit: str, meaning: str) -> tuple[Signal, ...]:
    """One signal per letter, named prefix + letter."""
    return tuple(Signal(name=prefix + a, unit=unit, meaning=meaning) for a in letters)


def first_complete(readings: FloatArray) -> FloatArray | None:
    """The first of the rows (n, columns) that has all columns; None where there is none."""
    good = readings[np.isfinite(readings).all(axis=1)]
    return good[0] if len(good) else None
