"""What discover found: names and their grounds, what is left, the gap; as plain values
(discovery.json) and in words."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from greybox.discovery import document
from greybox.discovery.left import Left
from greybox.discovery.name import LOG10, Name
from greybox.discovery.words import first_line, in_words, rows_of
from greybox.errors import GreyboxError
from greybox.estimation.fit import Fit
from greybox.estimation.noise_table import SensorRow
from greybox.files import to_plain, withdraw, write_atomic, write_json
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel, library_versions
from greybox.model.layer import physics_of
from greybox.model.verdict import Verdict
from greybox.planning.experiment import Manoeuvres
from greybox.plots import bars
from greybox.residual.laws.axis import Axis
from greybox.residual.laws.effect_file import WITH_LAWS, file_name, set_aside_laws
from greybox.shown import Cell, Shown
from greybox.validation.gap import GapRow

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCHEMA = "greybox.discovery/2"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Discovery(Shown):
    """What was found. `verdict` is a key of `SAYS`, `names` everything that was asked, `fit` the
    final structure, `left` what its unnamed force and torque hold. `bar` is the log e-value that a
    name needs, `denied` which stated numbers the flights deny, `so_far` what a stopped search
    knows, `unchanged` what is said where nothing has changed since a model, `ahead` whether errors
    ahead alone judged. `lawful` is the model with laws (the one to go on with; None without),
    `proposals()` the laws as files by name."""

    verdict: str
    names: tuple[Name, ...] = ()
    fit: Fit | None = None
    left: Left | None = None
    before: tuple[Axis, ...] = ()
    gap: tuple[GapRow, ...] = ()
    gap_on: str = ""
    bar: float = 0.0
    alone: float = 0.0
    unjudged: Mapping[str, str] = field(default_factory=dict)
    minimum_detectable: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    faults: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    omega_known: bool
    seconds: float
    settings: document.SearchSettings = field(default_factory=document.SearchSettings)
    tested_on: tuple[str, ...] = ()
    separating: Mapping[str, Manoeuvres | None] = field(default_factory=dict)
    steps: tuple[document.StepRow, ...] = ()
    sensors: tuple[SensorRow, ...] = ()
    base: tuple[str, ...] = ()
    lawful: IdentifiedModel | None = None
    denied: tuple[str, ...] = ()
    so_far: str = ""
    unchanged: str = ""
    ahead: bool = False

    @property
    def model(self) -> IdentifiedModel:
        """The improved model. Raises `GreyboxError` where bad data stopped the search."""
        if self.fit is None:
            raise GreyboxError("no model: blocking faults", fix="mend the log, then run again")
        return self.fit.model

    @property
    def model_verdict(self) -> Verdict | None:
        """What the flights that judge say of the model to go on with; None where nobody asked."""
        final = self.lawful or (self.fit and self.fit.model)
        return final.verdict if final else None

    def _shown_text(self) -> str:
        """The verdict in words."""
        return self.summary()

    def _shown_rows(self) -> list[dict[str, Cell]]:
        return rows_of(self.names)

    def plot(self, ax: Axes | None = None) -> Axes:
        """The log10 e-value of every cause that was judged, against leaving it out, and the bar
        that a name needs; matplotlib axes. Raises `GreyboxError` where none was judged."""
        rows = [(f"{r['cause']} ({r['status']})", r["log10 e"]) for r in self._shown_rows()]
        held = [(n, float(v)) for n, v in rows if isinstance(v, float) and np.isfinite(v)]
        return bars(dict(held), x="log10 e-value", threshold=self.bar / LOG10, ax=ax)

    def said(self, *status: str) -> list[Name]:
        """Names of some status, in the order of the catalogue."""
        return [n for n in self.names if n.status in status]

    def effects(self) -> list[document.NamedRow]:
        """Certified and supported effects with the estimates of the final fit."""
        return [
            {**n.to_dict(), "stage": self._stage(n.name), "parameters": self.numbers_of(n.name)}
            for n in self.said("certified", "supported")
        ]

    def traces(self) -> list[document.UnnamedRow]:
        """What is certain but worth nothing, or of a size that no craft has, with the reason."""
        return [
            {**n.to_dict(), "reason": n.reason, "in_model": n.kept}
            for n in self.said("trace", "impossible")
        ]

    def _stage(self, name: str) -> str:
        if physics_of(self.model.dynamics) is None:
            return "own"
        return next((e.stage for e in self.final_effects if e.name == name), "wrench")

    def numbers_of(self, name: str) -> dict[str, document.Estimate]:
        """Estimates of a cause in the final fit, by the names of its numbers."""
        assert self.fit is not None
        own = self.fit.of_effect(name)
        wide = {n: float(np.hypot(e.std, self._apart(n, e.value))) for n, e in own.items()}
        std = {n: error if np.isfinite(error) else None for n, error in wide.items()}
        rows = [(n.split(".", 1)[-1], e.value, std[n], e.unit) for n, e in own.items()]
        return {n: {"value": value, "std": s, "unit": unit} for n, value, s, unit in rows}

    def _apart(self, parameter: str, value: float) -> float:
        """Standard deviation of its value over causes that the flights cannot tell apart."""
        asked = [(n.shares[s], there) for n in self.names for s, there in n.elsewhere.items()]
        terms = [w * (there.get(parameter, value) - value) ** 2 for w, there in asked]
        return float(np.sqrt(sum(terms)))

    @property
    def final_effects(self) -> tuple[Effect, ...]:
        """Effects of the improved model of a vehicle."""
        physics = physics_of(self.model.dynamics)
        return () if physics is None else tuple(physics.effects)

    def unnamed(self) -> list[document.LeftRow]:
        """Axes that hold something no effect explains; where it has a law, with its file."""
        if self.left is None:
            return []
        numbers = {law.channel: n for n, law in enumerate(self.left.laws, 1)}
        return [
            {**a.to_dict(), "file": file_name(numbers[a.channel])}
            if a.channel in numbers
            else {**a.to_dict(), "file": None, "proposal": None, "depends_on": []}
            for a in self.left.unnamed
        ]

    def proposals(self) -> dict[str, str]:
        """File name -> text, one for every law of what is left."""
        return {} if self.left is None else self.left.files

    def locations(self) -> list[document.LocationRow]:
        """Axes of force and torque: RMS of the discrepancy before and after the names."""
        after = {} if self.left is None else {a.channel: a.rms for a in self.left.axes}
        return [{**a.to_dict(), "rms_after": after.get(a.channel)} for a in self.before]

    def ambiguous(self) -> list[document.AmbiguousRow]:
        """Sets of causes that the flights cannot tell apart."""
        return [
            {
                "candidates": [
                    {"name": c, "weight": w, "elsewhere": dict(n.elsewhere.get(c, {}))}
                    for c, w in n.shares.items()
                ],
                "separating_manoeuvre": self.separating.get(n.name),
                "log10_e": n.certificate.rivals.get((), 0.0) / LOG10,
                "parameters": self.numbers_of(n.name),
            }
            for n in self.said("one of these")
        ]

    def to_dict(self) -> document.DiscoveryDocument:
        """discovery.json, schema "greybox.discovery/2"."""
        fitted = self.fit is not None
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "line": self.line,
            "model_verdict": to_plain(v.to_dict()) if (v := self.model_verdict) else None,
            "bar_log10_e": self.bar / LOG10,
            "alone_log10_e": self.alone / LOG10,
            "effects": self.effects() if fitted else [],
            "traces": self.traces() if fitted else [],
            "omega_known": self.omega_known,
            "ambiguous": self.ambiguous() if fitted else [],
            "unnamed": self.unnamed(),
            "not_certified": [
                {**n.to_dict(), "reason": n.reason, "in_model": n.kept}
                for n in self.said("not certified")
            ],
            "model_with_laws": None if self.lawful is None else WITH_LAWS,
            "base": [{"name": n, "parameters": self.numbers_of(n)} for n in self.base if fitted],
            "sensors": [s.copy() for s in self.sensors],
            "locations": self.locations(),
            "steps": [s.copy() for s in self.steps],
            "gap": [r.to_dict() for r in self.gap],
            "gap_on": self.gap_on,
            "minimum_detectable": {n: dict(v) for n, v in self.minimum_detectable.items()},
            "not_judged": dict(self.unjudged),
            "denied": list(self.denied),
            "faults": list(self.faults),
            "by_errors_ahead": self.ahead,
            "warnings": list(self.warnings),
            "settings": self.settings.copy(),
            "trained_on": list(self.fit.model.trained_on) if self.fit is not None else [],
            "tested_on": list(self.tested_on),
            "data_hash": self.fit.data_hash if self.fit is not None else None,
            "seconds": self.seconds,
            "versions": library_versions(),
        }

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write discovery.json, model.json, and of laws proposal_N.py and model_with_laws.json, as
        `greybox discover` does; returns the folder. Raises `OutputError`."""
        return write_found(self, folder, self.to_dict())

    @property
    def line(self) -> str:
        """What a pilot wants to know, in one line."""
        return self.unchanged or first_line(self)

    def summary(self) -> str:
        """The verdict in words, most important first."""
        return in_words(self)


def write_found(
    found: Discovery, folder: str | os.PathLike[str], content: document.DiscoveryDocument
) -> Path:
    """As `Discovery.save`, with this `content` of discovery.json, which comes last and is alone
    where bad data stopped the search. Laws of an earlier one are set aside."""
    out = Path(folder)
    if found.fit is not None:
        found.model.save(out / "model.json")
        laws = found.proposals()
        set_aside_laws(out, laws)
        for name, text in laws.items():
            write_atomic(out / name, text)
        if found.lawful is not None:
            found.lawful.save(out / WITH_LAWS)
        else:
            withdraw(out, WITH_LAWS)
    write_json(out / "discovery.json", content)
    return out
