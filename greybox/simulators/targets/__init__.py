"""Targets: one file per simulator, and the table that `--target` looks into."""

from __future__ import annotations

from greybox.errors import UnknownNameError
from greybox.simulators.target import Target
from greybox.simulators.targets.ardupilot import ArduPilot
from greybox.simulators.targets.crazyflow import CRAZYFLOW, DRONE_MODELS
from greybox.simulators.targets.flightgoggles import FlightGoggles
from greybox.simulators.targets.gazebo import Gazebo
from greybox.simulators.targets.isaac import Isaac
from greybox.simulators.targets.jax_module import JaxModule
from greybox.simulators.targets.jsbsim import JSBSim
from greybox.simulators.targets.mujoco import MuJoCo
from greybox.simulators.targets.numpy_module import NumPyModule
from greybox.simulators.targets.px4 import PX4
from greybox.simulators.targets.pybullet import PyBullet
from greybox.simulators.targets.rotorpy import RotorPy

TARGETS: tuple[Target, ...] = (
    NumPyModule(),
    JaxModule(),
    RotorPy(),
    MuJoCo(),
    CRAZYFLOW,
    DRONE_MODELS,
    PyBullet(),
    Gazebo(),
    PX4(),
    ArduPilot(),
    Isaac(),
    JSBSim(),
    FlightGoggles(),
)


def target_by_name(name: str) -> Target:
    """Raises `UnknownNameError` with the nearest names."""
    for target in TARGETS:
        if target.name == name:
            return target
    raise UnknownNameError("target", name, (t.name for t in TARGETS))
