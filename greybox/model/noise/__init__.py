"""Noise that is correlated in time: one file per kind, and the model that carries it as states.
White noise is no parts."""

from greybox.model.noise.augmented import (
    Augmented,
    disturbances,
    lasting_errors,
    noise_states,
    sensor_errors,
    sensor_parts,
    with_disturbance,
    with_parts,
    with_white_sensors,
    without_parts,
)
from greybox.model.noise.coloured import Coloured
from greybox.model.noise.delay import Delay
from greybox.model.noise.disturbance import Disturbance
from greybox.model.noise.drift import Drift
from greybox.model.noise.gust import Gust
from greybox.model.noise.kinds import KINDS, UNMOVED, noise_part, part_named
from greybox.model.noise.line import Line
from greybox.model.noise.low_pass import LowPass
from greybox.model.noise.part import NoisePart, SensorPart

__all__ = [
    "KINDS",
    "UNMOVED",
    "Augmented",
    "Coloured",
    "Delay",
    "Disturbance",
    "Drift",
    "Gust",
    "Line",
    "LowPass",
    "NoisePart",
    "SensorPart",
    "disturbances",
    "lasting_errors",
    "noise_part",
    "noise_states",
    "part_named",
    "sensor_errors",
    "sensor_parts",
    "with_disturbance",
    "with_parts",
    "with_white_sensors",
    "without_parts",
]
