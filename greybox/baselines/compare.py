"""compare: all methods on the same flights, judged on the same samples, with what they cost.

| method | what it is | tuned |
|---|---|---|
| persistence | the last measured value | |
| linear SISO PEM | one linear model per output, driven by its axis (roll, pitch, yaw, collective) | order by BIC |
| linear MIMO PEM | one linear model, rotor commands to all outputs | order by BIC |
| nonlinear PEM | the Newton-Euler model with its effects | |
| linear PEM + GP | the paper's hybrid: output residual of the SISO models | `budget` candidates |
| nonlinear PEM + GP | `learn`: force and torque in body axes | its own candidates, on left-out flights |
| nonlinear PEM + output GP | output residual of the nonlinear model | `budget` candidates |
| GP alone | NARX | `budget` candidates |
| LSTM | as in Ghoul et al. 2026 | `budget` candidates |
| TCN | decoupled, with history and multi-step loss, as in Rao et al. 2024 | `budget` candidates |
| physics + MLP, physics + LSTM | the nonlinear model without disturbance states, and a network | `budget` candidates |

On request also linear SISO, linear MIMO and nonlinear PEM, each with other learners
(`compare_methods.pairs`).

Candidates are judged on training flights that were held back for it; nothing looks at the test
flights. The commands that linear models, black boxes and residuals use for y(t) end one sample
before t. Black boxes see rates, specific force, body velocity and direction of gravity
(`black_box_view`), predict all of them, and get their pose by the kinematics of
`greybox.baselines.kinematics`; linear models and output residuals predict the IMU and get theirs
likewise. The one-step variance of a model of motion is scaled per channel to its errors on the
training flights, where those of the other methods come from too.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from greybox.baselines.compare_bench import Bench, Outcome
from greybox.baselines.compare_costs import expectation, expected
from greybox.baselines.compare_methods import METHODS, pairs
from greybox.baselines.compare_scores import one_step_scores
from greybox.baselines.document import CompareDocument, MethodRow, SeriesRow
from greybox.baselines.regressors import NotMeasured
from greybox.data.channel import channel
from greybox.errors import GreyboxError, UnknownNameError
from greybox.files import to_plain
from greybox.journal import answers, apart
from greybox.model.identified import library_versions
from greybox.residual.learners import GP, LEARNERS

SCHEMA = "greybox.compare/1"
SHOWN = 4.0
"""Seconds of the first test flight that the figure of predictions shows."""


def compare(
    bench: Bench, methods: Sequence[str] | None = None, *, learners: Sequence[str] = ()
) -> Iterator[CompareDocument]:
    """Run the methods one after the other; yields the content of compare.json after each.

    `methods` (default: all of the table; pairs have names too), then every model with each of
    `learners` (`pairs`). A method that fails, or cannot run on what the flights measure, has its
    reason in its row. Raises `UnknownNameError` for a method that there is not, and as `pairs`.
    """
    more = pairs(learners)
    there = {**METHODS, **pairs((GP, *LEARNERS)), **more}
    chosen = tuple(dict.fromkeys((*(METHODS if methods is None else methods), *more)))
    if not chosen:
        raise GreyboxError(
            "nothing to compare", fix=f"--methods {','.join(list(METHODS)[:2])}, or --learners"
        )
    for name in chosen:
        if name not in there:
            raise UnknownNameError("method", name, there)
    bench.say(
        expectation(
            expected(
                chosen,
                train=sum(s.n for s in bench.train_segments),
                test=sum(s.n for s in bench.segments),
                budget=bench.options.budget,
                fitted=bench.fitted,
            )
        )
    )
    rows: list[MethodRow] = []
    for name in chosen:
        bench.say(f"{name} ...")
        began = time.perf_counter()
        try:
            rows.append(_kept(bench, name, there[name]))
        except NotMeasured as error:
            needs = f"needs {', '.join(error.needs)}"
            rows.append({"method": name, "status": "cannot", "error": needs})
        except Exception as error:  # whatever a method does, the others keep their rows
            rows.append(
                {"method": name, "status": "failed", "error": f"{type(error).__name__}: {error}"}
            )
        bench.say(f"{name}: {rows[-1]['status']} after {time.perf_counter() - began:.0f} s")
        yield _content(bench, rows, [n for n in chosen if n not in {r["method"] for r in rows}])


def _kept(bench: Bench, name: str, method: Callable[[Bench], Outcome]) -> MethodRow:
    """The row of a method, from the journal of the command where it has ended before."""

    def work(_: Sequence[int]) -> Iterator[tuple[int, str]]:
        yield 0, json.dumps(_row(bench, name, method(bench)), default=to_plain)

    with apart(f"method {name}"):
        (told,) = answers([name], work, str)
    row: MethodRow = json.loads(told)
    return row


def _row(bench: Bench, name: str, found: Outcome) -> MethodRow:
    measured, means, variances, inputs = [], [], [], []
    for s, rows, m, v in zip(bench.segments, bench.late, found.mean, found.variance, strict=True):
        if rows.any():
            measured.append(s.matrix(bench.outputs)[rows])
            means.append(m[rows])
            variances.append(v[rows])
            inputs.append(s.matrix(bench.commands)[rows])
    scored = one_step_scores(
        measured,
        means,
        variances,
        inputs,
        names=bench.outputs,
        units=[channel(n).unit for n in bench.outputs],
        spread=bench.spread,
        dt=bench.dt,
    )
    table = found.table
    return {
        "method": name,
        "status": "done",
        **scored,
        "multi_step": None if table is None else table.to_dict(bench.options.horizons),
        "curve": None if table is None else table.curve(),
        "parameters": found.parameters,
        "train_seconds": found.seconds,
        "microseconds_per_sample": found.microseconds,
        "search": list(found.search),
        "settings": dict(found.settings),
        "series": _series(bench, found),
    }


def _series(bench: Bench, found: Outcome) -> dict[str, SeriesRow]:
    """A few seconds of the first test segment for the figure: mean and standard deviation per
    channel."""
    i = 0
    rows = np.flatnonzero(bench.late[i])[: round(SHOWN / bench.dt)]
    mean, std = found.mean[i][rows], np.sqrt(found.variance[i][rows])
    return {
        n: {"mean": mean[:, j].tolist(), "std": std[:, j].tolist()}
        for j, n in enumerate(bench.outputs)
    }


def _content(bench: Bench, rows: Sequence[MethodRow], missing: Sequence[str]) -> CompareDocument:
    first = np.flatnonzero(bench.late[0])[: round(SHOWN / bench.dt)]
    segment = bench.segments[0]
    return {
        "schema": SCHEMA,
        "vehicle": bench.vehicle.name,
        "train": list(bench.train.names),
        "test": list(bench.test.names),
        "sample_time": bench.dt,
        "channels": list(bench.outputs),
        "units": {n: channel(n).unit for n in bench.outputs},
        "train_std": dict(zip(bench.outputs, bench.spread.tolist(), strict=True)),
        "adapt": bench.options.adapt,
        "budget": bench.options.budget,
        "seed": bench.options.seed,
        "horizons": list(bench.options.horizons),
        "origin_spacing": bench.every * bench.dt,
        "held_back": sorted({s.flight for s in bench.split[1]}),
        "black_box_inputs": list(bench.inputs),
        "methods": list(rows),
        "dead_reckoning": bench.extra_tables["dead reckoning"].to_dict(bench.options.horizons)
        if "dead reckoning" in bench.extra_tables
        else None,
        "dead_reckoning_curve": bench.extra_tables["dead reckoning"].curve()
        if "dead reckoning" in bench.extra_tables
        else None,
        "not_run": list(missing),
        "measured": {
            "flight": segment.flight,
            "t": segment.t[first].tolist(),
            "channels": {n: segment.column(n)[first].tolist() for n in bench.outputs},
        },
        "versions": library_versions(),
    }
