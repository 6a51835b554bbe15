"""Missions: courses with limits that controllers fly, many seeded flights each, and what they say
together.

`greybox mpc` is its command. Nothing here knows a simulated vehicle: a plant is the identified
model itself or whatever `module:attribute` names.
"""

from mpc_export.mission.course import Course, Leg, Plane, SampledPath
from mpc_export.mission.obstacle_course import (
    JUDGING_SEEDS,
    OBSTACLE_COURSE,
    TRAINING_SEEDS,
    judging,
)

__all__ = [
    "JUDGING_SEEDS",
    "OBSTACLE_COURSE",
    "TRAINING_SEEDS",
    "Course",
    "Leg",
    "Plane",
    "SampledPath",
    "judging",
]
