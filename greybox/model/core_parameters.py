"""Core parameters: what the vehicle file says of the rigid body and its rotors, as declarations."""

from __future__ import annotations

import math
from collections.abc import Mapping

from greybox.model.bounds import core_bounds
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle


def leading(kind: str, values: Mapping[str, float]) -> str:
    """The coefficient that the map of `kind`, "thrust" or "torque", mostly consists of at full
    speed: thrust.c1 of one that is linear in the command."""
    return max((f"{kind}.c{k}" for k in (2, 1, 0)), key=lambda name: abs(values[name]))


def core_parameters(vehicle: Vehicle) -> tuple[Parameter, ...]:
    """Declarations of mass, inertia, centre of mass, thrust and torque maps from the vehicle file.

    Bounds follow the physics, or four sigma in older vehicle files (see `core_bounds`); priors are
    soft.
    """

    def declare(
        name: str, unit: str, value: float, sigma: float, meaning: str, *, size: float
    ) -> Parameter:
        lower, upper = core_bounds(vehicle, name)
        scale = sigma if 0 < sigma < math.inf else (abs(value) or size)
        return Parameter(
            name=name,
            unit=unit,
            nominal=value,
            lower=lower,
            upper=upper,
            sigma=sigma,
            scale=scale,
            meaning=meaning,
        )

    m = vehicle.mass
    out = [declare("mass", "kg", m.value, m.sigma, "mass", size=m.value)]
    for i, a in enumerate(("xx", "yy", "zz")):
        j, sigma = float(vehicle.inertia[i][i]), float(vehicle.inertia_sigma[i])
        meaning = f"moment of inertia {a}"
        out.append(declare(f"inertia.{a}", "kg m^2", j, sigma, meaning, size=j))
    for i, a in enumerate("xyz"):
        c = vehicle.center_of_mass[i]
        size = vehicle.arm_length
        out.append(
            declare(f"center_of_mass.{a}", "m", c.value, c.sigma, f"centre of mass {a}", size=size)
        )
    maps = (("thrust", "N", vehicle.actuator.thrust), ("torque", "N m", vehicle.actuator.torque))
    for kind, unit, triple in maps:
        size = max(abs(q.value) for q in triple) or 1.0
        for k, q in enumerate(triple):
            meaning = f"{kind} per rotor, power {k} of nu"
            out.append(declare(f"{kind}.c{k}", unit, q.value, q.sigma, meaning, size=size))
    return tuple(out)
