"""What every command that reads a vehicle file says of it: numbers believed by default, and what no
craft has."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from greybox.model.vehicle import Vehicle


def vehicle_lines(vehicle: Vehicle) -> list[str]:
    """One line for the defaults, and one per finding that blocks or warns (`greybox vehicle check`
    has all of them)."""
    from greybox.model.plausibility import vehicle_findings

    believed = vehicle.beliefs.sentence()
    found = [f.line() for f in vehicle_findings(vehicle) if f.severity != "info"]
    return [*([believed] if believed else []), *(f"vehicle file: {line}" for line in found)]


def say_vehicle(vehicle: Vehicle, say: Callable[[str], None]) -> None:
    """Pass every line of `vehicle_lines` to `say`."""
    for line in vehicle_lines(vehicle):
        say(line)
