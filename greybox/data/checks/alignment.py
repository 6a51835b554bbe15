"""Check of stream alignment: attitude against gyro over the flight, and when each channel answers
to the command.

Windowed cross-correlation gives the offset and how it drifts. A positive offset means that the gyro
is late against the attitude.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.checks.finding import Check, Finding, Unjudged, per_flight
from greybox.data.checks.signals import (
    attitude_rate,
    best_lag,
    bridged,
    correlation,
    peak,
    shifted,
    smoothed,
    windowed,
)
from greybox.data.checks.torque import torque_regression
from greybox.data.checks.view import FloatArray, View

WINDOW = 2.0
"""Length of a window [s]."""

LARGEST = 0.3
"""Largest offset that is looked for [s]."""

CREDIBLE = 0.7
"""Correlation from which a window counts."""

BLOCKING = 0.05
"""Median offset [s] from which a fit is blocked (and at least two samples)."""

HALF_WINDOW = 0.02
"""Rates are compared as means over twice this time [s]."""

ANSWERS = 0.05
"""Share of variance that commands must explain before a delay is stated."""


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on offsets and drift between the streams, and on the delay from command to
    motion."""
    offset = None
    if view.has("attitude", "rate"):
        windows = window_offsets(view)
        if windows.shape[0] >= 1:
            offset = float(np.median(windows[:, 1]))
            yield _offset(view, windows, offset)
        else:
            yield Unjudged(
                check="alignment", flight=view.name, reason="gyro and attitude are never alike"
            )
    else:
        what = (
            "no airborne stretch"
            if view.flight is None
            else "no attitude"
            if view.has("rate")
            else "no gyro"
        )
        yield Unjudged(check="alignment", flight=view.name, reason=what)
    yield from _answers(view, offset)


def window_offsets(view: View) -> FloatArray:
    """(K, 3): middle of the window [s], how late the gyro is against the attitude [samples],
    correlation there."""
    half = max(1, round(HALF_WINDOW / view.dt))
    gyro = smoothed(bridged(view.group("rate"), half), half)
    rate = attitude_rate(view.group("attitude"), view.dt, half)
    length, reach = round(WINDOW / view.dt), round(LARGEST / view.dt)
    time = view.time
    lags = np.arange(-reach, reach + 1)
    starts = np.arange(0, max(rate.shape[0] - length, 0) + 1, max(length // 2, 1))
    there = np.concatenate([[0], np.cumsum(np.isfinite(rate).all(axis=1))])
    starts = starts[starts + length <= rate.shape[0]]
    starts = starts[there[starts + length] - there[starts] >= 0.8 * length]
    out = []
    for start, scores in zip(starts, windowed(gyro, rate, lags, starts, length), strict=True):
        lag, top = peak(scores, lags)
        if top >= CREDIBLE and abs(lag) < reach:
            out.append((float(np.nanmean(time[start : start + length])), lag, top))
    return np.array(out).reshape(-1, 3)


def _offset(view: View, windows: FloatArray, offset: float) -> Finding:
    dt = view.dt
    low, high = (float(v) for v in np.percentile(windows[:, 1], [10, 90]))
    drift = high - low
    slope = 0.0
    if windows.shape[0] >= 3:
        since = windows[:, 0] - windows[0, 0]
        slope = float(np.polyfit(since, windows[:, 1], 1)[0]) * dt
    late = "late" if offset > 0 else "early"
    if abs(offset) >= max(BLOCKING / dt, 2.0):
        severity, text = (
            "blocking",
            f"the gyro is {abs(offset):.1f} samples {late} against the attitude",
        )
    elif abs(offset) > 1.0 or drift > 2.0:
        severity = "warning"
        text = (
            f"the gyro is {abs(offset):.1f} samples {late} against the attitude and wanders by "
            f"{drift:.1f}"
        )
    else:
        severity, text = (
            "info",
            f"gyro and attitude are aligned within {max(abs(offset), drift):.1f} samples",
        )
    return Finding(
        check="alignment",
        severity="blocking"
        if severity == "blocking"
        else "warning"
        if severity == "warning"
        else "info",
        flight=view.name,
        where="p, q, r against qw..qz",
        message=text,
        evidence={
            "offset_samples": offset,
            "offset_s": offset * dt,
            "low_samples": low,
            "high_samples": high,
            "drift_s_per_s": slope,
            "windows": int(windows.shape[0]),
        },
        fix="log all streams with one clock, stamped at the source; or shift one of them and fit a "
        "delay per flight",
    )


def _answers(view: View, offset: float | None) -> Iterator[Finding | Unjudged]:
    """The instant at which each channel answers, relative to the command."""
    if not (view.has("rate") and view.drives):
        return
    drive = "the commands" if view.commanded else "the rotor speeds"
    found = torque_regression(view)
    evidence: dict[str, float] = {}
    if found is not None and found.misaligned:
        lag = found.searched_lag
        yield Finding(
            check="alignment",
            severity="blocking",
            flight=view.name,
            where=f"p, q, r against {drive}",
            message=f"the motion fits {drive} best {abs(lag) * 1e3:.0f} ms "
            f"{'after' if lag > 0 else 'before'} them, "
            "which no craft does: they are not on one clock",
            evidence={
                "lag_s": lag,
                "share": found.searched_share,
                "share_plausible": found.plausible_share,
            },
            fix=f"shift {drive} against the sensors, or log both on one clock",
        )
        return
    if found is not None:
        for axis, name in enumerate(("p", "q", "r")):
            if found.share[axis] >= ANSWERS:
                evidence[f"{name}_s"] = float(found.lag[axis])
    rolls = [evidence[k] for k in ("p_s", "q_s") if k in evidence]
    if rolls and offset is not None:
        evidence["attitude_s"] = float(np.mean(rolls)) - offset * view.dt
    lift = _lift_lag(view)
    if lift is not None:
        evidence["az_s"] = lift
    if not evidence:
        yield Unjudged(
            check="alignment", flight=view.name, reason=f"no motion that answers to {drive}"
        )
        return
    # A speed acts at once, and is often logged late: a fit finds by how much.
    late = view.commanded and bool(rolls) and max(rolls) < 0.5 * view.dt
    yield Finding(
        check="alignment",
        severity="warning" if late else "info",
        flight=view.name,
        where=f"each channel against {drive}",
        message="the motion does not lag the commands: the commands are logged too late"
        if late
        else f"motion follows {drive} by "
        + ", ".join(f"{v * 1e3:.0f} ms ({k[:-2]})" for k, v in evidence.items()),
        evidence=evidence,
        fix="log the command at the instant it is sent; check that the log is not one row late",
    )


def _lift_lag(view: View) -> float | None:
    """Lag [s] of the vertical specific force behind the sum of the squared commands; None where it
    is not seen."""
    if not view.has("specific_force"):
        return None
    half = max(1, round(0.02 / view.dt))
    slow = max(2, round(0.5 / view.dt))
    force, lift = bridged(view.joined(["az"]), half), (view.drive**2).sum(axis=1, keepdims=True)
    force, lift = (smoothed(v, half) - smoothed(v, slow) for v in (force, lift))
    lags = np.arange(-round(0.05 / view.dt), round(0.15 / view.dt) + 1)
    lag, peak = best_lag(force, lift, lags)
    if peak < 0.4 or correlation(force, shifted(lift, round(lag))) < 0.4:
        return None
    return lag * view.dt


CHECK = Check(
    name="alignment",
    question="Are the streams on one clock, and when does each answer to the command?",
    run=per_flight(run),
)
