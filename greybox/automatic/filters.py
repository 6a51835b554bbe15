"""Noise of sensors: filters and colour, which are offered, and which are felt.

An IMU that is filtered at 30 Hz answers 5 ms late. Left out, that is taken for lag of the motors
and motion that the gyro did not see; as a part of the model it is a time constant with an error. A
filter also colours the noise that passes it. Errors that last longer than a filter (temperature,
structure) are colour, too: in a model without `Coloured` the filter's time constant explains them.
So both are offered together, and every level is free.

A pose may err for seconds (GPS, the attitude of an estimator). Taken for white noise, such an error
drags the craft along, and its time constant is then looked for in forces and in the gyro.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from greybox.estimation.fit import noise_of
from greybox.estimation.options import FitOptions
from greybox.estimation.result import Fit
from greybox.model.layer import physics_of
from greybox.model.noise import Coloured, LowPass, NoisePart, SensorPart, part_named
from greybox.model.noise.low_pass import FILTERED
from greybox.statistics.evidence import FELT
from greybox.statistics.whiteness import is_coloured

Value = TypeVar("Value")

LONGEST = 0.02
"""Time constant [s] from which it is no filter of an IMU (8 Hz) but something else that the model
has not."""


Part = LowPass | Coloured


def offered_parts(fitted: Fit) -> tuple[Part, ...]:
    """A filter and colour for each sensor of the IMU, where the innovations of one of them are not
    white: a filter of the one changes what the other must explain."""
    physics = physics_of(fitted.model.dynamics)
    if physics is None:
        return ()
    sensors = [s for s in FILTERED if s in physics.sensor_names]
    parts = tuple(kind(sensor=s) for kind in (LowPass, Coloured) for s in sensors)
    rows = [row for p in parts[: len(sensors)] for row in p.place(physics).rows]
    records = [e[:, rows] for own in fitted.innovations.values() for e in own]
    return parts if rows and is_coloured(records) else ()


def lasting_poses(fitted: Fit) -> tuple[Coloured, ...]:
    """Colour for each sensor of the pose and its rate whose innovations are not white, each in its
    own samples: most are slower than the model."""
    physics = physics_of(fitted.model.dynamics)
    if physics is None:
        return ()
    found = []
    for s in physics.sensors:
        if s.colour_time is None or s.name in FILTERED:
            continue
        part = Coloured(sensor=s.name)
        rows = list(part.place(physics).rows)
        each = [e[:, rows] for own in fitted.innovations.values() for e in own]
        if is_coloured([e[np.isfinite(e).all(axis=1)] for e in each]):
            found.append(part)
    return tuple(found)


def without_least_sure(fitted: Fit) -> tuple[Coloured, ...]:
    """The colours of a fit less the one whose time constant has the largest error; none of a
    single one."""
    own = [part_named(n) for n in fitted.settings["noise_parts"]]
    found = [p for p in own if isinstance(p, Coloured)]

    def doubt(part: Coloured) -> float:
        time = fitted.parameters[f"{part.name}.T"]
        return np.inf if time.at_bound else time.std / time.value

    return tuple(sorted(found, key=doubt)[:-1])


def is_felt(part: Part, fitted: Fit) -> bool:
    """Whether its time constant is clear of its lower bound, and that of a filter of an IMU. Of
    noise that lasts few flights know how long: its error counts in factors, as its scale does."""
    if is_endless(part, fitted):
        return True
    found = fitted.parameters[f"{part.name}.T"]
    lower = next(d.lower for d in fitted.model.dynamics.parameters if d.name == f"{part.name}.T")
    if found.at_bound or not part.filters:
        factors = FELT * found.std / found.value
        return not found.at_bound and factors < np.log(found.value / lower)
    return lower + FELT * found.std < found.value < LONGEST


def is_endless(part: NoisePart, fitted: Fit) -> bool:
    """Whether it is noise that lasts longer than any flight, which is at its upper bound."""
    found = fitted.parameters[f"{part.name}.T"]
    upper = next(d.upper for d in fitted.model.dynamics.parameters if d.name == f"{part.name}.T")
    filters = isinstance(part, SensorPart) and part.filters
    return not filters and found.at_bound and found.value == upper


def described(part: Part, fitted: Fit) -> str:
    """What is said of it."""
    time = fitted.parameters[f"{part.name}.T"].value
    if not part.filters:
        said = f"{1e3 * time:.0f} ms" if time < 1.0 else f"{time:.3g} s"
        longer = "beyond " if is_endless(part, fitted) else ""
        return f"{part.name} (T {longer or '= '}{said})"
    cutoff = part.described(0.0, fitted.model.values, 1.0)["cutoff"]
    return f"{part.name} ({cutoff:.0f} Hz, T = {1e3 * time:.1f} ms)"


def with_noise_parts(options: FitOptions, parts: Sequence[Part], before: Fit) -> FitOptions:
    """The options with these parts. A sensor's noise passes its filter, that of its conversion
    does not, and colour may enter behind: all levels are free, and start at what `before`, with
    white noise, found for the sensor."""
    found = noise_of(before.model)
    dynamics, dt = before.model.dynamics, before.model.sample_time
    start: dict[str, float] = {}
    for p in parts:
        place = p.place(dynamics)
        white = np.array([found[f"noise.sensor.{s.name}"] for s in place.signals])
        names = [f"noise.process.{s.name}" for s in p.signals(place)]
        start.update(zip(names, p.driving(white, dt).tolist(), strict=True))
    return options.but(
        noise_parts=(*options.noise_parts, *(p.name for p in parts)),
        noise={**options.noise, **start},
    )


def without_parts(options: FitOptions, names: Sequence[str]) -> FitOptions:
    """The options without some noise parts and what was said of them."""
    values, levels = dict(options.values), dict(options.noise)
    priors, own = dict(options.priors), dict(options.flight_priors)
    for name in names:
        values, levels = without_noise_of(name, values), without_noise_of(name, levels)
        priors, own = without_noise_of(name, priors), without_noise_of(name, own)
    return options.but(
        noise_parts=tuple(n for n in options.noise_parts if n not in names),
        values=values,
        priors=priors,
        flight_priors=own,
        noise=levels,
    )


def without_noise_of(part: str, table: Mapping[str, Value]) -> dict[str, Value]:
    """A table of parameter values or noise levels without those of a noise part."""
    own = (f"{part}.", f"noise.process.{part}.")
    return {
        n: v for n, v in table.items() if n != f"noise.process.{part}" and not n.startswith(own)
    }
