"""Flights of `greybox mpc rates`: five rate controllers with the same seeds, kept row by row, and
what they say together.

    pid            the rate loops of the vehicle file
    linear         predictive control on the linear model, plans up to the limits
    linear-tube    the same, tightened by the linear model's own covariance
    hybrid         predictive control on the linear model with its process
    tube           the same, tightened by the covariance with the process's variance

Weights are one set for all, set by hand on training seeds. The vehicle file is wrong by what
`identify.ERRORS` says.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from greybox.baselines.output_residual import OutputHybrid
from greybox.files import checksum, file_sha256
from greybox.model.identified import library_versions
from greybox.report.mpc_documents import RatesController, RatesDocument, RatesFound, RatesTrace
from mpc_export.kept_flights import Row, flights
from mpc_export.mission import TRAINING_SEEDS
from mpc_export.predictors import predictor_model
from mpc_export.promise import answer_times, counted, kept, left_open, p_value
from mpc_export.rates.controller import FORM, RateController, RateProblem
from mpc_export.rates.craft import FLIGHTS, OUTPUTS, PLANT, Task, vehicle
from mpc_export.rates.flight import Flight, Pilot, fly, outer_loops
from mpc_export.rates.identify import identify, vehicle_card
from mpc_export.tube.risk import kappa

TEXTS = {
    "pid": "PID loops that know the vehicle file, which is 8 to 10 % wrong",
    "linear": "linear model, no tightening",
    "linear-tube": "linear model, tightened by its own covariance",
    "hybrid": "linear model and Gaussian process, no tightening",
    "tube": "linear model and Gaussian process, tightened by their covariance",
}
PLAIN = {"linear-tube": "linear", "tube": "hybrid"}
"""On whose training flights the touched limits of a tightened controller are counted."""
TUNING = 4
"""Training flights on which they are."""
WATCHED = 2
"""So many flights are kept for the animation."""


class FlightRow(Row[RatesTrace], Flight):
    """A flight as it is kept."""


@dataclass(kw_only=True)
class Rates:
    """Everything that flies: models, plant, controllers by name with their standard deviations
    `kappa`."""

    out: Path
    task: Task
    hybrid: OutputHybrid
    level: float
    kappa: dict[str, float]
    touched: dict[str, float]

    def __post_init__(self) -> None:
        problem = RateProblem(limit=self.task.limit)
        self.plant = vehicle()
        card = vehicle_card(self.out / "models")
        planners = {
            "linear": RateController(predictor_model(self.hybrid.base), problem),
            "hybrid": RateController(predictor_model(self.hybrid), problem),
        }
        self._pilots = {
            n: Pilot(outer=outer_loops(card, self.task), inner=planners.get(PLAIN.get(n, n)))
            for n in TEXTS
        }
        models = [file_sha256(self.out / "models" / f) for f in ("hybrid.json", "vehicle.toml")]
        self._key = checksum([repr(self.task), repr(problem), FORM, PLANT, *models])

    def key(self, name: str) -> str:
        """What a row must have been flown with to count."""
        return checksum([self._key, name, self.kappa.get(name, 0.0)])[:16]

    def fly(self, name: str, seed: int, *, watch: bool = False) -> FlightRow:
        """One flight of a controller."""
        pilot = self._pilots[name]
        if pilot.inner is not None:
            pilot.inner.kappa = self.kappa.get(name, 0.0)
        return {
            "controller": name,
            "key": self.key(name),
            **fly(pilot, self.plant, self.task, seed, watch=watch),
        }


def prepare(out: Path, level: float, say: Callable[[str], None], task: Task | None = None) -> Rates:
    """Models from training flights, and back-offs from the limits that untightened training flights
    touch (Boole)."""
    found = Rates(
        out=out,
        task=task or Task(),
        hybrid=identify(out / "models", say),
        level=level,
        kappa={},
        touched={},
    )
    for tightened, plain in PLAIN.items():
        say(f"counting limits that {plain} touches on {TUNING} training flights")
        seeds = TRAINING_SEEDS[FLIGHTS : FLIGHTS + TUNING]
        pairs = float(
            np.mean(
                [r["touched"] for r in flights(found, [plain], seeds, say=say, log="tuning.jsonl")]
            )
        )
        found.touched[tightened] = pairs
        found.kappa[tightened] = kappa(level, max(pairs, 1.0))
    return found


def summary(
    rates: Rates, rows: Sequence[FlightRow], seeds: Sequence[int], command: str
) -> RatesDocument:
    """The content of mpc_rates.json (greybox.mpc_rates/1)."""
    file = rates.out / "models" / "hybrid.json"
    out: RatesFound = {
        "schema": "greybox.mpc_rates/1",
        "command": command,
        "level": rates.level,
        "plant": PLANT,
        "model": rates.hybrid.name,
        "model_sha256": file_sha256(file),
        "features": list(rates.hybrid.features),
        "limit": rates.task.limit,
        "seconds": rates.task.seconds,
        "outputs": list(OUTPUTS),
        "seeds": {"first": min(seeds), "count": len(seeds)},
        "tuning": {
            n: {"touched": rates.touched[n], "kappa": k, "flights": TUNING}
            for n, k in rates.kappa.items()
        },
        "controllers": {
            n: _controller(n, [r for r in rows if r["controller"] == n], rates) for n in TEXTS
        },
    }
    return {
        **out,
        "verdict": verdict(out),
        "next": advice(out, file),
        "versions": library_versions(),
    }


def beyond(row: Flight) -> bool:
    """Whether a true rate went beyond the limit, or the craft was lost."""
    return bool(row["crashed"] or row["beyond"])


def _controller(name: str, rows: Sequence[FlightRow], rates: Rates) -> RatesController:
    n, hits = len(rows), sum(map(beyond, rows))

    return {
        "text": TEXTS[name],
        "kappa": rates.kappa.get(name, 0.0),
        "flights": n,
        "beyond": counted(hits, n),
        "p_value": p_value(hits, n, rates.level),
        "crashed": sum(bool(r["crashed"]) for r in rows),
        "samples_beyond": sum(r["beyond"] for r in rows) / max(1, sum(r["samples"] for r in rows)),
        "worst": max((max(r["worst"]) for r in rows), default=None),
        "rmse": _mean([r["rmse"] for r in rows]),
        "away": _mean([r["away"] for r in rows]),
        "failures": sum(r["failures"] for r in rows),
        "solve_ms": answer_times(rows),
    }


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def verdict(content: RatesFound) -> str:
    """One or two sentences: was the promise kept, and what did the others do?"""
    found = content["controllers"]
    tube = found["tube"]
    if not tube["flights"]:
        return "The tube has not flown yet."
    others = ", ".join(
        f"{n} in {c['beyond']['count']} of {c['flights']}"
        for n, c in found.items()
        if n != "tube" and c["flights"]
    )
    may = f"flights may go beyond a body rate of {content['limit']:g} rad/s"
    promise = kept("The tube", tube, tube["flights"], content["level"], may)
    return f"{promise}. Beyond it went {others}."


def advice(content: RatesFound, file: Path) -> list[str]:
    """What to do next."""
    tube = content["controllers"]["tube"]
    out = []
    if tube["flights"] and left_open(tube, content["level"]):
        out.append(
            "So few flights leave the share open: fly more with --flights; the ones that are there "
            "are kept."
        )
    out.append(
        f"The model that plans is a file: greybox export {file} --with covariance,filter writes it "
        "as C."
    )
    out.append(
        "A craft of your own: greybox linear, then greybox learn on what it wrote, and the same "
        "export."
    )
    return out


def format_table(content: RatesFound) -> str:
    """The table for a terminal."""
    lines = [
        f"{'controller':11s} {'flights':>7s} {'beyond':>6s} {'95 % interval':>14s} "
        f"{'time beyond':>11s} {'worst [rad/s]':>13s} {'RMSE [rad/s]':>12s} {'off path [m]':>12s} "
        f"{'median/99 % [ms]':>16s}"
    ]
    for name, c in content["controllers"].items():
        if not c["flights"]:
            lines.append(f"{name:11s} {0:7d}")
            continue
        low, high = (100 * v for v in c["beyond"]["interval"])
        t = c["solve_ms"]
        lines.append(
            f"{name:11s} {c['flights']:7d} {c['beyond']['count']:6d} {low:5.0f} ..{high:4.0f} % "
            f"{100 * c['samples_beyond']:9.1f} % {c['worst']:13.2f} {c['rmse']:12.3f} "
            f"{c['away']:12.2f} {t['median']:8.1f}/{t['p99']:.1f}"
        )
    return "\n".join(lines)
