"""Effects that a simulated plant can hide: one file, one effect."""

from __future__ import annotations

from greybox.plants.effects.accelerometer_bias import AccelerometerBias
from greybox.plants.effects.accelerometer_lever_arm import AccelerometerLeverArm
from greybox.plants.effects.accelerometer_scale import AccelerometerScale
from greybox.plants.effects.axial_inflow import AxialInflow
from greybox.plants.effects.base import PlantEffect
from greybox.plants.effects.battery_sag import BatterySag
from greybox.plants.effects.blade_flapping import BladeFlapping
from greybox.plants.effects.center_of_mass_offset import CenterOfMassOffset
from greybox.plants.effects.command_delay import CommandDelay
from greybox.plants.effects.command_saturation import CommandSaturation
from greybox.plants.effects.constant_force import ConstantForce
from greybox.plants.effects.ground_effect import GroundEffect
from greybox.plants.effects.gyro_bias import GyroBias
from greybox.plants.effects.gyro_scale import GyroScale
from greybox.plants.effects.imu_misalignment import ImuMisalignment
from greybox.plants.effects.linear_drag import LinearDrag
from greybox.plants.effects.mocap_misalignment import MocapMisalignment
from greybox.plants.effects.motor_lag import MotorLag
from greybox.plants.effects.motor_lag_asymmetry import MotorLagAsymmetry
from greybox.plants.effects.motor_lag_second import MotorLagSecond
from greybox.plants.effects.motor_lag_speed import MotorLagSpeed
from greybox.plants.effects.parasitic_drag import ParasiticDrag
from greybox.plants.effects.payload_mass import PayloadMass
from greybox.plants.effects.pose_delay import PoseDelay
from greybox.plants.effects.pose_lever_arm import PoseLeverArm
from greybox.plants.effects.products_of_inertia import ProductsOfInertia
from greybox.plants.effects.rotational_damping import RotationalDamping
from greybox.plants.effects.rotor_asymmetry import RotorAsymmetry
from greybox.plants.effects.rotor_drag import RotorDrag
from greybox.plants.effects.rotor_gyroscopic import RotorGyroscopic
from greybox.plants.effects.rotor_speed_delay import RotorSpeedDelay
from greybox.plants.effects.rotor_speed_scale import RotorSpeedScale
from greybox.plants.effects.sensor_delay import SensorDelay
from greybox.plants.effects.steady_wind import SteadyWind
from greybox.plants.effects.thrust_curve import ThrustCurve
from greybox.plants.effects.thrust_level import ThrustLevel
from greybox.plants.effects.translational_lift import TranslationalLift

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
    LinearDrag,
    MocapMisalignment,
    MotorLag,
    MotorLagAsymmetry,
    MotorLagSecond,
    MotorLagSpeed,
    ParasiticDrag,
    PayloadMass,
    PoseDelay,
    PoseLeverArm,
    ProductsOfInertia,
    RotationalDamping,
    RotorAsymmetry,
    RotorDrag,
    RotorGyroscopic,
    RotorSpeedDelay,
    RotorSpeedScale,
    SensorDelay,
    SteadyWind,
    ThrustCurve,
    ThrustLevel,
    TranslationalLift,
)
"""Every effect class; a new effect is one small file plus one line here."""
