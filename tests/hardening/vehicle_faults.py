"""Slips in a vehicle file, each as a change of its text that `greybox vehicle check`, the reader or
`greybox check` on a sound flight must see."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from greybox.model.vehicle import Vehicle
from greybox.model.vehicle_parts import Rotor


def _rotors(change: Callable[[Sequence[Rotor]], Sequence[Rotor]]) -> Callable[[Vehicle], Vehicle]:
    return lambda v: replace(v, rotors=tuple(change(v.rotors)))


def _moved(x: float, y: float) -> Callable[[Vehicle], Vehicle]:
    return _rotors(
        lambda rs: [
            replace(r, position=(x * r.position[0], y * r.position[1], r.position[2])) for r in rs
        ]
    )


def _turned(degrees: float) -> Callable[[Vehicle], Vehicle]:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))

    def turn(r: Rotor) -> Rotor:
        x, y, z = r.position
        return replace(r, position=(c * x - s * y, s * x + c * y, z))

    return _rotors(lambda rs: [turn(r) for r in rs])


def _mass(factor: float) -> Callable[[Vehicle], Vehicle]:
    return lambda v: replace(v, mass=replace(v.mass, value=factor * v.mass.value))


def _inertia(factor: float) -> Callable[[Vehicle], Vehicle]:
    return lambda v: replace(v, inertia=tuple(tuple(factor * x for x in row) for row in v.inertia))


def _thrust(factor: float) -> Callable[[Vehicle], Vehicle]:
    def change(v: Vehicle) -> Vehicle:
        thrust = tuple(replace(c, value=factor * c.value) for c in v.actuator.thrust)
        return replace(v, actuator=replace(v.actuator, thrust=thrust))

    return change


VEHICLE_FAULTS: dict[str, Callable[[Vehicle], Vehicle]] = {
    "rotors in the order of another firmware": _rotors(lambda rs: [rs[1], rs[0], *rs[2:]]),
    "rotors numbered one place on": _rotors(lambda rs: [*rs[1:], rs[0]]),
    "all spins the wrong way": _rotors(lambda rs: [replace(r, spin=-r.spin) for r in rs]),
    "two spins the wrong way": _rotors(
        lambda rs: [replace(r, spin=-r.spin) if i < 2 else r for i, r in enumerate(rs)]
    ),
    "rotor places in mm": _moved(1e3, 1e3),
    "rotor places in cm": _moved(100.0, 100.0),
    "rotor y to the right": _moved(1.0, -1.0),
    "rotor x to the rear": _moved(-1.0, 1.0),
    "X written as +": _turned(45.0),
    "mass in g": _mass(1e3),
    "inertia in g m^2": _inertia(1e3),
    "inertia in kg cm^2": _inertia(1e4),
    "thrust in g": _thrust(1e3 / 9.81),
    "gravity negated": lambda v: replace(v, gravity=-v.gravity),
}
"""Name -> the file as it was written down."""
