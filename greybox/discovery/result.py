"""What discover found: the additions in order, what is left, the gap; as plain values (discovery.json) and in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from greybox.discovery.candidates import IN_OTHER_WORDS
from greybox.discovery.gap import GapRow
from greybox.discovery.leftover import Promoted
from greybox.discovery.name import Addition
from greybox.discovery.nested import NestedFit
from greybox.discovery.proposal import file_name, proposal_text
from greybox.discovery.screen import Score
from greybox.discovery.spectrum import Spectrum
from greybox.discovery.stability import Stability
from greybox.discovery.veto import Withheld
from greybox.errors import GreyboxError
from greybox.estimation.fit import Fit
from greybox.model.effect import Effect
from greybox.model.effects import CATALOGUE
from greybox.model.identified import IdentifiedModel, library_versions

SCHEMA = "greybox.discovery/1"
WITH_LAWS = "model_with_laws.json"
"""File of the model that has the laws of the leftover as well."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Discovery:
    """What was found: `verdict` ("bad_data", "named", "ambiguous", "unnamed" or "nothing_missing"), the additions in
    order, what is left, and how far the gap closed. `fit` is the last one on the model that holds only what was added;
    `lawful` is the `model` with the laws of the leftover as well, effects of the files of `proposals` (None without one)."""

    verdict: str
    additions: tuple[Addition, ...] = ()
    fit: Fit | None = None
    final: NestedFit | None = None
    leftover: Promoted | None = None
    before: Promoted | None = None
    gap: tuple[GapRow, ...] = ()
    gap_on: str = ""
    unjudged: Mapping[str, str] = field(default_factory=dict)
    last_scores: tuple[Score, ...] = ()
    minimum_detectable: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    faults: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    omega_known: bool
    seconds: float
    settings: Mapping[str, Any] = field(default_factory=dict)
    spectrum: Spectrum | None = None
    tested_on: tuple[str, ...] = ()
    withheld: tuple[Withheld, ...] = ()
    separating: Mapping[tuple[str, ...], Mapping[str, Any] | None] = field(default_factory=dict)
    errors: tuple[Mapping[str, Any], ...] = ()
    sensors: tuple[Mapping[str, Any], ...] = ()
    plain: IdentifiedModel | None = None
    stability: tuple[Stability, ...] = ()
    lawful: IdentifiedModel | None = None

    @property
    def model(self) -> IdentifiedModel:
        """The improved model, its sensors white, with states of force and torque where what is left was carried along.

        Raises `GreyboxError` where bad data stopped the search."""
        if self.fit is None:
            raise GreyboxError("no model: the data have blocking faults", fix="mend the log, then run again")
        return self.fit.model if self.plain is None else self.plain

    @property
    def named(self) -> tuple[Addition, ...]:
        """Additions whose name is clear."""
        return tuple(a for a in self.additions if not a.rivals)

    def effects(self) -> list[dict[str, Any]]:
        """Named effects with the estimates of the final fit."""
        out = []
        assert self.fit is not None
        for step, a in self._numbered():
            if a.rivals:
                continue
            for name in a.effects:
                own = {n.split(".", 1)[1]: e for n, e in self.fit.parameters.items() if n.split(".")[0] == name}
                stage = next(e.stage for e in self.final_effects if e.name == name)
                out.append(
                    {
                        "name": name,
                        "stage": stage,
                        "parameters": {
                            n: {"value": e.value, "std": e.std if np.isfinite(e.std) else None, "unit": e.unit}
                            for n, e in own.items()
                        },
                        "p_value": a.p_value,
                        "delta_bic": a.delta_bic,
                        "delta_bic_rival": a.delta_bic_rival,
                        "alternatives": self._in_other_words(name, max(abs(e.value) for e in own.values())),
                        "step": step,
                    }
                )
        return out

    def _numbered(self) -> list[tuple[int, Addition]]:
        """(step, addition): what was added together and then said apart has the same step."""
        out: list[tuple[int, Addition]] = []
        for a in self.additions:
            number, last = out[-1] if out else (0, None)
            out.append((number + (last is None or a.after is not last.after), a))
        return out

    def _in_other_words(self, name: str, size: float) -> list[str]:
        """Effects that are the same thing together, where these logs have the sensors that they speak of and they may be of
        that `size`."""
        same = [e for n in IN_OTHER_WORDS.get(name, ()) for e in CATALOGUE if e.name == n]
        physics = self.model.physics
        there = not any(e.missing(physics.vehicle, self.model.sensors) for e in same)
        small = all(size <= d.upper for e in same for d in e.parameters(physics.vehicle))
        known = {e.name for e in self.final_effects} & {e.name for e in same}
        return ["+".join(e.name for e in same)] if same and there and small and not known else []

    @property
    def final_effects(self) -> tuple[Effect, ...]:
        """Effects of the improved model."""
        return self.model.physics.effects

    def unnamed(self) -> list[dict[str, Any]]:
        """Axes that miss something which no catalogue effect explains; where it has a law, with the file that holds it."""
        if self.leftover is None:
            return []
        numbers = {law.channel: n for n, law in enumerate(self.leftover.laws, 1)}
        return [
            a.to_dict() | {"file": file_name(numbers[a.channel]) if a.channel in numbers else None}
            | ({} if a.lawful else {"depends_on": [], "proposal": None})
            for a in self.leftover.unnamed
        ]  # fmt: skip

    def proposals(self) -> dict[str, str]:
        """File name -> text of an effect file, one for every law of the leftover."""
        laws = () if self.leftover is None else self.leftover.laws
        taken = () if self.fit is None else self.fit.model.effects
        return {file_name(n): proposal_text(law, n, taken) for n, law in enumerate(laws, 1)}

    def locations(self) -> list[dict[str, Any]]:
        """Axes of force and torque: RMS of the smoothed discrepancy before and after, and what it follows before."""
        if self.before is None:
            return []
        after = {} if self.leftover is None else {a.channel: a.rms for a in self.leftover.axes}
        return [a.to_dict() | {"rms_after": after.get(a.channel)} for a in self.before.axes]

    def steps(self) -> list[dict[str, Any]]:
        """Every screening with what was added after it; the last one, where nothing was, included."""
        screenings: list[tuple[tuple[str, ...], float, dict[str, float], tuple[Score, ...]]] = []
        for k, a in self._numbered():
            if k == len(screenings):
                added, gain, rivals, scores = screenings[-1]
                screenings[-1] = (*added, *a.effects), gain, rivals | a.rivals, scores
            else:
                screenings.append((a.effects, a.delta_bic, a.rivals, a.scores))
        if self.last_scores:
            screenings.append(((), 0.0, {}, self.last_scores))
        return [
            {
                "step": k, "added": list(added), "delta_bic": gain if added else None, "rivals": dict(rivals),
                "p_limit": next((s.limit for s in scores if s.judged), None),
                "scores": [
                    {
                        "name": s.name, "gain": 0.5 * s.statistic, "statistic": s.robust, "dof": s.dof, "p": s.p,
                        "p_family": s.p_family,
                    }
                    for s in scores if s.judged
                ],
            }
            for k, (added, gain, rivals, scores) in enumerate(screenings, 1)
        ]  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """discovery.json, schema "greybox.discovery/1"."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "effects": [] if self.fit is None else self.effects(),
            "omega_known": self.omega_known,
            "ambiguous": [
                {
                    "candidates": [{"name": n, "weight": w} for n, w in a.rivals.items()],
                    "separating_manoeuvre": self.separating.get(a.effects),
                }
                for a in self.additions
                if a.rivals
            ],
            "unnamed": self.unnamed(),
            "model_with_laws": None if self.lawful is None else WITH_LAWS,
            "withheld": [w.to_dict() for w in self.withheld],
            "sensors": [dict(s) for s in self.sensors],
            "locations": self.locations(),
            "deficiency": {
                "before": None if self.before is None else self.before.deficiency,
                "after": None if self.leftover is None else self.leftover.deficiency,
            },
            "stability": [s.to_dict() for s in self.stability],
            "held_out_errors": [dict(row) for row in self.errors],
            "regimes": [] if self.before is None else [r.to_dict() for r in self.before.regimes],
            "spectrum": None if self.spectrum is None else self.spectrum.to_dict(),
            "steps": self.steps(),
            "gap": [r.to_dict() for r in self.gap],
            "gap_on": self.gap_on,
            "minimum_detectable": {n: dict(v) for n, v in self.minimum_detectable.items()},
            "not_judged": dict(self.unjudged),
            "faults": list(self.faults),
            "warnings": list(self.warnings),
            "settings": dict(self.settings),
            "trained_on": [] if self.fit is None else list(self.fit.model.trained_on),
            "tested_on": list(self.tested_on),
            "data_hash": None if self.fit is None else self.fit.data_hash,
            "seconds": self.seconds,
            "versions": library_versions(),
        }

    def summary(self) -> str:
        """The verdict in words."""
        words = {
            "bad_data": "the data have faults that block the search",
            "named": "missing effects were found and named",
            "ambiguous": "something is missing; these data cannot say which of several effects",
            "unnamed": "something structured is left that no effect of the catalogue explains",
            "nothing_missing": "nothing is missing at the power of these data",
        }
        lines = [words[self.verdict], *(f"  fault: {f}" for f in self.faults)]
        if self.fit is not None:
            for e in self.effects():
                numbers = ", ".join(
                    f"{n} = {v['value']:.4g}" + (f" +- {v['std']:.2g}" if v["std"] else "") + f" {v['unit']}"
                    for n, v in e["parameters"].items()
                )
                lines.append(f"  {e['name']}: {numbers} (p {e['p_value']:.2g}, BIC {e['delta_bic']:.0f} better)")
                lines += [f"    the same thing in these logs: {n.replace('+', ' and ')} alike" for n in e["alternatives"]]
        for a in self.additions:
            if a.rivals:
                lines.append("  one of " + ", ".join(f"{n} ({w:.0%})" for n, w in a.rivals.items()))
                if fly := self.separating.get(a.effects):
                    lines.append(
                        f"    to tell them apart, {fly['text']}"
                        + (f", {fly['amplitude']:g} {fly['unit']}" if fly["unit"] else "")
                    )
        for kind in dict.fromkeys(s["kind"] for s in self.sensors if s["kind"] != "white"):
            lines.append(f"  sensors: {kind} in {', '.join(s['channel'] for s in self.sensors if s['kind'] == kind)}")
        for w in self.withheld:
            lines.append(f"  withheld: {' and '.join(w.effects)} ({w.reason})")
        for u in self.unnamed():
            law = (
                f"{u['proposal']} ({u['share']:.0%} of what is left there)"
                if u["proposal"]
                else f"{u['channel']}, {_size(u)}: no law found, no signal of the log explains it"
            )
            lines.append(f"  unnamed: {law}")
        if lasts := self.settings.get("carried"):
            lines.append(
                "  carried along: " + ", ".join(f"what is left of {g} lasts {t:.2g} s" for g, t in lasts.items())
            )
        for r in self.gap:
            if r.closed is not None and r.horizon_s in (0.1, 0.5):
                lines.append(
                    f"  {r.group} {r.horizon_s:g} s ahead: {r.before:.4g} -> {r.after:.4g} {r.unit}"
                    f" ({r.closed:.0%} of the gap closed"
                    + (")" if r.with_proposals is None else f", {r.with_proposals:.0%} with the proposed laws)")
                )
        if self.unjudged:
            lines += [f"  cannot be judged: {n} ({why})" for n, why in self.unjudged.items()]
        return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings)])


def _size(axis: Mapping[str, Any]) -> str:
    size = f"{axis['rms']:.2g} {axis['unit']}"
    return size if axis["lasts_s"] is None else f"{size} that lasts {axis['lasts_s']:.2g} s"
