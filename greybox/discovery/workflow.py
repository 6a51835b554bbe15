"""discover: the whole loop, from a vehicle file and flights to named effects, or an honest no.

faults -> null fit -> screen -> add (loop, with a backward re-test) -> leftover -> gap before and after. The null model has
white force and torque noise and no disturbance states: process noise that is correlated would hide what is missing.
"""

from __future__ import annotations

import concurrent.futures
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.stats
from threadpoolctl import threadpool_limits

from greybox.data import Dataset
from greybox.data.checks import CheckReport, check
from greybox.discovery.candidates import candidates
from greybox.discovery.experiment import separating_manoeuvre
from greybox.discovery.gap import GapRow
from greybox.discovery.leftover import Promoted, promote
from greybox.discovery.name import Addition, next_addition, prune
from greybox.discovery.nested import Nest, NestedFit
from greybox.discovery.proposal import file_name, proposal_text
from greybox.discovery.screen import Score
from greybox.discovery.sensor_noise import (
    TIMING,
    coloured_sensors,
    dressed,
    filtered_imu,
    may_be_filtered,
    parts_of,
    plain_model,
    sensor_table,
)
from greybox.discovery.spectrum import Spectrum, spectrum
from greybox.discovery.stability import Stability, stability
from greybox.discovery.verify import gap_rows, verified, with_proposals
from greybox.discovery.veto import HeldOut, Withheld, unseen
from greybox.errors import GreyboxError, UnknownNameError
from greybox.estimation.fit import Fit
from greybox.estimation.record import sample_time
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel, library_versions
from greybox.model.vehicle import Vehicle

SCHEMA = "greybox.discovery/1"
POWER = 0.9
Progress = Callable[[str, float], None]


@dataclass(frozen=True, kw_only=True, eq=False)
class Discovery:
    """What was found: `verdict` ("bad_data", "named", "ambiguous", "unnamed" or "nothing_missing"), the additions in
    order, what is left, and how far the gap closed. `fit` is the last one on the model that holds only what was added."""

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
    errors: tuple[list[dict[str, Any]], ...] = ()
    sensors: tuple[Mapping[str, Any], ...] = ()
    plain: IdentifiedModel | None = None
    stability: tuple[Stability, ...] = ()

    @property
    def model(self) -> IdentifiedModel:
        """The improved model, its sensors white. Raises `GreyboxError` where bad data stopped the search."""
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
        for step, a in enumerate(self.additions, 1):
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
                        "alternatives": [n for n in a.rivals if n != name],
                        "step": step,
                    }
                )
        return out

    @property
    def final_effects(self) -> tuple[Effect, ...]:
        """Effects of the improved model."""
        return tuple(getattr(self.model.physics, "effects", ()))

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
        return {file_name(n): proposal_text(law, n) for n, law in enumerate(laws, 1)}

    def locations(self) -> list[dict[str, Any]]:
        """Axes of force and torque: RMS of the smoothed discrepancy before and after, and what it follows before."""
        if self.before is None:
            return []
        after = {} if self.leftover is None else {a.channel: a.rms for a in self.leftover.axes}
        return [a.to_dict() | {"rms_after": after.get(a.channel)} for a in self.before.axes]

    def steps(self) -> list[dict[str, Any]]:
        """Every screening with what was added after it; the last one, where nothing was, included."""
        screenings = [(a.effects, a.delta_bic, a.rivals, a.scores) for a in self.additions]
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
            "withheld": [w.to_dict() for w in self.withheld],
            "sensors": [dict(s) for s in self.sensors],
            "locations": self.locations(),
            "deficiency": {
                "before": None if self.before is None else self.before.gain,
                "after": None if self.leftover is None else self.leftover.gain,
            },
            "stability": [s.to_dict() for s in self.stability],
            "held_out_errors": [
                {"added": added, "errors": rows}
                for added, rows in zip(([], *(list(a.effects) for a in self.additions)), self.errors, strict=False)
            ],
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
            "unnamed": "something structured is missing that no effect of the catalogue explains",
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
                else f"{u['channel']}, no law found"
            )
            lines.append(f"  unnamed: {law}")
        for r in self.gap:
            if r.closed is not None and r.horizon_s in (0.1, 0.5):
                lines.append(
                    f"  {r.group} {r.horizon_s:g} s ahead: {r.before:.4g} -> {r.after:.4g} {r.unit}"
                    f" ({r.closed:.0%} of the gap closed)"
                )
        if self.unjudged:
            lines += [f"  cannot be judged: {n} ({why})" for n, why in self.unjudged.items()]
        return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings)])


