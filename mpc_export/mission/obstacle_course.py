"""A dash toward a wall, a narrow gap, a low ceiling. Fixed before any controller was tuned.

The reference asks for 2 cm more than the wall, one side of the gap and the ceiling allow, so that
they bind: whoever plans up to a limit crosses it in every other gust.
"""

from __future__ import annotations

from mpc_export.mission.course import Course, Leg, Plane

TRAINING_SEEDS = range(100)
"""Seeds of flights that a model or a controller may learn from or be tuned on."""
JUDGING_SEEDS = range(1000, 1400)
"""Seeds of flights that judge."""


def judging(count: int, seed: int) -> range:
    """`count` seeds of flights that judge; another `seed` of a command gives others."""
    first = JUDGING_SEEDS[0] * (1 + seed)
    return range(first, first + count)


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
        Plane(
            name="gap, near side",
            normal=(-1.0, 0.0, 0.0),
            offset=-2.86,
            where={0: (2.0, 10.0), 1: (0.8, 1.2)},
        ),
        Plane(
            name="gap, far side",
            normal=(1.0, 0.0, 0.0),
            offset=2.98,
            where={0: (2.0, 10.0), 1: (0.8, 1.2)},
        ),
        Plane(
            name="ceiling",
            normal=(0.0, 0.0, 1.0),
            offset=1.48,
            where={0: (-0.5, 1.5), 1: (1.2, 10.0)},
        ),
    ),
    tilt_max=0.85,
    command_min=0.05,
    command_max=0.95,
    lost=1.5,
)
