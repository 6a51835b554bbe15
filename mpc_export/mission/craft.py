"""The craft that flies the obstacle course: gusts and hidden effects. Fixed before any controller
was tuned.

The 250 mm vehicle has what home-made ones have and a data sheet does not say: motor lag, rotor
drag, drag of its body, blade flapping, and a centre of mass beside the middle. Its gusts are
Gauss-Markov forces of 1 m/s^2 (rms per axis) with a correlation time of 0.4 s.
"""

from __future__ import annotations

from greybox.plants.effects import (
    BladeFlapping,
    CenterOfMassOffset,
    MotorLag,
    ParasiticDrag,
    RotorDrag,
)
from greybox.plants.noise import ProcessNoise
from greybox.plants.presets import X250, x250
from greybox.plants.quadrotor import Quadrotor

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