@threadpool_limits.wrap(limits=1)  # small matrices: threads of BLAS only wait for each other
def discover(
    vehicle: Vehicle,
    train: Dataset,
    test: Dataset | None = None,
    *,
    own: Iterable[Effect] = (),
    alpha: float = 0.05,
    max_effects: int = 8,
    adapt: float | None = None,
    kinematic_noise: bool = False,
    per_flight: Iterable[str] = (),
    fixed: Iterable[str] = (),
    hold_sensor_noise: bool = False,
    attainable: bool = False,
    seed: int = 0,
    faults: CheckReport | None = None,
    progress: Progress | None = None,
    save: Callable[[Discovery], None] | None = None,
    executor: concurrent.futures.Executor | None = None,
) -> Discovery:
    """Find, name and add what the model of `vehicle` misses on the flights of `train`; judge on `test`.

    alpha: family-wise level of a name. `own`: effects besides the catalogue. `adapt` [s]: per-flight parameters of test
    flights are fitted on their first seconds. `per_flight` parameters get one value per flight, `fixed` ones stay at that
    of the vehicle file, `hold_sensor_noise` keeps the sensors' levels there too. `attainable`: also learn what the bare
    model misses with a Gaussian process (extra `gp`), the line that names are held against. `faults`: what `check_logs`
    said about the files (by default the data sets are checked, which no longer show faults of their clock). `save` gets
    what is known after every step, so that an interruption loses nothing. `executor` fits the rivals of a step side by
    side, in processes or on a cluster, with the same result. Raises `DataError`, `ModelError`, `FitError`.
    """
    began = time.perf_counter()
    say = progress or (lambda _text, _share: None)
    settings: dict[str, Any] = {"alpha": alpha, "seed": seed, "max_effects": max_effects, "adapt": adapt}
    judged = test if test is not None and test.flights else train
    if faults is None:
        faults = check(train if judged is train else train + judged, vehicle)
    if not faults.ok:
        return refused(faults, vehicle, settings=settings, seconds=time.perf_counter() - began)
    offered = candidates(
        vehicle, train.channels, own=own, sample_time=sample_time(train), noncausal=train.noncausal,
        kinematic_noise=kinematic_noise,
    )  # fmt: skip
    settings["sample_time"] = offered.model.sample_time
    per_flight, fixed = tuple(per_flight), set(fixed)
    if wrong := {*per_flight, *fixed} - {d.name for d in offered.model.parameters}:
        raise UnknownNameError("parameter", min(wrong), [d.name for d in offered.model.parameters])
    offered = replace(offered, core=tuple(n for n in offered.core if n not in fixed))
    choices = {"per_flight": per_flight, "estimate_noise": "process" if hold_sensor_noise else True}
    settings |= {"per_flight": per_flight, "fixed": sorted(fixed), "hold_sensor_noise": hold_sensor_noise}
    nest = Nest(candidates=offered, data=train, choices=choices, executor=executor)

    judge = HeldOut(judged, adapt)
    held_out = judge if judged is not train else None

    def interim(now: NestedFit, found: Iterable[Addition]) -> None:
        # A model file has white sensors: what was saved without their noise models stands until the end.
        if save is not None and not parts_of(now.fit.model.dynamics):
            save(
                Discovery(
                    verdict=_verdict(found, None), additions=tuple(found), fit=now.fit, final=now,
                    unjudged=offered.unjudged, warnings=("the search was stopped before its end",),
                    omega_known=offered.model.omega_known, seconds=time.perf_counter() - began, settings=settings,
                    errors=_errors(held_out, now, tuple(found)),
                )
            )  # fmt: skip

    say("fit without any addition", 0.05)
    null = nest.refit(())
    warnings: list[str] = []
    if not null.fit.converged:
        warnings.append(f"the fit without any addition: {null.fit.status.advice}")
    search = _Search(held_out=held_out, alpha=alpha, seed=seed, max_effects=max_effects, say=say, interim=interim)
    interim(null, ())
    done = search.run(nest, null)
    say("noise of the sensors", 0.72)
    noise = coloured_sensors(done.at.fit, train)
    if noise is not None:
        say("search with the sensors' own noise", 0.73)
        again, at = dressed(done.nest, done.at, noise)
        redone = search.run(again, at, done) if at.bic < done.at.bic else None
        if redone is not None and redone.at.bic < done.at.bic:
            done = redone
        else:
            noise = None
            warnings.append("a fit with the sensors' own noise went astray: names are those of white sensors")
    nest, at, additions, scores = done.nest, done.at, done.additions, done.scores
    withheld = done.withheld
    warnings += done.warnings
    say("leftover", 0.75)
    # A dozen iterations show where a model is deficient; where the share that is left decides, both are carried through.
    enough = {} if offered.blind else {"iterations": 12}
    before = promote(null.fit, train, seed=seed, **enough) if at is not null else None
    last = verified(nest, at, additions, train, held_out, before=before, seed=seed)
    at, additions, leftover = last.at, last.additions, last.leftover
    named = {n for a in additions for n in a.effects}
    # What was withheld at one step and named at a later one is named.
    withheld = [w for w in {w.effects: w for w in (*withheld, *last.withheld)}.values() if not set(w.effects) <= named]
    before = before or leftover
    say("flight by flight", 0.88)
    steady = stability(nest, at, additions)
    warnings += [
        f"{s.name} differs between the flights (p {s.p_value:.2g}): "
        + ", ".join(f"{f} {v:.4g} +- {e:.2g}" for f, (v, e) in s.flights.items())
        + f" {s.unit}".rstrip()
        for s in steady if s.differs
    ]  # fmt: skip
    say("gap", 0.9)
    if judged is train:
        warnings.append("the gap is judged on the training flights: give --test flights")
    rows = gap_rows(
        null, at, with_proposals(at.fit, leftover, train), train, judge, attainable=attainable, seed=seed,
        say=lambda text: say(text, 0.95), notes=warnings,
    )  # fmt: skip
    separating = {}
    for a in additions:
        if a.rivals:
            say(f"what separates {' and '.join(a.rivals)}", 0.97)
            separating[a.effects] = _separating(nest, a)
    skipped = dict(offered.unjudged) | {s.name: s.reason for s in scores if not s.judged}
    return Discovery(
        verdict=_verdict(additions, leftover), additions=tuple(additions), fit=at.fit, final=at, leftover=leftover,
        before=before, gap=rows,
        gap_on="test" if judged is not train else "train", unjudged=skipped, last_scores=tuple(scores),
        minimum_detectable=_detectable(scores, alpha), faults=(), warnings=tuple(warnings),
        omega_known=offered.model.omega_known, seconds=time.perf_counter() - began, settings=settings,
        spectrum=spectrum(null.fit, at.fit), tested_on=tuple(judged.names) if judged is not train else (),
        withheld=tuple(withheld), separating=separating, errors=_errors(held_out, null, additions),
        plain=plain_model(at.fit, train), stability=tuple(steady),
        sensors=tuple(sensor_table(at.fit, done.filters | ({} if noise is None else dict(noise.gains)))),
    )  # fmt: skip


