"""IMU filter: does the IMU filter what it measures?

A low-pass looks like a motor lag or a delay to everything but the pose, which it does not touch. It competes with the
effects of timing before one of them is named (`filtered_imu`), is asked once more when all names are there
(`filtered_after_all`), and goes again where they do without it (`unfiltered`). The model of the filter is a kind of
`greybox.model.noise`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from greybox.discovery.candidates import TIMING
from greybox.discovery.leftover import ENOUGH, disturbed
from greybox.discovery.nested import ROOM, ROUGH, Nest, NestedFit, Refit, Task
from greybox.discovery.screen import Key, Score
from greybox.discovery.sensor_noise import suspicious, with_parts
from greybox.discovery.veto import HALF
from greybox.model.noise import LowPass, sensor_parts
from greybox.model.sensors import SENSORS, on_clock
from greybox.statistics.evidence import CLEAR

DELAYS = ("sensor_delay", "pose_delay")
"""Those of `TIMING` that nothing but a filter tells from one on slow signals."""
IMU = tuple(x.name for s in SENSORS if s.name in on_clock("imu") for x in s.innovation_signals(None))
"""Innovations of gyro and accelerometer."""
FILTER = 0.004
"""Start value of the filter's time constant [s]."""


def _imu_filters(nest: Nest) -> tuple[LowPass, ...]:
    """Filters of gyro and accelerometer that the model could have; none where it has them already."""
    if any(isinstance(p, LowPass) for p in sensor_parts(nest.candidates.model)):
        return ()
    sensors = nest.candidates.physics.sensor_names
    return tuple(LowPass(sensor=s, time=FILTER) for s in ("gyro", "accelerometer") if s in sensors)


def _likeliest(nest: Nest, tasks: Sequence[Task], held: float) -> Refit | None:
    """The best fit of a contest against one of BIC `held`; None where none can be compared."""
    found = [r for r in nest.contest(tasks, held) if r.comparable]
    return min(found, key=lambda r: r.bic, default=None)


def filtered_imu(nest: Nest, at: NestedFit, rival: NestedFit) -> tuple[Nest, NestedFit, dict[str, float]] | None:
    """(nest, fit, BIC gain of the whole filter by part name) with a low-pass of the IMU, where BIC prefers it to `rival`,
    or it and one of the rival's effects to the rival.

    `at` is the fit without either. None where the IMU is filtered already, or is not there, or the filter does not win.
    """
    parts = _imu_filters(nest)
    if not parts:
        return None
    filtered = with_parts(nest, (*sensor_parts(nest.candidates.model), *parts))
    # A filter delays slow signals by its time constant; noise levels of the better fit are the nearer start.
    late = rival.fit.parameters["sensor_delay.d"].value if "sensor_delay" in rival.effects else FILTER
    first: dict[tuple[str, str | None], float] = {(f"{p.name}.T", None): max(late, 0.25 * FILTER) for p in parts}
    task = filtered.task(at.effects, start=rival, first=first, also=at)
    rough = filtered.refits([replace(task, tolerance=ROUGH)])[0]

    def lost(found: Refit, room: float) -> bool:
        # A filter at a bound is a way round something else that is missing.
        bent = any(f"{p.name}.T" in found.bounds for p in parts)
        return bent or not found.converged or not found.bic < at.bic - CLEAR + room

    if lost(rough, ROOM):
        return None
    exact = filtered.refits([replace(task, starts=(rough.theta,))])[0]
    if lost(exact, 0.0):
        return None
    now = filtered.settle(exact)
    if now.bic >= rival.bic:
        # Lag and delay together may stand in for a filter and one of them, which is then named next to the filter.
        added = [e for e in rival.effects if e not in at.effects]
        with_one = [filtered.task((*at.effects, e), start=rival, first=first, also=at) for e in added]
        if not any(r.converged and r.bic < rival.bic - CLEAR for r in filtered.contest(with_one)):
            return None
    return filtered, now, {p.name: at.bic - now.bic for p in parts}


