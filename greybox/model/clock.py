"""Clock: what instant a sensor shows. All sensors of one clock show the same one; effects may delay
a clock.

The states of a model are those of `STATE_CLOCK`: its sensors are fast, and are then exact however
late they are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Clock:
    """A clock by `name`. `delay` is the slot of the effects that make it late, None for one that is
    never late.

    `reach` [s] is how far back commands are looked up for it; before that the oldest of them
    stands.
    """

    name: str
    delay: str | None
    reach: float = math.inf


STATE_CLOCK = "imu"
ROTOR_CLOCK = "rotors"
CLOCKS: Mapping[str, Clock] = {
    c.name: c
    for c in (
        Clock(name=STATE_CLOCK, delay="imu_delay"),
        Clock(name="pose", delay="pose_delay", reach=0.05),
        Clock(name=ROTOR_CLOCK, delay="rotor_speed_delay"),
        Clock(name="now", delay=None),
    )
}
"""imu: what the flight controller samples; pose: motion capture, satellites or cameras; rotors:
telemetry of the speed controllers; now: what comes with commands."""

DELAYS = frozenset(c.delay for c in CLOCKS.values() if c.delay is not None)
"""Slots of the stage "sensor" that delay a clock [s]."""
