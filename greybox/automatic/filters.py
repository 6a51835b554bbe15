"""Low-pass filters of gyro and accelerometer: which are offered, and which are felt.

An IMU that is filtered at 30 Hz answers 5 ms late. Left out, that is taken for lag of the motors and
motion that the gyro did not see; as a part of the model it is a time constant with an error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

from greybox.estimation.options import FitOptions
from greybox.estimation.result import Fit
from greybox.model.layer import physics_of
from greybox.model.noise import LowPass
from greybox.statistics.whiteness import is_coloured

Value = TypeVar("Value")

FILTERED = ("gyro", "accelerometer")
"""Sensors that come with a filter before the log: those of the IMU."""
FELT = 3.0
"""Standard errors from which a time constant counts as felt."""


def offered_filters(fitted: Fit) -> tuple[LowPass, ...]:
    """A filter for each sensor of the IMU whose innovations are not white, where one of them is
    not: a filter of the one changes what the other must explain."""
    physics = physics_of(fitted.model.dynamics)
    if physics is None:
        return ()
    parts = tuple(LowPass(sensor=s) for s in FILTERED if s in physics.sensor_names)
    rows = [row for p in parts for row in p.place(physics).rows]
    records = [e[:, rows] for own in fitted.innovations.values() for e in own]
    return parts if rows and is_coloured(records) else ()


def is_felt(part: LowPass, fitted: Fit) -> bool:
    """Whether its time constant is clear of its lower bound."""
    found = fitted.parameters[f"{part.name}.T"]
    lower = next(d.lower for d in fitted.model.dynamics.parameters if d.name == f"{part.name}.T")
    return not found.at_bound and found.value - lower > FELT * found.std


def described(part: LowPass, fitted: Fit) -> str:
    """What is said of it."""
    found = fitted.parameters[f"{part.name}.T"]
    cutoff = part.described(0.0, fitted.model.values, 1.0)["cutoff"]
    return f"{part.name} ({cutoff:.0f} Hz, T = {1e3 * found.value:.1f} ms)"


def without_parts(options: FitOptions, names: Sequence[str]) -> FitOptions:
    """The options without some noise parts and what was said of them."""
    values, levels = dict(options.values), dict(options.noise)
    for name in names:
        values, levels = without_noise_of(name, values), without_noise_of(name, levels)
    kept = tuple(n for n in options.noise_parts if n not in names)
    return options.but(noise_parts=kept, values=values, noise=levels)


def without_noise_of(part: str, table: Mapping[str, Value]) -> dict[str, Value]:
    """A table of parameter values or noise levels without those of a noise part."""
    own = (f"{part}.", f"noise.process.{part}.")
    return {n: v for n, v in table.items() if not n.startswith(own)}
