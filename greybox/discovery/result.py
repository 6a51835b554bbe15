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
from greybox.discovery.cause import LEVELS
from greybox.discovery.folder import WITH_LAWS, write_found
from greybox.discovery.left import Left
from greybox.discovery.name import LOG10, Name
from greybox.errors import GreyboxError
from greybox.estimation.fit import Fit
from greybox.estimation.noise_table import SensorRow
from greybox.files import to_plain
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel, library_versions
from greybox.model.layer import physics_of
from greybox.model.verdict import Verdict
from greybox.planning.experiment import Manoeuvres
from greybox.plots import bars
from greybox.residual.laws.axis import Axis
from greybox.residual.laws.effect_file import file_name
from greybox.shown import Cell, Shown
from greybox.validation.gap import GapRow, closing, doubt

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCHEMA = "greybox.discovery/2"
SAYS = {
    "bad_data": "the data have faults that block the search",
    "stopped": "the search was stopped before its end: what it had found until then is not judged",
    "named": "missing effects were found and named",
    "ambiguous": "something is missing; these data cannot say which of several effects",
    "unnamed": "something is left that no effect on offer explains",
    "nothing_missing": "nothing is missing at the power of these data",
}


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Discovery(Shown):
    """What was found. `verdict` is a key of `SAYS`, `names` everything that was asked, `fit` the
    final structure, `left` what its unnamed force and torque hold. `bar` is the log e-value that a
    name needs, `denied` which stated numbers the flights deny, `so_far` what a stopped search
    knows. `lawful` is the model with laws (the one to go on with; None without), `proposals()` the
    laws as files by name."""

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

    @property
    def model(self) -> IdentifiedModel:
        """The improved model. Raises `GreyboxError` where bad data stopped the search."""
        if self.fit is None:
            raise GreyboxError(
                "no model: the data have blocking faults", fix="mend the log, then run again"
            )
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
        """One row per cause that was judged: the log10 e-value of leaving it out, and the share of
        the squared error ahead that it removes."""
        return [
            {
                "cause": n.name,
                "status": n.status,
                "log10 e": n.certificate.rivals.get((), float("nan")) / LOG10,
                "removes": None if n.worth is None else n.worth.share,
                "of": None if n.worth is None else n.worth.group,
                "horizon [s]": None if n.worth is None else n.worth.horizon,
                "reason": n.reason,
            }
            for n in self.names
        ]

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
            {**n.to_dict(), "stage": self._stage(n.name), "parameters": self._parameters(n.name)}
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

    def _parameters(self, name: str) -> dict[str, document.Estimate]:
        assert self.fit is not None
        own = {n: e for n, e in self.fit.parameters.items() if n.split(".")[0] == name}
        wide = {n: float(np.hypot(e.std, self._apart(n, e.value))) for n, e in own.items()}
        std = {n: error if np.isfinite(error) else None for n, error in wide.items()}
        rows = [(n.split(".", 1)[-1], e.value, std[n], e.unit) for n, e in own.items()]
        return {n: {"value": value, "std": s, "unit": unit} for n, value, s, unit in rows}

    def _apart(self, parameter: str, value: float) -> float:
        """How far its value is spread over the causes that the flights cannot tell apart: one
        standard deviation."""
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
                "parameters": self._parameters(n.name),
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
            "base": [{"name": n, "parameters": self._parameters(n)} for n in self.base if fitted],
            "sensors": [s.copy() for s in self.sensors],
            "locations": self.locations(),
            "steps": [s.copy() for s in self.steps],
            "gap": [r.to_dict() for r in self.gap],
            "gap_on": self.gap_on,
            "minimum_detectable": {n: dict(v) for n, v in self.minimum_detectable.items()},
            "not_judged": dict(self.unjudged),
            "denied": list(self.denied),
            "faults": list(self.faults),
            "warnings": list(self.warnings),
            "settings": self.settings.copy(),
            "trained_on": list(self.fit.model.trained_on) if self.fit is not None else [],
            "tested_on": list(self.tested_on),
            "data_hash": self.fit.data_hash if self.fit is not None else None,
            "seconds": self.seconds,
            "versions": library_versions(),
        }

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write what `greybox discover` writes into a folder, but its report: discovery.json,
        model.json, and of laws proposal_N.py and model_with_laws.json; returns the folder. Raises
        `OutputError`."""
        return write_found(self, folder, self.to_dict())

    @property
    def line(self) -> str:
        """What a pilot wants to know, in one line."""
        if self.verdict in ("bad_data", "stopped"):
            more = f"; {self.so_far}" if self.so_far else ""
            return f"{self.verdict.replace('_', ' ').upper()}: {SAYS[self.verdict]}{more}"
        found = [e["name"] for e in self.effects()]
        if len(found) == 1:  # numbers of several stand below
            found = [_in_words(e["name"], e["parameters"]) for e in self.effects()]
        for a in self.ambiguous():
            found.append("one of " + " / ".join(c["name"] for c in a["candidates"]))
        lawful = [u["channel"] for u in self.unnamed() if u["file"]]
        found += [
            f"laws without a name, of {', '.join(lawful)} (use {WITH_LAWS}, in Python .lawful)"
        ][: len(lawful)]
        held = dict.fromkeys(u["channel"].split(".")[0] for u in self.unnamed() if not u["file"])
        kept = ", ".join(n.name for n in self.said("not certified") if n.kept)
        told = self.model_verdict
        rough = f"{told.sentence}. " if told and told.refused else doubt(self.gap)
        if self.fit and not self.fit.converged:
            rough += "NOT CONVERGED, every number may move: "
        rough += f"AGAINST THE FILE: {'; '.join(self.denied)}. " * bool(self.denied)
        what = f"MISSING: {'; '.join(found)}" if found else "nothing is missing that has a name"
        what += f"; in the model, not certified: {kept}" * bool(kept)
        what = rough + what
        if held:
            return f"{what}; without a name: {', '.join(held)}"
        if found or kept:
            return f"{what}; nothing clear is left"
        least = list(self.minimum_detectable.items())[:3]
        seen = ", ".join(f"{n} {next(iter(v.values())):.2g}" for n, v in least)
        return (
            f"{rough}NOTHING MISSING"
            + f" (would have been named from {seen} on at the latest, ...)" * bool(seen)
        )

    def summary(self) -> str:
        """The verdict in words, most important first."""
        lines = [self.line, *(f"  fault: {f}" for f in self.faults)]
        if self.fit is None:
            return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings)])
        for e in self.effects():
            words = _in_words(e["name"], e["parameters"])
            told = f"{e['status']}, log10 e {e['log10_e']:.1f}{_worth(e['worth'])}"
            lines.append(f"  {words}: {told}")
            odds = "    rather than {name}: log10 odds {log10_odds:.1f}, log10 e {log10_e:.1f}"
            lines += [odds.format(**u) for u in e["unlikely"]]
            laws = {} if self.lawful is None else self.lawful.values
            its = [(n, f"{e['name']}.{n}") for n in e["parameters"]]
            said = ", ".join(f"{n} = {laws[k]:.4g}" for n, k in its if k in laws)
            lines += [f"    with the laws: {said}"] if said else []
        for a in self.ambiguous():
            own = _in_words(a["candidates"][0]["name"], a["parameters"])
            rows = [own, *(c["name"] for c in a["candidates"][1:])]
            shares = (f", {c['weight']:.0%}" for c in a["candidates"])
            lines.append("  one of " + " / ".join(map("".join, zip(rows, shares, strict=True))))
            for c in a["candidates"]:
                moved = ", ".join(f"{k} = {v:.4g}" for k, v in c.get("elsewhere", {}).items())
                lines += [f"    with {c['name']}: {moved}"] * bool(moved)
            if fly := a["separating_manoeuvre"]:
                size = f", {fly['amplitude']:g} {fly['unit']}" if fly["unit"] else ""
                apart = f"to tell them apart, {fly['text']}{size}"
                never = "no manoeuvre that was tried tells all of them apart"
                lines.append(f"    {never if fly['seconds_to_bic_10'] is None else apart}")
        lines += [f"  {t['status']}: {t['name']}, {t['reason']}" for t in self.traces()]
        for n in self.said("not certified"):
            lines.append(f"  not certified{', in the model' * n.kept}: {n.name} ({n.reason})")
        if self.base:
            drift = ", noise between attitude and gyro" * bool(self.settings.get("kinematic_noise"))
            base = (_in_words(n, self._parameters(n)) if n in LEVELS else n for n in self.base)
            lines.append(f"  in every model: {', '.join(base)}{drift}")
        for kind in dict.fromkeys(s["kind"] for s in self.sensors if s["kind"] != "white"):
            channels = [s["channel"] for s in self.sensors if s["kind"] == kind]
            lines.append(f"  sensors: {kind} in {', '.join(channels)}")
        if held := [f"{u['channel']} {_size(u)}" for u in self.unnamed() if not u["proposal"]]:
            lines.append(f"  without a name: {', '.join(held)}")
        for u in (u for u in self.unnamed() if u["proposal"]):
            law = f"{u['proposal']} ({u['share']:.0%} of it)"
            lines.append(f"  unnamed: {u['channel']}, {_size(u)}: {law}")
        lines += closing(self.gap)
        lines += [f"  cannot be judged: {n} ({why})" for n, why in self.unjudged.items()]
        return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings)])


def _in_words(name: str, parameters: Mapping[str, document.Estimate]) -> str:
    numbers = ", ".join(
        f"{n} = {v['value']:.4g}" + (f" +- {v['std']:.2g}" if v["std"] else "") + f" {v['unit']}"
        for n, v in parameters.items()
    )
    return f"{name} ({numbers})"


def _worth(w: document.WorthRow | None) -> str:
    if w is None:
        return ""
    ahead = f"{w['horizon_s']:g} s" if w["horizon_s"] else "one sample"
    return f", removes {w['share']:.0%} of the squared error of {w['group']} {ahead} ahead"


def _size(axis: document.LeftRow) -> str:
    return f"{axis['rms']:.2g} {axis['unit']} that lasts {axis['lasts_s']:.2g} s"
