"""Motion from what a predictor of channels says: rates and specific force, or body velocity,
integrated to a pose.

Black boxes predict channels, not motion. So that they stand in the same multi-step table as models
of motion, their predictions go through the kinematics that every user of such a predictor would
add: attitude by integrating the predicted rate; velocity from the predicted body velocity, or else
by integrating the predicted specific force; position by integrating that velocity (trapezoidal
rule, as strapdown navigation does: Titterton and Weston 2004, ch. 3).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.signal

from greybox.data import Segment
from greybox.estimation.record import hold_missing
from greybox.frames import numeric
from greybox.symbolic import FloatArray, IntArray

IMU = ("p", "q", "r", "ax", "ay", "az")
QUATERNION = ("qw", "qx", "qy", "qz")
VELOCITY, POSITION = ("vx", "vy", "vz"), ("x", "y", "z")
BODY_VELOCITY = ("body_vx", "body_vy", "body_vz")
GRAVITY_DIRECTION = ("gravity_x", "gravity_y", "gravity_z")
WINDOW = 9
"""Samples of the one-sided quadratic from whose end the velocity is read where only the position is
measured."""


def black_box_view(segment: Segment) -> Segment:
    """The segment as a predictor of channels sees it: missing cells hold the last value; body
    velocity and direction of gravity in body axes are added where attitude, and velocity or
    position, are logged. Uses no later sample.

    Give it no channel that was smoothed with later samples.
    """
    values, _ = hold_missing(segment.matrix(segment.names))
    held = segment.replace(dict(zip(segment.names, values.T, strict=True)))
    if not _has(held, QUATERNION):
        return held
    q = held.matrix(QUATERNION)
    added = dict(zip(GRAVITY_DIRECTION, -numeric("matrix", q)[:, 6:9].T, strict=True))
    world = causal_velocity(held)
    if world is not None:
        added |= dict(zip(BODY_VELOCITY, numeric("rotate_inverse", q, world).T, strict=True))
    return held.replace(added)


def causal_velocity(segment: Segment) -> FloatArray | None:
    """World velocity (n, 3): as measured, or from the last `WINDOW` positions; None without
    either."""
    if _has(segment, VELOCITY):
        return segment.matrix(VELOCITY)
    if not _has(segment, POSITION):
        return None
    position = segment.matrix(POSITION)
    weights = scipy.signal.savgol_coeffs(
        WINDOW, 2, deriv=1, delta=segment.dt, pos=WINDOW - 1, use="dot"
    )
    before = np.vstack([np.repeat(position[:1], WINDOW - 1, axis=0), position])
    return np.asarray(
        np.stack([before[i : i + segment.n] for i in range(WINDOW)], axis=-1) @ weights
    )


def motion(
    view: Segment,
    origins: IntArray,
    names: Sequence[str],
    mean: FloatArray,
    variance: FloatArray,
    *,
    gravity: float,
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """(group -> predictions (m, H, dimension), group -> covariances (m, H, 3, 3)) from channels
    `names` (m, H, n_y).

    `view` (`black_box_view`) gives the pose and velocity at the origins. Groups as in
    `greybox.validation.groups`, as far as they follow from the channels; covariances only of what
    is predicted directly.
    """
    at = {n: i for i, n in enumerate(names)}
    m, steps = mean.shape[:2]
    groups: dict[str, FloatArray] = {}
    stated: dict[str, FloatArray] = {}
    if not {"p", "q", "r"} <= set(at):
        return groups, stated
    rows = [at[n] for n in IMU[:3]]
    groups["rate"], stated["rate"] = mean[..., rows], _diagonal(variance[..., rows])
    if not _has(view, QUATERNION):
        return groups, stated
    attitude = _attitude(view, origins, groups["rate"])
    groups["rotation"] = attitude[:, 1:]
    start = causal_velocity(view)
    if start is None:
        return groups, stated
    flat = attitude.reshape(-1, 4)
    if set(BODY_VELOCITY) <= set(at):
        rows = [at[n] for n in BODY_VELOCITY]
        own = numeric(
            "rotate", attitude[:, 1:].reshape(-1, 4), mean[..., rows].reshape(-1, 3)
        ).reshape(m, steps, 3)
        velocity = np.concatenate([start[origins][:, None], own], axis=1)
        turned = numeric("matrix", attitude[:, 1:].reshape(-1, 4)).reshape(m, steps, 3, 3)
        stated["velocity"] = turned @ _diagonal(variance[..., rows]) @ turned.swapaxes(-1, -2)
    elif set(IMU[3:]) <= set(at):
        force = np.concatenate(
            [view.matrix(IMU[3:])[origins][:, None], mean[..., [at[n] for n in IMU[3:]]]], axis=1
        )
        world = numeric("rotate", flat, force.reshape(-1, 3)).reshape(m, steps + 1, 3) - [
            0.0,
            0.0,
            gravity,
        ]
        velocity = start[origins][:, None] + _integral(world, view.dt)
    else:
        return groups, stated
    groups["velocity"] = velocity[:, 1:]
    if _has(view, POSITION):
        groups["position"] = (
            view.matrix(POSITION)[origins][:, None] + _integral(velocity, view.dt)
        )[:, 1:]
    return groups, stated


def _attitude(view: Segment, origins: IntArray, rate: FloatArray) -> FloatArray:
    """Attitude (m, H + 1, 4) at the origins and at the predicted rates (m, H, 3) after them."""
    rate = np.concatenate([view.matrix(IMU[:3])[origins][:, None], rate], axis=1)
    q = view.matrix(QUATERNION)[origins]
    attitude = np.empty((*rate.shape[:2], 4))
    attitude[:, 0] = q / np.linalg.norm(q, axis=1, keepdims=True)
    for h in range(rate.shape[1] - 1):
        turn = 0.5 * view.dt * (rate[:, h] + rate[:, h + 1])
        attitude[:, h + 1] = numeric("multiply", attitude[:, h], numeric("exp", turn))
    return attitude


def _integral(values: FloatArray, dt: float) -> FloatArray:
    """Trapezoidal integral along axis 1, zero at its start."""
    steps = 0.5 * dt * (values[:, 1:] + values[:, :-1])
    return np.concatenate([np.zeros_like(values[:, :1]), np.cumsum(steps, axis=1)], axis=1)


def _diagonal(variance: FloatArray) -> FloatArray:
    # A free run that diverges states a variance without bounds, from which no density can be
    # computed.
    return np.clip(variance, 1e-12, 1e6)[..., None] * np.eye(variance.shape[-1])


def _has(segment: Segment, names: Sequence[str]) -> bool:
    return all(n in segment.channels for n in names)
