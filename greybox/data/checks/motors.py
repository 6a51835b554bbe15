"""Check of the motors: order of the commands, spin directions, and the gyro's unit where there is no attitude.

The torque directions found by regression are compared with those that position and spin of the vehicle file promise.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator

import numpy as np

from greybox.data.airframe import Airframe, ThrustMap, Weighed
from greybox.data.checks.finding import Check, Finding, Unjudged, per_flight
from greybox.data.checks.torque import Torque, directions, expected_signs, torque_regression
from greybox.data.checks.view import FloatArray, View

SEEN = 0.08
"""Share of the angular acceleration's variance that the commands must explain before a verdict on roll and pitch."""

SEEN_YAW = 0.02
AGREE = 0.5
"""Cosine of found and promised torque directions from which they agree."""

LEAD = 0.15
"""An other order must agree by this much better, on the mean of roll and pitch."""

MOST_ROTORS = 6
"""Orders are searched up to this many rotors."""


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on motor order and spin."""
    if not view.has("rate", "command"):
        what = "no airborne stretch" if view.flight is None else "no gyro"
        yield Unjudged(check="motors", flight=view.name, reason=what)
        return
    found = torque_regression(view)
    if found is None:
        yield Unjudged(check="motors", flight=view.name, reason="fewer than 200 complete samples")
        return
    seen = found.share >= np.array([SEEN, SEEN, SEEN_YAW])
    if not seen[:2].all():
        reason = "the commands explain too little of the angular acceleration (share "
        reason += ", ".join(f"{s:.3f}" for s in found.share) + ")"
        yield Unjudged(check="motors", flight=view.name, reason=reason)
        return
    promised = expected_signs(view)
    agreement = (directions(found.gains) * promised).sum(axis=1)
    steady = (directions(found.thirds) * promised).sum(axis=2)
    evidence = {f"agreement_{a}": float(c) for a, c in zip(("roll", "pitch", "yaw"), agreement, strict=True)}
    evidence |= {f"share_{a}": float(c) for a, c in zip(("roll", "pitch", "yaw"), found.share, strict=True)}
    order, best = _best_order(found, promised)
    better = float(best[:2].mean() - agreement[:2].mean()) > LEAD
    if better or not bool((agreement[:2] >= AGREE).all()):
        yield _disorder(view, order, best, agreement, evidence)
        return
    if view.vehicle.rotors and np.any(promised[2]):
        if not seen[2]:
            yield Unjudged(check="motors", flight=view.name, reason="too little yaw motion to see the spins")
        elif agreement[2] < -AGREE and bool((steady[:, 2] < 0).all()):
            yield Finding(
                check="motors",
                severity="blocking",
                flight=view.name,
                where="spin of the rotors",
                message="the yaw torques have the opposite sign: the spins are the wrong way round",
                evidence=evidence,
                fix="change the sign of spin of every rotor (1 = counter-clockwise seen from above)",
            )
        elif agreement[2] < AGREE and bool((steady[:, 2] < AGREE).all()):
            signs = np.sign(-directions(found.gains)[2]).astype(int).tolist()
            yield Finding(
                check="motors",
                severity="warning",
                flight=view.name,
                where="spin of the rotors",
                message=f"the yaw torques look like spins {signs}, the vehicle file says otherwise",
                evidence=evidence,
                fix="compare spin of each rotor with the craft",
            )
    yield from _strength(view, found, evidence)


def _best_order(found: Torque, promised: FloatArray) -> tuple[tuple[int, ...], FloatArray]:
    """(order of rotors under which found and promised directions agree best, agreement (3,) there)."""
    n = promised.shape[1]
    seen = directions(found.gains)
    orders = itertools.permutations(range(n)) if n <= MOST_ROTORS else iter([tuple(range(n))])
    weights = np.array([1.0, 1.0, 0.1])
    order = max(orders, key=lambda o: float(weights @ (seen * promised[:, o]).sum(axis=1)))
    return order, np.asarray((seen * promised[:, order]).sum(axis=1), dtype=np.float64)


def _disorder(
    view: View, order: tuple[int, ...], best: FloatArray, agreement: FloatArray, evidence: dict[str, float]
) -> Finding:
    fix = "compare rotor positions and u1.. in [columns] with the craft, and the signs of the gyro axes"
    text = "the torques of the commands do not fit the rotor positions"
    moved = [f"u{i + 1} drives rotor {j + 1}" for i, j in enumerate(order) if i != j]
    if moved and float(best[:2].min()) >= AGREE:
        text = f"the motor order is wrong: {', '.join(moved)}"
        fix = "reorder u1.. in [columns] or the [[rotor]] tables (or correct a gyro axis with the wrong sign)"
    return Finding(
        check="motors",
        severity="blocking",
        flight=view.name,
        where="u1.. against p, q, r",
        message=f"{text} (roll {agreement[0]:+.2f}, pitch {agreement[1]:+.2f} where +1 is right)",
        evidence={**evidence, "agreement_other_order": float(best[:2].mean())},
        fix=fix,
    )


def _strength(view: View, found: Torque, evidence: dict[str, float]) -> Iterator[Finding]:
    """The gyro's unit from the size of the torque gains, where thrust and inertia are known."""
    promised = promised_gain(view.vehicle)
    if promised is None:
        return
    seen = np.linalg.norm(found.gains[:2] - found.gains[:2].mean(axis=1, keepdims=True), axis=1)
    ratio = float(np.sqrt(np.prod(seen / promised)))
    # Lag and smoothing take half or more of the gain: 0.15 .. 1 is usual in rad/s.
    if ratio > 6.0 or ratio < 0.02:
        what = "deg/s" if ratio > 6.0 else "scaled from deg/s to rad/s twice"
        yield Finding(
            check="motors",
            severity="blocking",
            flight=view.name,
            where="p, q, r",
            message=f"angular acceleration {ratio:.3g} times what thrust and inertia promise: the gyro is {what}",
            evidence={**evidence, "found_over_promised": ratio},
            fix="set the scale of p, q, r in [columns] (deg/s: 0.017453292519943295), or correct inertia and thrust",
        )


def promised_gain(vehicle: Airframe) -> FloatArray | None:
    """Size of the roll and pitch gains (2,) [rad/s^2 per u^2] that the vehicle file promises; None where it is silent.

    The thrust map is taken by its slope at the thrust that carries the weight.
    """
    actuator = vehicle.actuator
    if not isinstance(vehicle, Weighed) or not isinstance(actuator, ThrustMap):
        return None
    inertia = vehicle.inertia
    c0, c1, c2 = (float(c.value) for c in actuator.thrust)
    share = float(vehicle.mass.value) * vehicle.gravity / len(vehicle.rotors)
    if c2 > 0:
        inner = c1 * c1 - 4 * c2 * (c0 - share)
        nu = (-c1 + math.sqrt(inner)) / (2 * c2) if inner > 0 else 1.0
    else:
        nu = (share - c0) / c1 if c1 > 0 else 1.0
    slope = (c1 + 2 * c2 * nu) / max(2 * nu, 1e-9)
    if slope <= 0:
        return None
    place = np.array([r.position for r in vehicle.rotors], dtype=np.float64)
    arms = np.linalg.norm(place - place.mean(axis=0), axis=0)
    sizes = np.array([arms[1] / inertia[0][0], arms[0] / inertia[1][1]]) * slope
    return sizes if bool((sizes > 0).all()) else None


CHECK = Check(
    name="motors", question="Does every command drive the rotor that the vehicle file says, with its spin?", run=per_flight(run)
)
