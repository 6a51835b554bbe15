"""Courses that a controller has to fly: a path, limits that bind along it, gusts, and the seeds that judge."""

from scenarios.courses.course import Course, Leg, Plane
from scenarios.courses.obstacle_course import GUSTS, JUDGING_SEEDS, OBSTACLE_COURSE, TRAINING_SEEDS, vehicle

__all__ = ["GUSTS", "JUDGING_SEEDS", "OBSTACLE_COURSE", "TRAINING_SEEDS", "Course", "Leg", "Plane", "vehicle"]
