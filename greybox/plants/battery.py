"""A battery whose voltage falls with the charge used and with the current drawn."""

from __future__ import annotations

from dataclasses import dataclass

from greybox.plants.vectors import Number


@dataclass(frozen=True, kw_only=True)
class Battery:
    """Open-circuit voltage linear in the charge used, minus internal resistance times current.

    full and empty: open-circuit voltages [V]; capacity [A s]; resistance [ohm]; idle_current [A];
    full_current [A] is what all rotors together draw at nu = 1 (current grows with the cube of
    rotor speed, as shaft power does).
    """

    full: float = 4.15
    empty: float = 3.3
    capacity: float = 900.0
    resistance: float = 0.05
    idle_current: float = 0.1
    full_current: float = 12.0

    def current(self, nu: list[Number]) -> Number:
        """Current [A] at the normalised rotor speeds nu."""
        total = sum(n * n * n for n in nu)
        return self.idle_current + self.full_current * total / len(nu)

    def voltage(self, used: Number, current: Number) -> Number:
        """Terminal voltage [V] after `used` [A s] at `current` [A]."""
        return (
            self.full - (self.full - self.empty) * used / self.capacity - self.resistance * current
        )
