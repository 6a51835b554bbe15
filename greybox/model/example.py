"""A quadrotor of round numbers, for listings of declarations and for trying out an effect."""

from __future__ import annotations

from functools import cache

from greybox.model.vehicle import Vehicle


@cache
def example_vehicle(size: float = 1.0) -> Vehicle:
    """The quadrotor, its arms and moments of inertia `size` times as large; it states every fact
    that an effect needs."""
    arm, j = 0.1 * size, 0.01 * size
    places = ((arm, -arm, 1), (-arm, -arm, -1), (-arm, arm, 1), (arm, arm, -1))
    return Vehicle.from_dict(
        {
            "schema": "greybox.vehicle/1",
            "name": "example",
            "mass": 1.0,
            "inertia": [[j, 0.0, 0.0], [0.0, j, 0.0], [0.0, 0.0, 1.8 * j]],
            "rotor": [{"position": [x, y, 0.0], "spin": spin} for x, y, spin in places],
            "actuator": {
                "thrust": [0.0, 0.0, 5.0],
                "torque": [0.0, 0.0, 0.1],
                "speed_max": 1000.0,
                "rotor_radius": 0.06,
            },
            "battery": {"nominal_voltage": 11.1},
        },
        where="example vehicle",
    )
