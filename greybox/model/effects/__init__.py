"""Effects: one file is one effect; `CATALOGUE` lists them all. A new effect is a file plus a line here."""

from __future__ import annotations

from greybox.errors import UnknownNameError
from greybox.model.effect import Effect
from greybox.model.effects.accelerometer_bias import AccelerometerBias
from greybox.model.effects.battery_sag import BatterySag
from greybox.model.effects.blade_flapping import BladeFlapping
from greybox.model.effects.center_of_mass_offset import CenterOfMassOffset
from greybox.model.effects.command_delay import CommandDelay
from greybox.model.effects.constant_force import ConstantForce
from greybox.model.effects.gyro_bias import GyroBias
from greybox.model.effects.imu_misalignment import ImuMisalignment
from greybox.model.effects.mocap_misalignment import MocapMisalignment
from greybox.model.effects.motor_lag import MotorLag
from greybox.model.effects.pose_delay import PoseDelay
from greybox.model.effects.rotational_damping import RotationalDamping
from greybox.model.effects.rotor_asymmetry import RotorAsymmetry
from greybox.model.effects.rotor_drag import RotorDrag
from greybox.model.effects.rotor_gyroscopic import RotorGyroscopic
from greybox.model.effects.thrust_curve import ThrustCurve

CATALOGUE: tuple[Effect, ...] = (
    CommandDelay(),
    ThrustCurve(),
    MotorLag(),
    BatterySag(),
    RotorAsymmetry(),
    CenterOfMassOffset(),
    RotorDrag(),
    BladeFlapping(),
    RotationalDamping(),
    RotorGyroscopic(),
    ConstantForce(),
    ImuMisalignment(),
    PoseDelay(),
    MocapMisalignment(),
    AccelerometerBias(),
    GyroBias(),
)


def effect_by_name(name: str) -> Effect:
    """The catalogue's effect of that name. Raises `UnknownNameError` with the nearest names."""
    for effect in CATALOGUE:
        if effect.name == name:
            return effect
    raise UnknownNameError("effect", name, (e.name for e in CATALOGUE))
