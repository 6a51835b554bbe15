"""Flights that suit a craft of any size: a controller as quick as its rotors allow, and excitation
that it can follow."""

from __future__ import annotations

from dataclasses import dataclass, replace

from greybox.excitation import Excitation, Lemniscate, Multisine, RandomWaypoints
from greybox.plants.controller import CascadeController, Gains
from greybox.plants.flight_log import Log, Plant, fly
from scenarios.foreign.craft import Craft

SAMPLE_TIME = 0.01
DURATION = 20.0
WARM_UP = 1.0
"""Seconds flown before a log begins."""
CENTER = (0.0, 0.0, 1.5)
"""Middle of the flights [m]."""
RATE_TIMES_LAG = 0.6
"""Rate gain times the loop's lag; 0.5 is the damping ratio 1/sqrt(2) of an ideal rotor, more is
quicker and rougher."""
SHARE_OF_AUTHORITY = 0.16
"""RMS of the roll and pitch excitation as a share of the angular acceleration that rotors give
between hover and stop."""
SHARE_OF_YAW_AUTHORITY = 0.15
BRISK = 0.035
"""Slowness of the loop [s] up to which the paths are flown as they are."""
STRONGEST = 14.0
"""Largest RMS of the roll and pitch excitation [rad/s^2]."""
STRONGEST_YAW = 4.0


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One flight: the path and how strongly it is excited (1 is a training flight)."""

    reference: RandomWaypoints | Lemniscate
    level: float


WAYPOINTS = RandomWaypoints(
    box=(1.5, 1.5, 0.5), center=CENTER, shortest=1.0, longest=1.9, speed=2.8, yaw_swing=0.6
)
CALMER = RandomWaypoints(
    box=(1.3, 1.3, 0.4), center=CENTER, shortest=1.0, longest=2.0, speed=2.6, yaw_swing=0.4
)
TRAIN = (Plan(reference=WAYPOINTS, level=1.0),) * 3
TEST = (
    Plan(reference=CALMER, level=0.6),
    Plan(
        reference=Lemniscate(radius=1.3, period=4.5, climb=0.3, center=CENTER, yaw_rate=0.3),
        level=0.4,
    ),
)


def slowness(craft: Craft) -> float:
    """Lag, delay and hold of the innermost loop [s]."""
    return craft.lag + craft.delay + 0.5 * SAMPLE_TIME


def gains_for(craft: Craft) -> Gains:
    """Loop gains for rotors that lag: every loop is a fixed part of the one inside it."""
    rate = min(18.0, RATE_TIMES_LAG / slowness(craft))
    return Gains(
        position=0.012 * rate**2,
        velocity=0.19 * rate,
        position_integral=0.04 * rate,
        height=0.05 * rate**2,
        climb=0.42 * rate,
        height_integral=0.1 * rate,
        attitude=0.38 * rate,
        yaw=0.16 * rate,
        rate=rate,
        yaw_rate=0.44 * rate,
        rate_integral=0.04 * rate**2,
        tilt_max=0.5,
    )


def excitation_for(craft: Craft, level: float) -> Excitation:
    """Orthogonal multisines on the mixer's inputs, of a size that leaves the rotors room to fly."""
    frame = craft.airframe
    pull = frame.mass * frame.gravity
    arms = [max(abs(rotor.position[axis]) for rotor in frame.rotors) for axis in (1, 0)]
    hover = float(frame.hover_speed)
    ratio = sum(c * hover**k for k, c in enumerate(frame.torque)) / (pull / len(frame.rotors))
    roll, pitch = (0.5 * pull * arm / j for arm, j in zip(arms, frame.inertia))
    yaw = 0.5 * pull * ratio / frame.inertia[2]

    def sines(rms: float, low: float, high: float, offset: int) -> Multisine:
        return Multisine(rms=level * rms, low=low, high=high, count=32, offset=offset, stride=4)

    return Excitation(
        mixer={
            "thrust": sines(0.9, 0.3, 6.0, 0),
            "roll": sines(min(STRONGEST, SHARE_OF_AUTHORITY * roll), 0.8, 8.0, 1),
            "pitch": sines(min(STRONGEST, SHARE_OF_AUTHORITY * pitch), 0.8, 8.0, 2),
            "yaw": sines(min(STRONGEST_YAW, SHARE_OF_YAW_AUTHORITY * yaw), 0.4, 5.0, 3),
        }
    )


def path_for(craft: Craft, plan: Plan) -> RandomWaypoints | Lemniscate:
    """The plan's path, stretched in time for a craft whose rotors are slower than BRISK."""
    slower = max(1.0, (slowness(craft) / BRISK) ** 0.5)
    path = plan.reference
    if isinstance(path, Lemniscate):
        return replace(path, period=slower * path.period)
    return replace(
        path,
        shortest=slower * path.shortest,
        longest=slower * path.longest,
        speed=path.speed / slower,
    )


def fly_plan(
    plant: Plant, craft: Craft, plan: Plan, seed: int, *, duration: float = DURATION
) -> Log:
    """The log of one flight with the true states as columns `true.<state>`."""
    controller = CascadeController(craft.airframe, gains_for(craft))
    excitation = excitation_for(craft, plan.level)
    return fly(
        plant,
        controller,
        path_for(craft, plan),
        excitation,
        duration,
        SAMPLE_TIME,
        seed,
        warm_up=WARM_UP,
        record=("truth",),
    )
