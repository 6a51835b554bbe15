"""Channels: the canonical names of what a log can hold, each with unit, group and plausible range.

The names are the flight-log contract: `t` [s]; `u1..un` command [-]; `omega1..omegan` rotor speed
[rad/s]; `vbat` [V]; `qw,qx,qy,qz` attitude, body (FLU) to world (ENU); `p,q,r` body rate [rad/s];
`ax,ay,az` specific force, body [m/s^2]; `x,y,z` [m] and `vx,vy,vz` [m/s] in the world;
`sp_x,sp_y,sp_z` position setpoint [m] (an instrument in closed loop).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from greybox.errors import UnknownNameError


@dataclass(frozen=True, kw_only=True)
class Channel:
    """One canonical channel: SI unit, group, and the range [lower, upper] outside which a value is
    not plausible."""

    name: str
    unit: str
    group: str
    lower: float
    upper: float
    meaning: str = ""


TIME = "t"

_FIXED = {
    "battery": (("vbat", "V", 1.0, 100.0, "battery voltage"),),
    "attitude": tuple(
        (n, "1", -1.01, 1.01, "attitude quaternion, body to world")
        for n in ("qw", "qx", "qy", "qz")
    ),
    "rate": tuple((n, "rad/s", -70.0, 70.0, "body rate") for n in ("p", "q", "r")),
    "specific_force": tuple(
        (n, "m/s^2", -320.0, 320.0, "specific force, body axes") for n in ("ax", "ay", "az")
    ),
    "position": tuple((n, "m", -1e4, 1e4, "position in the world") for n in ("x", "y", "z")),
    "velocity": tuple(
        (n, "m/s", -100.0, 100.0, "velocity in the world") for n in ("vx", "vy", "vz")
    ),
    "setpoint": tuple(
        (n, "m", -1e4, 1e4, "position setpoint in the world") for n in ("sp_x", "sp_y", "sp_z")
    ),
}

_CATALOGUE = {
    name: Channel(name=name, unit=unit, group=group, lower=lower, upper=upper, meaning=meaning)
    for group, rows in _FIXED.items()
    for name, unit, lower, upper, meaning in rows
}

_COMMAND = re.compile(r"u([1-9][0-9]?)")
_ROTOR_SPEED = re.compile(r"omega([1-9][0-9]?)")

GROUPS = ("command", "rotor_speed", *_FIXED)
"""All channel groups."""


def rotor_index(name: str) -> int | None:
    """Number (from 1) of the rotor that a channel `u3` or `omega3` belongs to; None for other
    channels."""
    match = _COMMAND.fullmatch(name) or _ROTOR_SPEED.fullmatch(name)
    return int(match[1]) if match else None


def is_canonical(name: str) -> bool:
    """Whether `name` is a canonical channel (`t` is the clock, not a channel)."""
    return name in _CATALOGUE or rotor_index(name) is not None


def channel(name: str) -> Channel:
    """Declaration of a canonical channel. Raises `UnknownNameError` for another name."""
    if name in _CATALOGUE:
        return _CATALOGUE[name]
    if _COMMAND.fullmatch(name):
        return Channel(
            name=name, unit="1", group="command", lower=0.0, upper=1.0, meaning="rotor command"
        )
    if _ROTOR_SPEED.fullmatch(name):
        return Channel(
            name=name,
            unit="rad/s",
            group="rotor_speed",
            lower=0.0,
            upper=2e4,
            meaning="rotor speed",
        )
    raise UnknownNameError("channel", name, canonical_names(4))


def group_names(group: str, rotors: int = 4) -> tuple[str, ...]:
    """Names of the channels of a group, for a craft with `rotors` rotors. Raises
    `UnknownNameError`."""
    if group == "command":
        return tuple(f"u{i + 1}" for i in range(rotors))
    if group == "rotor_speed":
        return tuple(f"omega{i + 1}" for i in range(rotors))
    if group in _FIXED:
        return tuple(row[0] for row in _FIXED[group])
    raise UnknownNameError("channel group", group, GROUPS)


def canonical_names(rotors: int) -> tuple[str, ...]:
    """All canonical channels of a craft with `rotors` rotors, in the order of `GROUPS`."""
    return tuple(name for group in GROUPS for name in group_names(group, rotors))


def group_of(name: str) -> str | None:
    """Group of a canonical channel, None for any other name."""
    return channel(name).group if is_canonical(name) else None


def command_names(names: Iterable[str]) -> tuple[str, ...]:
    """The commands u1, u2, ... among `names`, in rotor order."""
    return _of_rotors(_COMMAND, names)


def rotor_speed_names(names: Iterable[str]) -> tuple[str, ...]:
    """The rotor speeds omega1, omega2, ... among `names`, in rotor order."""
    return _of_rotors(_ROTOR_SPEED, names)


def _of_rotors(pattern: re.Pattern[str], names: Iterable[str]) -> tuple[str, ...]:
    found = [(int(m[1]), n) for n in names if (m := pattern.fullmatch(n))]
    return tuple(n for _, n in sorted(found))
