"""A course is a fair judge: its limits bind, and its path asks for what the vehicle can do."""

import numpy as np
import pytest

from greybox.plants.flight_log import fly
from greybox.plants.presets import controller_for
from mpc_export.mission import JUDGING_SEEDS, OBSTACLE_COURSE, TRAINING_SEEDS
from mpc_export.mission.craft import vehicle

TIME = np.arange(0.0, OBSTACLE_COURSE.duration, 0.01)
REFERENCE = OBSTACLE_COURSE.sample(TIME)


def test_the_reference_asks_for_a_little_more_than_three_planes_allow_and_keeps_the_fourth():
    nearest = {
        name: margin.min() for name, margin in OBSTACLE_COURSE.margins(REFERENCE.position).items()
    }
    beside = nearest.pop("gap, near side")
    assert 0.1 < beside < 0.2
    assert all(-0.03 < margin < -0.01 for margin in nearest.values())


def test_planes_end_where_they_are_said_to_end():
    gap = next(p for p in OBSTACLE_COURSE.planes if p.name == "gap, far side")
    inside, before = np.array([3.2, 1.0, 1.0]), np.array([3.2, 0.7, 1.0])
    assert gap.margin(inside) == pytest.approx(-0.22)
    assert gap.margin(before) == np.inf
    assert gap.exists(before, reach=0.15)


def test_derivatives_of_the_reference_are_those_of_its_path():
    step = 1e-4
    ahead, behind = OBSTACLE_COURSE.sample(TIME + step), OBSTACLE_COURSE.sample(TIME - step)
    np.testing.assert_allclose(
        (ahead.position - behind.position) / (2 * step), REFERENCE.velocity, atol=1e-6
    )
    np.testing.assert_allclose(
        (ahead.velocity - behind.velocity) / (2 * step), REFERENCE.acceleration, atol=3e-3
    )
    np.testing.assert_allclose((ahead.yaw - behind.yaw) / (2 * step), REFERENCE.yaw_rate, atol=1e-6)


def test_the_reference_needs_less_tilt_than_is_allowed():
    a = REFERENCE.acceleration + np.array((0.0, 0.0, 9.80665))
    tilt = np.arctan2(np.hypot(a[:, 0], a[:, 1]), a[:, 2])
    assert 0.6 < tilt.max() < OBSTACLE_COURSE.tilt_max


def test_seeds_that_judge_are_apart_from_seeds_that_teach():
    assert not set(TRAINING_SEEDS) & set(JUDGING_SEEDS)
    assert len(JUDGING_SEEDS) >= 200


def test_gusts_push_a_cascade_controller_mostly_across_a_plane_but_not_out_of_the_sky():
    plant = vehicle()
    log = fly(
        plant,
        controller_for(plant),
        OBSTACLE_COURSE,
        None,
        OBSTACLE_COURSE.duration,
        seed=list(TRAINING_SEEDS[:8]),
        record=("truth",),
    )
    position = np.stack([log["true.x"], log["true.y"], log["true.z"]], axis=-1)
    away = np.linalg.norm(position - REFERENCE.position[:, None], axis=-1)
    assert away.max() < OBSTACLE_COURSE.lost
    worst = np.min([m.min(axis=0) for m in OBSTACLE_COURSE.margins(position).values()], axis=0)
    assert np.mean(worst < 0.0) >= 0.5
