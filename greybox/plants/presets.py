"""Ready-made vehicles and controllers: `nano()`, `x250()`, `duckiedrone()` give a plant,
`controller_for` flies it.

Numbers are of the size that public data sheets and papers give for vehicles of the class; none is a
measurement of a particular one.
"""

from __future__ import annotations

from collections.abc import Sequence

from greybox.plants.airframe import Airframe, plus_layout, x_layout
from greybox.plants.battery import Battery
from greybox.plants.controller import CascadeController, Gains
from greybox.plants.effects import (
    AccelerometerBias,
    AccelerometerScale,
    BatterySag,
    BladeFlapping,
    GroundEffect,
    GyroBias,
    GyroScale,
    MotorLag,
    PlantEffect,
    ProductsOfInertia,
    RotorDrag,
    ThrustCurve,
)
from greybox.plants.noise import ProcessNoise, SensorNoise
from greybox.plants.quadrotor import Quadrotor

NANO = Airframe(
    name="nano quadrotor, 28 g, X",
    mass=0.0282,
    inertia=(1.43e-5, 1.43e-5, 2.89e-5),
    rotors=x_layout(0.0325, 0.0325),
    thrust=(0.0, 0.0, 0.14375),
    torque=(0.0, 0.0, 9.75e-4),
    speed_max=2500.0,
    rotor_radius=0.0231,
    nominal_voltage=3.8,
)
X250 = Airframe(
    name="250 mm quadrotor, 0.5 kg, X",
    mass=0.5,
    inertia=(2.1e-3, 2.4e-3, 3.9e-3),
    rotors=x_layout(0.088, 0.088),
    thrust=(0.0, 0.0, 4.2),
    torque=(0.0, 0.0, 0.055),
    speed_max=2300.0,
    rotor_radius=0.0635,
    nominal_voltage=11.1,
)
DUCKIEDRONE = Airframe(
    name="plus quadrotor, 0.9 kg",
    mass=0.9,
    inertia=(8.0e-3, 8.5e-3, 1.45e-2),
    rotors=plus_layout(0.15),
    thrust=(0.0, 0.0, 6.3),
    torque=(0.0, 0.0, 0.095),
    speed_max=1250.0,
    rotor_radius=0.0635,
    nominal_voltage=11.1,
)

NANO_SENSORS = SensorNoise(
    gyro=0.015,
    accelerometer=0.08,
    attitude=0.002,
    position=0.001,
    velocity=0.01,
    voltage=0.002,
    rotor_speed=5.0,
)
LARGE_SENSORS = SensorNoise(
    gyro=0.01,
    accelerometer=0.1,
    attitude=0.003,
    position=0.003,
    velocity=0.02,
    voltage=0.005,
    rotor_speed=3.0,
)
MEMS = SensorNoise(
    gyro=0.01,
    accelerometer=0.05,
    attitude=0.003,
    position=0.003,
    velocity=0.02,
    voltage=0.005,
    rotor_speed=3.0,
)
"""A small IMU on a soft mount; what a low-cost estimator makes of attitude and position."""
CALM = ProcessNoise(force=0.0005 * 0.9, torque=(0.01 * 8.0e-3, 0.01 * 8.5e-3, 0.01 * 1.45e-2))
"""Still air for `DUCKIEDRONE`: 0.0005 m/s^2 and 0.01 rad/s^2 per root hertz."""
EVERYDAY: tuple[PlantEffect, ...] = (
    ThrustCurve(f=0.35),
    BatterySag(nominal_voltage=11.1, c_V=1.0),
    MotorLag(tau=0.045),
    GroundEffect(rotor_radius=0.0635, k=2.0),
    RotorDrag(k_x=1.5e-4, k_y=1.8e-4),
    BladeFlapping(k_flap=1e-5),
    ProductsOfInertia(Jxy=8e-4, Jxz=6e-4, Jyz=-5e-4),
    AccelerometerScale(s_x=0.02, s_y=-0.015, s_z=0.01),
    AccelerometerBias(b_x=0.08, b_y=-0.05, b_z=0.1),
    GyroScale(s_x=0.01, s_y=-0.01, s_z=0.015),
    GyroBias(b_x=0.008, b_y=-0.005, b_z=0.004),
)
"""What a home-made `DUCKIEDRONE` has besides a rigid body: see docs/studies/paper_experiment.md."""

DEFAULT = Gains()
SOFT = Gains(
    position=2.0, velocity=2.4, position_integral=0.3, attitude=5.0, rate=12.0, rate_integral=6.0
)
STIFF = Gains(
    position=6.0, velocity=4.5, position_integral=1.2, attitude=9.0, rate=24.0, rate_integral=20.0
)


def _process(airframe: Airframe) -> ProcessNoise:
    """Process noise that moves any vehicle alike: 0.01 m/s^2 and 0.05 rad/s^2 per root hertz."""
    return ProcessNoise(
        force=0.01 * float(airframe.mass),
        torque=(
            0.05 * float(airframe.inertia[0]),
            0.05 * float(airframe.inertia[1]),
            0.05 * float(airframe.inertia[2]),
        ),
    )


def nano(
    effects: Sequence[PlantEffect] = (),
    *,
    sensors: SensorNoise | None = None,
    process: ProcessNoise | None = None,
) -> Quadrotor:
    """A 28 g quadrotor in X, hovering at u = 0.69, with a single-cell battery."""
    battery = Battery(
        full=4.15, empty=3.3, capacity=900.0, resistance=0.03, idle_current=0.1, full_current=9.0
    )
    return Quadrotor(
        NANO,
        effects,
        battery=battery,
        sensors=sensors or NANO_SENSORS,
        process=process or _process(NANO),
    )


def x250(
    effects: Sequence[PlantEffect] = (),
    *,
    sensors: SensorNoise | None = None,
    process: ProcessNoise | None = None,
) -> Quadrotor:
    """A 0.5 kg quadrotor with 250 mm between opposite motors, hovering at u = 0.54, three cells."""
    battery = Battery(
        full=12.5, empty=10.2, capacity=4700.0, resistance=0.03, idle_current=0.4, full_current=60.0
    )
    return Quadrotor(
        X250,
        effects,
        battery=battery,
        sensors=sensors or LARGE_SENSORS,
        process=process or _process(X250),
    )


def duckiedrone(
    effects: Sequence[PlantEffect] = (),
    *,
    sensors: SensorNoise | None = None,
    process: ProcessNoise | None = None,
) -> Quadrotor:
    """A 0.9 kg quadrotor in plus, rotor 1 in front, hovering at u = 0.59, three cells."""
    battery = Battery(
        full=12.5,
        empty=10.2,
        capacity=7900.0,
        resistance=0.025,
        idle_current=0.8,
        full_current=55.0,
    )
    return Quadrotor(
        DUCKIEDRONE,
        effects,
        battery=battery,
        sensors=sensors or LARGE_SENSORS,
        process=process or _process(DUCKIEDRONE),
    )


def controller_for(
    plant: Quadrotor, gains: Gains | None = None, *, feedback: str = "measured"
) -> CascadeController:
    """A cascade controller that knows the plant's airframe but none of its effects."""
    return CascadeController(plant.airframe, gains, feedback=feedback)
