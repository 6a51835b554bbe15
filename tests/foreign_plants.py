"""A craft of medium size for tests, and the foreign plants that fly it; skips without its
package."""

from __future__ import annotations

from dataclasses import replace

import pytest

from greybox.plants.airframe import Airframe, x_layout
from scenarios.foreign.craft import Air, Craft

FOREIGN = ("rotorpy", "mujoco", "drone_models", "pybullet")
ALL = ("plants", *FOREIGN)
GRAVITY = 9.81
FRAME = Airframe(
    name="craft of medium size",
    mass=0.5,
    inertia=(2.1e-3, 2.4e-3, 3.9e-3),
    rotors=x_layout(0.09, 0.08),
    thrust=(0.0, 0.0, 4.2),
    torque=(0.0, 0.0, 0.055),
    speed_max=2300.0,
    rotor_radius=0.0635,
    gravity=GRAVITY,
)
CRAFT = Craft(airframe=FRAME, lag=0.04)
HOVER = float(FRAME.hover_speed)
OFFSET = replace(FRAME, center_of_mass=(0.006, -0.004, 0.003), imu_position=(0.01, 0.02, -0.005))
WINDY = Air(rotor_drag=2e-5, inflow=1.5e-5, parasitic=(1e-3, 1e-3, 2e-3), gusts=1.0, swirl=1.0)


def make(simulator: str, craft: Craft = CRAFT, **settings):
    """A plant of this simulator; skips the test when its package is not installed."""
    if simulator == "rotorpy":
        pytest.importorskip("rotorpy", reason="RotorPy comes with the extra judge")
        from scenarios.foreign.rotorpy_plant import RotorPyPlant

        return RotorPyPlant(craft, **settings)
    if simulator == "mujoco":
        pytest.importorskip("mujoco", reason="MuJoCo comes with the extra judge")
        from scenarios.foreign.mujoco_plant import MuJoCoPlant

        return MuJoCoPlant(craft, **settings)
    if simulator == "pybullet":
        pytest.importorskip("pybullet", reason="PyBullet comes with the extra judge")
        from scenarios.foreign.pybullet_plant import PyBulletPlant

        return PyBulletPlant(craft, **settings)
    if simulator == "drone_models":
        # drone_models itself refuses to be imported after SciPy, which its plant knows how to mend
        pytest.importorskip("array_api_compat", reason="drone-models comes with the extra judge")
        from scenarios.foreign.drone_models_plant import DroneModelsPlant

        return DroneModelsPlant(craft, **settings)
    from scenarios.foreign.in_house import in_house_plant

    return in_house_plant(craft, **settings)
