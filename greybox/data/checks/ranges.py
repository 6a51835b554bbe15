"""Check of ranges: values that no such channel can have, commands out of range, quaternions not of
unit length."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.channel import channel, group_names
from greybox.data.checks.finding import Check, Finding, Severity, per_flight
from greybox.data.checks.view import View
from greybox.data.column_guess import range_of_commands
from greybox.data.impossible import OUTSIDE, OVERSPEED, SPIKES, lowest, top_speed

BLOCKING_SHARE = 0.01
REMOVED_SHARE = 0.05
"""Missing samples harm no fit; a sensor of which so many are removed is broken."""
COMMAND_SLACK = 0.02
"""Commands may pass their range by this share of it."""

UNIT_SLACK = 0.02
"""Largest deviation of a quaternion's length from 1."""

FIXES = {
    "command": "give the range of the commands: [columns.command] limits = [0, 65535], [1000, "
    "2000] or what the log says",
    "rotor_speed": "check the unit: rad/s (unit = 'rpm' in [columns.rotor_speed]), and "
    "actuator.speed_max",
    "rate": "check the unit: rad/s (unit = 'deg/s' in [columns.rate])",
    "specific_force": "check the unit: m/s^2",
    "attitude": "check which columns hold the quaternion",
}


def run(view: View) -> Iterator[Finding]:
    """Findings on values outside the plausible range."""
    log = view.raw
    actuator = view.vehicle.actuator
    slack = COMMAND_SLACK * (actuator.u_max - actuator.u_min)
    for name, values in log.channels.items():
        declared = channel(name)
        lower, upper = lowest(declared, values), declared.upper
        if declared.group == "command":
            lower, upper = actuator.u_min - slack, actuator.u_max + slack
        top = top_speed(view.vehicle) if declared.group == "rotor_speed" else None
        if top is not None and (values > OVERSPEED * top).mean() > SPIKES:
            upper = OVERSPEED * top  # fewer are spikes, which are removed
        outside = np.flatnonzero((values < lower) | (values > upper))
        if outside.size:
            share = outside.size / max(int(np.isfinite(values).sum()), 1)
            worst = values[outside[np.argmax(np.abs(values[outside]))]]
            # Slack is for noise: what is said is the range itself.
            low, high = declared.lower, upper
            if declared.group == "command":
                low, high = actuator.u_min, actuator.u_max
            unit = "" if declared.unit == "1" else f" {declared.unit}"
            yield Finding(
                check="ranges",
                severity="blocking" if share > BLOCKING_SHARE else "warning",
                flight=view.name,
                where=f"channel {name}, row {log.rows[outside[0]]}",
                message=f"{outside.size} value(s) outside {low:g} .. {high:g}{unit}",
                evidence={"rows": int(outside.size), "share": share, "worst": float(worst)},
                fix=(
                    _range_of(view)
                    if declared.group == "command" and share > BLOCKING_SHARE
                    else FIXES.get(declared.group, "check the unit in [columns]")
                ),
            )
    yield from _removed(view)
    names = group_names("attitude")
    if all(n in log.channels for n in names):
        norm = np.sqrt(sum(log.channels[n] ** 2 for n in names))
        bad = np.flatnonzero(np.abs(norm - 1.0) > UNIT_SLACK)
        if bad.size:
            share = bad.size / max(int(np.isfinite(norm).sum()), 1)
            yield Finding(
                check="ranges",
                severity="blocking" if share > BLOCKING_SHARE else "warning",
                flight=view.name,
                where=f"qw..qz, row {log.rows[bad[0]]}",
                message=f"{bad.size} quaternion(s) not of unit length",
                evidence={"rows": int(bad.size), "share": share, "first_norm": float(norm[bad[0]])},
                fix="leave the cells empty where the attitude was lost; check the column names",
            )


def _range_of(view: View) -> str:
    """The range to state for commands that are outside of 0 to 1: a customary one that they
    fill, where the file states none."""
    source = view.vehicle.columns.sources.get("command")
    stated = source is not None and source.limits is not None
    values = [v for n, v in view.raw.channels.items() if channel(n).group == "command"]
    usual = range_of_commands(
        min(float(np.nanmin(v)) for v in values), max(float(np.nanmax(v)) for v in values)
    )
    if stated or usual is None:
        return FIXES["command"]
    low, high = usual
    return f"give the range of the commands: [columns.command] limits = [{low:g}, {high:g}]?"


def _removed(view: View) -> Iterator[Finding]:
    """Samples inside their range that no craft can have made: every command takes them as
    missing."""
    for removed in view.possible.removed:
        if removed.reason == OUTSIDE:
            continue
        before, after = (log.channels[removed.channels[0]] for log in (view.raw, view.possible))
        gone = view.raw.t[np.isfinite(before) & np.isnan(after)]
        share = removed.count / max(int(np.isfinite(before).sum()), 1)
        # A blow that no rotor gave; where the flight is not known, nothing is known to be one.
        landing = view.flight is not None and not any(view.in_flight(t) for t in gone)
        severity: Severity = (
            "blocking" if share > REMOVED_SHARE else "info" if landing else "warning"
        )
        yield Finding(
            check="ranges",
            severity=severity,
            flight=view.name,
            where=f"{', '.join(removed.channels)}, first at t = {removed.first_time:.3f} s",
            message=f"{removed.count} sample(s) taken as missing: {removed.reason}",
            evidence={"rows": removed.count, "share": share, "worst": removed.worst},
            fix="leave these cells empty; --keep-impossible fits them all the same",
        )


CHECK = Check(name="ranges", question="Is every value possible?", run=per_flight(run))
