"""Relation of the attitude to the gyro: the turn over a time is the integral of the body rate.

It sees quaternion order and direction (body to world), gyro axes and unit, and a gyro in world
axes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.checks.kinematics import Relation, Streams
from greybox.data.checks.relations import Reading
from greybox.data.checks.signals import (
    BRIDGED,
    FloatArray,
    attitude_joined_up,
    integral,
    turned,
    turns_between,
)
from greybox.data.checks.spans import length_of, spans
from greybox.data.checks.view import View
from greybox.data.readers.assemble import other_frame
from greybox.data.readers.recording import FRAMES

SPAN = 0.2
"""Time [s] over which turns are taken, and longer where streams are slow."""
DEGREES = 180.0 / np.pi
MEND = (
    "correct the order or the signs of the quaternion in [columns.attitude] (body to world, "
    "scalar first)"
)

ORDERS = {
    "": (0, 1, 2, 3),
    "the scalar comes last: the columns hold x, y, z, w": (3, 0, 1, 2),
    "the columns named qx, qy, qz, qw hold w, x, y, z": (1, 2, 3, 0),
}
CONJUGATE = (
    "the quaternion turns world into body: negate qx, qy, qz (of a matrix, swap rows and columns)"
)


def quaternion_readings(quaternions: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    """(what it would mean, quaternions (N, 4)) of the readings of quaternions (N, 4), the one given
    first. Columns are read another way before their frame is turned to ours, whichever it was."""
    yield "", quaternions
    for frame in FRAMES["attitude"]:
        logged = other_frame(quaternions, "attitude", frame)
        for sign, inverse in ((1.0, ""), (-1.0, CONJUGATE)):
            for text, order in ORDERS.items():
                if text or inverse:
                    read = logged[:, order] * np.array([1.0, sign, sign, sign])
                    said = "; ".join(part for part in (text, inverse) if part)
                    yield said, other_frame(read, "attitude", frame)


def streams(view: View) -> Streams | str:
    """Turns of the attitude against the integrated gyro, for every reading of the quaternion, and
    against that of a gyro in other axes. Means are left out: a gyro has a bias."""
    if not view.has("attitude", "rate"):
        return "no attitude" if view.has("rate") else view.lacks("rate", "gyro")
    gyro, quaternions = view.group("rate"), view.group("attitude")
    n = length_of(SPAN / view.dt, between=quaternions, of=gyro)
    at = spans(quaternions, n, centred=True)
    told = integral(gyro, view.dt, n // BRIDGED)
    first, last = at.rows.T
    readings = [
        Reading(text=text, fix=MEND, y=turns_between(read[first], read[last]), x=told)
        for text, read in quaternion_readings(quaternions)
    ]
    joined = attitude_joined_up(quaternions, n // BRIDGED)
    others = (
        ("rotate_inverse", "the gyro is in world axes", "set"),
        ("rotate", "the gyro is in body axes and was turned from the world's", "drop"),
    )
    readings += [
        Reading(
            text=text,
            fix=f"{do} frame = 'ENU' (or 'NED') in [columns.rate], or log what the gyro measures",
            y=readings[0].y,
            x=integral(turned(turn, joined, gyro), view.dt, n // BRIDGED),
        )
        for turn, text, do in others
    ]
    return Streams(readings=tuple(readings), axes=("p", "q", "r"), spans=at)


RELATION = Relation(
    name="attitude",
    streams="gyro and attitude",
    factor="the attitude turns {0} times as far as the gyro says",
    where="p, q, r against qw..qz",
    fix="say the gyro's axes: [columns.rate] frame = 'FRD', or a minus sign; or the frame of "
    "[columns.attitude]",
    least=0.01,
    much=0.03,
    units=(
        (1.0 / DEGREES, "the gyro is in deg/s", "set unit = 'deg/s' in [columns.rate]"),
        (
            DEGREES,
            "the gyro was scaled from deg/s to rad/s twice",
            "drop the unit or scale in [columns.rate]",
        ),
    ),
    blocking=1.7,
    streams_of=streams,
)