def unfiltered(plain: Nest, start: NestedFit, at: NestedFit) -> NestedFit | None:
    """The fit of `at` without its filter of the IMU, and perhaps without one of its lags and delays, where that is not
    clearly worse: a filter that came in while much was missing may stand in for it, and a delay then mends the filter.

    `plain` are the candidates without the filter and `start` a fit there, whose noise levels it starts from.
    """
    late = [e.value for n, e in at.fit.parameters.items() if n.startswith("low_pass.")]
    timed = [e for e in at.effects if e in TIMING]
    tasks = []
    for gone in (None, *timed):
        chosen = tuple(e for e in at.effects if e != gone)
        known: dict[Key, float] = {(n, None): e.value for n, e in at.fit.parameters.items() if n.split(".")[0] in chosen}
        more = {k: v + float(np.mean(late)) for k, v in known.items() if k[0].split(".")[0] in timed}
        firsts = (known, known | more) if more else (known,)
        tasks += [plain.task(chosen, start=start, first=first) for first in firsts]
    best = _likeliest(plain, tasks, at.bic)
    return plain.settle(best) if best is not None and best.bic < at.bic + CLEAR else None


def filtered_after_all(plain: Nest, at: NestedFit) -> tuple[Nest, NestedFit, dict[str, float]] | None:
    """As `filtered_imu`, for everything that was named: with a filter of the IMU instead of one of the lags and delays of
    `at`, or next to all of them, where BIC prefers that and the IMU's innovations are not white.

    A lag and two delays imitate a filter and two delays; each of them alone, or the filter next to all, is worse or leads
    back. What is left out hands its time to the delays that stay, and the pose, which no filter touches, may be later.
    Where only the IMU is logged nothing is asked: a filter of all that is measured is a lag of what is commanded.
    """
    timed, parts = [e for e in at.effects if e in TIMING], _imu_filters(plain)
    if not parts or plain.candidates.blind or not any(n in IMU for n in suspicious(at.fit)):
        return None
    filtered = with_parts(plain, (*sensor_parts(plain.candidates.model), *parts))
    known: dict[Key, float] = {
        (u.name, u.flight): float(t) for u, t in zip(at.fit.problem.unknowns, at.fit.theta, strict=True)
        if u.kind == "parameter" and u.name.split(".")[0] in timed
    }  # fmt: skip
    tasks = []
    for gone in (None, *timed):
        chosen = tuple(e for e in at.effects if e != gone)
        lost = float(np.mean([v for (n, _), v in known.items() if n.split(".")[0] == gone] or [0.0]))
        first = {k: v for k, v in known.items() if k[0].split(".")[0] != gone}
        first |= {(f"{p.name}.T", None): FILTER for p in parts}
        handed = {k: v + lost for k, v in first.items() if k[0] == "command_delay.d"}
        later = {k: v + FILTER for k, v in first.items() if k[0] == "pose_delay.d"}
        for more in {tuple(m.items()): m for m in ({}, later, handed, handed | later)}.values():
            task = filtered.task(chosen, start=at, first=first | more)
            tasks.append(replace(task, starts=task.starts[:1]))
    best = _likeliest(filtered, tasks, at.bic)
    if best is None or best.bic >= at.bic - CLEAR or any(f"{p.name}.T" in best.bounds for p in parts):
        return None
    now = filtered.settle(best)
    # As every name it must explain twice what is left: where much is missing a filter takes up some of it.
    if disturbed(now.fit, plain.data, ENOUGH)[1] > HALF * (at.bic - now.bic):
        return None
    return filtered, now, {p.name: at.bic - now.bic for p in parts}


def may_be_filtered(rival: NestedFit, scores: Sequence[Score], alpha: float) -> bool:
    """Whether a filter of the IMU may stand behind the effect of timing that `rival` added; `scores` were taken after it.

    An effect that is there leaves nothing of its kind to find; one that stands in for a filter has another slope: further
    effects of timing pass, or the IMU's innovations have the colour of the noise in front of the filter.
    """
    if set(DELAYS) & set(rival.effects):
        return True
    if any(s.name in TIMING and s.judged and s.p_family <= alpha for s in scores):
        return True
    return any(n in IMU for n in suspicious(rival.fit))
