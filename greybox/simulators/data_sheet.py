"""A model from a vehicle file alone: what a data sheet says, before any flight.

Its numbers are as good as the file. Sigmas of the file become the covariance; the domain is a calm
flight about hover.
"""

from __future__ import annotations

import math

import numpy as np

from greybox.model.effects import effect_by_name
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel
from greybox.model.parameter import ParameterValues
from greybox.model.vehicle import Vehicle

SAMPLE_TIME = 0.01
CALM = {"v": 2.0, "rate": 2.0, "tilt": 0.2}
"""Velocity [m/s], rate [rad/s] and half sine of the tilt of the domain."""


def model_of(vehicle: Vehicle) -> IdentifiedModel:
    """The vehicle with the effects of its file. Raises `UnknownNameError`, `ModelError`."""
    physics = PhysicsModel(
        vehicle=vehicle, effects=tuple(effect_by_name(n) for n in vehicle.effects)
    )
    uncertain = [d for d in physics.parameters if 0 < d.sigma < math.inf]
    full = sum(q.value for q in vehicle.actuator.thrust)
    nu = math.sqrt(vehicle.mass.value * vehicle.gravity / len(vehicle.rotors) / full)
    commands = {n: (0.8 * nu, min(1.0, 1.2 * nu)) for n in physics.inputs.names if n[0] == "u"}
    boxes = {
        **{f"v{a}": CALM["v"] for a in "xyz"},
        **dict.fromkeys("pqr", CALM["rate"]),
        **{f"q{a}": CALM["tilt"] for a in "xyz"},
    }
    volt = vehicle.nominal_voltage
    return IdentifiedModel(
        dynamics=physics,
        values=ParameterValues({d.name: d.nominal for d in physics.parameters}),
        covariance_names=tuple(d.name for d in uncertain),
        covariance=np.diag([d.sigma**2 for d in uncertain]),
        process_noise=np.zeros(len(physics.noises)),
        sensor_noise=physics.sensor_scale(),
        weak=np.zeros(len(physics.error_states)),
        reference_state=physics.reference({}),
        reference_inputs=np.full(len(physics.inputs), nu),
        sample_time=SAMPLE_TIME,
        domain={
            **commands,
            **{k: (-v, v) for k, v in boxes.items()},
            "z": (0.5, 2.0),
            **({} if volt is None else {"vbat": (0.85 * volt, 1.05 * volt)}),
        },
    )
