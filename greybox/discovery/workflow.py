"""discover: the whole loop, from a vehicle file and flights to named effects, or an honest no.

faults -> null fit -> screen -> add (loop, with a backward re-test) -> leftover -> gap before and after. The null model has
white force and torque noise and no disturbance states: process noise that is correlated would hide what is missing. Only
where much is left that follows no law does the search go on with such states (greybox.discovery.carried).
"""

from __future__ import annotations

import concurrent.futures
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Unpack

import numpy as np
import scipy.stats
from threadpoolctl import threadpool_limits

from greybox.data import Dataset
from greybox.data.checks import CheckReport, check
from greybox.discovery.candidates import TIMING, candidates
from greybox.discovery.carried import carried, is_carried, may_carry, memories
from greybox.discovery.clocks import never_separated, said_two_ways
from greybox.discovery.experiment import separating_manoeuvre
from greybox.discovery.gap import outgrown
from greybox.discovery.lead import led
from greybox.discovery.leftover import ENOUGH, Promoted, promote
from greybox.discovery.name import Addition
from greybox.discovery.nested import Nest, NestedFit
from greybox.discovery.options import DiscoverChoices, DiscoverOptions
from greybox.discovery.result import Discovery
from greybox.discovery.screen import Score
from greybox.discovery.search import Found, Progress, Search
from greybox.discovery.sensor_noise import coloured_sensors, dressed, plain_model, sensor_table
from greybox.discovery.spectrum import spectrum
from greybox.discovery.stability import stability
from greybox.discovery.verify import Verified, gap_rows, verified
from greybox.discovery.veto import HeldOut, unseen
from greybox.discovery.written import lawful_model
from greybox.errors import DataError, GreyboxError, UnknownNameError
from greybox.estimation.fit import Fit
from greybox.estimation.options import says_choices
from greybox.estimation.record import sample_time
from greybox.estimation.status import Code
from greybox.model.effects import CATALOGUE
from greybox.model.vehicle import Vehicle

POWER = 0.9
SHORTEST_FLIGHT = 0.6
"""Seconds without an interruption: the first tenth tells only its commands, what is left is averaged over half a second."""


