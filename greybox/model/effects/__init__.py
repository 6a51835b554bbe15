"""Effects: one file is one effect; `CATALOGUE` lists them all. A new effect is a file plus a line
here."""

from __future__ import annotations

from collections.abc import Iterable

from greybox.errors import UnknownNameError
from greybox.model.effect import Effect
from greybox.model.effects.accelerometer_bias import AccelerometerBias
from greybox.model.effects.accelerometer_lever_arm import AccelerometerLeverArm
from greybox.model.effects.accelerometer_scale import AccelerometerScale
from greybox.model.effects.axial_inflow import AxialInflow
from greybox.model.effects.battery_sag import BatterySag
from greybox.model.effects.blade_flapping import BladeFlapping
from greybox.model.effects.center_of_mass_offset import CenterOfMassOffset
from greybox.model.effects.command_delay import CommandDelay
from greybox.model.effects.command_saturation import CommandSaturation
from greybox.model.effects.constant_force import ConstantForce
from greybox.model.effects.ground_effect import GroundEffect
from greybox.model.effects.gyro_bias import GyroBias
from greybox.model.effects.gyro_scale import GyroScale
from greybox.model.effects.imu_misalignment import ImuMisalignment
from greybox.model.effects.linear_drag import LinearDrag
from greybox.model.effects.mocap_misalignment import MocapMisalignment
from greybox.model.effects.motor_lag import MotorLag
from greybox.model.effects.motor_lag_asymmetry import MotorLagAsymmetry
from greybox.model.effects.motor_lag_second import MotorLagSecond
from greybox.model.effects.motor_lag_speed import MotorLagSpeed
from greybox.model.effects.parasitic_drag import ParasiticDrag
from greybox.model.effects.payload_mass import PayloadMass
from greybox.model.effects.pose_delay import PoseDelay
from greybox.model.effects.pose_lever_arm import PoseLeverArm
from greybox.model.effects.products_of_inertia import ProductsOfInertia
from greybox.model.effects.rotational_damping import RotationalDamping
from greybox.model.effects.rotor_asymmetry import RotorAsymmetry
from greybox.model.effects.rotor_drag import RotorDrag
from greybox.model.effects.rotor_gyroscopic import RotorGyroscopic
from greybox.model.effects.rotor_speed_delay import RotorSpeedDelay
from greybox.model.effects.rotor_speed_scale import RotorSpeedScale
from greybox.model.effects.sensor_delay import SensorDelay
from greybox.model.effects.steady_wind import SteadyWind
from greybox.model.effects.thrust_curve import ThrustCurve
from greybox.model.effects.thrust_level import ThrustLevel
from greybox.model.effects.translational_lift import TranslationalLift
from greybox.model.vehicle import Vehicle

CATALOGUE: tuple[Effect, ...] = (
    CommandDelay(),
    CommandSaturation(),
    ThrustCurve(),
    MotorLag(),
    MotorLagAsymmetry(),
    MotorLagSpeed(),
    MotorLagSecond(),
    BatterySag(),
    RotorAsymmetry(),
    ThrustLevel(),
    AxialInflow(),
    TranslationalLift(),
    GroundEffect(),
    CenterOfMassOffset(),
    ProductsOfInertia(),
    PayloadMass(),
    RotorDrag(),
    LinearDrag(),
    ParasiticDrag(),
    SteadyWind(),
    BladeFlapping(),
    RotationalDamping(),
    RotorGyroscopic(),
    ConstantForce(),
    AccelerometerLeverArm(),
    ImuMisalignment(),
    PoseDelay(),
    RotorSpeedDelay(),
    MocapMisalignment(),
    PoseLeverArm(),
    AccelerometerScale(),
    GyroScale(),
    RotorSpeedScale(),
    AccelerometerBias(),
    GyroBias(),
    SensorDelay(),
)


def demand_parameters(
    effect: Effect, stated: Iterable[str], vehicle: Vehicle, *, where: str | None = None
) -> None:
    """Raises `UnknownNameError` where one of the `stated` parameters is none of the effect's."""
    names = [d.name for d in effect.parameters(vehicle)]
    derived = effect.derived(dict.fromkeys(names, 0.0), vehicle)  # follow from the others
    for short in stated:
        if short not in names and short not in derived:
            raise UnknownNameError(f"parameter of effect {effect.name}", short, names, where=where)


def effect_by_name(name: str, *, where: str | None = None) -> Effect:
    """The catalogue's effect of that name. Raises `UnknownNameError` with the nearest names."""
    for effect in CATALOGUE:
        if effect.name == name:
            return effect
    raise UnknownNameError("effect", name, (e.name for e in CATALOGUE), where=where)
