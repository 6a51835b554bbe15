"""Relation of the position to the velocity: the displacement over a time is the velocity's
integral."""

from __future__ import annotations

from collections.abc import Iterator

from greybox.data.checks.kinematics import Relation, Streams
from greybox.data.checks.relations import Reading
from greybox.data.checks.signals import (
    BRIDGED,
    FloatArray,
    attitude_joined_up,
    integral,
    turned,
)
from greybox.data.checks.spans import length_of, spans
from greybox.data.checks.view import View
from greybox.data.readers.assemble import other_frame

SPAN = 0.5
"""Time [s] over which displacements are taken, and longer where streams are slow."""


BODY_AXES = (("FLU", "ENU"), ("FRD", "NED"), ("FRD", "ENU"))
"""(body axes, the world frame that a velocity in them was taken for)."""


def in_body_axes(velocity: FloatArray) -> Iterator[tuple[str, str, FloatArray]]:
    """(what is wrong, its fix, velocity in our body axes (N, 3)) of the ways in which a velocity
    (N, 3) of the world may be one in body axes."""
    for body, world in BODY_AXES:
        said = other_frame(velocity, "velocity", world)
        yield (
            "the velocity is in body axes" + (f" ({body})" if body != "FLU" else ""),
            f"set frame = '{body}' in [columns.velocity], or log the velocity in world axes",
            other_frame(said, "velocity", body),
        )


def streams(view: View) -> Streams | str:
    """Displacement against integrated velocity, and against that of a velocity in body axes."""
    if not view.has("position", "velocity"):
        return "no position with velocity"
    position, velocity = view.group("position"), view.group("velocity")
    n = length_of(SPAN / view.dt, between=position, of=velocity)
    at = spans(position, n)
    moved = at.of(position)

    def reading(text: str, fix: str, world: FloatArray) -> Reading:
        return Reading(text=text, fix=fix, y=moved, x=integral(world, view.dt, n // BRIDGED))

    readings = [reading("", "", velocity)]
    if view.has("attitude"):
        quaternions = attitude_joined_up(view.group("attitude"))
        for text, fix, body in in_body_axes(velocity):
            readings.append(reading(text, fix, turned("rotate", quaternions, body)))
    return Streams(readings=tuple(readings), axes=("vx", "vy", "vz"), spans=at)


RELATION = Relation(
    name="motion",
    streams="position and velocity",
    factor="the position moves {0} times as far as the velocity says",
    where="x, y, z against vx, vy, vz",
    fix="correct fields and frame in [columns.position] or [columns.velocity]: both in one world "
    "frame, z up",
    least=0.02,
    much=0.2,
    units=((1e3, "the position is in mm", "set unit = 'mm' in [columns.position]"),),
    blocking=1.6,
    streams_of=streams,
)
