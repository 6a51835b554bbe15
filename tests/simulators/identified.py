"""An identified model of round numbers with effects of one's choice, and flights to fly it on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from greybox.model.example import example_vehicle
from greybox.model.identified import IdentifiedModel
from greybox.model.model import PhysicsModel
from greybox.model.parameter import ParameterValues
from greybox.model.vehicle import Vehicle

Array = NDArray[np.float64]

AERODYNAMICS = {
    "motor_lag.tau": 0.05,
    "rotor_drag.k_x": 2e-5,
    "rotor_drag.k_y": 2e-5,
    "axial_inflow.k_z": 3e-5,
    "blade_flapping.k_flap": 2e-7,
    "linear_drag.d_x": 0.03,
    "linear_drag.d_y": 0.04,
    "linear_drag.d_z": 0.02,
    "parasitic_drag.c_x": 0.03,
    "parasitic_drag.c_y": 0.04,
    "parasitic_drag.c_z": 0.05,
    "translational_lift.k_h": 2e-3,
    "steady_wind.w_x": 1.0,
    "steady_wind.w_y": -0.5,
    "thrust_level.s": -0.03,
    "rotor_asymmetry.delta_1": 0.03,
    "rotor_asymmetry.delta_2": -0.02,
    "rotor_asymmetry.delta_3": 0.01,
    "center_of_mass_offset.c_x": 0.003,
    "center_of_mass_offset.c_y": -0.002,
    "center_of_mass_offset.c_z": 0.01,
    "products_of_inertia.Jxy": 2e-4,
    "products_of_inertia.Jxz": -1e-4,
    "products_of_inertia.Jyz": 1.5e-4,
    "payload_mass.mu": 0.1,
    "command_delay.d": 0.0137,
    "thrust_curve.f": 0.2,
}
"""A craft with most of the catalogue."""
DOMAIN = {
    **{f"u{i}": (0.4, 0.9) for i in range(1, 5)},
    **{f"v{a}": (-4.0, 4.0) for a in "xyz"},
    **dict.fromkeys("pqr", (-3.0, 3.0)),
    **{f"q{a}": (-0.3, 0.3) for a in "xyz"},
    "vbat": (10.0, 12.0),
    "z": (0.1, 3.0),
}


def identified(
    values: Mapping[str, float], vehicle: Vehicle | None = None, *, gravity: float = 9.81
) -> IdentifiedModel:
    """The model of `vehicle` (the example craft) with the effects that `values` names."""
    vehicle = replace(vehicle or example_vehicle(), gravity=gravity)
    core = ("mass", "inertia", "thrust", "torque", "center_of_mass")
    names = dict.fromkeys(n.split(".")[0] for n in values if n.split(".")[0] not in core)
    physics = PhysicsModel(vehicle=vehicle).with_effect(*names)
    settled = {d.name: d.null if d.null is not None else d.nominal for d in physics.parameters}
    p = ParameterValues({**settled, **values})
    size = len(physics.error_states)
    return IdentifiedModel(
        dynamics=physics,
        values=p,
        process_noise=physics.noise_scale(0.01),
        sensor_noise=physics.sensor_scale(),
        weak=np.zeros(size),
        reference_state=physics.reference({}),
        reference_inputs=np.full(len(physics.inputs), 0.7),
        sample_time=0.01,
        domain=DOMAIN,
    )


def manoeuvre(hover: float, seconds: float = 0.5, dt: float = 0.01) -> Array:
    """Commands (4, steps): doublets of every rotor about `hover`."""
    steps = round(seconds / dt)
    u = np.full((4, steps), hover)
    for i, (start, size) in enumerate(((0, 0.05), (8, -0.04), (14, 0.05), (22, -0.03))):
        u[i, start : start + 10] += size
        u[(i + 2) % 4, start + 5 : start + 12] -= 0.5 * size
    return u


START = {
    "position": np.array([0.2, -0.1, 1.5]),
    "velocity": np.array([2.0, -1.0, 0.5]),
    "attitude": np.array([0.97, 0.12, -0.15, 0.13]) / np.linalg.norm([0.97, 0.12, -0.15, 0.13]),
    "rate": np.array([0.5, -0.4, 0.3]),
}
"""A start that wakes every force: tilted, turning, moving."""
