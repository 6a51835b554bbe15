"""Predicted channels integrated to a pose, on a motion that is known; and a view of a flight that
knows no later sample."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.baselines.kinematics import (
    BODY_VELOCITY,
    GRAVITY_DIRECTION,
    IMU,
    black_box_view,
    causal_velocity,
    motion,
)
from greybox.data import Segment
from greybox.frames import numeric

DT, G, N = 0.01, 9.81, 300


@pytest.fixture(scope="module")
def known():
    """A slow roll and pitch on a curve: attitude, rate, position, velocity and specific force
    belong together."""
    t = DT * np.arange(N)
    q = numeric("from_euler", np.stack([0.3 * np.sin(2 * t), 0.2 * np.cos(t), 0.5 * t], axis=1))
    turn = numeric("difference", q[:-1], q[1:]) / DT  # mean rate of every step, body axes
    rate = np.vstack([turn[:1], 0.5 * (turn[1:] + turn[:-1]), turn[-1:]])
    x = np.stack([np.sin(t), 0.5 * t**2, 1 + 0.2 * np.cos(2 * t)], axis=1)
    v = np.stack([np.cos(t), t, -0.4 * np.sin(2 * t)], axis=1)
    a = np.stack([-np.sin(t), np.ones(N), -0.8 * np.cos(2 * t)], axis=1)
    f = numeric("rotate_inverse", q, a + np.array([0, 0, G]))
    columns = dict(zip(("qw", "qx", "qy", "qz"), q.T)) | dict(zip("xyz", x.T))
    columns |= dict(zip(IMU, np.hstack([rate, f]).T))
    return Segment(t=t, channels=columns, flight="known"), q, x, v


def ahead(view, names, origins, steps):
    rows = np.asarray(origins)[:, None] + np.arange(1, steps + 1)
    return view.matrix(names)[rows], np.full((len(origins), steps, len(names)), 1e-4)


def test_perfect_channels_give_the_motion_back(known):
    segment, q, x, v = known
    view, origins = black_box_view(segment), np.array([20, 100])
    rows = origins[:, None] + np.arange(1, 51)
    for names in (IMU, (*IMU, *BODY_VELOCITY, *GRAVITY_DIRECTION)):
        groups, stated = motion(view, origins, names, *ahead(view, names, origins, 50), gravity=G)
        angle = np.linalg.norm(
            numeric("difference", groups["rotation"].reshape(-1, 4), q[rows].reshape(-1, 4)), axis=1
        )
        assert angle.max() < 2e-3
        assert groups["velocity"] == pytest.approx(v[rows], abs=6e-3)
        assert groups["position"] == pytest.approx(x[rows], abs=4e-3)
        assert np.array_equal(groups["rate"], view.matrix(("p", "q", "r"))[rows])
        assert ("velocity" in stated) == (len(names) > 6)
    assert stated["velocity"] == pytest.approx(
        np.broadcast_to(1e-4 * np.eye(3), (2, 50, 3, 3)), abs=1e-12
    )


def test_only_rates_are_no_more_than_an_attitude(known):
    segment, *_ = known
    view = black_box_view(segment)
    groups, _ = motion(view, np.array([5]), IMU[:3], *ahead(view, IMU[:3], [5], 10), gravity=G)
    assert set(groups) == {"rate", "rotation"}


def test_a_diverged_spread_still_has_a_density(known):
    segment, *_ = known
    view = black_box_view(segment)
    mean, variance = ahead(view, IMU, [5], 3)
    variance[0, 2] = np.inf
    _, stated = motion(view, np.array([5]), IMU, mean, variance, gravity=G)
    assert np.isfinite(np.linalg.cholesky(stated["rate"])).all()


def test_the_view_uses_no_later_sample(known):
    segment, *_ = known
    changed = segment.replace(
        {n: np.where(np.arange(N) > 150, 0.5, c) for n, c in segment.channels.items()}
    )
    before, after = black_box_view(segment), black_box_view(changed)
    for n in before.names:
        assert np.array_equal(before.channels[n][:151], after.channels[n][:151]), n
    assert set(BODY_VELOCITY) | set(GRAVITY_DIRECTION) <= set(before.names)


def test_the_velocity_from_positions_is_that_of_the_motion(known):
    segment, _, _, v = known
    assert causal_velocity(segment)[20:] == pytest.approx(v[20:], abs=2e-3)


def test_missing_cells_hold_the_last_value():
    p = np.array([1.0, np.nan, np.nan, 4.0])
    view = black_box_view(Segment(t=DT * np.arange(4), channels={"p": p}))
    assert view.channels["p"].tolist() == [1.0, 1.0, 1.0, 4.0]
