"""Runs of `greybox mpc` on a model of the user's own, kept row by row, and what they say together.

mean   predictive control on the model, plans up to the limits
tube   the same, limits tightened by what the model is unsure of
"""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Literal

import numpy as np

from greybox.errors import ModelError, UnknownNameError
from greybox.files import checksum, file_sha256
from greybox.model.identified import IdentifiedModel, library_versions
from greybox.report.mpc_documents import OwnController, OwnDocument, OwnFound, RunTrace
from greybox.residual.files import load_model
from greybox.symbolic import FloatArray
from mpc_export.functions import model_functions
from mpc_export.kept_flights import Row, flights
from mpc_export.mission import TRAINING_SEEDS
from mpc_export.noise import parameter_covariance
from mpc_export.outputs.controller import OutputController, typical_problem
from mpc_export.outputs.machine import Asked, Machine, Run, machine_of, run
from mpc_export.promise import answer_times, counted, kept, left_open, p_value
from mpc_export.tube.risk import kappa

TEXTS = {
    "mean": "the model, plans up to the limits",
    "tube": "the model, limits tightened by what it is unsure of",
}
TUNING = 4
"""Training runs on which the touched limits are counted."""
WATCHED = 1
"""So many runs are kept for the page."""
LONGEST = 100_000
"""Most samples of a run."""
FORM = "no number is beyond, the first command in its range"
"""Of controller and judgement: runs of another form do not count with those of this one."""


class RunRow(Row[RunTrace], Run):
    """A run as it is kept."""


What = Literal["excess", "rmse", "settled"]


@dataclass(kw_only=True)
class OwnCampaign:
    """A model file, what is asked, and two controllers that differ in `kappa` alone."""

    out: Path
    file: Path
    asked: Asked
    level: float
    horizon: int = 20
    plant: str | None = None
    touched: float = 0.0

    def __post_init__(self) -> None:
        model = load_model(self.file)
        assert isinstance(model, IdentifiedModel)
        self.model = model
        names = parameter_covariance(model)[0]
        f = model_functions(model, with_=("covariance", "filter"), runtime_parameters=names)
        self.asked = checked(self.asked, model, f.bounds, self.horizon)
        lower, upper = self._bounds(self.asked.limits, f.outputs.names)
        u_min, u_max = self._bounds(self.asked.ranges, f.inputs.names)
        problem = typical_problem(
            f,
            held=tuple(self.asked.held),
            lower=lower,
            upper=upper,
            u_min=u_min,
            u_max=u_max,
            horizon=self.horizon,
        )
        self.units = {s.name: s.unit for s in (*f.outputs, *f.inputs)}
        self.controller = OutputController(f, problem)
        self.machine = machine_of(self.plant, model)
        self.kappa = {"mean": 0.0, "tube": 0.0}
        self._key = checksum(
            [
                repr(self.asked),
                self.horizon,
                self.plant or "model",
                file_sha256(self.file),
                FORM,
                *(sources(self.plant, self.machine) if self.plant else ()),
            ]
        )

    @staticmethod
    def _bounds(
        given: Mapping[str, tuple[float, float]], names: Sequence[str]
    ) -> tuple[FloatArray, FloatArray]:
        pairs = np.array([given.get(n, (-math.inf, math.inf)) for n in names]).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    def key(self, name: str) -> str:
        """What a row must have been run with to count."""
        return checksum([self._key, name, self.kappa[name]])[:16]

    def fly(self, name: str, seed: int, *, watch: bool = False) -> RunRow:
        """One run of a controller."""
        self.controller.kappa = self.kappa[name]
        found = run(self.controller, self.machine, self.asked, seed, watch=watch)
        return {"controller": name, "key": self.key(name), **found}

    def tune(self, say: Callable[[str], None]) -> None:
        """The back-off for the level, from the limits that training runs without one touch
        (Boole)."""
        if not self.asked.limits:
            return
        say(f"counting limits that {TUNING} training runs touch")
        rows = flights(self, ["mean"], TRAINING_SEEDS[:TUNING], say=say, log="tuning.jsonl")
        self.touched = float(np.mean([r["touched"] for r in rows]))
        self.kappa["tube"] = kappa(self.level, max(self.touched, 1.0))

    @property
    def names(self) -> list[str]:
        """The controllers that run: without limits there is nothing to tighten."""
        return list(TEXTS) if self.asked.limits else ["mean"]


