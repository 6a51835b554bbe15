"""Standing: forces and torques that stay, which a filter in flight must follow although the flights
that trained its model showed none.

A craft does not fly again as it was: the battery sits elsewhere, a propeller is worn. The torque of
that is constant. A disturbance that decays as identified never holds it: the filter would need a
standing innovation. So a filter in flight keeps its disturbances, and lets them walk, beside the
identified noise, as far in a day as the vehicle file leaves open:

    d+ = d + w,   var(w) = identified + sigma^2 dt / DAY

sigma is what the vehicle file says is not known of a craft at hover: its mass, where its centre of
mass is, what each rotor gives. What a fit found of them is exact for the flights that it saw, and
says nothing of the next one. Horizontal forces, which nothing in the file makes, walk as
identified.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from greybox.model.beliefs import default_sigma
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.vehicle import Vehicle

FOREVER = 1e6
"""Time constant [s] of a disturbance that is as good as constant."""
DAY = 86400.0
"""[s]. What it is decides little: the time to follow a torque goes with its fourth root. A walk
a hundred times faster follows no better, and its lag upsets a craft whose thrust is a third
less than stated."""
PREFIX = "disturbance."


def integrating(model: IdentifiedModel) -> IdentifiedModel:
    """The model with disturbances that do not decay; the noise that drives them stays."""
    return model.with_values(
        {n: FOREVER for n in model.values if n.startswith(PREFIX) and n.endswith(".T")}
    )


def in_flight(model: IdentifiedModel) -> IdentifiedModel:
    """The model that a filter in flight is settled for: `integrating`, with disturbances that walk
    as far as the vehicle file leaves open."""
    kept, levels = integrating(model), model.process_noise.copy()
    share = model.sample_time / DAY
    names = model.dynamics.noises.names
    for name, sigma in unknown(model).items():
        if name in names:
            at = names.index(name)
            levels[at] = math.hypot(levels[at], sigma * math.sqrt(share))
    return replace(kept, process_noise=levels)


def unknown(model: IdentifiedModel) -> dict[str, float]:
    """Disturbance -> standard deviation of the constant push [N, N m, body axes] that the next
    craft of this kind may have at hover. Empty without a vehicle."""
    physics = physics_of(model.dynamics)
    if physics is None:
        return {}
    vehicle, values, sigma = physics.vehicle, model.values, _sigmas(physics.vehicle)
    weight, rotors = values["mass"] * vehicle.gravity, len(vehicle.rotors)
    thrust, torque = _each(vehicle, values, sigma, weight / rotors)
    places = np.array([r.position for r in vehicle.rotors], dtype=float)
    arms = places - [values[f"center_of_mass.{a}"] for a in "xyz"]
    by_x, by_y = (float(np.linalg.norm(arms[:, i])) for i in (0, 1))
    pushes = {
        "force.z": math.hypot(sigma["mass"] * vehicle.gravity, thrust * math.sqrt(rotors)),
        "torque.x": math.hypot(weight * sigma["center_of_mass.y"], thrust * by_y),
        "torque.y": math.hypot(weight * sigma["center_of_mass.x"], thrust * by_x),
        "torque.z": torque * math.sqrt(rotors),
    }
    return {f"{PREFIX}{n}": v for n, v in pushes.items()}


def _sigmas(vehicle: Vehicle) -> dict[str, float]:
    """Quantity -> its standard deviation; of what the file calls exact the default, because the
    next craft is not."""
    arm = vehicle.arm_length
    return {
        b.quantity: b.sigma or default_sigma(b.quantity, b.value, arm)
        for b in vehicle.beliefs.entries
    }


def _each(
    vehicle: Vehicle, values: Mapping[str, float], sigma: Mapping[str, float], wanted: float
) -> tuple[float, float]:
    """Standard deviations of thrust [N] and torque [N m] of one rotor that gives the thrust
    `wanted` [N]."""
    commands = np.linspace(vehicle.actuator.u_min, vehicle.actuator.u_max, 101)
    powers = np.vander(commands, 3, increasing=True)
    given = powers @ [values[f"thrust.c{k}"] for k in range(3)]
    at = powers[int(np.argmin(np.abs(given - wanted)))]
    thrust, torque = (
        float(np.linalg.norm(at * [sigma[f"{kind}.c{k}"] for k in range(3)]))
        for kind in ("thrust", "torque")
    )
    return thrust, torque
