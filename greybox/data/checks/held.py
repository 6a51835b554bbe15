"""Check of held samples: a stream that was logged in more rows than it has samples.

Of what is measured only the first of each run of repeats counts. Commands truly hold until the next
one; but a log in which they are held and a command that is held look alike, and where they were
sent faster than they were logged they are old. The motion tells which: it cannot follow what is sent
at the end of an interval before that.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.channel import command_names, group_names
from greybox.data.checks.block_sums import BLOCKS
from greybox.data.checks.finding import Check, Finding, Severity, Unjudged, per_flight
from greybox.data.checks.rates import HALF_WINDOW
from greybox.data.checks.relations import CLEAR, jackknife
from greybox.data.checks.signals import FloatArray, IntArray
from greybox.data.checks.torque import torque_regression
from greybox.data.checks.view import View
from greybox.data.drive import drive_names
from greybox.data.repeats import Held, held, repeated, said

MATTERS = 0.025
"""Intervals of commands from here on change what is found of the motors [s]."""
PAST = 3
"""Commands before that of an interval which still act in it."""
FEWEST = 60
"""Fewer intervals than this tell nothing."""
ITSELF = 0.05
"""A weight of the next command that is below this is none."""
IMU = ("rate", "specific_force")


def run(view: View) -> Iterator[Finding | Unjudged]:
    """Findings on measured channels that repeat, and on commands that are held."""
    raw = view.raw
    for one in repeated(raw):
        yield _finding(view, one, "info", said(one), "leave the cells empty between its samples")
    for group in IMU:
        imu = held(raw, group, group_names(group))
        if imu is not None:
            yield _finding(view, imu, "warning", _of_imu(imu), "log the IMU as it is sampled")
    names = drive_names(raw.channels, len(view.vehicle.rotors))
    drives = held(raw, "drive", names)
    if drives is not None and drives.interval >= MATTERS:
        yield _of_drives(view, drives)


def _of_imu(one: Held) -> str:
    return (
        f"every sample comes {one.rows} times: its noise is no longer white, and it is "
        f"{0.5e3 * (1.0 - 1.0 / one.rows) * one.interval:.3g} ms late on average"
    )


def _of_drives(view: View, one: Held) -> Finding:
    """What is said of commands (or rotor speeds) that are held over one interval."""
    what = "commands" if command_names(one.names) else "rotor speeds"
    text = f"the {what} change every {1e3 * one.interval:.0f} ms only ({one.rows} rows)"
    old = (
        f"what is held is {0.5e3 * one.interval:.0f} ms old on average, so that the lag of the "
        "motors is found too short by as much, and the thrust differs by what changes meanwhile"
    )
    severity: Severity = "warning"
    evidence = {"interval_s": one.interval, "rows": one.rows}
    found = _foreseen(view, one)
    if found is not None:
        evidence |= {"next_share": found[0], "next_share_error": found[1]}
    share, error = found or (0.0, float("inf"))
    if share - CLEAR * error > ITSELF:
        text += f", but the motion follows them before they stand in the log: {old}"
    elif share + CLEAR * error < ITSELF:
        text, severity = f"{text}, and so does the motion", "info"
    else:
        text += f", and the motion does not tell whether they were sent so; if faster, {old}"
    return _finding(view, one, severity, text, f"log the {what} as they are sent", evidence)


def _foreseen(view: View, one: Held) -> tuple[float, float] | None:
    """(weight of the next command, as a share of all, in the angular acceleration at the end of an
    interval, its standard error); None where the flight does not tell it.

    The commands of this interval and of those before it stand beside, and the rates. What is sent
    next answers to the motion, which gives it a weight of the other sign.
    """
    torque = torque_regression(view) if view.flight is not None and view.has("rate") else None
    if torque is None:
        return None
    log = view.increasing
    u = np.column_stack([log.channels[n] for n in one.names])
    known = np.flatnonzero(np.isfinite(u).all(axis=1))
    first = known[np.r_[True, (np.diff(u[known], axis=0) != 0.0).any(axis=1)]]
    wide = max(1, min(one.rows, round(2.0 * HALF_WINDOW * one.rows / one.interval)))
    rate = np.column_stack([log.channels[n] for n in "pq"])
    push = u[first] ** 2 @ torque.gains[:2].T
    end, start = first[PAST + 1 :], first[PAST:-1]
    turn = (rate[end] - rate[end - wide]) / (log.t[end] - log.t[end - wide])[:, None]
    beside = [push[PAST + 1 - k : len(push) - k] for k in range(PAST + 2)]
    every = np.stack([*beside, rate[start]], axis=2)
    usual = end - start <= 2 * one.rows
    good = usual & np.isfinite(turn).all(axis=1) & np.isfinite(every).all(axis=(1, 2))
    good &= np.array([view.in_flight(t) for t in log.t[end]], dtype=bool)
    if good.sum() < FEWEST:
        return None
    parts = np.array_split(np.flatnonzero(good), BLOCKS)
    shares = [_share(turn, every, np.concatenate(parts))]
    shares += [
        _share(turn, every, np.concatenate(parts[:i] + parts[i + 1 :])) for i in range(BLOCKS)
    ]
    return shares[0], jackknife(np.array(shares[1:]))


def _share(turn: FloatArray, every: FloatArray, rows: IntArray) -> float:
    """Weight of the first column over that of all commands, in the regression of both axes (N, 2)
    on these columns (N, 2, k), the last of which has one weight per axis."""
    columns = every[rows] - every[rows].mean(axis=0)
    own = [np.where(np.arange(2) == axis, columns[:, :, -1], 0.0).ravel() for axis in (0, 1)]
    x = np.column_stack([columns[:, :, :-1].reshape(-1, columns.shape[2] - 1), *own])
    y = (turn[rows] - turn[rows].mean(axis=0)).ravel()
    weights = np.linalg.lstsq(x, y, rcond=None)[0][:-2]
    return float(weights[0] / weights.sum())


def _finding(
    view: View,
    one: Held,
    severity: Severity,
    message: str,
    fix: str,
    evidence: dict[str, float] | None = None,
) -> Finding:
    return Finding(
        check="held",
        severity=severity,
        flight=view.name,
        where=", ".join(one.names),
        message=message,
        evidence=evidence or {"interval_s": one.interval, "rows": one.rows},
        fix=fix,
    )


CHECK = Check(
    name="held",
    question="Do samples stand in more rows than were sampled?",
    run=per_flight(run),
)
