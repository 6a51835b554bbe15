"""Plausibility: what in a vehicle file no quadrotor has, and which slip of unit or sign would
explain it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from greybox.files import Json
from greybox.model.beliefs import Beliefs
from greybox.model.effects import CATALOGUE, demand_parameters, effect_by_name
from greybox.model.plausibility import judges
from greybox.model.plausibility.allocation import allocation
from greybox.model.plausibility.craft import FIGURES, Craft
from greybox.model.plausibility.finding import SEVERITIES, Implausible
from greybox.model.vehicle import Vehicle
from greybox.shown import Row, Shown

SCHEMA = "greybox.vehicle_check/1"
NOTHING = Beliefs(entries=())


@dataclass(frozen=True, kw_only=True, repr=False)
class Plausibility(Shown):
    """What `check_vehicle` found, the worst first, the key figures (SI) of the craft, and how sure
    its file is of what."""

    vehicle: str
    figures: dict[str, float | None]
    findings: tuple[Implausible, ...]
    beliefs: Beliefs = NOTHING

    @property
    def ok(self) -> bool:
        """Whether nothing blocks."""
        return all(f.severity != "blocking" for f in self.findings)

    @property
    def verdict(self) -> str:
        """ "plausible", "warnings" or "implausible"."""
        levels = {f.severity for f in self.findings}
        return (
            "implausible"
            if "blocking" in levels
            else "warnings"
            if "warning" in levels
            else "plausible"
        )

    def _shown_text(self) -> str:
        """The summary."""
        return self.summary()

    def _shown_rows(self) -> list[Row]:
        """One row per finding; without any the key figures."""
        if self.findings:
            return [asdict(f) for f in self.findings]
        return [{"figure": name, "value": value} for name, value in self.figures.items()]

    def to_dict(self) -> dict[str, Json]:
        """The content of `greybox vehicle check --json` (schema "greybox.vehicle_check/1")."""
        return {
            "schema": SCHEMA,
            "vehicle": self.vehicle,
            "verdict": self.verdict,
            "counts": {s: sum(f.severity == s for f in self.findings) for s in SEVERITIES},
            "figures": self.figures,
            "findings": [asdict(f) for f in self.findings],
            "beliefs": [asdict(b) for b in self.beliefs.entries],
        }

    def summary(self) -> str:
        """The findings, key figures and beliefs as text."""
        units = {"mass": " kg", "arm_length": " m", "torque_over_thrust": " m", "tip_speed": " m/s"}
        figures = [
            f"{k.replace('_', ' ')} {v:.3g}{units.get(k, '')}"
            for k, v in self.figures.items()
            if v is not None
        ]
        believed = self.beliefs.lines()
        return "\n".join(
            [
                f"{self.vehicle}: {self.verdict}",
                f"  {', '.join(figures)}",
                *(f.line() for f in self.findings),
                *(
                    [
                        "believed within one sigma (the rest is exact):",
                        *(f"  {b}" for b in believed),
                    ]
                    if believed
                    else []
                ),
            ]
        )


def check_vehicle(vehicle: Vehicle, *, where: str | None = None) -> Plausibility:
    """Judge a vehicle that its reader accepts; `where`: its file. Raises `UnknownNameError` for an
    effect that the catalogue does not have, and for a parameter that an effect does not have."""
    for name, stated in vehicle.effects.items():
        place = f"{where}: effects.{name}" if where else f"effects.{name}"
        demand_parameters(effect_by_name(name, where=where), stated, vehicle, where=place)
    extreme = list(judges.extremes(vehicle))
    if extreme:
        return Plausibility(
            vehicle=vehicle.name,
            figures=dict.fromkeys(FIGURES),
            findings=tuple(extreme),
            beliefs=vehicle.beliefs,
        )
    with np.errstate(all="ignore"):
        return _judged(Craft(vehicle))


def vehicle_findings(vehicle: Vehicle) -> tuple[Implausible, ...]:
    """What in a vehicle no quadrotor has, the worst first. Effects that are not in the catalogue (a
    user's own) are passed over."""
    own = {e.name for e in CATALOGUE}
    return check_vehicle(
        replace(vehicle, effects={k: v for k, v in vehicle.effects.items() if k in own})
    ).findings


def _judged(craft: Craft) -> Plausibility:
    found = list(judges.size(craft))
    if any(f.severity == "blocking" for f in found):
        found.append(
            Implausible(
                "info",
                "inertia",
                "not judged, nor thrust and torque",
                "mass and arms that fit each other",
                "see above",
                "correct them, then check again",
            )
        )
    else:
        found += [
            f
            for judge in (judges.inertia, judges.thrust, judges.rotors, judges.points)
            for f in judge(craft)
        ]
    found += [
        f for judge in (allocation, judges.lags, judges.sigmas, judges.noise) for f in judge(craft)
    ]
    found.sort(key=lambda f: SEVERITIES.index(f.severity))
    return Plausibility(
        vehicle=craft.vehicle.name,
        figures=craft.figures,
        findings=tuple(found),
        beliefs=craft.vehicle.beliefs,
    )
