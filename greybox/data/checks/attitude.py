"""Check of the attitude against the gyro: quaternion order, direction (body to world), gyro axes and gyro unit.

The rate that the quaternions imply is correlated with the gyro for every reading of the columns that people mix up.
A correlation does not see the unit; the ratio of the two sizes does.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from greybox.data.checks.finding import Check, Finding, Unjudged
from greybox.data.checks.signals import attitude_rate, best_lag, products, smoothed
from greybox.data.checks.view import FloatArray, View

HALF_WINDOW = 0.02
"""Rates are compared as means over twice this time [s]."""

LARGEST_LAG = 0.15
"""Streams may be this far apart [s] when readings are compared."""

LEAD = 0.05
"""A reading must beat the one given by this much correlation, and beat it in three quarters of the flight."""

SEEN = 0.5
"""... and have at least this correlation itself."""

MOVING = 0.05
"""Less than this rate [rad/s RMS] shows nothing."""

DEGREES = 180.0 / np.pi

ORDERS = {
    "": (0, 1, 2, 3),
    "the scalar comes last: the columns hold x, y, z, w": (3, 0, 1, 2),
    "the columns named qx, qy, qz, qw hold w, x, y, z": (1, 2, 3, 0),
}
CONJUGATE = "the quaternion turns world into body: negate qx, qy, qz"


def readings() -> Iterator[tuple[str, tuple[int, ...], FloatArray]]:
    """(what it would mean, column order, signs) of the quaternion readings; the first is the one given."""
    for signs, inverse in (((1.0, 1.0, 1.0, 1.0), ""), ((1.0, -1.0, -1.0, -1.0), CONJUGATE)):
        for text, order in ORDERS.items():
            yield "; ".join(part for part in (text, inverse) if part), order, np.array(signs)


def gyro_and_attitude_rate(view: View) -> tuple[FloatArray, FloatArray, int]:
    """(smoothed gyro (N, 3), quaternions (N, 4), half window in samples) of the airborne part."""
    half = max(1, round(HALF_WINDOW / view.dt))
    return smoothed(view.group("rate"), half), view.group("attitude"), half


def _axes(correlations: FloatArray) -> Iterator[tuple[str, float]]:
    """(how it is written, best correlation) of the gyro with axes exchanged or turned round, from `products`."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            if (order, signs) != ((0, 1, 2), (1.0, 1.0, 1.0)):
                text = ", ".join(
                    f"{'pqr'[i]} = {'-' if s < 0 else ''}{'pqr'[j]}"
                    for i, (j, s) in enumerate(zip(order, signs, strict=True))
                )
                yield text, float((correlations[:, range(3), order] @ np.array(signs)).max())


def _quarters_won(other: FloatArray, given: FloatArray, gyro: FloatArray, lags: npt.NDArray[np.int64]) -> int:
    """In how many quarters of the flight another reading fits the gyro better than the one given."""
    won = 0
    for rows in np.array_split(np.arange(gyro.shape[0]), 4):
        won += best_lag(other[rows], gyro[rows], lags)[1] > best_lag(given[rows], gyro[rows], lags)[1]
    return won


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on quaternion order and direction, gyro axes and gyro unit."""
    if not view.has("attitude") or not view.has("rate"):
        what = "no airborne stretch" if view.flight is None else "no attitude" if view.has("rate") else "no gyro"
        yield Unjudged(check="attitude", flight=view.name, reason=what)
        return
    gyro, quaternions, half = gyro_and_attitude_rate(view)
    lags = np.arange(-round(LARGEST_LAG / view.dt), round(LARGEST_LAG / view.dt) + 1)
    scores = []
    for text, order, signs in readings():
        turned = attitude_rate(quaternions[:, order] * signs, view.dt, half)
        table = products(turned, gyro, lags)
        scores.append((text, float(np.trace(table, axis1=1, axis2=2).max()), turned, table))
    given, given_rate = scores[0][1], scores[0][2]
    moving = float(np.sqrt(np.nanmean(given_rate**2))) if np.isfinite(given_rate).any() else 0.0
    if moving < MOVING:
        yield Unjudged(check="attitude", flight=view.name, reason=f"the attitude hardly moves ({moving:.2g} rad/s)")
        return
    best = max(scores, key=lambda s: s[1])
    axes = max(_axes(scores[0][3]), key=lambda s: s[1])
    evidence = {"correlation_as_given": given, "correlation_other_order": best[1], "correlation_other_axes": axes[1]}
    steady = _quarters_won(best[2], given_rate, gyro, lags) >= 3
    if best[1] > max(given + LEAD, SEEN) and best[1] > axes[1] - 0.05 and steady:
        yield Finding(
            check="attitude",
            severity="blocking",
            flight=view.name,
            where="qw, qx, qy, qz",
            message=f"gyro and attitude agree only when {best[0]}",
            evidence=evidence,
            fix="correct the order or the signs of the quaternion in [columns] (body to world, scalar first)",
        )
        return
    if axes[1] > max(given + 3 * LEAD, SEEN):
        yield Finding(
            check="attitude",
            severity="blocking",
            flight=view.name,
            where="p, q, r",
            message=f"gyro and attitude agree only with other gyro axes: {axes[0]}",
            evidence=evidence,
            fix="correct the gyro's names and signs in [columns] (forward, left, up), or the attitude's body axes",
        )
        return
    if given < SEEN:
        yield Finding(
            check="attitude",
            severity="warning",
            flight=view.name,
            where="qw..qz against p, q, r",
            message=f"gyro and attitude agree poorly (correlation {given:.2f}) in every reading",
            evidence=evidence,
            fix="check the noise of the attitude and the alignment of its clock",
        )
        return
    yield from _unit(view, gyro, given_rate, evidence)


def _unit(view: View, gyro: FloatArray, rate: FloatArray, evidence: dict[str, float]) -> Iterator[Finding]:
    ratio = float(np.nanstd(gyro) / np.nanstd(rate))
    evidence = {**evidence, "gyro_over_attitude_rate": ratio}
    if ratio > np.sqrt(DEGREES):
        message, fix = "the gyro is in deg/s", "set scale = 0.017453292519943295 for p, q, r in [columns]"
    elif ratio < 1 / np.sqrt(DEGREES):
        message, fix = "the gyro was scaled from deg/s to rad/s twice", "drop the scale of p, q, r in [columns]"
    else:
        if not 0.6 < ratio < 1.7:
            yield Finding(
                check="attitude",
                severity="warning",
                flight=view.name,
                where="p, q, r",
                message=f"the gyro is {ratio:.2f} times as large as the attitude's rate",
                evidence=evidence,
                fix="check the gyro's scale and the attitude's smoothing",
            )
        return
    yield Finding(
        check="attitude",
        severity="blocking",
        flight=view.name,
        where="p, q, r",
        message=f"{message} ({ratio:.1f} times the rate that the attitude shows)",
        evidence=evidence,
        fix=fix,
    )


CHECK = Check(name="attitude", question="Do attitude and gyro tell the same story, in rad/s?", run=run)
