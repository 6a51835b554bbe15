"""Setpoints: a planned flight as a table for an autopilot, one row per sample.

`t` [s]; `sp_x, sp_y, sp_z` [m] and `sp_vx ..`, `sp_ax ..` world (the derivatives for feed-forward);
`sp_yaw` [rad], `sp_yaw_rate` [rad/s]; `inj_roll, inj_pitch, inj_yaw` angular accelerations
[rad/s^2] and `inj_thrust` specific thrust [m/s^2] to add behind the attitude controller;
`manoeuvre` counts the manoeuvres from 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from greybox.planning.excitation_blocks import ExcitationBlock, sequence
from greybox.planning.limits import Limits
from greybox.symbolic import FloatArray


def setpoints(
    steps: Sequence[tuple[ExcitationBlock, float]], limits: Limits, dt: float, gravity: float
) -> dict[str, FloatArray]:
    """Columns (n,) by name, n = seconds / dt."""
    manoeuvre = sequence(steps, limits)
    n = round(sum(p.seconds for p, _ in steps) / dt)
    t = dt * np.arange(n)
    path = np.array([manoeuvre.path(float(v), 1.0) for v in t])
    path[:, 3] = np.unwrap(path[:, 3])
    twist = np.array([manoeuvre.twist(float(v), 1.0) for v in t])
    velocity = np.gradient(path, dt, axis=0)
    push = np.gradient(velocity, dt, axis=0)
    out = {"t": t} | {f"sp_{a}": path[:, i] for i, a in enumerate("xyz")}
    out |= {f"sp_v{a}": velocity[:, i] for i, a in enumerate("xyz")}
    out |= {f"sp_a{a}": push[:, i] for i, a in enumerate("xyz")}
    out |= {"sp_yaw": path[:, 3], "sp_yaw_rate": velocity[:, 3]}
    out |= {f"inj_{a}": twist[:, i] for i, a in enumerate(("roll", "pitch", "yaw"))}
    out["inj_thrust"] = gravity * twist[:, 3]
    ends = np.cumsum([p.seconds for p, _ in steps])
    out["manoeuvre"] = 1.0 + np.minimum(np.searchsorted(ends, t, side="right"), len(steps) - 1)
    return out


def csv(columns: dict[str, FloatArray]) -> str:
    """The table as CSV text, a header row first, to ten digits: an hour of 8 kHz, and signals of
    any size."""
    rows = np.stack(list(columns.values()), axis=1) + 0.0
    body = "\n".join(",".join(f"{v:.10g}" for v in row) for row in rows.tolist())
    return ",".join(columns) + "\n" + body + "\n"
