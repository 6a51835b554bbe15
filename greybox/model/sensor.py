"""Sensor: which columns it fills, its ideal reading, and the innovation that belongs to it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

from greybox.model.effect import Flow
from greybox.symbolic import Expr, Signal


class Sensor(ABC):
    """Base of all sensors. A sensor takes part when the log has all of its columns; the others are not needed."""

    name: ClassVar[str]
    group: ClassVar[str]
    summary: ClassVar[str]

    @abstractmethod
    def signals(self, vehicle: Any) -> tuple[Signal, ...]:
        """Columns of the log, with units."""

    @abstractmethod
    def innovation_signals(self, vehicle: Any) -> tuple[Signal, ...]:
        """Components of the innovation, with units."""

    @abstractmethod
    def reading(self, flow: Flow, specific_force: Expr) -> Expr:
        """Ideal reading of the sensor at its own point, before the sensor-stage effects."""

    def innovation(self, y: Expr, y_hat: Expr, rotation: Expr) -> Expr:
        """e = y - y_hat, in body axes where the sensor measures a world vector (see the members)."""
        return y - y_hat

    def __repr__(self) -> str:
        return f"<sensor {self.name}>"


def axes(prefix: str, letters: str, unit: str, meaning: str) -> tuple[Signal, ...]:
    """One signal per letter, named prefix + letter."""
    return tuple(Signal(name=prefix + a, unit=unit, meaning=meaning) for a in letters)
