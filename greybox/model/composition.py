"""Composition: whether effects and sensors go together, said in one line where they do not."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence

from greybox.errors import ModelError
from greybox.model.clock import CLOCKS
from greybox.model.effect import Effect
from greybox.model.flow import Remembered
from greybox.model.sensor import Sensor
from greybox.model.vehicle import Vehicle

SHAPING = ("command", "rotor")
"""Stages between the command and the rotor speed."""
REMEMBERING = ("thrust", "wrench")
"""Stages whose effects may have states of their own."""


def acts_on_speeds(effect: Effect) -> bool:
    """Whether an effect has anything to do where measured rotor speeds drive the model: what shapes
    the command is in them already, but for the clock of the log."""
    return effect.stage not in SHAPING or set(effect.early) == {"delay"}


def check_effects(
    effects: Sequence[Effect],
    vehicle: Vehicle,
    sensor_names: Collection[str],
    *,
    measured_speed: bool,
) -> None:
    """Raises `ModelError` where an effect is there twice, lacks what it needs, or is ill declared.

    `measured_speed`: measured rotor speeds drive the model, which leaves nothing to effects of the
    command but a delay.
    """
    names = [e.name for e in effects]
    double = sorted({n for n in names if names.count(n) > 1})
    if double:
        raise ModelError(f"effect given twice: {', '.join(double)}")
    if measured_speed:
        if vehicle.actuator.speed_max is None:
            raise ModelError(
                "rotor speeds as the input (--input speed) need actuator.speed_max in the "
                "vehicle file",
                fix="add speed_max [rad/s], or log the commands",
            )
        for e in effects:
            if not acts_on_speeds(e):
                raise ModelError(
                    f"effect {e.name} shapes the command, which --input speed does not use"
                )
    for e in effects:
        if missing := e.missing(vehicle, sensor_names):
            raise ModelError(
                f"effect {e.name} needs {', '.join(missing)}",
                fix="add it, or leave the effect out",
            )
        own = e.memory(vehicle)
        if own and e.stage not in REMEMBERING:
            raise ModelError(
                f"effect {e.name} of stage {e.stage} has a memory",
                expected=f"one of stage {' or '.join(REMEMBERING)}",
            )
        if own and e.early:
            raise ModelError(
                f"effect {e.name} has a memory and returns {', '.join(sorted(e.early))}, "
                "needed before that is known",
                fix="return a force instead",
            )
        _check_memory(f"effect {e.name}", own)
    lags = [e.name for e in effects if "lag" in e.early]
    if len(lags) > 1:
        raise ModelError(f"two lags of the rotors: {', '.join(lags)}", fix="keep one of them")


def check_sensors(
    sensors: Sequence[Sensor], effects: Sequence[Effect], vehicle: Vehicle, inputs: Collection[str]
) -> None:
    """Raises `ModelError` where a sensor is there twice, measures an input, or is ill declared."""
    shaping = {e.name for e in effects if e.memory(vehicle)}
    seen: set[str] = set()
    for s in sensors:
        columns = {x.name for x in s.signals(vehicle)}
        if doubled := columns & set(inputs):
            what = ", ".join(sorted(doubled))
            raise ModelError(
                f"sensor {s.name}: {what} cannot be input and output at once",
                fix=f"leave {s.name} out of sensors",
            )
        if doubled := ({s.name} | columns) & seen:
            raise ModelError(
                f"sensor {s.name}: {', '.join(sorted(doubled))} given twice", fix="keep one"
            )
        seen |= {s.name} | columns
        if s.clock not in CLOCKS or not 0 <= s.delay < math.inf:
            raise ModelError(
                f"sensor {s.name} shows an unknown instant",
                expected=f"a clock of {', '.join(CLOCKS)} and a delay of 0 s or more",
                got=f"{s.clock!r}, {s.delay:g} s",
            )
        if s.name in shaping and s.memory(vehicle):
            raise ModelError(
                f"an effect and a sensor that remember are both named {s.name}",
                fix="rename one",
            )
        _check_memory(f"sensor {s.name}", s.memory(vehicle))


def _check_memory(owner: str, memory: Sequence[Remembered]) -> None:
    names = {m.name for m in memory}
    if len(names) < len(memory) or not all(re.fullmatch(r"[a-z][a-z0-9_]*", n) for n in names):
        raise ModelError(
            f"{owner}: bad names in its memory",
            got=", ".join(m.name for m in memory),
            expected="each its own, of lower-case letters, digits and underscores",
        )
    if not all(0 < m.size < math.inf for m in memory):
        raise ModelError(
            f"{owner}: a size in its memory is not positive", expected="what is typical of it"
        )
    if not all(0 <= m.drift < math.inf for m in memory):
        raise ModelError(f"{owner}: a drift in its memory is negative", expected="0 for none")
