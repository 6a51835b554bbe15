"""Where the back-offs of the tube study come from: rehearsals on the model, passages and constants
on training flights.

Nothing here touches a judging seed. What was found is kept in OUT/tuned.json; delete the file to
tune anew.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.files import write_json
from greybox.model.identified import IdentifiedModel
from mpc_export.mission import TRAINING_SEEDS
from mpc_export.mission.model_plant import RehearsedPlant
from mpc_export.tube.controller import TubeController
from mpc_export.tube.correlation import correlation, error_transition
from mpc_export.tube.risk import kappa, kappa_passages, kappa_rehearsed, passages, touching
from scenarios.studies.tube_flights import controller, crossed, flight

Array = NDArray[np.float64]
TUNING = 24
"""Training flights on which limits are counted and each constant is tried."""
MOVED = (0.001, 0.0025, 0.004)
"""Constant back-offs that are tried [m]."""
REHEARSED = (0.5, 1.0, 1.5, 2.0)
"""Standard deviations that are rehearsed."""
REHEARSALS = 20
"""Flights against the identified model for each of them."""


class Tuning:
    """Where back-offs come from: found when asked for, kept in `out`/tuned.json. No judging seed is
    touched."""

    def __init__(
        self, out: Path, hybrid: IdentifiedModel, report: Callable[[str], None] = print
    ) -> None:
        self.file, self.hybrid, self.report = out / "tuned.json", hybrid, report
        self.values: dict[str, Any] = (
            dict(json.loads(self.file.read_text())["values"]) if self.file.exists() else {}
        )

    def _keep(self, name: str, value: Any) -> Any:
        self.values[name] = value
        write_json(self.file, {"schema": "greybox.study/1", "values": self.values})
        return value

    def rehearsed(self) -> list[tuple[float, int]]:
        """(standard deviations, flights of `REHEARSALS` that crossed) against the identified model
        itself."""
        if "rehearsed" in self.values:
            return [(float(k), int(n)) for k, n in self.values["rehearsed"]]
        self.report(
            f"rehearsing {REHEARSALS} flights at each of {REHEARSED} standard deviations against "
            "the model itself"
        )
        plant, rows = RehearsedPlant(self.hybrid), []
        for k in REHEARSED:
            pilot = controller(self.hybrid, deviations=k)
            rows.append((k, sum(crossed(flight(pilot, s, plant=plant)) for s in range(REHEARSALS))))
        return list(self._keep("rehearsed", rows))

    def lengths(self) -> list[int]:
        """Passages of `TUNING` training flights without tightening [plans]."""
        if "lengths" in self.values:
            return list(self.values["lengths"])
        self.report(f"counting passages on {TUNING} training flights")
        pilot, found = controller(self.hybrid), []
        for seed in TRAINING_SEEDS[1 : 1 + TUNING]:
            seen: list[Any] = []
            flight(
                pilot,
                seed,
                at=lambda _k, _p, flown, seen=seen: seen.append(touching(flown.solver)),  # type: ignore[misc]
            )
            found += passages(seen)
        return list(self._keep("lengths", found))

    def tried(self) -> list[tuple[float, int]]:
        """(constant back-off [m], flights of `TUNING` training flights that crossed)."""
        if "constant" in self.values:
            return [(float(v), int(n)) for v, n in self.values["constant"]]
        self.report(f"trying constants on {TUNING} training flights")
        rows = []
        for moved in MOVED:
            pilot = controller(self.hybrid, moved=moved)
            rows.append(
                (moved, sum(crossed(flight(pilot, s)) for s in TRAINING_SEEDS[1 : 1 + TUNING]))
            )
        return list(self._keep("constant", rows))

    def deviations(self, level: float) -> float:
        """Standard deviations for a risk per flight, by the rehearsals."""
        tried, hits = zip(*self.rehearsed(), strict=True)
        return kappa_rehearsed(level, tried, hits, [REHEARSALS] * len(tried))

    def moved(self, level: float) -> float:
        """The constant [m] for a risk per flight: the same line through what training flights say,
        at its median."""
        tried, hits = zip(*self.tried(), strict=True)
        return 1e-3 * kappa_rehearsed(
            level, [1e3 * v for v in tried], hits, [TUNING] * len(tried), surety=0.5
        )

    def by_boole(self, level: float) -> float:
        """Standard deviations by Boole's inequality over the touched samples of a flight."""
        return kappa(level, max(sum(self.lengths()) / TUNING, 1.0))

    def by_passages(self, level: float) -> float:
        """Standard deviations by passages and the closed loop's correlation."""
        return kappa_passages(
            level, self.lengths(), passage_correlation(controller(self.hybrid)), flights=TUNING
        )


def passage_correlation(pilot: TubeController, length: int = 20) -> Array:
    """Correlation of the deviation along x, the wall's normal, over the stages of a plan."""
    functions = pilot.functions
    normal = np.zeros(len(functions.error_states))
    normal[functions.error_states["d_position.x"]] = 1.0
    transition = error_transition(pilot.filter, pilot.every, len(normal))
    return correlation(functions, pilot.solver.stages, transition, normal, length)