@says_choices(DiscoverOptions)
@threadpool_limits.wrap(limits=1)  # small matrices: threads of BLAS only wait for each other
def discover(
    vehicle: Vehicle,
    train: Dataset,
    test: Dataset | None = None,
    options: DiscoverOptions | None = None,
    *,
    faults: CheckReport | None = None,
    progress: Progress | None = None,
    save: Callable[[Discovery], None] | None = None,
    executor: concurrent.futures.Executor | None = None,
    **choices: Unpack[DiscoverChoices],
) -> Discovery:
    """Find, name and add what the model of `vehicle` misses on the flights of `train`; judge on `test`.

    The choices are keywords, fields of `DiscoverOptions` with its defaults, or `options` as a whole: own, alpha,
    max_effects, adapt, kinematic_noise, per_flight, fixed, hold_sensor_noise, attainable, seed.

    alpha: family-wise level of a name. `own`: effects besides the catalogue. `adapt` [s]: per-flight parameters of test
    flights are fitted on their first seconds. `per_flight` parameters get one value per flight, `fixed` ones stay at that
    of the vehicle file, `hold_sensor_noise` keeps the sensors' levels there too. `attainable`: also learn what the bare
    model misses with a Gaussian process (extra `gp`), the line that names are held against. `faults`: what `check_logs`
    said about the files (by default the data sets are checked, which no longer show faults of their clock). `save` gets
    what is known after every step, so that an interruption loses nothing. `executor` fits the rivals of a step side by
    side, in processes or on a cluster, with the same result. Raises `DataError`, `ModelError`, `FitError`,
    `UnknownNameError` (of a choice, too).
    """
    began = time.perf_counter()
    options = DiscoverOptions.of(options, choices)
    alpha, seed, adapt, max_effects = options.alpha, options.seed, options.adapt, options.max_effects
    say = progress or (lambda _text, _share: None)
    settings: dict[str, Any] = {"alpha": alpha, "seed": seed, "max_effects": max_effects, "adapt": adapt}
    tested = test if test is not None and test.flights else None
    if faults is None:
        faults = check(train if tested is None else train + tested, vehicle)
    if not faults.ok:
        return refused(faults, vehicle, settings=settings, seconds=time.perf_counter() - began)
    _long_enough(train)
    offered = candidates(
        vehicle, train.channels, own=options.own, sample_time=sample_time(train), noncausal=train.noncausal,
        kinematic_noise=options.kinematic_noise,
    )  # fmt: skip
    settings["sample_time"] = offered.physics.sample_time
    fixed = set(options.fixed)
    if wrong := {*options.per_flight, *fixed} - {d.name for d in offered.model.parameters}:
        raise UnknownNameError("parameter", min(wrong), [d.name for d in offered.model.parameters])
    offered = replace(offered, core=tuple(n for n in offered.core if n not in fixed))
    settings |= {
        "per_flight": options.per_flight, "fixed": sorted(fixed), "hold_sensor_noise": options.hold_sensor_noise
    }  # fmt: skip
    train = led(train)
    judged = train if tested is None else tested
    nest = Nest(candidates=offered, data=train, options=options.of_every_fit, executor=executor)

    judge = HeldOut(judged, adapt)
    held_out = judge if judged is not train else None

    def interim(now: NestedFit, found: Iterable[Addition]) -> None:
        # A model file has white noise: what was saved without other noise models stands until the end.
        if save is not None and now.fit.model.dynamics is now.fit.model.core:
            save(
                Discovery(
                    verdict=_verdict(found, None), additions=tuple(found), fit=now.fit, final=now,
                    unjudged=offered.unjudged, warnings=("the search was stopped before its end",),
                    omega_known=offered.physics.omega_known, seconds=time.perf_counter() - began, settings=settings,
                    errors=_errors(held_out, now, tuple(found)),
                )
            )  # fmt: skip

    say("fit without any addition", 0.05)
    null = nest.refit(())
    warnings: list[str] = []
    search = Search(held_out=held_out, alpha=alpha, seed=seed, max_effects=max_effects, say=say, interim=interim)
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
    enough: dict[str, Any] = {} if offered.blind else {"iterations": ENOUGH}
    before = promote(null.fit, train, seed=seed, memory=False, **enough) if at is not null else None
    last = verified(nest, at, additions, train, held_out, before=before, seed=seed)
    before = before or last.leftover
    if held_out is not None and not offered.blind and may_carry(last.first):
        say("search with what is left carried along", 0.82)
        interim(last.at, last.additions)
        try:
            on = _go_on(search, done, last, seed)
        except GreyboxError as error:
            on = None
            warnings.append(f"no search with what is left carried along: {error}")
        if on is not None:
            nest, scores, last = on[0].nest, on[0].scores, on[1]
            settings["carried"] = memories(last.at.fit, last.leftover)
            warnings += on[0].warnings
    at, additions, leftover = last.at, last.additions, last.leftover
    warnings += _unfinished(null.fit, at)
    named = {n for a in additions for n in a.effects}
    # What was withheld at one step and named at a later one is named.
    withheld = [w for w in {w.effects: w for w in (*withheld, *last.withheld)}.values() if not set(w.effects) <= named]
    if not leftover.known:
        warnings.append("no law of what is left was sought: with disturbance states the model has no finite prediction")
    say("flight by flight", 0.88)
    steady = stability(nest, at, additions)
    warnings += [
        f"{s.name} differs between the flights (p {s.p_value:.2g}): "
        + ", ".join(f"{f} {v:.4g} +- {e:.2g}" for f, (v, e) in s.flights.items())
        + f" {s.unit}".rstrip()
        for s in steady if s.differs
    ]  # fmt: skip
    plain = plain_model(at.fit, train)
    lawful = None
    if last.written is not None:
        try:
            lawful = lawful_model(last.written, leftover, at.fit.model.effects, train)
        except GreyboxError as error:
            warnings.append(f"no model with the proposed laws: {error}")
    say("gap", 0.9)
    if judged is train:
        warnings.append("the gap is judged on the training flights: give --test flights")
    rows = gap_rows(
        null, plain, lawful, train, judge, attainable=options.attainable, seed=seed,
        say=lambda text: say(text, 0.95), notes=warnings,
    )  # fmt: skip
    if judged is not train and (grown := outgrown(rows)):
        warnings.append(
            f"the proposed laws do not hold on the test flights ({', '.join(grown)} grow with them): they describe the "
            "training flights alone"
        )
    separating = {}
    for a in additions:
        if a.rivals and not never_separated(at, a.rivals):
            say(f"what separates {' and '.join(a.rivals)}", 0.97)
            separating[a.effects] = _separating(nest if is_carried(a.before.fit) else done.nest, a)
    said, otherwise = said_two_ways(nest, at, additions)
    skipped = dict(offered.unjudged) | {s.name: _why(s, at) for s in scores if not (s.judged or s.refit)}
    if unscored := [s.name for s in scores if s.refit]:
        warnings.append(
            f"nothing shows a velocity without {', '.join(unscored)}: these can only be refitted, and how small they may be "
            "to be seen is not known"
        )
    return Discovery(
        verdict=_verdict(said, leftover), additions=tuple(said), fit=at.fit, final=at, leftover=leftover,
        before=before, gap=rows,
        gap_on="test" if judged is not train else "train", unjudged=skipped, last_scores=tuple(scores),
        minimum_detectable=_detectable(scores, alpha), faults=(), warnings=(*warnings, *otherwise),
        omega_known=offered.physics.omega_known, seconds=time.perf_counter() - began, settings=settings,
        spectrum=spectrum(null.fit, at.fit), tested_on=tuple(judged.names) if judged is not train else (),
        withheld=tuple(withheld), separating=separating, errors=_errors(held_out, null, additions),
        plain=plain, lawful=lawful, stability=tuple(steady),
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


def _long_enough(train: Dataset) -> None:
    longest = max((s.n * f.dt for f in train for s in f.segments), default=0.0)
    if longest < SHORTEST_FLIGHT:
        raise DataError(
            "no training flight is long enough to search in", expected=f"{SHORTEST_FLIGHT:g} s without an interruption",
            got=f"{longest:.2g} s at most", fix="flights of some ten seconds in which everything moves",
        )  # fmt: skip


def _unfinished(null: Fit, last: NestedFit) -> list[str]:
    """Warnings of fits that did not converge: the one without any addition and the last one."""
    said = []
    if not null.converged and last.fit is not null:
        said.append(
            f"the fit without any addition stopped after {null.status.iterations} iterations before its optimum, as much is "
            "missing: the gap before is a little too large"
        )
    if last.fit.status.code is Code.NO_PROGRESS and (late := set(TIMING) & set(last.effects)):
        said.append(
            f"the last fit ended at a kink of the likelihood, as of a delay of whole samples ({', '.join(sorted(late))}): "
            "the standard error is that of one side"
        )
    elif not last.fit.converged:
        said.append(f"the last fit: {last.fit.status.advice}")
    return said


def _verdict(additions: Iterable[Addition], leftover: Promoted | None) -> str:
    """The first of named, ambiguous and unnamed that there is."""
    rivals = [bool(a.rivals) for a in additions]
    if rivals:
        return "ambiguous" if all(rivals) else "named"
    return "unnamed" if leftover is not None and leftover.unnamed else "nothing_missing"


def _go_on(search: Search, done: Found, last: Verified, seed: int) -> tuple[Found, Verified] | None:
    """What a search finds that carries along what is left, and what that leaves; None where it names nothing more, or where
    what is left follows a law next to the new names: they fit only half."""
    begun = carried(done.nest, last.at, last.first)
    if begun is None:
        return None
    nest, at = begun
    before = replace(done, nest=nest, at=at, additions=last.additions, warnings=[], withheld=[])
    found = replace(search, may_filter=False, carries=True).run(nest, at, before)
    if {n for a in found.additions for n in a.effects} <= set(at.effects):
        return None
    # What is left is seen as it was before, past white noise.
    white = done.nest.refit(found.at.effects, start=found.at, also=last.at)
    leftover = promote(white.fit, done.nest.data, seed=seed)
    if leftover.laws:
        return None
    lost = [
        f"{n} was named before what is left was carried along; with it no parameter is two standard errors from none"
        for a in last.additions for n in a.effects if unseen(found.at, (n,), nest.candidates.null) is not None
    ]  # fmt: skip
    withheld = [*last.withheld, *found.withheld]
    return replace(found, warnings=[*found.warnings, *lost]), replace(
        last, at=found.at, additions=found.additions, withheld=withheld, leftover=leftover, written=None
    )


def _why(score: Score, at: NestedFit) -> str:
    """Why an effect cannot be judged: first that it acts through others that the model does not have."""
    effects = {e.name for e in at.fit.model.physics.effects}
    through = [n for e in CATALOGUE if e.name == score.name for n in e.needs.effects]
    return score.reason if not through or effects & set(through) else f"felt only with {' or '.join(through)}"


def _errors(
    held_out: HeldOut | None, null: NestedFit, additions: Sequence[Addition]
) -> tuple[dict[str, Any], ...]:
    """Errors on flights that were not searched before any addition and after each, and between them where what was left is
    carried along from there on; empty without such flights."""
    if held_out is None:
        return ()
    at = additions[0].before if additions and not is_carried(additions[0].before.fit) else null
    rows = [{"added": [], "carried": False, "errors": held_out.errors(at)}]
    for a in additions:
        if is_carried(a.after.fit) and not is_carried(at.fit):
            rows.append({"added": [], "carried": True, "errors": held_out.errors(a.before)})
        at = a.after
        rows.append({"added": list(a.effects), "carried": is_carried(at.fit), "errors": held_out.errors(at)})
    return tuple(rows)


def _separating(nest: Nest, addition: Addition) -> dict[str, Any] | None:
    """The manoeuvre that tells the rivals of an addition apart, each fitted next to what was found before."""
    before = addition.before
    if set(addition.rivals) == {"command_delay", nest.candidates.late_alike}:
        return None  # another sensor tells them apart, no manoeuvre does
    if not {n for name in addition.rivals for n in name.split("+")} <= set(nest.candidates.parameters):
        return None  # one of them has nothing to be seen with in these logs
    try:
        fits = {
            name: nest.unled((*before.effects, *name.split("+")), before).fit for name in addition.rivals
        }  # fmt: skip
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
