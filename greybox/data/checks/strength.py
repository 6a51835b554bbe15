"""How strongly the commands turn the craft, against what the vehicle file promises.

The gain of each axis is judged with its standard error: one that is not clear of zero was not seen,
and accuses nobody. A gain that is far off is the gyro's unit, or a number of the file. The attitude
tells which, where there is one; else whether mass, arms and inertia of the file fit each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from greybox.data.airframe import (
    LENGTH_UNITS,
    MOMENTS,
    USUAL_MOMENT,
    Airframe,
    ThrustMap,
    Weighed,
)
from greybox.data.checks.attitude import DEGREES
from greybox.data.checks.attitude import RELATION as ATTITUDE
from greybox.data.checks.kinematics import related
from greybox.data.checks.rates import shown_by
from greybox.data.checks.relations import CLEAR, factor, jackknife
from greybox.data.checks.torque import Sums
from greybox.data.checks.view import FloatArray, View

PLAUSIBLE = (0.02, 6.0)
"""Gains over promised ones of a gyro in rad/s: lag and smoothing take half or more, and the file is
no measurement."""


class Wrong(TypedDict):
    """What is wrong, in the words of a verdict."""

    claim: str
    where: str
    message: str
    evidence: dict[str, float]
    fix: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Strength:
    """Found over promised gain of roll and pitch, `ratio` (2,), and its standard error (2,)."""

    vehicle: Weighed
    arm: float
    ratio: FloatArray
    error: FloatArray

    @property
    def _seen(self) -> FloatArray:
        return np.asarray(self.ratio - CLEAR * self.error > 0.0)

    @property
    def told(self) -> bool:
        """Whether the gain of an axis is clear of zero."""
        return bool(self._seen.any())

    def wrong(self, views: Sequence[View]) -> Wrong | None:
        """What is wrong by the axes that are told; None where nothing is."""
        ratio, error = self.ratio[self._seen], CLEAR * self.error[self._seen]
        least, most = PLAUSIBLE
        if not self.told or not (all(ratio + error < least) or all(ratio - error > most)):
            return None
        size = float(np.exp(np.log(ratio).mean()))
        witnesses = {_witness(v) for v in views}
        vouched = "" not in witnesses
        file = self._of_the_file(size)
        said = f"angular acceleration {size:.3g} times what arms, thrust and inertia promise"
        said += "".join(sorted(witnesses)) if vouched else ""
        evidence = {"found_over_promised": size, "error": float(error.max()) / CLEAR}
        if file or vouched:
            return Wrong(
                claim="file",
                where="numbers of the vehicle file" if file else "commands and vehicle file",
                message=f"{said}: "
                + (file or "one of these, or the unit of the commands, is wrong"),
                evidence=evidence,
                fix="correct the vehicle file: metres, kg m^2, N (greybox vehicle check)"
                + ("" if file else ", or limits in [columns.command]"),
            )
        what = "deg/s" if size > 1.0 else "scaled from deg/s to rad/s twice"
        return Wrong(
            claim=what,
            where="p, q, r",
            message=f"{said}: the gyro is {what}",
            evidence=evidence,
            fix="set the unit in [columns.rate] (deg/s, rad/s), or correct arms, inertia, thrust",
        )

    def _of_the_file(self, size: float) -> str:
        """Which number of the file is wrong, by its mass, arms and inertia and by the gain; empty
        where these fit each other."""
        moments = [float(self.vehicle.inertia[i][i]) for i in range(2)]
        moment = math.sqrt(moments[0] * moments[1])
        moment /= float(self.vehicle.mass.value) * self.arm**2
        if MOMENTS[0] <= moment <= MOMENTS[1]:
            return ""
        inertia = moment / USUAL_MOMENT
        arms = inertia**-0.5
        # Arms make the gain larger as they are, inertia as it is smaller.
        if abs(math.log(size * arms)) > abs(math.log(size / inertia)):
            return f"the inertia is about {_times(inertia)} for mass and arms"
        unit = min(LENGTH_UNITS, key=lambda u: abs(math.log(u * arms)))
        near = abs(math.log(unit * arms)) < 0.5 * math.log(2.54)
        named = f" ({LENGTH_UNITS[unit]}?)" if near else ""
        return f"the arms are about {_times(arms)} for mass and inertia{named}"


def _times(factor_of: float) -> str:
    way = "large" if factor_of > 1.0 else "small"
    times = float(f"{max(factor_of, 1.0 / factor_of):.2g}")
    return f"{times:g} times too {way}"


def _witness(view: View) -> str:
    """What says that the rates are in rad/s, as the end of a message: an attitude has no unit, nor
    rates of it; to a gyro it is nearer than to one in another unit. Empty where nothing does."""
    if shown_by(view) == "attitude":
        return ", by the attitude"
    found = related(ATTITUDE, view)
    size = None if isinstance(found, str) else factor(found.given)
    near = size is not None and abs(math.log(size.value)) < 0.5 * math.log(DEGREES)
    return ", and the attitude agrees with the gyro" if near else ""


def strength_of(vehicle: Airframe, sums: Sums, promised: FloatArray) -> Strength | None:
    """The strength along the promised directions (3, n); None where the vehicle file is silent."""
    gains = promised_gain(vehicle)
    if gains is None or not isinstance(vehicle, Weighed):
        return None
    ratio = sums.total.along(promised)[:2, 0] / gains
    left_out = sums.left_out.along(promised)[:2] / gains[:, None]
    place = np.array([r.position for r in vehicle.rotors], dtype=np.float64)
    return Strength(
        vehicle=vehicle,
        arm=float(np.linalg.norm(place[:, :2], axis=1).max()),
        ratio=ratio,
        error=np.array([jackknife(g) for g in left_out]),
    )


def promised_gain(vehicle: Airframe) -> FloatArray | None:
    """Size of the roll and pitch gains (2,) [rad/s^2 per u^2] that the vehicle file promises; None
    where it is silent.

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
