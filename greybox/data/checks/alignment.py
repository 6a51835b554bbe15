"""Check of stream alignment: attitude against gyro over the flight, and when each channel answers
to the commands and to the rotor speeds.

A positive offset means that the gyro is late against the attitude. Offset and drift are stated where
they are clear of what the flight's rates can tell. A clock moves all axes alike: it has what they
share, and where they differ the attitude comes from an estimator.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping

import numpy as np

from greybox.data.checks.delay import Delays, delays
from greybox.data.checks.finding import Check, Finding, Severity, Unjudged, per_flight
from greybox.data.checks.rates import shown_by
from greybox.data.checks.relations import CLEAR
from greybox.data.checks.signals import best_lag, bridged, correlation, shifted, smoothed
from greybox.data.checks.torque import LARGEST_LAG, Torque, torque_regression
from greybox.data.checks.view import View
from greybox.data.drive import LATE_SPEEDS

BLOCKING = 0.05
"""Median offset [s] from which a fit is blocked (and at least two samples)."""

CLOCKS = (
    "log all streams with one clock, stamped at the source; or shift one of them and fit a delay per "
    "flight"
)

SAID = 1.0
"""Offsets, and differences between axes, are said from here on [samples]."""

ANSWERS = 0.05
"""Share of variance that commands must explain before a delay is stated, if they tell it to within
what a craft can have."""


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on offsets and drift between the streams, and on the delay from command to
    motion."""
    offset = None
    if view.has("attitude", "rate"):
        told = delays(view)
        if axes := _apart_axes(view, told):
            yield _estimated(view, axes)
        elif _known(view, told):
            offset = told.quantile(0.5)
            yield _offset(view, told)
        else:
            what = "the rates change too little to tell their delay against the attitude"
            what = what if told.count else "gyro and attitude are never alike"
            yield Unjudged(check="alignment", flight=view.name, reason=what)
    else:
        what = (
            "no airborne stretch"
            if view.flight is None
            else "no attitude"
            if view.has("rate")
            else view.lacks("rate", "gyro")
        )
        yield Unjudged(check="alignment", flight=view.name, reason=what)
    yield from _answers(view, offset, "p, q, r")
    if view.measured is not None:
        yield from _answers(view.measured, offset, "the motion")


def _known(view: View, told: Delays) -> bool:
    """Whether the rates tell a delay to within what matters."""
    return CLEAR * told.middle_error(wandering=False) < max(BLOCKING / view.dt, 2.0)


def _apart_axes(view: View, told: Delays) -> dict[str, tuple[float, float]]:
    """(delay, standard error) [samples] of every axis that tells one; empty where what they share
    is more than what they clearly differ by, and where all together are not late."""
    if _known(view, told) and not _sure(told):
        return {}
    each = {name: delays(view, [axis], told.mounting) for axis, name in enumerate("pqr")}
    axes = {
        n: (d.quantile(0.5), d.middle_error())
        for n, d in each.items()
        if CLEAR * d.middle_error() < max(BLOCKING / view.dt, 2.0)
    }
    shared = abs(_shared(axes))
    for one, other in itertools.combinations(axes, 2):
        apart = each[one].against(each[other])
        # Every instant is in two windows: they are half as many as they seem.
        if _sure(apart, CLEAR * np.sqrt(2.0)) and abs(apart.quantile(0.5)) > shared:
            return axes
    return {}


def _shared(axes: Mapping[str, tuple[float, float]]) -> float:
    """The delay [samples] that all axes have, 0 where it is not clear of its error."""
    late = [a for a, _ in axes.values()]
    least, error = min(axes.values(), key=lambda a: abs(a[0]), default=(0.0, 0.0))
    one_way = bool(late) and min(late) * max(late) > 0.0
    return least if one_way and abs(least) > CLEAR * error else 0.0


def _sure(told: Delays, clear: float = CLEAR) -> bool:
    """Whether an offset is there and `clear` times its error."""
    offset = abs(told.quantile(0.5)) if told.count else 0.0
    return offset > SAID and offset > clear * told.middle_error()


def _estimated(view: View, axes: Mapping[str, tuple[float, float]]) -> Finding:
    """The axes differ: a clock has at most what all of them share."""
    late = [a for a, _ in axes.values()]
    shared = _shared(axes)
    blocks = abs(shared) >= max(BLOCKING / view.dt, 2.0)
    sign, way = (1.0, "late") if sum(late) > 0.0 else (-1.0, "early")
    ms = 1e3 * view.dt
    each = ", ".join(f"{sign * ms * a:.1f} +- {ms * e:.1f} ({n})" for n, (a, e) in axes.items())
    text = f"the gyro is {each} ms {way} against the attitude"
    text += ": no clock differs by axis, an estimator that filters does"
    if blocks:
        text += f"; what all share, {_time(view, abs(shared))}, is a clock's"
    evidence = {
        "offset_samples": shared,
        "offset_s": shared * view.dt,
        "error_samples": max(e for _, e in axes.values()),
        "axes_apart_samples": max(late) - min(late),
        "sample_s": view.dt,
    }
    return Finding(
        check="alignment",
        severity="blocking" if blocks else "warning",
        flight=view.name,
        where="p, q, r against qw..qz",
        message=text,
        evidence=evidence | {f"{n}_samples": a for n, (a, _) in axes.items()},
        fix=CLOCKS
        if blocks
        else "log an attitude that was measured; with this one, --kinematic-noise says that it is "
        "not the gyro's integral, and predicted attitudes are no better than it",
    )