def sources(plant: str, machine: Machine) -> list[str]:
    """SHA-256 of the files of the module that `plant` names, and of the machine's class, where they
    are Python."""
    found = set()
    for of in (sys.modules.get(plant.partition(":")[0]), type(machine)):
        try:
            path = inspect.getsourcefile(of)  # type: ignore[arg-type]
        except (TypeError, OSError):
            continue
        if path and Path(path).is_file():
            found.add(path)
    return [file_sha256(p) for p in sorted(found)]


def checked(
    asked: Asked, model: IdentifiedModel, bounds: tuple[FloatArray, FloatArray], horizon: int
) -> Asked:
    """`asked` with the range of every input, by default that of the training data (`bounds`), and a
    length, by default five horizons for every value. Raises `UnknownNameError`, `ModelError`."""
    inputs, outputs = model.dynamics.inputs.names, model.dynamics.outputs.names
    for option, given, known in (
        ("--hold", asked.held, outputs),
        ("--limit", asked.limits, outputs),
        ("--range", asked.ranges, inputs),
    ):
        for name in given:
            if name not in known:
                raise UnknownNameError(f"{option}: name", name, known)
    if not asked.held:
        first = outputs[0]
        low, high = model.domain.get(first, (0.0, 1.0))
        raise ModelError(
            "a model of your own needs something to hold",
            expected="--hold OUTPUT=VALUE,...",
            got="nothing",
            fix=f"--hold {first}={0.5 * (low + high):.3g}; its outputs are {', '.join(outputs)}",
        )
    ranges = {}
    for name, low, high in zip(inputs, *(v.tolist() for v in bounds), strict=True):
        ranges[name] = asked.ranges.get(name, (low, high))
    for option, pairs, ends in (
        ("--limit", asked.limits, "LOW below HIGH"),
        ("--range", ranges, "two numbers, the first the smaller"),
    ):
        for name, (low, high) in pairs.items():
            finite = option == "--limit" or (math.isfinite(low) and math.isfinite(high))
            if not (low < high and finite):
                raise ModelError(
                    f"{option} {name}",
                    expected=ends,
                    got=f"{low:g},{high:g}",
                    fix=f"{option} {name}=-1,1",
                )
    for name, values in asked.held.items():
        low, high = asked.limits.get(name, (-math.inf, math.inf))
        for value in values:
            if not (math.isfinite(value) and low <= value <= high):
                raise ModelError(
                    f"--hold {name} asks for what --limit forbids"
                    if math.isfinite(value)
                    else f"--hold {name} takes numbers",
                    expected=f"{low:g} to {high:g}",
                    got=f"{value:g}",
                )
    dt, most = model.sample_time, max(map(len, asked.held.values()))
    seconds = 5 * horizon * dt * most if asked.seconds is None else asked.seconds
    if not 10 * dt <= seconds <= LONGEST * dt:
        raise ModelError(
            f"--seconds takes 10 to {LONGEST} samples of {dt:g} s",
            got=f"{seconds:g} s",
            fix=f"--seconds {5 * horizon * dt * most:g}",
        )
    return replace(asked, ranges=ranges, seconds=seconds)


def summary(
    own: OwnCampaign, rows: Sequence[RunRow], seeds: Sequence[int], command: str
) -> OwnDocument:
    """The content of mpc_own.json (greybox.mpc_own/1)."""
    a = own.asked
    out: OwnFound = {
        "schema": "greybox.mpc_own/1",
        "command": command,
        "level": own.level,
        "plant": own.plant or "model",
        "model": own.model.name,
        "model_sha256": file_sha256(own.file),
        "dt": own.model.sample_time,
        "seconds": a.seconds,
        "horizon": own.horizon,
        "held": {n: list(v) for n, v in a.held.items()},
        "limits": {n: [None if math.isinf(e) else e for e in v] for n, v in a.limits.items()},
        "ranges": {n: list(v) for n, v in a.ranges.items()},
        "units": own.units,
        "seeds": {"first": min(seeds), "count": len(seeds)},
        "tuning": {"touched": own.touched, "kappa": own.kappa["tube"], "runs": TUNING},
        "controllers": {
            n: _controller(n, [r for r in rows if r["controller"] == n], own) for n in own.names
        },
    }
    return {**out, "verdict": verdict(out), "next": advice(out), "versions": library_versions()}


