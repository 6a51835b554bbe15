"""The craft, its training flights and the task of `greybox mpc rates`. Fixed before any controller
was tuned.

The rates of a multirotor are nearly linear in its commands, except that thrust goes with the square
of rotor speed: a command turns the craft twice as hard at twice the speed. Flights that climb and
drop show it, a linear model cannot say it, and the process's inputs (rates, attitude, last
commands) can.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from greybox.excitation.injection import Excitation
from greybox.excitation.multisine import Multisine
from greybox.excitation.waypoints import RandomWaypoints
from greybox.plants.effects import CenterOfMassOffset, MotorLag, RotorDrag
from greybox.plants.flight_log import fly
from greybox.plants.presets import controller_for, x250
from greybox.plants.quadrotor import Quadrotor
from greybox.symbolic import FloatArray
from mpc_export.mission import TRAINING_SEEDS
from mpc_export.mission.craft import GUSTS

PLANT = "mpc_export.rates.craft:vehicle"
OUTPUTS = ("p", "q", "r")
CHANNELS = {
    "thrust": ((1.0, "u1"), (1.0, "u2"), (1.0, "u3"), (1.0, "u4")),
    "roll": ((-1.0, "u1"), (-1.0, "u2"), (1.0, "u3"), (1.0, "u4")),
    "pitch": ((-1.0, "u1"), (1.0, "u2"), (1.0, "u3"), (-1.0, "u4")),
    "yaw": ((-1.0, "u1"), (1.0, "u2"), (-1.0, "u3"), (1.0, "u4")),
}
"""Inputs of the linear model as sums of commands: all four directions, so that it misses nothing
that is linear."""
DT = 0.01
SECONDS, FLIGHTS = 20.0, 3
"""Length of a training flight [s], and how many."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """Random waypoints flown for `seconds`, every body rate within `limit` [rad/s]; farther than
    `lost` [m] is a crash."""

    limit: float = 2.5
    seconds: float = 8.0
    lost: float = 3.0
    path: RandomWaypoints = field(
        default_factory=lambda: RandomWaypoints(
            box=(2.0, 2.0, 1.2), speed=4.0, shortest=0.9, longest=1.8, yaw_swing=1.0
        )
    )


def vehicle() -> Quadrotor:
    """A 250 mm craft with motor lag, rotor drag, a centre of mass beside the middle and the gusts
    of the obstacle course."""
    effects = (
        MotorLag(tau=0.03),
        RotorDrag(k_x=4e-5, k_y=5e-5),
        CenterOfMassOffset(c_x=0.004, c_y=-0.003),
    )
    return x250(effects, process=GUSTS)


def excitation(climbs: float = 4.0) -> Excitation:
    """Multisines at the mixer: turns, and `climbs` [m/s^2 rms], by default enough to change the
    thrust by a fifth (rms)."""

    def sines(rms: float, low: float, high: float, offset: int) -> Multisine:
        return Multisine(rms=rms, low=low, high=high, count=32, offset=offset, stride=4)

    return Excitation(
        mixer={
            "thrust": sines(climbs, 0.3, 4.0, 0),
            "roll": sines(12.0, 0.8, 10.0, 1),
            "pitch": sines(12.0, 0.8, 10.0, 2),
            "yaw": sines(4.0, 0.4, 5.0, 3),
        }
    )


def training_log(
    index: int, seconds: float = SECONDS, plant: Quadrotor | None = None, climbs: float = 4.0
) -> dict[str, FloatArray]:
    """Columns of one training flight of `plant`, by default the craft."""
    plant = plant or vehicle()
    log = fly(
        plant,
        controller_for(plant),
        Task().path,
        excitation(climbs),
        seconds,
        dt=DT,
        seed=TRAINING_SEEDS[index],
        warm_up=1.0,
    )
    return {n: v for n, v in log.items() if not n.startswith("omega")}
