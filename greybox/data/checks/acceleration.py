"""Relation of the velocity to the specific force: its change over a time is the integral of the
specific force, turned into the world by the attitude, less gravity.

It sees a world frame that is turned, mirrored or upside down against the attitude, and an
accelerometer in world or other body axes. Without an accelerometer the thrust that the commands
give stands for it, up to its size, to how much it changes and to drag; without a velocity the
position does. A point of the craft that is off its centre of mass moves with every turn, too, which
is no other frame: another reading must also be better where what these add is set aside. Another
reading of the accelerometer must be better by the gyro's attitude (`witness.py`), too: an
estimator's errs with what it feels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import lsq_linear

from greybox.data.checks.attitude import MEND, quaternion_readings
from greybox.data.checks.kinematics import Relation, Streams
from greybox.data.checks.motion import in_body_axes
from greybox.data.checks.relations import Reading
from greybox.data.checks.signals import (
    BRIDGED,
    FloatArray,
    Integral,
    attitude_joined_up,
    derivative,
    integral,
    pace,
    turned,
)
from greybox.data.checks.spans import Spans, length_of, spans
from greybox.data.checks.view import View
from greybox.data.checks.witness import by_gyro
from greybox.data.direction import axis_of_thrust
from greybox.frames import GRAVITY

SPAN = 0.4
"""Time [s] over which changes of velocity are taken, and longer where streams are slow."""
HALF_WINDOW = 0.05
"""A velocity from the position is its difference over twice this time [s], or two samples."""

MOST_DRAG = 1.0
"""Share of its speed that the air takes from a craft in a second [1/s], at most."""

DOWN = "z is down, in the body (FRD) and in the world (NED)"
FRAMES_DOWN = (
    "set frame = 'FRD/NED' in [columns.attitude], 'FRD' in [columns.rate], and 'NED' in "
    "[columns.position] and [columns.velocity]; the order of the motors may then be right"
)

ABOUT_THRUST = {
    "ax = ay, ay = -ax": ((0.0, 1.0), (-1.0, 0.0)),
    "ax = -ay, ay = ax": ((0.0, -1.0), (1.0, 0.0)),
    "ax = -ax, ay = -ay": ((-1.0, 0.0), (0.0, -1.0)),
    "ax = ay, ay = ax": ((0.0, 1.0), (1.0, 0.0)),
    "ax = -ay, ay = -ax": ((0.0, -1.0), (-1.0, 0.0)),
    "ax = -ax": ((-1.0, 0.0), (0.0, 1.0)),
    "ay = -ay": ((1.0, 0.0), (0.0, -1.0)),
}
"""Axes of an accelerometer whose z is right: those that gravity does not show."""


def streams(view: View) -> Streams | str:
    """Change of velocity against integrated specific force, in the readings of both.

    Means are left out: a bias, or an attitude that is off by a few degrees.
    """
    force = _specific_force(view)
    if isinstance(force, str):
        return force
    dt, quaternions = view.dt, view.group("attitude")
    measured, moving = view.has("specific_force"), view.has("velocity")
    track = view.group("velocity" if moving else "position")
    n = length_of(SPAN / dt, between=track, of=force)
    quaternions = attitude_joined_up(quaternions, n // BRIDGED)
    half = max(1, round(HALF_WINDOW / dt))
    window = 0 if moving else 2 * max(half, pace(track))
    at = spans(track, n, window=window, dt=dt, centred=True)
    change, times = at.of(track), 1 if moving else 2

    def reading(text: str, fix: str, world: FloatArray) -> Reading:
        return Reading(text=text, fix=fix, y=change, x=integral(world, dt, n // BRIDGED, times))

    readings = [reading(*r) for r in _worlds(quaternions, force, measured)]
    if moving:
        for text, fix, body in in_body_axes(track):
            moved = at.of(turned("rotate", quaternions, body))
            readings.append(Reading(text=text, fix=fix, y=moved, x=readings[0].x))

    def witness() -> tuple[Reading, ...]:
        turned_by = by_gyro(quaternions, view.group("rate"), dt, n // BRIDGED)
        return tuple(reading(*r) for r in _forces(turned_by, force))

    def apart() -> tuple[Reading, ...]:
        arms = _body_axes(quaternions)
        if moving:
            arms = [derivative(a, dt, pace(view.group("attitude"))) for a in arms]
        y = change
        if not measured:  # an accelerometer feels it
            way = integral(track - np.nanmean(track, axis=0), dt, n // BRIDGED)
            varied = turned("rotate", quaternions, force - np.nanmean(force, axis=0))
            more = integral(varied, dt, n // BRIDGED, times)
            y = _as_if_felt(at, y, readings[0].x, [at.over(way), at.over(more)], half)
        y = _without_lever_arm(at, y, readings[0].x, [at.of(a) for a in arms], half)
        return tuple(replace(r, y=y) if r.y is change else r for r in readings)

    return Streams(
        readings=tuple(readings),
        apart=apart,
        suspects=tuple(text for text, _, _ in _forces(quaternions, force) if text and measured),
        witness=witness if measured and view.has("rate") else None,
        axes=("the world's x", "y", "z"),
        spans=at,
        power=-1.0 if moving else -2.0,
        scaled=measured,
        where=f"{'vx, vy, vz' if moving else 'x, y, z'} against {'ax..az' if measured else 'u1..'} "
        "with qw..qz",
    )


def _specific_force(view: View) -> FloatArray | str:
    """Specific force (N, 3), that of the rotors where none is measured, or why it tells nothing of
    the motion."""
    if not view.has("attitude"):
        return "no attitude"
    if not (view.has("velocity") or view.has("position")):
        return "no velocity or position"
    if not view.has("specific_force"):
        return _thrust(view)
    force = view.group("specific_force")
    axis = axis_of_thrust(force)
    if axis == "+z":
        return force
    # A force upside down looks like a world that is mirrored, one without gravity like a world that
    # is turned.
    what = "the accelerometer's z is not up" if axis else "the force has no lasting direction"
    return f"{what} (see gravity)"


def _worlds(
    quaternions: FloatArray, force: FloatArray, measured: bool
) -> Iterator[tuple[str, str, FloatArray]]:
    """(what is wrong, its fix, specific force in the world (N, 3)) of every reading of quaternions
    (N, 4) and force (N, 3), the right one first; the axes of a force that was not `measured` are
    those of the thrust."""
    for text, read in quaternion_readings(quaternions):
        yield text, MEND, turned("rotate", read, force)
    if measured:
        _, *others = _forces(quaternions, force)
        yield from others
    else:
        yield DOWN, FRAMES_DOWN, turned("rotate", quaternions, -force)


BODY_AXES = "log ax, ay, az as the accelerometer measures them, in body axes (forward, left, up)"


def _forces(quaternions: FloatArray, force: FloatArray) -> Iterator[tuple[str, str, FloatArray]]:
    """As `_worlds`, of the readings of the accelerometer alone."""
    yield "", MEND, turned("rotate", quaternions, force)
    world = f"set frame = 'ENU' (or 'NED') in [columns.specific_force], or {BODY_AXES}"
    yield "the specific force is in world axes", world, force
    up = np.tile([0.0, 0.0, GRAVITY], (len(force), 1))
    fix = "set or drop frame = 'ENU' (or 'NED') beside gravity = false in [columns.specific_force]"
    # What was put back is taken out again: the axes were wrong, gravity was not.
    as_body = force - turned("rotate_inverse", quaternions, up) + up
    yield "the acceleration without gravity is in world axes", fix, as_body
    as_world = turned("rotate", quaternions, turned("rotate", quaternions, force) - up) + up
    yield "the acceleration without gravity is in body axes", fix, as_world
    fix = BODY_AXES
    for text, matrix in ABOUT_THRUST.items():
        other = np.column_stack([force[:, :2] @ np.array(matrix).T, force[:, 2]])
        yield f"the accelerometer's {text}", fix, turned("rotate", quaternions, other)


def _body_axes(quaternions: FloatArray) -> list[FloatArray]:
    """Where points one metre along each body axis are from the centre of mass, in the world, (N, 3)
    each."""
    return [turned("rotate", quaternions, np.tile(e, (len(quaternions), 1))) for e in np.eye(3)]


def _without_lever_arm(
    at: Spans, change: FloatArray, integrated: Integral, arms: Sequence[FloatArray], late: int
) -> FloatArray:
    """A change of velocity (M, 3) less that of a point off the centre of mass.

    Its place is found by least squares beside any matrix times what is `integrated`, and how that
    changes over `late` samples either way, so that no frame, factor or delay is taken for a place.
    `arms` (M, 3) is what a metre along each body axis adds.
    """
    told = at.over(integrated)
    drift = at.over(integrated, late) - at.over(integrated, -late)
    axes = np.stack(arms, axis=2)
    known = np.isfinite(np.column_stack([change, told, drift, axes.reshape(-1, 9)]))
    rows = np.flatnonzero(known.all(axis=1))
    if not rows.size:
        return change
    beside = at.without_bias(np.column_stack([told, drift])[rows], rows)
    basis, size, _ = np.linalg.svd(beside, full_matrices=False)
    basis = basis[:, size > 1e-9 * size[0]]

    def left(values: FloatArray) -> FloatArray:
        return np.asarray(values - basis @ (basis.T @ values))

    moved = np.concatenate([left(axes[rows, i]) for i in range(3)])
    wanted = left(at.without_bias(change[rows], rows))
    place = np.linalg.lstsq(moved, wanted.T.ravel(), rcond=None)[0]
    return np.asarray(change - axes @ place)


def _as_if_felt(
    at: Spans, change: FloatArray, integrated: Integral, felt: Sequence[FloatArray], late: int
) -> FloatArray:
    """A change of velocity (M, 3) less what an accelerometer feels besides the thrust that is told:
    of `felt` (M, 3) each the rate of a drag times the way, and how much more the thrust changes.

    On a circle drag is a turn of the frame, and so is a delay; a thrust that changes less than told
    looks like one about a level axis. As much is left to them as a craft can have, by least squares
    beside what is `integrated` and how that changes over `late` samples either way.
    """
    parts = [at.over(integrated), at.over(integrated, late) - at.over(integrated, -late), *felt]
    rows = np.flatnonzero(np.isfinite(np.column_stack([change, *parts])).all(axis=1))
    if not rows.size:
        return change
    told = np.column_stack([at.without_bias(p[rows], rows).ravel() for p in parts])
    size = np.linalg.norm(told, axis=0)
    size[size == 0.0] = 1.0
    limits = np.array([(0.0, np.inf), (-np.inf, np.inf), (-MOST_DRAG, 0.0), (-1.0, 1.0)])
    found = lsq_linear(
        told / size,
        at.without_bias(change[rows], rows).ravel(),
        (limits * size[:, None]).T,
    )
    drag, more = (found.x / size)[2:]
    return np.asarray(change - drag * felt[0] - more * felt[1])


def _thrust(view: View) -> FloatArray:
    """What the commands push along the body's z, as if it carried the weight on average (N, 3)."""
    lift = (view.drive**2).sum(axis=1)
    mean = float(np.nanmean(lift)) if np.isfinite(lift).any() else 0.0
    out = np.zeros((lift.size, 3))
    out[:, 2] = lift / mean * view.vehicle.gravity if mean > 0 else np.nan
    return out


RELATION = Relation(
    name="acceleration",
    streams="velocity and specific force",
    factor="the velocity changes {0} times as much as the specific force says",
    where="vx, vy, vz against ax..az with qw..qz",
    fix="say the frame of position, velocity and attitude in [columns.position] and so on: NED, or "
    "ours (east, north, up)",
    least=0.05,
    much=0.4,
    units=((1e3, "the position or velocity is in mm", "set its unit = 'mm' in [columns]"),),
    blocking=1.7,
    streams_of=streams,
)
