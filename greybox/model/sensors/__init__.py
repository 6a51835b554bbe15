"""Sensors: one file is one sensor; `SENSORS` lists them in the order of the output vector."""

from __future__ import annotations

from greybox.model.sensor import Sensor
from greybox.model.sensors.accelerometer import Accelerometer
from greybox.model.sensors.attitude import Attitude
from greybox.model.sensors.gyro import Gyro
from greybox.model.sensors.position import Position
from greybox.model.sensors.rotor_speed import RotorSpeed
from greybox.model.sensors.velocity import Velocity

SENSORS: tuple[Sensor, ...] = (
    Position(),
    Velocity(),
    Attitude(),
    Gyro(),
    Accelerometer(),
    RotorSpeed(),
)

USUAL: tuple[Sensor, ...] = tuple(s for s in SENSORS if s.usual)
"""Those that a model has which nobody gave any."""


def on_clock(clock: str) -> tuple[str, ...]:
    """Names of the catalogue's sensors that show the instant of a clock (`greybox.model.clock`)."""
    return tuple(s.name for s in SENSORS if s.clock == clock)
