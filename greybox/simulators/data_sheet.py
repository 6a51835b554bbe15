"""A model from a vehicle file alone: what a data sheet says, before any flight.

Its numbers are as good as the file. Sigmas of the file become the covariance; the domain is a calm
flight about hover.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from greybox.data.channel import command_names
from greybox.model.effects import effect_by_name
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel
from greybox.model.parameter import ParameterValues
from greybox.model.vehicle import Vehicle
from greybox.simulators.craft import Craft

SAMPLE_TIME = 0.01
CALM = {"v": 2.0, "rate": 2.0, "tilt": 0.2}
"""Velocity [m/s], rate [rad/s] and half sine of the tilt of the domain."""


def model_of(vehicle: Vehicle) -> IdentifiedModel:
    """The vehicle with the effects of its file. Raises `UnknownNameError`, `ModelError` for one
    that cannot hover."""
    physics = PhysicsModel(
        vehicle=vehicle, effects=tuple(effect_by_name(n) for n in vehicle.effects)
    )
    uncertain = [d for d in physics.parameters if 0 < d.sigma < math.inf]
    volt = vehicle.nominal_voltage
    model = IdentifiedModel(
        dynamics=physics,
        values=ParameterValues({d.name: d.nominal for d in physics.parameters}),
        covariance_names=tuple(d.name for d in uncertain),
        covariance=np.diag([d.sigma**2 for d in uncertain]),
        process_noise=np.zeros(len(physics.noises)),
        sensor_noise=physics.sensor_scale(),
        weak=np.zeros(len(physics.error_states)),
        reference_state=physics.reference({}),
        reference_inputs=np.zeros(len(physics.inputs)),
        sample_time=SAMPLE_TIME,
        domain={
            **{f"v{a}": (-CALM["v"], CALM["v"]) for a in "xyz"},
            **dict.fromkeys("pqr", (-CALM["rate"], CALM["rate"])),
            **{f"q{a}": (-CALM["tilt"], CALM["tilt"]) for a in "xyz"},
            "z": (0.5, 2.0),
            **({} if volt is None else {"vbat": (0.85 * volt, 1.05 * volt)}),
        },
    )
    u = Craft.of(model).hover_command
    commands = command_names(physics.inputs.names)
    at = [u if n in commands else volt or 1.0 for n in physics.inputs.names]
    about = dict.fromkeys(commands, (0.8 * u, min(1.0, 1.2 * u)))
    return replace(model, reference_inputs=np.array(at), domain={**about, **model.domain})
