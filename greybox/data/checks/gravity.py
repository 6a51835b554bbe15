"""Check of the specific force: unit, direction of gravity, and the world's up."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.checks.finding import Check, Finding, Unjudged, per_flight
from greybox.data.checks.relations import ANGLES
from greybox.data.checks.signals import correlation, derivative, joined_up, smoothed
from greybox.data.checks.view import FloatArray, View
from greybox.data.direction import axis_of_thrust, straightness
from greybox.data.drive import drive_names
from greybox.frames import GRAVITY, numeric

FAST = 0.2
"""Vertical motion below this [m/s RMS] shows nothing."""

DEEP = 0.1
"""Flying this far [m] below the ground means that z points down."""

DOWN = (
    "set frame = 'NED' in [columns.position] and [columns.velocity] (turns down to up, north to y)"
)


def _finding(
    view: View, severity: str, message: str, fix: str, evidence: dict[str, float], where: str
) -> Finding:
    return Finding(
        check="gravity",
        severity="blocking" if severity == "blocking" else "warning",
        flight=view.name,
        where=where,
        message=message,
        evidence=evidence,
        fix=fix,
    )


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on the accelerometer's unit and signs, and on the direction of up."""
    if not view.has("specific_force"):
        what = "no airborne stretch" if view.flight is None else "no accelerometer"
        yield Unjudged(check="gravity", flight=view.name, reason=what)
        return
    force = view.group("specific_force")
    known = force[np.isfinite(force).all(axis=1)]
    if known.shape[0] < 10:
        yield Unjudged(
            check="gravity", flight=view.name, reason="fewer than 10 samples of specific force"
        )
        return
    size = float(np.median(np.linalg.norm(known, axis=1)))
    mean = known.mean(axis=0)
    evidence = {"median_size": size, "mean_x": mean[0], "mean_y": mean[1], "mean_z": mean[2]}
    shown, where = axis_of_thrust(known), "ax, ay, az"
    if not shown:
        text = "the specific force has no lasting direction: gravity was taken out"
        fix = (
            "log the raw accelerometer (it reads +9.81 at rest), or set gravity = false in "
            "[columns.specific_force], and frame = 'ENU' or 'NED' where its axes are the world's"
        )
        yield _finding(
            view, "blocking", text, fix, {**evidence, "straightness": straightness(known)}, where
        )
        return
    if (wrong := _wrong_unit(size)) is not None:
        yield _finding(view, *wrong, evidence, where)
    if shown != "+z":
        text = f"thrust acts along {shown} of the accelerometer, not along +z"
        fix = (
            "say which axes: frame = 'FRD' in [columns.specific_force] and [columns.rate] (x "
            "forward, y right, z down)"
            if shown == "-z"
            else "turn the fields of [columns.specific_force] and [columns.rate] to forward, left, "
            "up"
        ) + "; specific force at rest is (0, 0, +9.81)"
        # Where the whole body is turned, the gyro agrees with the attitude all the same.
        gyro = view.has("rate")
        seen = f"{where}, and p, q, r if they share its axes" if gyro else where
        yield _finding(view, "blocking", text, fix, evidence, seen)
        return
    yield from _up(view, force, evidence)


def _wrong_unit(size: float) -> tuple[str, str, str] | None:
    """(severity, message, fix) for a median specific force [m/s^2] that is not that of gravity."""
    share = size / GRAVITY
    if 1 / GRAVITY / 2 < share < 2 / GRAVITY:
        message = f"the specific force is in g (median size {size:.3g})"
        return "blocking", message, "set unit = 'g' in [columns.specific_force]"
    if GRAVITY / 2 < share < GRAVITY * 2:
        message = f"the specific force was scaled from g twice (median size {size:.3g})"
        return "blocking", message, "drop the unit or scale in [columns.specific_force]"
    if not 0.6 < share < 1.6:
        message = f"the median specific force in flight is {size:.3g} m/s^2"
        severity = "blocking" if not 0.3 < share < 3 else "warning"
        fix = "check the unit in [columns.specific_force], and gravity = false there"
        return severity, message, fix
    return None


def _below_the_ground(view: View) -> float | None:
    """How far [m] the craft flies below every place where its motors stood still; None where that
    is not seen."""
    log = view.increasing
    names = drive_names(log.channels, len(view.vehicle.rotors))
    if not names:
        return None
    least = view.vehicle.actuator.u_min if view.commanded else 0.0
    mean = np.mean([log.channels[n] for n in names], axis=0) - least
    z = log.channels["z"]
    running = mean[mean > max(0.3 * float(np.nanpercentile(mean, 95)), 0.0)]
    if not running.size:
        return None
    level = float(np.median(running))
    flown = z[(mean > 0.7 * level) & np.isfinite(z)]
    half = log.n // 2
    stood = [
        part
        for rows in (slice(0, half), slice(half, None))
        if (part := _idle(mean, z, level, rows)).size >= 10
    ]
    if flown.size < 10 or not stood:
        return None
    return min(float(np.median(part)) for part in stood) - float(np.median(flown))


def _idle(mean: FloatArray, z: FloatArray, level: float, rows: slice) -> FloatArray:
    return z[rows][(mean[rows] < 0.1 * level) & np.isfinite(z[rows])]


def _up(view: View, force: FloatArray, evidence: dict[str, float]) -> Iterator[Finding]:
    """The same in the world: mean specific force must point up, and climbing must need more of
    it."""
    if view.has("attitude"):
        quaternions = view.group("attitude")
        known = np.isfinite(quaternions).all(axis=1) & np.isfinite(force).all(axis=1)
        if known.sum() < 10:
            return
        world = np.full_like(force, np.nan)
        world[known] = numeric("rotate", quaternions[known], force[known])
        mean = np.nanmean(world, axis=0)
        angle = float(np.degrees(np.arccos(mean[2] / np.linalg.norm(mean))))
        if angle > ANGLES[0]:
            text = f"the mean specific force is {angle:.0f} deg from the world's up"
            fix = "check the quaternion (body to world, z up) and the accelerometer's axes"
            severity = "blocking" if angle > ANGLES[1] else "warning"
            yield _finding(
                view, severity, text, fix, {**evidence, "tilt_deg": angle}, "ax..az with qw..qz"
            )
    else:
        world = force
    name = "z" if view.flight is not None and "z" in view.flight.channels else None
    if name is None:
        return
    depth = _below_the_ground(view)
    if depth is not None and depth > DEEP:
        text = (
            f"the craft flies {depth:.2f} m below the place where it stood: the world's z "
            "points down"
        )
        yield _finding(view, "blocking", text, DOWN, {**evidence, "depth_m": depth}, "z")
        return
    half = max(1, round(0.1 / view.dt))
    climb = derivative(joined_up(view.joined(["z"])), view.dt, half)
    if np.isfinite(climb).sum() < 10 or float(np.nanstd(climb)) < FAST:
        return
    acceleration = derivative(smoothed(climb, half), view.dt, half)
    agreement = correlation(smoothed(world[:, 2:3], 2 * half), acceleration)
    if agreement < -0.3:
        text = "the craft climbs where z falls: the world's z points down"
        yield _finding(view, "blocking", text, DOWN, {**evidence, "correlation": agreement}, "z")


CHECK = Check(
    name="gravity",
    question="Is the specific force in m/s^2, along +z, and up in the world?",
    run=per_flight(run),
)
