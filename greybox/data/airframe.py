"""Airframe: what the data package needs to know of a vehicle. The vehicle of greybox.model
satisfies it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:  # reading logs asks for airframes
    from greybox.data.readers.mapping import LogMapping

MOMENTS = (0.01, 3.0)
"""J / (m L^2) of bodies whose mass, arms L and inertia fit each other at all, ..."""
USUAL_MOMENT = 0.3
"""... and of small craft (0.2 to 0.5)."""
LENGTH_UNITS = {
    1e-3: "millimetres instead of metres",
    1e-2: "centimetres instead of metres",
    0.0254: "inches",
}
"""Metres per unit that lengths were given in by mistake -> what it is."""


class RotorPlace(Protocol):
    """Place and sense of one rotor."""

    @property
    def position(self) -> Sequence[float]:
        """Hub position [m] from the body origin, body axes (FLU)."""

    @property
    def spin(self) -> int:
        """+1 counter-clockwise seen from above, -1 clockwise."""


class CommandRange(Protocol):
    """Range of the commands."""

    @property
    def u_min(self) -> float:
        """Lowest command [-]."""

    @property
    def u_max(self) -> float:
        """Highest command [-]."""

    @property
    def hold(self) -> str:
        """How the command runs between samples: "previous" or "linear"."""


class Airframe(Protocol):
    """A vehicle as the data package sees it."""

    @property
    def name(self) -> str:
        """Name for messages."""

    @property
    def gravity(self) -> float:
        """Gravity [m/s^2]."""

    @property
    def rotors(self) -> Sequence[RotorPlace]:
        """Rotors in the order of the commands u1..un."""

    @property
    def actuator(self) -> CommandRange:
        """Command range."""

    @property
    def columns(self) -> LogMapping:
        """Which fields of its logs are which channels (what is not named keeps its canonical
        name)."""


class Number(Protocol):
    """A number of the vehicle file."""

    @property
    def value(self) -> float:
        """In SI units."""

    @property
    def sigma(self) -> float:
        """One standard deviation, in the same unit; 0 = exact."""


@runtime_checkable
class ThrustMap(Protocol):
    """An actuator whose thrust is known."""

    @property
    def thrust(self) -> Sequence[Number]:
        """c0, c1, c2 [N] per rotor: powers of the normalised rotor speed."""


@runtime_checkable
class Weighed(Protocol):
    """A vehicle whose mass and moments of inertia are known."""

    @property
    def mass(self) -> Number:
        """[kg]."""

    @property
    def inertia(self) -> Sequence[Sequence[float]]:
        """(3, 3) [kg m^2] about the centre of mass."""


@runtime_checkable
class WithEffects(Protocol):
    """A vehicle whose file may state effects."""

    @property
    def effects(self) -> Mapping[str, Mapping[str, Number]]:
        """Effect -> parameter -> number."""


@runtime_checkable
class TopSpeed(Protocol):
    """An actuator that may know the speed of its rotors at full command."""

    @property
    def speed_max(self) -> float | None:
        """[rad/s]; None: not stated."""
