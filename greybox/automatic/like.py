"""What a model of one craft says of another one like it: a prior for the effects that a vehicle
file does not mention.

A vehicle file says what can be weighed and measured. That the rotors lag, and what the air does to
the craft, only flights say. Those of a like craft give the right order of magnitude, so that few
seconds of its own flight are enough to correct it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from greybox.automatic.facts import Facts
from greybox.automatic.sets import is_felt
from greybox.model.beliefs import DEFAULT_SIGMAS
from greybox.model.effects import CATALOGUE
from greybox.model.identified import IdentifiedModel
from greybox.model.units import MASSES, powers_of
from greybox.model.vehicle import Vehicle
from greybox.model.vehicle_parts import Quantity


def like(vehicle: Vehicle, source: IdentifiedModel, facts: Facts) -> Vehicle:
    """The vehicle with the effects of `source`, a model of a craft like it.

    Added are effects of the catalogue that `vehicle` does not mention, that its flights (`facts`)
    can show and that belong to a craft: those with a value per flight are left to the flights. A
    value is believed within the default for numbers "of another craft" and its own standard error.
    Sizes with a mass in their unit grow as those of craft that are alike in shape and fly alike
    (Froude scaling: Wolowicz, Bowman and Gilbert 1979, NASA TP-1435), with mass, arm and rotor
    speed of the two. Raises `ModelError` for a model of another kind than a vehicle's.
    """
    physics = source.physics
    added: dict[str, dict[str, Quantity]] = {}
    for effect in physics.effects:
        declared = {f"{effect.name}.{d.name}": d for d in effect.parameters(vehicle)}
        units = [d.unit for d in effect.parameters(physics.vehicle)]
        if (
            effect.name in vehicle.effects
            or effect not in CATALOGUE
            or not is_felt(effect.name, vehicle, facts)
            or units != [d.unit for d in declared.values()]  # one craft's rotor speed is not known
            or any(n in source.flight_spread or n not in source.values for n in declared)
        ):
            continue
        added[effect.name] = {}
        for name, d in declared.items():
            factor = grown(d.unit, vehicle, physics.vehicle)
            value, own = (factor * number for number in _identified(source, name))
            sigma = float(np.hypot(own, DEFAULT_SIGMAS["effects"].share * max(abs(value), d.scale)))
            if sigma > 0.0:
                value = float(np.clip(value, d.lower, d.upper))
                added[effect.name][d.name] = Quantity(value=value, sigma=sigma)
    return replace(vehicle, effects={**vehicle.effects, **added})


def lasting(source: IdentifiedModel, groups: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Priors (mean, sigma) of the correlation times of disturbances ("force", "torque") that
    `source` has."""
    names = (f"disturbance.{group}.T" for group in groups)
    share = DEFAULT_SIGMAS["effects"].share
    found = {n: _identified(source, n) for n in names if n in source.values}
    return {n: (v, float(np.hypot(own, share * v))) for n, (v, own) in found.items()}


def _identified(source: IdentifiedModel, name: str) -> tuple[float, float]:
    """(value, standard error) of a number of another craft."""
    return source.values[name], source.standard_errors.get(name, 0.0)


def grown(unit: str, vehicle: Vehicle, source: Vehicle) -> float:
    """How much larger what has this unit is for `vehicle` than for `source`; 1 for a unit without a
    mass, which does not belong to the size of a craft."""
    powers = powers_of(unit)
    if not set(powers) & set(MASSES):
        return 1.0
    mass = vehicle.mass.value / source.mass.value
    length = vehicle.arm_length / source.arm_length
    scales = {"kg": mass, "N": mass, "m": length, "s": length**0.5}
    scales["rad"] = length**0.5 * vehicle.omega_scale / source.omega_scale  # rad/s as rotors turn
    return float(np.prod([scales.get(symbol, 1.0) ** power for symbol, power in powers.items()]))