def _controller(name: str, rows: Sequence[RunRow], own: OwnCampaign) -> OwnController:
    n, hits = len(rows), sum(r["beyond"] > 0 for r in rows)
    held = list(own.asked.held)
    return {
        "text": TEXTS[name],
        "kappa": own.kappa[name],
        "runs": n,
        "beyond": counted(hits, n),
        "p_value": p_value(hits, n, own.level),
        "samples_beyond": sum(r["beyond"] for r in rows) / max(1, sum(r["samples"] for r in rows)),
        "excess": {o: max(_numbers(rows, "excess", o), default=None) for o in own.asked.limits},
        "rmse": _means(rows, "rmse", held),
        "settled": _means(rows, "settled", held),
        "failures": sum(r["failures"] for r in rows),
        "solve_ms": answer_times(rows),
    }


def _means(rows: Sequence[RunRow], what: What, held: Sequence[str]) -> dict[str, float | None]:
    return {o: fmean(v) if (v := _numbers(rows, what, o)) else None for o in held}


def _numbers(rows: Sequence[RunRow], what: What, output: str) -> list[float]:
    """Of the rows in which it is one: an output that was not finite has no error."""
    return [v for r in rows if (v := r[what][output]) is not None]


def verdict(content: OwnFound) -> str:
    """One or two sentences: how well outputs were held, and whether the promise was kept."""
    found, units = content["controllers"], content["units"]
    name = "tube" if "tube" in found else "mean"
    c = found[name]
    if not c["runs"]:
        return "Nothing has run yet."
    errors = ", ".join(f"{o} to {_text(v, '.3g')} {units[o]}" for o, v in c["settled"].items())
    held = f"Once settled, {name} held {errors} (rms)."
    if c["failures"]:
        plans = "1 plan was" if c["failures"] == 1 else f"{c['failures']} plans were"
        held += f" {plans} not solved: there the commands of the plan before went on."
    if name == "mean":
        return held
    promise = kept("It", c, c["runs"], content["level"], "runs may pass a limit")
    plain = found["mean"]
    return f"{held} {promise}, {plain['beyond']['count']} of {plain['runs']} without tightening."


def _text(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def advice(content: OwnFound) -> list[str]:
    """What to do next."""
    out = []
    tube = content["controllers"].get("tube")
    if tube is None:
        out.append("State what outputs must not leave: --limit OUTPUT=LOW,HIGH.")
    elif left_open(tube, content["level"]):
        out.append(
            "So few runs leave the share open: more with --flights; the ones that are there are kept."
        )
    if content["plant"] == "model":
        out.append(
            "The machine was the model itself: what its structure misses stays unseen. A simulation "
            "of your own flies with --plant MODULE:ATTRIBUTE."
        )
    out.append("The model as C for a controller: greybox export MODEL --with covariance,filter.")
    return out


def format_table(content: OwnFound) -> str:
    """The table for a terminal."""
    held = list(content["held"])
    lines = [
        f"{'controller':10s} {'runs':>5s} {'beyond':>6s} {'95 % interval':>14s} {'time beyond':>11s} "
        + " ".join(f"{'settled ' + o + ' [' + content['units'][o] + ']':>24s}" for o in held)
        + f" {'median/99 % [ms]':>16s}"
    ]
    for name, c in content["controllers"].items():
        if not c["runs"]:
            lines.append(f"{name:10s} {0:5d}")
            continue
        low, high = (100 * v for v in c["beyond"]["interval"])
        t = c["solve_ms"]
        lines.append(
            f"{name:10s} {c['runs']:5d} {c['beyond']['count']:6d} {low:5.0f} ..{high:4.0f} % "
            f"{100 * c['samples_beyond']:9.1f} % "
            + " ".join(f"{_text(c['settled'][o], '.4g'):>24s}" for o in held)
            + f" {t['median']:8.1f}/{t['p99']:.1f}"
        )
    return "\n".join(lines)
