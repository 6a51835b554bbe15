"""Check of the clock: time that goes back or stands still, wrong unit, jitter."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from greybox.data.checks.finding import Check, Finding, per_flight
from greybox.data.checks.view import View
from greybox.data.clock import GOES_BACK, STANDS_STILL, UNIT, backward_rows, no_flight_log

JITTER = 0.6
"""Range of the steps, as a share of the sample time, from which resampling is worth a warning."""


def run(view: View) -> Iterator[Finding]:
    """Findings on the time stamps."""
    raw = view.raw
    bad = backward_rows(raw.t)
    steps = np.diff(raw.t)
    for what, count, text, fix in (
        ("repeated", int((steps == 0).sum()), "the same time stamp comes twice", STANDS_STILL),
        ("backward", int((steps < 0).sum()), "time goes back", GOES_BACK),
    ):
        if count:
            k = int(bad[np.flatnonzero((steps[bad - 1] == 0) == (what == "repeated"))[0]])
            yield Finding(
                check="clock",
                severity="blocking",
                flight=view.name,
                where=f"t, row {raw.rows[k]}",
                message=f"{text} ({raw.t[k - 1]:.15g} s, then {raw.t[k]:.15g} s)",
                evidence={
                    f"{what}_rows": count,
                    "first_row": int(raw.rows[k]),
                    "step_s": float(steps[k - 1]),
                },
                fix=fix,
            )
    if view.clock is None:
        return
    rate = view.rate
    wrong = no_flight_log(rate)
    if wrong is not None:
        yield Finding(
            check="clock",
            severity="blocking",
            flight=view.name,
            where="t",
            message=wrong,
            evidence={"rate_hz": rate},
            fix=UNIT,
        )
    elif not view.clock.uniform:
        yield Finding(
            check="clock",
            severity="warning" if view.clock.jitter > JITTER else "info",
            flight=view.name,
            where="t",
            message=f"the clock is not uniform ({rate:.4g} Hz on average); it will be resampled",
            evidence={"rate_hz": rate, "jitter_share": view.clock.jitter},
            fix="log at a fixed rate, stamped where the sensor is read",
        )


CHECK = Check(
    name="clock",
    question="Does time go forward, in seconds, at a steady rate?",
    run=per_flight(run),
)
