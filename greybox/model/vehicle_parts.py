"""Parts of a vehicle: a number with its standard deviation, a rotor, what its commands do; and the
schemas of its file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

SCHEMA = "greybox.vehicle/2"
EXACT_SCHEMA = "greybox.vehicle/1"
"""Schema of older files, in which a number without a sigma is exact and bounds are four sigma."""
SCHEMAS = (EXACT_SCHEMA, SCHEMA)
ASSUMED = "default_sigma"
"""Key of a written vehicle: names of the numbers whose sigma nobody stated."""
Vector3 = tuple[float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A number with one standard deviation; `sigma` 0 means exact."""

    value: float
    sigma: float = 0.0

    @property
    def exact(self) -> bool:
        """Whether the number is held fixed by default."""
        return self.sigma == 0.0


Quantity3 = tuple[Quantity, Quantity, Quantity]


@dataclass(frozen=True, kw_only=True)
class Rotor:
    """Hub position [m] from the body origin, and spin (+1 counter-clockwise seen from above, -1
    clockwise)."""

    position: Vector3
    spin: int


@dataclass(frozen=True, kw_only=True)
class Actuator:
    """Commands and the thrust and torque maps, c0 + c1 nu + c2 nu^2 per rotor ([N] and [N m]).

    `hold` says how the command runs between samples; `rotor_radius` [m] and `speed_max` [rad/s at
    nu = 1] are optional.
    """

    u_min: float = 0.0
    u_max: float = 1.0
    hold: Literal["previous", "linear"] = "previous"
    rotor_radius: float | None = None
    speed_max: float | None = None
    thrust: Quantity3
    torque: Quantity3


def arm_length(rotors: Iterable[Rotor]) -> float:
    """Longest horizontal distance of a hub from the body origin [m], 0.1 where all are there."""
    return max(float(np.hypot(r.position[0], r.position[1])) for r in rotors) or 0.1