def refused(
    faults: CheckReport, vehicle: Vehicle, *, settings: Mapping[str, Any] | None = None, seconds: float = 0.0
) -> Discovery:
    """The answer "bad_data": faults that block would be read as physics."""
    blocking = tuple(f"{f.flight}: {f.message}" for f in faults.findings if f.severity == "blocking")
    return Discovery(
        verdict="bad_data", faults=blocking, omega_known=vehicle.actuator.speed_max is not None, seconds=seconds,
        settings=dict(settings or {}),
    )  # fmt: skip


def _verdict(additions: Iterable[Addition], leftover: Promoted | None) -> str:
    """The first of named, ambiguous and unnamed that there is."""
    rivals = [bool(a.rivals) for a in additions]
    if rivals:
        return "ambiguous" if all(rivals) else "named"
    return "unnamed" if leftover is not None and leftover.unnamed else "nothing_missing"


@dataclass(frozen=True, kw_only=True, eq=False)
class _Found:
    """What one search gave; `filters`: BIC gain of filters of the IMU that came in on the way."""

    nest: Nest
    at: NestedFit
    additions: list[Addition]
    scores: list[Score]
    withheld: list[Withheld]
    warnings: list[str]
    filters: dict[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """Screen, add, repeat, prune: with the settings of one run."""

    held_out: HeldOut | None
    alpha: float
    seed: int
    max_effects: int
    say: Progress
    interim: Callable[[NestedFit, Iterable[Addition]], None]

    def run(self, nest: Nest, at: NestedFit, before: _Found | None = None) -> _Found:
        """From the fit `at` until no candidate passes; what was found `before`, with other noise, must prove itself."""
        additions, withheld, warnings = list[Addition](), list[Withheld](), list[str]()
        scores: list[Score] = []
        filters: dict[str, float] = {}
        if before is not None:
            filters |= before.filters
            at, additions, warnings = prune(nest, at, before.additions, single=True)
        ready: list[Score] | None = None
        for step in range(self.max_effects + 1):
            scores, ready = ready or self._screen(nest, at, step), None
            if step == self.max_effects:
                if any(s.judged and s.p_family <= self.alpha for s in scores):
                    warnings.append(f"stopped at {self.max_effects} additions: more would pass the tests")
                break
            found, refused_now = _earned(nest, at, scores, self.alpha, self.held_out)
            withheld += refused_now
            if found is None:
                break
            if set(TIMING) & set(found.effects):
                # A filter of the IMU looks like a lag or a delay.
                ready = self._screen(nest, found.after, step + 1)
                instead = (
                    filtered_imu(nest, at, found.after) if may_be_filtered(found.after, ready, self.alpha) else None
                )
                if instead is not None:
                    self.say("the IMU is filtered", min(0.14 + 0.08 * step, 0.7))
                    nest, at, gains = instead
                    filters |= gains
                    ready = None
                    continue
            self.say(f"added {' and '.join(found.effects)}", min(0.14 + 0.08 * step, 0.7))
            additions.append(found)
            at = found.after
            self.interim(at, additions)
        at, additions, removed = prune(nest, at, additions)
        return _Found(
            nest=nest, at=at, additions=additions, scores=scores, withheld=withheld, warnings=warnings + removed,
            filters=filters,
        )  # fmt: skip

    def _screen(self, nest: Nest, at: NestedFit, step: int) -> list[Score]:
        self.say(f"screening, step {step + 1}", min(0.1 + 0.08 * step, 0.7))
        return nest.screen(at, alpha=self.alpha, seed=self.seed)


def _earned(
    nest: Nest, at: NestedFit, scores: Sequence[Score], alpha: float, held_out: HeldOut | None
) -> tuple[Addition | None, list[Withheld]]:
    """The best addition that flights which were not searched do not contradict, and those that they did."""
    withheld: list[Withheld] = []
    while True:
        # Of a pair that failed either may stand alone.
        refused = {frozenset(w.effects) for w in withheld}
        out = {w.effects[0] for w in withheld if len(w.effects) == 1}
        found = next_addition(nest, at, [s for s in scores if s.name not in out], alpha, refused)
        refusal = None if found is None else unseen(found.after, found.effects, nest.candidates.null)
        if refusal is None and found is not None and held_out is not None:
            refusal = held_out.withheld(found.before, found.after)
        if refusal is None:
            return found, withheld
        withheld.append(refusal)


def _errors(
    held_out: HeldOut | None, null: NestedFit, additions: Sequence[Addition]
) -> tuple[list[dict[str, Any]], ...]:
    """Errors on flights that were not searched before any addition and after each; empty without such flights."""
    if held_out is None:
        return ()
    first = additions[0].before if additions else null
    return tuple(held_out.errors(f) for f in (first, *(a.after for a in additions)))


def _separating(nest: Nest, addition: Addition) -> dict[str, Any] | None:
    """The manoeuvre that tells the rivals of an addition apart, each fitted next to what was found before."""
    before = addition.before
    if not {n for name in addition.rivals for n in name.split("+")} <= set(nest.candidates.parameters):
        return None  # one of them has nothing to be seen with in these logs
    fits = {
        name: nest.refit((*before.effects, *name.split("+")), start=before).fit for name in addition.rivals
    }  # fmt: skip
    try:
        return separating_manoeuvre(fits)
    except GreyboxError:
        return None


def _detectable(scores: Iterable[Score], alpha: float) -> dict[str, dict[str, float]]:
    """Size of every parameter that would have been seen with probability `POWER` in a test of all candidates at once."""
    judged = [s for s in scores if s.judged]
    if not judged:
        return {}
    # Bonferroni bounds the family; one direction of the candidate at a time.
    need = scipy.stats.norm.isf(alpha / (2 * len(judged))) + scipy.stats.norm.ppf(POWER)
    # The robust statistic is smaller than Fisher's by the same factor as the information it uses.
    out = {}
    for s in judged:
        loss = float(np.sqrt(max(s.statistic / s.robust, 1.0))) if s.robust > 0 and s.statistic > s.robust else 1.0
        sizes: dict[str, float] = {}
        for (label, _), std in s.std.items():
            # One value per flight: the flight that sees least decides.
            name = label.split(".", 1)[1]
            if np.isfinite(std):
                sizes[name] = max(sizes.get(name, 0.0), float(need * loss * std))
        out[s.name] = sizes
    return out
