"""A dash toward a wall, a narrow gap, a low ceiling; gusts and hidden effects. Fixed before any controller was tuned.

The 250 mm vehicle has what home-made ones have and a data sheet does not say: motor lag, rotor drag, drag of its body,
blade flapping, and a centre of mass beside the middle. Its gusts are Gauss-Markov forces of 1 m/s^2 (rms per axis) with a
correlation time of 0.4 s. The reference asks for 2 cm more than the wall, one side of the gap and the ceiling allow, so that
they bind: whoever plans up to a limit crosses it in every other gust.
"""

from __future__ import annotations

from scenarios.courses.course import Course, Leg, Plane
from scenarios.plants.effects import BladeFlapping, CenterOfMassOffset, MotorLag, ParasiticDrag, RotorDrag
from scenarios.plants.noise import ProcessNoise
from scenarios.plants.presets import X250, x250
from scenarios.plants.quadrotor import Quadrotor

TRAINING_SEEDS = range(100)
"""Seeds of flights that a model or a controller may learn from or be tuned on."""
JUDGING_SEEDS = range(1000, 1400)
"""Seeds of flights that judge."""

_GUST_TIME = 0.4
_GUST = 1.0 * float(X250.mass)

GUSTS = ProcessNoise(
    force=0.01 * float(X250.mass),
    torque=(
        0.1 * float(X250.inertia[0]),
        0.1 * float(X250.inertia[1]),
        0.1 * float(X250.inertia[2]),
    ),
    drift_force=_GUST * (2.0 / _GUST_TIME) ** 0.5,
    drift_time=_GUST_TIME,
)
"""White noise as in calm air, ten times the torque, and gusts."""

OBSTACLE_COURSE = Course(
    start=(0.0, 0.0, 1.0, 0.0),
    wait=0.5,
    legs=(
        Leg(to=(3.0, 0.0, 1.0, 0.0), time=1.4, hold=0.2),
        Leg(to=(3.0, 2.0, 1.0, 0.0), time=1.4, hold=0.2),
        Leg(to=(0.5, 2.0, 1.5, 1.0), time=1.6, hold=0.2),
        Leg(to=(0.0, 0.0, 1.0, 0.0), time=1.7, hold=0.8),
    ),
    planes=(
        Plane(name="wall", normal=(1.0, 0.0, 0.0), offset=2.98, where={1: (-10.0, 0.7)}),
        Plane(name="gap, near side", normal=(-1.0, 0.0, 0.0), offset=-2.86, where={0: (2.0, 10.0), 1: (0.8, 1.2)}),
        Plane(name="gap, far side", normal=(1.0, 0.0, 0.0), offset=2.98, where={0: (2.0, 10.0), 1: (0.8, 1.2)}),
        Plane(name="ceiling", normal=(0.0, 0.0, 1.0), offset=1.48, where={0: (-0.5, 1.5), 1: (1.2, 10.0)}),
    ),
    tilt_max=0.85,
    command_min=0.05,
    command_max=0.95,
    lost=1.5,
)


def vehicle(process: ProcessNoise = GUSTS) -> Quadrotor:
    """The plant with its hidden effects; `process` are its gusts."""
    return x250(
        (
            MotorLag(tau=0.04),
            RotorDrag(k_x=4e-5, k_y=5e-5),
            ParasiticDrag(c_x=0.02, c_y=0.025, c_z=0.03),
            BladeFlapping(k_flap=8e-6),
            CenterOfMassOffset(c_x=0.004, c_y=-0.003),
        ),
        process=process,
    )
