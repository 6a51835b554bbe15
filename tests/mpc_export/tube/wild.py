"""Measurements of every kind that no sensor should send, and a flight of a pilot through them."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from mpc_export.tube.descent import Watch

STRETCH, REST = 100, 150
"""Samples with one kind of damage, and without any after it."""
SOON = 5
"""So many samples after the damage good measurements are believed."""
NEAR = 0.1
"""Who is nearer is there [m]."""


def _power(rng, low, high):
    return float(rng.choice((-1.0, 1.0))) * 10.0 ** rng.uniform(low, high)


KINDS = {
    "near": lambda v, _, rng: v + rng.uniform(-0.3, 0.3),
    "wild": lambda v, _, rng: v + _power(rng, -3, 12),
    "nan": lambda *_: math.nan,
    "inf": lambda _, __, rng: float(rng.choice((-math.inf, math.inf))),
    "none": lambda *_: None,
    "text": lambda *_: "n/a",
    "constant": lambda _, constant, __: constant,
    "jump": lambda v, constant, _: v + math.copysign(1.0 + 9.0 * abs(constant), constant),
    "denormal": lambda _, __, rng: _power(rng, -323, -308),
    "huge": lambda _, __, rng: _power(rng, 100, 308),
    "whole": lambda _, __, rng: int(rng.integers(-9, 9)) * 10 ** int(rng.integers(0, 400)),
}
CLOCKS = (None, math.nan, math.inf, -1e300, 1e9, "noon", 0.0)


@dataclass
class Tally:
    """What a fuzzed flight did. outside: commands beyond limits or rate, or not finite. Of `rests`,
    the stretches without damage, `back` ended with a plan and an estimate within 0.1 m, `home` with
    the craft within 0.1 m of its place besides; of the others a pilot who is told the true state
    from SOON samples after the damage on brings `lost` home. slowest: call [s]."""

    steps: Counter = field(default_factory=Counter)
    events: Counter = field(default_factory=Counter)
    outside: int = 0
    raised: list[str] = field(default_factory=list)
    back: int = 0
    rests: int = 0
    home: int = 0
    lost: int = 0
    slowest: float = 0.0


def damaged(measured, kind, share, constant, rng):
    """Some of the columns, or None for all of them."""
    if kind == "missing":
        return (
            None
            if rng.random() < 0.5
            else {k: v for k, v in measured.items() if rng.random() > share}
        )
    kinds = list(KINDS)
    out = dict(measured)
    for column, value in measured.items():
        if rng.random() < share:
            change = KINDS[kinds[int(rng.integers(len(kinds)))] if kind == "mixed" else kind]
            out[column] = change(value, constant, rng)
    return out


def brought_home(pilot, place, x, u):
    """Whether a pilot who is told the true state brings the craft from x under u to its place in
    what is left of a rest."""
    f = pilot.filter
    at = [f.states.names.index(f"position.{a}") for a in "xyz"]
    pilot.start(x)
    pilot.u, pilot.past = u.copy(), [u.copy() for _ in pilot.past]
    for k in range(REST - SOON):
        pilot.estimator.x = x.copy()
        measured = dict(
            zip(f.outputs.names, f["h"](x, u, f.parameter_values).full().ravel().tolist())
        )
        new = np.array(pilot.sample(k * pilot.model.sample_time, measured))
        x, u = f["f_d"](x, u, f.parameter_values).full().ravel(), new
    return bool(np.abs(x[at] - place[at]).max() < NEAR)


def fuzzed(pilot, steps, seed):
    """The model as the plant, taken back to its place when it flew off or before every rest, and
    measurements damaged in stretches. A descent is taken back too: the pilot starts anew."""
    rng, tally, f = np.random.default_rng(seed), Tally(), pilot.filter
    pilot.start()
    place = pilot.estimate.copy()
    at = [f.states.names.index(f"position.{a}") for a in "xyz"]
    begun = []
    x, u, clock, kind, share, constant = place.copy(), pilot.u.copy(), 0.0, "", 0.0, 0.0
    kinds = (*KINDS, "missing", "mixed", "clock")
    for k in range(steps):
        if k % (STRETCH + REST) == 0:
            kind, constant = kinds[int(rng.integers(len(kinds)))], float(rng.uniform(-1, 1))
            share = float(rng.choice((0.05, 0.3, 1.0)))
        resting = k % (STRETCH + REST) >= STRETCH
        if k % (STRETCH + REST) == STRETCH or not np.abs(x[at]).max() < 50.0:
            x = place.copy()
        if k % (STRETCH + REST) == STRETCH and pilot.descending:
            pilot.descent, pilot._watch = None, Watch()
        if k % (STRETCH + REST) == STRETCH + SOON:
            begun.append((x.copy(), u.copy()))
        measured = dict(
            zip(f.outputs.names, f["h"](x, u, f.parameter_values).full().ravel().tolist())
        )
        told = clock = clock + pilot.model.sample_time
        if not resting:
            if kind == "clock":
                told = CLOCKS[int(rng.integers(len(CLOCKS)))] if rng.random() < share else told
            else:
                measured = damaged(measured, kind, share, constant, rng)
        begin = time.perf_counter()
        try:
            new = np.array(pilot.sample(told, measured))
        except Exception as error:
            tally.raised.append(f"{kind}: {type(error).__name__}: {error}")
            new = u
        tally.slowest = max(tally.slowest, time.perf_counter() - begin)
        tally.steps["rest" if resting else kind] += 1
        p = pilot.problem
        bounded = (new >= p.command_min).all() and (new <= p.command_max).all()
        within = bounded and (np.abs(new - u) <= p.rate_max + 1e-12).all()
        tally.outside += not within
        tally.events.update(e.what.split(":")[0] for e in pilot.events)
        pilot.events.clear()
        x, u = f["f_d"](x, u, f.parameter_values).full().ravel(), new
        if k % (STRETCH + REST) == STRETCH + REST - 1:
            tally.rests += 1
            known = np.abs(pilot.estimate[at] - x[at]).max() < NEAR
            back = bool(known and pilot.plan is not None and pilot._failures == 0)
            tally.back += back
            if back and np.abs(x[at] - place[at]).max() < NEAR:
                tally.home += 1
                begun.pop()
    tally.lost = sum(
        brought_home(pilot, place, *start) for start in begun[: tally.rests - tally.home]
    )
    return tally
