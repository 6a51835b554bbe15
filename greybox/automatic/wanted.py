"""Wanted: error bars that hold although the model may lack an effect.

A fit that lacks an effect bends what it has into its place: a rotor drag stands for a drag of
another form, a misalignment of the pose for an IMU that is turned in its mount. The predictions are
good, the numbers are not, and no scatter shows it: every flight is bent alike. So every effect of
the catalogue that the model lacks is asked for at the end of a fit (`greybox.statistics.rivals`):
one run of the filter per parameter tells how much likelier the flights were with it, and where the
estimates would go; what a delay hides from it is asked for elsewhere (`greybox.automatic.ridge`).
So is every effect that is held at nothing, at its bound: flights that push beyond it by more than
chance have a wrong clock, or a model of a wrong form, which comes first. Error bars hold that, and
what would go further than its error allows is said to be no measurement. Where nothing would,
pushes without a name stand for the effect: in flights like these. The model stays: naming what is
missing is for `greybox discover`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from greybox.automatic.ridge import on_the_ridge
from greybox.automatic.widened import HELD, moved_away, no_measurement, widened
from greybox.data import Dataset
from greybox.errors import GreyboxError
from greybox.estimation.covariance import FEWEST_BLOCKS
from greybox.estimation.differences import with_candidate_sensitivities
from greybox.estimation.laplace import at_bound
from greybox.estimation.prior import denied_share, prior_terms
from greybox.estimation.problem import Problem
from greybox.estimation.result import Fit
from greybox.estimation.solver import Value
from greybox.model.absence import absence, not_offered
from greybox.model.effect import Effect
from greybox.model.effects import CATALOGUE
from greybox.model.layer import physics_of, with_physics
from greybox.model.model import PhysicsModel
from greybox.statistics.evidence import FELT
from greybox.statistics.rivals import Averaged, Form, Parabola, averaged, price_of, room
from greybox.symbolic import BoolArray, FloatArray

UNKNOWN = "no craft has that: a clock, a sign or the form of the model is wrong"
"""What a parameter beyond its bound says, where its effect does not know it."""

CLEAR = float(np.log(20.0))
"""Log odds from which on an effect that moves no number is spoken of: those of a name of `discover`
at its level of 5 %."""


def with_rivals(found: Fit, data: Dataset) -> Fit:
    """The fit to `data` with errors that hold what effects which it lacks would change.

    As it was where it did not end at a minimum of the likelihood, whose slope tells what is
    missing, or where nothing is: predictions and the model's own covariance stay.
    """
    physics = physics_of(found.problem.dynamics)
    if physics is None or found.settings["predictor"] != "innovation" or not found.converged:
        return found
    if found.settings["criterion"] != "gaussian":
        return found
    try:
        with threadpool_limits(limits=1):
            value, offered = found.problem.evaluate(found.theta), _offered(physics, data)
            at, wide, there = _parabola(found, value, data, physics, offered)
            more = on_the_ridge(found, value.cost, data, offered, at.fitted, price_of(at))
            seen = averaged(at, more)
    except (GreyboxError, np.linalg.LinAlgError):  # a larger model that cannot predict
        return found
    return found if seen.best is None else _told(found, at, seen, wide, there)


def _parabola(
    found: Fit, ended: Value, data: Dataset, physics: PhysicsModel, effects: Sequence[Effect]
) -> tuple[Parabola, Problem, FloatArray]:
    """(the cost about the fit, which `ended` there, with `effects` that it lacks and those that it
    holds at nothing; the problem whose unknowns have the same places; where they stand). What is
    held for a ratio may move as far as it is stated: an effect that does the same as its error is
    no news."""
    small, theta = found.problem, found.theta
    held = at_bound(small, theta, ended)
    declared = {d.name: d for d in small.dynamics.parameters}
    stated = {n: (float(small.base[i]), declared[n].sigma) for i, n in enumerate(declared)}
    # The error of the fit, whose user may have given another than what is declared.
    errors = {n: error for n, (error, _) in found.model.considered.items()}
    priors = {n: (stated[n][0], errors.get(n, stated[n][1])) for n in found.settings["considered"]}
    at_null = _at_null(small, theta, held)
    for e in (*physics.effects, *effects):
        absent = absence(e, physics.vehicle)
        priors |= {n: a for n, a in absent.items() if e in effects or n in at_null}
    free = {u.name for u in small.unknowns}
    nulls = {n: null for n, (null, _) in priors.items() if n not in free}
    wide, at = _with_effects(found, data, physics, effects, nulls)
    value = wide.evaluate(at, scores=small.score_block)
    assert value.gradient is not None and value.data_hessian is not None
    n, names = small.n, [u.name for u in wide.unknowns]
    asked = {e.name for e in effects}
    places: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        effect, added = name.split(".")[0], i >= n
        if (added and effect in asked) or (name in at_null and (added or held[i])):
            places.setdefault(effect, []).append(i)
    sigma = np.array([u.sigma for u in small.unknowns] + [priors[m][1] for m in names[n:]])
    for i in (i for rows in places.values() for i in rows):
        sigma[i] = min(sigma[i], priors[names[i]][1])
    prior = np.where(np.isfinite(sigma), sigma, np.inf) ** -2.0
    pulls = prior_terms(wide.unknowns, at)[1]
    # What flights deny may be another craft's: it asks for no cause that brings it nearer.
    lost = denied_share(pulls, prior)
    lost[n:] = 0.0
    prior *= 1.0 - lost
    gradient = value.gradient - lost * pulls
    gradient[n:] -= pulls[n:]
    # A craft has no such effect; but what the model has and the flights hold at its bound, or what
    # a wrong clock makes of an effect, lies beyond.
    past = {e.name for e in effects if e.beyond}
    bounded = np.array([m not in at_null and m.split(".")[0] not in past for m in names])
    loose = [*np.flatnonzero(~held).tolist(), *range(n, wide.n)]
    scores = value.scores
    low, high = room(at, wide.lower, wide.upper, bounded)
    parabola = Parabola.about(
        value.data_hessian,
        gradient,
        prior,
        loose,
        places,
        low=low,
        high=high,
        scatter=None
        if not found.coloured or scores is None or len(scores) < FEWEST_BLOCKS
        else scores.T @ scores,
    )
    return parabola, wide, at


def _with_effects(
    found: Fit,
    data: Dataset,
    physics: PhysicsModel,
    effects: Sequence[Effect],
    nulls: Mapping[str, float],
) -> tuple[Problem, FloatArray]:
    """(the problem of a fit with `effects` and what else stands at `nulls`; where it stands)."""
    small = found.problem
    early = {e.name for e in effects if e.early or e.memory(physics.vehicle)}
    near = [e for e in effects if e.name not in early]
    return with_candidate_sensitivities(
        small,
        found.theta,
        with_physics(small.dynamics, lambda m: m.with_effect(*near)),
        data,
        nulls,
        apart=with_physics(small.dynamics, lambda m: m.with_effect(*effects)) if early else None,
    )


def _at_null(small: Problem, theta: FloatArray, held: BoolArray) -> frozenset[str]:
    """Names of the parameters that are nothing at a bound: held there, or where a search ended."""
    value = dict(zip((d.name for d in small.dynamics.parameters), small.base, strict=True))
    value |= {u.name: np.nan for u in small.unknowns}
    value |= {small.unknowns[i].name: theta[i] for i in np.flatnonzero(held)}
    return frozenset(
        d.name
        for d in small.dynamics.parameters
        if value[d.name] == d.null and d.null in (d.lower, d.upper)
    )


def _offered(physics: PhysicsModel, data: Dataset) -> list[Effect]:
    """The effects of the catalogue that the model lacks and these flights can judge. One that
    brings a motion which nothing measures has a state that nobody holds: only a fit can tell."""
    there = {e.name for e in physics.effects}
    absent = [e for e in CATALOGUE if e.name not in there]
    judged = [e for e in absent if not_offered(e, physics, data.channels) is None]
    pushed = physics.noises.names
    return [e for e in judged if physics.with_effect(e).noises.names == pushed]


def _told(found: Fit, at: Parabola, seen: Averaged, wide: Problem, there: FloatArray) -> Fit:
    """The fit with wider errors, what is no measurement, and first of all which bounds the flights
    push against. How far a limit that is missing moves numbers is not to be seen where it is not
    felt."""
    assert seen.best is not None
    by_name: dict[str, list[int]] = {}
    row = {place: k for k, place in enumerate(at.fitted)}
    for i, u in enumerate(found.problem.unknowns):
        if i in row:
            by_name.setdefault(u.name, []).append(row[i])
    away = moved_away(found, seen.shift, by_name)
    limits = frozenset(n.split(".")[0] for n, _ in wide.thresholds)
    pushed = _beyond(seen.best, wide, there)
    line = _line(away, seen.best, limits, bounded=bool(pushed))
    held = widened(found, seen.spread, by_name, line)
    if not pushed:
        return held
    old, said = held.diagnostics, "; ".join(pushed)
    covariance = replace(old.covariance, beyond=said)
    told = replace(old, covariance=covariance, warnings=(said, *old.warnings))
    return replace(held, diagnostics=told)


def _beyond(best: Form, wide: Problem, at: FloatArray) -> list[str]:
    """In words, which unknowns of the likeliest form, which stand `at` (n,), go beyond the bound
    where they are nothing by more than chance, the surest first."""
    why = {e.name: e.beyond for e in CATALOGUE}
    found = []
    for i, (step, error) in best.steps.items():
        u = wide.unknowns[i]
        out = (step < 0 and at[i] <= u.lower) or (step > 0 and at[i] >= u.upper)
        if out and abs(step) > FELT * error > 0:
            size, sure = abs(step), abs(step) / error
            rows = max(1, round(size / wide.dt)) * wide.dt
            reason = (why.get(u.name.split(".")[0]) or UNKNOWN).format(size, rows)
            beyond = f"{sure:.0f} standard errors beyond its bound {at[i]:g}"
            found.append((-sure, f"{u.name} would be {beyond}: {reason}"))
    return [text for _, text in sorted(found)]


def _line(
    away: Mapping[str, float], best: Form, limits: frozenset[str], *, bounded: bool = False
) -> str:
    """Which numbers are no measurement, and why; what is clearly wanted though none hangs on it."""
    lacks = "which this model lacks or bounds" if bounded else "which this model lacks"
    known, want = HELD, f"the flights want {', '.join(best.causes)}, {lacks}"
    if found := [n for n in best.causes if n in limits]:
        known = f"how far {', '.join(found)} moves numbers needs a fit: trust no error before that"
    if away or best.log_odds < CLEAR:
        return no_measurement(away, f"{want} and which would", known)
    return f"{want}: no number hangs on that, predictions of other manoeuvres may"
