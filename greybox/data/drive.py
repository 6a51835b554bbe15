"""What drives the rotors in a log: its commands, or, where it has none, the rotor speeds that it
measured."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from greybox.data.airframe import Airframe, TopSpeed
from greybox.data.channel import command_names, group_names

FloatArray = npt.NDArray[np.float64]

LATE_SPEEDS = 0.05
"""How late rotor speeds may be logged [s]: telemetry of a speed controller takes its time."""


def drive_names(channels: Iterable[str], rotors: int) -> tuple[str, ...]:
    """Channels that drive `rotors` rotors: commands where all are there, else rotor speeds where
    all are, else the commands that are left."""
    have = set(channels)
    for group in ("command", "rotor_speed"):
        names = group_names(group, rotors)
        if have.issuperset(names):
            return names
    return command_names(have)


def full_drive(names: Iterable[str], vehicle: Airframe, seen: FloatArray) -> float:
    """What counts as one of the driving channels `names`, whose values are `seen`: a command as it
    is, a rotor speed over `speed_max` (where the file does not state it: over the highest seen)
    [rad/s]."""
    if command_names(names):
        return 1.0
    stated = vehicle.actuator.speed_max if isinstance(vehicle.actuator, TopSpeed) else None
    highest = float(np.nanmax(seen)) if np.isfinite(seen).any() else 1.0
    return stated or max(highest, 1.0)


def drive(channels: Mapping[str, FloatArray], vehicle: Airframe) -> FloatArray | None:
    """Commands, or rotor speeds as shares of the highest, (N, n); None where neither is whole."""
    n = len(vehicle.rotors)
    names = drive_names(channels, n)
    if len(names) < n:
        return None
    values = np.column_stack([channels[name] for name in names])
    return values / full_drive(names, vehicle, values)
