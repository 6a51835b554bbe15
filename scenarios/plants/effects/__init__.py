"""Effects that a simulated plant can hide: one file, one effect."""

from __future__ import annotations

from scenarios.plants.effects.accelerometer_bias import AccelerometerBias
from scenarios.plants.effects.accelerometer_lever_arm import AccelerometerLeverArm
from scenarios.plants.effects.accelerometer_scale import AccelerometerScale
from scenarios.plants.effects.axial_inflow import AxialInflow
from scenarios.plants.effects.base import PlantEffect
from scenarios.plants.effects.battery_sag import BatterySag
from scenarios.plants.effects.blade_flapping import BladeFlapping
from scenarios.plants.effects.center_of_mass_offset import CenterOfMassOffset
from scenarios.plants.effects.command_delay import CommandDelay
from scenarios.plants.effects.command_saturation import CommandSaturation
from scenarios.plants.effects.constant_force import ConstantForce
from scenarios.plants.effects.ground_effect import GroundEffect
from scenarios.plants.effects.gyro_bias import GyroBias
from scenarios.plants.effects.gyro_scale import GyroScale
from scenarios.plants.effects.imu_misalignment import ImuMisalignment
from scenarios.plants.effects.mocap_misalignment import MocapMisalignment
from scenarios.plants.effects.motor_lag import MotorLag
from scenarios.plants.effects.motor_lag_asymmetry import MotorLagAsymmetry
from scenarios.plants.effects.parasitic_drag import ParasiticDrag
from scenarios.plants.effects.payload_mass import PayloadMass
from scenarios.plants.effects.pose_delay import PoseDelay
from scenarios.plants.effects.products_of_inertia import ProductsOfInertia
from scenarios.plants.effects.rotational_damping import RotationalDamping
from scenarios.plants.effects.rotor_asymmetry import RotorAsymmetry
from scenarios.plants.effects.rotor_drag import RotorDrag
from scenarios.plants.effects.rotor_gyroscopic import RotorGyroscopic
from scenarios.plants.effects.sensor_delay import SensorDelay
from scenarios.plants.effects.steady_wind import SteadyWind
from scenarios.plants.effects.thrust_curve import ThrustCurve
from scenarios.plants.effects.translational_lift import TranslationalLift

CATALOGUE: tuple[type[PlantEffect], ...] = (
    AccelerometerBias,
    AccelerometerLeverArm,
    AccelerometerScale,
    AxialInflow,
    BatterySag,
    BladeFlapping,
    CenterOfMassOffset,
    CommandDelay,
    CommandSaturation,
    ConstantForce,
    GroundEffect,
    GyroBias,
    GyroScale,
    ImuMisalignment,
    MocapMisalignment,
    MotorLag,
    MotorLagAsymmetry,
    ParasiticDrag,
    PayloadMass,
    PoseDelay,
    ProductsOfInertia,
    RotationalDamping,
    RotorAsymmetry,
    RotorDrag,
    RotorGyroscopic,
    SensorDelay,
    SteadyWind,
    ThrustCurve,
    TranslationalLift,
)
"""Every effect class; a new effect is one small file plus one line here."""
