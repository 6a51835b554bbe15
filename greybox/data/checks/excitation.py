"""Check of excitation: whether the flight moves enough about and along every axis to be worth a
fit."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.checks.finding import Check, Finding, Unjudged, per_flight
from greybox.data.checks.rates import body_rates, shown_by, windows
from greybox.data.checks.signals import smoothed
from greybox.data.checks.torque import expected_signs, torque_regression
from greybox.data.checks.view import View

LEAST_RATE = 0.03
"""Body rate [rad/s RMS] below which an axis is called still."""

LEAST_COMMAND = 0.003
"""Change of a command combination (share of the range, RMS about its 1 s mean) below which it is
called still, unless the motion shows it."""

LEAST_TIME = 5.0
"""Shorter flights [s] are worth a warning."""


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on axes that hardly move, with the size of motion and command per axis."""
    if view.flight is None:
        yield Unjudged(
            check="excitation", flight=view.name, reason="no airborne stretch on a usable clock"
        )
        return
    if not view.drives:
        yield Unjudged(
            check="excitation", flight=view.name, reason="neither all commands nor all rotor speeds"
        )
        return
    evidence: dict[str, float] = {"duration_s": view.flight.duration}
    still = []
    u = view.drive
    moved = u - smoothed(u, max(1, round(0.5 / view.dt)))
    actuator = view.vehicle.actuator
    span = actuator.u_max - actuator.u_min if view.commanded else 1.0
    seen = _seen(view)
    mix = np.vstack([expected_signs(view), np.full((1, u.shape[1]), 1.0 / np.sqrt(u.shape[1]))])
    for name, row in zip(("roll", "pitch", "yaw", "thrust"), mix, strict=True):
        combined = (moved @ row) / np.sqrt(u.shape[1]) / span
        if not np.isfinite(combined).any():
            continue  # too short for a mean to move about
        size = float(np.sqrt(np.nanmean(combined**2)))
        evidence[f"{name}_command_rms"] = size
        if size < LEAST_COMMAND and np.any(row) and name not in seen:
            still.append(f"{name} command")
    if shown_by(view):
        rate, _ = body_rates(view, windows(view)[-1])
        for name, column in zip(("p", "q", "r"), rate.T, strict=True):
            known = column[np.isfinite(column)]
            size = float(known.std()) if known.size else 0.0
            evidence[f"{name}_rms_rad_s"] = size
            if size < LEAST_RATE:
                still.append(name)
    if view.has("velocity"):
        speed = np.linalg.norm(view.group("velocity"), axis=1)
        evidence["speed_max_m_s"] = float(np.nanmax(speed, initial=0.0))
    short = view.flight.duration < LEAST_TIME
    if still or short:
        text = f"hardly any excitation of {', '.join(still)}" if still else "a short flight"
    else:
        text = "every axis is excited"
    yield Finding(
        check="excitation",
        severity="warning" if still or short else "info",
        flight=view.name,
        where=", ".join(still) or f"{view.flight.duration:.1f} s of flight",
        message=text,
        evidence=evidence,
        fix="fly doublets or chirps about that axis; parameters that only it shows may keep their "
        "prior, or have wide errors",
    )


def _seen(view: View) -> set[str]:
    """The axes whose motion shows what the commands do, however little they move: a quiet craft of
    much torque needs hardly any command."""
    found = torque_regression(view)
    if found is None:
        return set()
    return {a for a, seen in zip(("roll", "pitch", "yaw"), found.seen, strict=True) if seen}


CHECK = Check(name="excitation", question="Does every axis move enough?", run=per_flight(run))
