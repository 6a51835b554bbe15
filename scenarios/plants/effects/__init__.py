"""Effects that a simulated plant can hide: one file, one effect."""

from __future__ import annotations

from scenarios.plants.effects.accelerometer_bias import AccelerometerBias
from scenarios.plants.effects.base import PlantEffect
from scenarios.plants.effects.battery_sag import BatterySag
from scenarios.plants.effects.blade_flapping import BladeFlapping
from scenarios.plants.effects.center_of_mass_offset import CenterOfMassOffset
from scenarios.plants.effects.command_delay import CommandDelay
from scenarios.plants.effects.constant_force import ConstantForce
from scenarios.plants.effects.gyro_bias import GyroBias
from scenarios.plants.effects.imu_misalignment import ImuMisalignment
from scenarios.plants.effects.mocap_misalignment import MocapMisalignment
from scenarios.plants.effects.motor_lag import MotorLag
from scenarios.plants.effects.parasitic_drag import ParasiticDrag
from scenarios.plants.effects.rotational_damping import RotationalDamping
from scenarios.plants.effects.rotor_asymmetry import RotorAsymmetry
from scenarios.plants.effects.rotor_drag import RotorDrag
from scenarios.plants.effects.steady_wind import SteadyWind
from scenarios.plants.effects.thrust_curve import ThrustCurve

CATALOGUE: tuple[type[PlantEffect], ...] = (
    AccelerometerBias,
    BatterySag,
    BladeFlapping,
    CenterOfMassOffset,
    CommandDelay,
    ConstantForce,
    GyroBias,
    ImuMisalignment,
    MocapMisalignment,
    MotorLag,
    ParasiticDrag,
    RotationalDamping,
    RotorAsymmetry,
    RotorDrag,
    SteadyWind,
    ThrustCurve,
)
"""Every effect class; a new effect is one small file plus one line here."""