def _time(view: View, samples: float) -> str:
    """So many samples of the checks' own rate in ms, and in rows of the log as it was written."""
    seconds = samples * view.dt
    return f"{1e3 * seconds:.1f} ms ({seconds * view.rate:.1f} rows)"


def _offset(view: View, told: Delays) -> Finding:
    dt = view.dt
    low, high = told.drift
    offset, drift, error = told.quantile(0.5), high - low, told.middle_error()
    sure = _sure(told)
    late = "late" if offset > 0 else "early"
    severity: Severity = "info"
    most = _time(view, max(abs(offset), drift, error))
    text = f"gyro and attitude are aligned within {most}"
    if sure and abs(offset) >= max(BLOCKING / dt, 2.0):
        severity = "blocking"
        text = f"the gyro is {_time(view, abs(offset))} {late} against the attitude"
    elif sure or drift > 2.0:
        severity = "warning"
        text = (
            f"the gyro is {_time(view, abs(offset))} {late} against the attitude and wanders by "
            f"{1e3 * drift * dt:.1f} ms"
        )
    return Finding(
        check="alignment",
        severity=severity,
        flight=view.name,
        where="p, q, r against qw..qz",
        message=text,
        evidence={
            "offset_samples": offset,
            "offset_s": offset * dt,
            "error_samples": error,
            "low_samples": low,
            "high_samples": high,
            "sample_s": dt,
            "drift_s_per_s": told.slope * dt,
            "windows": told.count,
        },
        fix=CLOCKS,
    )


def _answers(view: View, offset: float | None, motion: str) -> Iterator[Finding | Unjudged]:
    """The instant at which each channel answers, relative to what drives the rotors. A fault is one
    of `motion` against it."""
    if not (shown_by(view) and view.drives):
        return
    drive = "the commands" if view.commanded else "the rotor speeds"
    found = torque_regression(view)
    evidence: dict[str, float] = {}
    if found is not None and found.misaligned:
        yield _apart(view, found, motion, drive)
        return
    if found is not None:
        for axis, name in enumerate(("p", "q", "r")):
            if found.share[axis] >= ANSWERS and CLEAR * found.lag_error[axis] < LARGEST_LAG:
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
    # A speed acts at once, and is often logged late: a fit finds by how much. Rotors that obey at
    # once (a simulator's) lag by half a row, in which the command is held, and by as much less than
    # nothing where it is logged a row late.
    late = view.commanded and bool(rolls) and max(rolls) < 0.0
    late = late and found is not None and float(found.lag_error[:2].max()) < view.dt
    yield Finding(
        check="alignment",
        severity="warning" if late else "info",
        flight=view.name,
        where=f"each channel against {drive}",
        message="the motion does not lag the commands: the commands are logged too late"
        if late
        else _said(evidence, drive, view.dt, view.commanded),
        evidence=evidence,
        fix="log the command at the instant it is sent; check that the log is not one row late, "
        "and that these are no rotor speeds",
    )


def _apart(view: View, found: Torque, motion: str, drive: str) -> Finding:
    """What drives the rotors is on another clock than the motion."""
    lag = found.searched_lag
    if view.commanded:
        message = (
            f"the motion fits {drive} best {abs(lag) * 1e3:.0f} ms "
            f"{'after' if lag > 0 else 'before'} them, which no craft does: they are not on one "
            "clock"
        )
        fix = f"shift {drive} against the sensors, or log both on one clock"
    else:
        message = (
            f"{drive} are logged {abs(lag) * 1e3:.0f} ms {'early' if lag > 0 else 'late'} against "
            f"the motion: a fit takes off {LATE_SPEEDS * 1e3:.0f} ms at most"
        )
        fix = f"delay = {-lag:.3g} in [columns.rotor_speed], or log both on one clock"
    return Finding(
        check="alignment",
        severity="blocking",
        flight=view.name,
        where=f"{motion} against {drive}",
        message=message,
        evidence={
            "lag_s": lag,
            "share": found.searched_share,
            "share_plausible": found.plausible_share,
        },
        fix=fix,
    )


def _said(evidence: dict[str, float], drive: str, dt: float, commanded: bool) -> str:
    """The lags [s] in words, at samples of `dt` [s]."""
    early = max(evidence.values()) < -0.5 * dt
    lags = ", ".join(
        f"{abs(v) * 1e3 if early else v * 1e3:.0f} ms ({k[:-2]})" for k, v in evidence.items()
    )
    if early:
        return f"{drive} are logged late, by {lags}"
    # A controller that answers to gusts and noise makes commands that seem to come sooner.
    said = f"motion follows {drive} by {lags}"
    if commanded:
        return f"{said} (often too short under feedback: a fit finds the lag)"
    return f"{said} (speeds push at once: the sensors are filtered, or these are commands)"


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
