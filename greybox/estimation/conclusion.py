"""What a fit comes to: estimates with their errors, what is not identified, the identified model,
and what must be said of all this.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from greybox.data import Dataset
from greybox.estimation.build import trouble
from greybox.estimation.considered import Considered, considered
from greybox.estimation.covariance import Covariance, correlation, covariance, scaled_inverse
from greybox.estimation.document import FitSettings
from greybox.estimation.feasible import wall
from greybox.estimation.few_samples import too_short_for_errors
from greybox.estimation.identifiability import Combination, marginal_information, unidentified
from greybox.estimation.noise_split import wider_split
from greybox.estimation.options import FitOptions
from greybox.estimation.prior import prior_terms
from greybox.estimation.problem import Problem
from greybox.estimation.result import Diagnostics, Estimate, Estimates, Fit, Provenance
from greybox.estimation.solver import Value
from greybox.estimation.solvers.levenberg_marquardt import newton_decrement
from greybox.estimation.status import Status
from greybox.estimation.turning import turning_states
from greybox.estimation.unknown import Unknown
from greybox.estimation.varying import varying_spread
from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import own_parameters, physics_of
from greybox.model.parameter import ParameterValues
from greybox.statistics.whiteness import is_coloured
from greybox.symbolic import BoolArray, FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class _Innovations:
    """One-step errors at the solution, by flight and all of them (N, n_e), NaN where nothing was
    measured; whether they are coloured."""

    by_flight: Mapping[str, list[FloatArray]]
    all: Sequence[FloatArray]
    coloured: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class _Errors:
    """Covariances of the unknowns; the one that is reported (n, n); variances with the priors of
    all model parameters taken away (n,); which unknowns are held at a bound (n,)."""

    spread: Covariance
    matrix: FloatArray
    alone: FloatArray
    held: BoolArray

    def parameters(self, problem: Problem) -> list[int]:
        """Places of the model parameters that are not held."""
        return [
            i for i, u in enumerate(problem.unknowns) if u.kind == "parameter" and not self.held[i]
        ]


def concluded(
    problem: Problem,
    data: Dataset,
    options: FitOptions,
    theta: FloatArray,
    status: Status,
    began: float,
) -> Fit:
    """The whole result of a search for the unknowns of `problem`, made of `data` and `options`,
    that `began` (`time.perf_counter`) and ended at `theta` (n,) with this status."""
    block = problem.score_block
    value = problem.evaluate(theta, scores=block)
    seen = _innovations(problem, theta, value)
    aside = considered(problem, data, options, theta, block if seen.coloured else None)
    errors = _errors(problem, theta, value, aside, seen.coloured)
    estimates = _estimates(problem, theta, errors)
    combinations = _combinations(problem, theta, value, errors)
    nearer = aside.told if status.converged else {}
    model = _identified(problem, data, theta, estimates, errors, seen)
    kept = errors.parameters(problem)
    moved = {n: (s, _moves(problem, kept, by)) for n, (s, by) in aside.moves.items()}
    turned = turning(model, data) if problem.predictor.one_step.name == "innovation" else ""
    combinations = tuple(_seen_with_one_gain(c) if turned else c for c in combinations)
    status = replace(status, detail=turned or status.detail)
    said = [
        *([status.advice] if turned or not status.converged else []),
        *([errors.spread.doubt] if errors.spread.doubt else []),
        *([UNFINISHED] if status.converged and _unfinished(value, errors.held) else []),
        *_warned(problem, estimates, errors, nearer, seen.coloured),
        *_combination_warnings(problem, kept, combinations),
    ]
    return Fit(
        estimates=Estimates(
            model=replace(model, considered=moved),
            parameters=estimates,
            derived=_derived(problem, theta, errors.matrix),
            noise=_noise(problem, theta, errors.matrix),
            correlation_names=model.covariance_names,
            correlations=correlation(model.covariance),
            theta=theta,
            told=nearer,
        ),
        diagnostics=Diagnostics(
            status=replace(status, seconds=time.perf_counter() - began),
            cost=value.cost,
            loglik=-value.likelihood,
            unidentifiable=combinations,
            innovations=seen.by_flight,
            coloured=seen.coloured,
            covariance=replace(errors.spread, coloured=seen.coloured),
            warnings=tuple(said),
        ),
        provenance=Provenance(
            problem=problem,
            settings=_settings(problem, options),
            data_hash=data.hash,
            n_samples=int(sum(r.n for r in problem.records)),
            n_parameters=sum(u.kind != "initial" for u in problem.unknowns),
            flights=tuple(f.facts() for f in data.flights),
        ),
    )


def _warned(
    problem: Problem,
    estimates: Mapping[str, Estimate],
    errors: _Errors,
    nearer: Mapping[str, tuple[float, float]],
    coloured: bool,
) -> list[str]:
    """What is said of colour, of bounds, of noise that is not told apart, of what flights tell of
    the rest and of the records."""
    return [
        *([NOT_WHITE] if coloured and _of_its_own(problem) else []),
        *_bound_warnings(estimates, problem.dynamics),
        *errors.spread.splits,
        *nearer_warnings(nearer),
        *_record_warnings(problem),
    ]


def _settings(problem: Problem, options: FitOptions) -> FitSettings:
    """The choices as in fit.json."""
    return {
        "predictor": problem.predictor.name,
        "criterion": problem.criterion.name,
        "solver": options.chosen_solver().name,
        "initialisation": options.initialisation,
        "disturbance": list(options.disturbance),
        "noise_parts": list(options.noise_parts),
        "estimate_noise": options.estimate_noise,
        "seed": options.seed,
        "per_flight": sorted(
            {u.name for u in problem.unknowns if u.kind == "parameter" and u.flight}
        ),
        "fixed": sorted({d.name for d in problem.dynamics.parameters} - set(problem.engine.active)),
        "compiled": problem.engine.compiled,
        "considered": sorted(options.considered),
    }


def _innovations(problem: Problem, theta: FloatArray, value: Value) -> _Innovations:
    one_step = problem.predictor.one_step
    by_flight: dict[str, list[FloatArray]] = {}
    every: list[FloatArray] = []
    for b in one_step.blocks(problem, theta, False) if value.valid else ():
        e = np.where(b.mask != 0, b.e, np.nan)
        by_flight.setdefault(b.record.flight, []).append(e)
        every.append(e)
    coloured = one_step is not problem.predictor or is_coloured(every)
    return _Innovations(by_flight=by_flight, all=every, coloured=coloured)


def _errors(
    problem: Problem, theta: FloatArray, value: Value, aside: Considered, coloured: bool
) -> _Errors:
    """Errors of the unknowns, with what the parameters that are considered `aside` add."""
    # A wall says where no body is. It is no measurement: errors are those without it.
    told = None if value.hessian is None else value.hessian - wall(problem.bodies, theta).hessian
    precision = prior_terms(problem.unknowns, theta)[2]
    spread, held = _spread(problem, theta, value, told, precision, aside)
    matrix = spread.chosen(coloured)
    levels = any(u.kind == "noise" for u in problem.unknowns)
    if value.gradient is not None and not spread.enough and (levels or coloured):
        seconds = problem.score_block * problem.dt
        doubt = too_short_for_errors(spread.blocks, seconds, levels, coloured)
        spread = replace(spread, doubt=doubt)
    alone = _without_priors(problem, told, precision, held)
    return _Errors(spread=spread, matrix=matrix, alone=alone, held=held)


def _combinations(
    problem: Problem, theta: FloatArray, value: Value, errors: _Errors
) -> tuple[Combination, ...]:
    """Combinations of parameters that the flights do not tell apart."""
    kept, n = errors.parameters(problem), problem.n
    hessian = np.zeros((n, n)) if value.data_hessian is None else value.data_hessian
    unknowns = [problem.unknowns[i] for i in kept]
    return unidentified(
        marginal_information(hessian, kept),
        [_label(u) for u in unknowns],
        [theta[i] for i in kept],
        [u.scale for u in unknowns],
    )


def turning(model: IdentifiedModel, data: Dataset) -> str:
    """What to do where one gain cannot serve a whole record; "" where it can."""
    names = turning_states(model, data.segments)
    if not names:
        return ""
    return (
        f"one gain serves a whole record, and with it errors of {', '.join(names)} grow on the way: "
        'next: predictor="kalman", whose gain follows the flight'
    )


def _seen_with_one_gain(c: Combination) -> Combination:
    """The combination without the word that the data were at fault."""
    if len(c.names) > 1:
        return c
    return replace(c, text=f"{c.names[0]}: with one gain nothing is seen of it")


def _combination_warnings(
    problem: Problem, kept: Sequence[int], combinations: Sequence[Combination]
) -> Iterator[str]:
    known = {_label(u): bool(np.isfinite(u.sigma)) for u in (problem.unknowns[i] for i in kept)}
    for c in combinations:
        decided = any(known[n] for n in c.names)
        yield f"not identified by these data: {c.text}" + ("; the priors decide" if decided else "")


def _noise(
    problem: Problem, theta: FloatArray, matrix: FloatArray
) -> dict[str, tuple[float, float, str]]:
    """Level, standard error and unit of every noise level that was estimated."""
    noise: dict[str, tuple[float, float, str]] = {}
    for i, u in enumerate(problem.unknowns):
        if u.kind == "noise":
            level = float(np.exp(theta[i]))
            noise[u.name] = (level, level * float(np.sqrt(max(matrix[i, i], 0.0))), u.unit)
    return noise


def _spread(
    problem: Problem,
    theta: FloatArray,
    value: Value,
    told: FloatArray | None,
    precision: FloatArray,
    considered: Considered,
) -> tuple[Covariance, BoolArray]:
    """(covariances of the unknowns, with what `considered` parameters and those that differ between
    flights add; which unknowns are held at a bound), nan and none where the cost has no
    derivatives. `told` (n, n) is the Hessian without walls, `precision` (n,) that of the priors."""
    n = problem.n
    if value.gradient is None or told is None or value.data_hessian is None:
        unknown = np.full((n, n), np.nan)
        return Covariance(fisher=unknown, sandwich=unknown, blocks=0), np.zeros(n, dtype=bool)
    low, high = theta <= problem.lower, theta >= problem.upper
    held = (low & (value.gradient > 0)) | (high & (value.gradient < 0))
    spread = covariance(told, value.scores, precision, held)
    wider, splits = wider_split(problem, theta, value, spread.fisher, held)
    by = np.outer(wider, wider)
    spread = replace(
        spread, fisher=spread.fisher * by, sandwich=spread.sandwich * by, splits=splits
    )
    more = varying_spread(problem, theta, told, held)
    if considered.spread is not None:
        free_rows = np.where(held, 0.0, 1.0)
        more = more + considered.spread * np.outer(free_rows, free_rows)
    fisher, sandwich = spread.fisher + more, spread.sandwich + more
    return replace(spread, fisher=fisher, sandwich=sandwich, more=more), held


UNFINISHED = "the solver stopped at its own tolerance, but a full step would still lower the cost"


def _unfinished(value: Value, held: BoolArray) -> bool:
    """Whether a full Newton step would still lower the cost."""
    if value.gradient is None or value.hessian is None or value.data_hessian is None:
        return False
    return newton_decrement(value.gradient, value.hessian, held) > 1e-2


NOT_WHITE = (
    "one-step errors are not white: the model lacks something, and numbers may be off by more than "
    "their errors; greybox discover looks for it"
)


def _of_its_own(problem: Problem) -> bool:
    """Whether a model of the user's own was fitted to its errors one step ahead."""
    one_step = problem.predictor.one_step is problem.predictor
    return one_step and physics_of(problem.dynamics) is None


def _bound_warnings(estimates: Mapping[str, Estimate], dynamics: Dynamics) -> list[str]:
    own = own_parameters(dynamics)
    advice = "check the vehicle file or the effect list"
    if physics_of(dynamics) is None:
        advice = (
            "are its bounds and its prior right (unit, sign)? Else the model lacks a term, and the "
            "other numbers bear it"
        )
    noise = "these flights do not show how long such noise lasts, and nothing else depends on it"
    return [
        f"{n} is at its bound {e.value:.4g} {e.unit}: no error bar; {advice if n in own else noise}"
        for n, e in estimates.items()
        if e.at_bound
    ]


def nearer_warnings(nearer: Mapping[str, tuple[float, float]]) -> list[str]:
    """One of every held parameter that flights tell to (error, stated error)."""
    return [
        f"{n} is held, but these flights tell it to {error:.2g}, nearer than its stated error of "
        f"{stated:.2g}: estimate it (leave it out of --fixed and --considered)"
        for n, (error, stated) in nearer.items()
    ]


def _record_warnings(problem: Problem) -> Iterator[str]:
    """What the records lack, and what ran them."""
    gaps = _gappy(problem)
    if gaps and problem.predictor.name == "innovation":
        yield (
            f"{', '.join(gaps)} missing in more than 5 % of the samples, without a rhythm: the "
            "gain assumes that they are there; use the kalman predictor"
        )
    total_held = sum(r.held for r in problem.records)
    if total_held:
        yield f"{total_held} missing command or voltage cells were held from the sample before"
    if not problem.engine.compiled:
        yield f"CasADi's VM ran the equations, slower than compiled: {trouble()}"


def _moves(problem: Problem, keep: Sequence[int], moves: FloatArray) -> dict[str, float]:
    """Parameter -> how far it moves per unit of a held one, of those in `keep`, from `moves` (n,)
    of all unknowns; of one with a value in every flight the mean over flights."""
    each: dict[str, list[float]] = {problem.unknowns[i].name: [] for i in keep}
    for u, move in zip(problem.unknowns, moves.tolist(), strict=True):
        if u.name in each:
            each[u.name].append(move)
    return {n: float(np.mean(v)) for n, v in each.items()}


def _gappy(problem: Problem, share: float = 0.05) -> list[str]:
    """Innovation components that are missing in more than `share` of the samples where the record's
    pattern has them."""
    total = sum(r.n for r in problem.records)
    lost = sum((r.usual.at(r.n) & (r.mask == 0)).sum(axis=0) for r in problem.records) / total
    seen = np.concatenate([r.mask for r in problem.records]).sum(axis=0) > 0
    return [
        n
        for n, s, v in zip(problem.dynamics.innovations.names, lost, seen, strict=True)
        if v and s > share
    ]


def _label(u: Unknown) -> str:
    return u.name if u.flight is None else f"{u.name} ({u.flight})"


def _without_priors(
    problem: Problem, hessian: FloatArray | None, precision: FloatArray, held: BoolArray
) -> FloatArray:
    """Variance of every unknown with the priors of all model parameters taken away (n,); infinite
    where data are silent."""
    out = np.full(problem.n, np.inf)
    if hessian is None:
        return out
    prior = np.where([u.kind == "parameter" for u in problem.unknowns], precision, 0.0)
    free = ~held
    inverse, empty = scaled_inverse((hessian - np.diag(prior))[np.ix_(free, free)])
    out[free] = np.where(empty, np.inf, np.diag(inverse))
    return out


def _estimates(
    problem: Problem,
    theta: FloatArray,
    errors: _Errors,
) -> dict[str, Estimate]:
    matrix, fisher, held, alone = (
        errors.matrix,
        errors.spread.fisher,
        errors.held,
        errors.alone,
    )
    out: dict[str, Estimate] = {}
    by_name: dict[str, list[int]] = {}
    for i, u in enumerate(problem.unknowns):
        if u.kind == "parameter":
            by_name.setdefault(u.name, []).append(i)

    def std(m: FloatArray, i: int) -> float:
        return float("nan") if held[i] else float(np.sqrt(max(m[i, i], 0.0)))

    for d in problem.dynamics.parameters:
        places = by_name.get(d.name)
        if not places:
            continue
        first = problem.unknowns[places[0]]
        has_prior = bool(np.isfinite(first.sigma))
        # Where neither data nor prior say anything both variances are infinite: no prior decided.
        known = [i for i in places if not held[i] and np.isfinite(fisher[i, i])]
        shares = [1.0 - fisher[i, i] / alone[i] if alone[i] > 0 else 0.0 for i in known]
        influence = float(np.clip(np.mean(shares), 0.0, 1.0)) if shares else 0.0
        per_flight: dict[str, tuple[float, float]] = {}
        if first.flight is None:
            value, error = float(theta[places[0]]), std(matrix, places[0])
            fisher_error = std(fisher, places[0])
        else:
            per_flight = {
                str(problem.unknowns[i].flight): (float(theta[i]), std(matrix, i)) for i in places
            }
            value, error, fisher_error = _over_flights(matrix, fisher, held, places, per_flight)
        out[d.name] = Estimate(
            name=d.name,
            value=value,
            std=error,
            std_fisher=fisher_error,
            unit=d.unit,
            scope="shared" if first.flight is None else "flight",
            prior=(first.mean, first.sigma) if has_prior else None,
            prior_influence=influence,
            at_bound=bool(held[places].any()),
            per_flight=per_flight,
        )
    return out


def _over_flights(
    matrix: FloatArray,
    fisher: FloatArray,
    held: BoolArray,
    places: Sequence[int],
    per_flight: Mapping[str, tuple[float, float]],
) -> tuple[float, float, float]:
    """(mean of the values of single flights, its standard error, that by the Fisher information):
    the error is at least what the spread between flights says."""
    numbers = np.array([v for v, _ in per_flight.values()])
    mean, loose = float(numbers.mean()), [i for i in places if not held[i]]
    if not loose:
        return mean, float("nan"), float("nan")
    error = max(_mean_error(matrix, loose), _between(numbers) / np.sqrt(numbers.size))
    return mean, error, _mean_error(fisher, loose)


def _mean_error(matrix: FloatArray, places: Sequence[int]) -> float:
    """Standard error of the mean of correlated estimates."""
    part = matrix[np.ix_(np.asarray(places), np.asarray(places))]
    return float(np.sqrt(max(part.sum(), 0.0))) / len(places)


def _between(numbers: FloatArray) -> float:
    """Standard deviation between flights; 0 for a single one."""
    return float(numbers.std(ddof=1)) if numbers.size > 1 else 0.0


def _derived(
    problem: Problem, theta: FloatArray, matrix: FloatArray
) -> dict[str, tuple[float, float]]:
    """Derived parameters with standard errors by the delta method (per-flight ones for each
    flight)."""
    physics = physics_of(problem.dynamics)
    if physics is None:
        return {}
    p = ca.SX.sym("p", len(problem.dynamics.parameters))
    table = physics.derived(p)
    if not table:
        return {}
    vector = ca.vertcat(*table.values())
    function = ca.Function(
        "derived", [p], [vector, ca.jacobian(vector, p)[:, problem.engine.active_index.tolist()]]
    )
    out: dict[str, tuple[float, float]] = {}
    own = {u.name.split(".")[0] for u in problem.unknowns if u.flight and u.kind == "parameter"}
    for flight in (None, *problem.flights):
        which = flight or problem.flights[0]  # a shared row does not depend on the flight
        values, slope = function(problem.parameters_of(theta, which))
        for k, name in enumerate(table):
            if (name.split(".")[0] in own) == (flight is None):
                continue  # per-flight effects get one row per flight, shared ones a single row
            # What is not felt is not asked: its variance may be infinite.
            row = slope.full()[k]
            columns, row = np.asarray(problem.local_columns(which))[row != 0], row[row != 0]
            known = matrix[np.ix_(columns, columns)]
            spread = float(row @ known @ row) if np.isfinite(known).all() else np.inf
            label = name if flight is None else f"{name} ({flight})"
            out[label] = (float(values[k]), float(np.sqrt(max(spread, 0.0))))
    return out


def _identified(
    problem: Problem,
    data: Dataset,
    theta: FloatArray,
    estimates: Mapping[str, Estimate],
    errors: _Errors,
    seen: _Innovations,
) -> IdentifiedModel:
    d = problem.dynamics
    shared = [i for i in errors.parameters(problem) if problem.unknowns[i].flight is None]
    values = {p.name: float(problem.base[i]) for i, p in enumerate(d.parameters)}
    values |= {n: e.value for n, e in estimates.items()}
    per_flight: dict[str, dict[str, float]] = {}
    spread: dict[str, tuple[float, float]] = {}
    declared = {p.name: p for p in d.parameters}
    for n, e in estimates.items():
        if e.scope != "flight":
            continue
        for f, (level, _) in e.per_flight.items():
            per_flight.setdefault(f, {})[n] = level
        between = _between(np.array([v for v, _ in e.per_flight.values()])) or declared[n].scale
        spread[n] = (e.value, float(between))
    process, sensor = problem.noise_levels(theta)
    if problem.predictor.misfit_is_sensor_noise and seen.all:
        stacked = np.concatenate(seen.all)
        good = np.isfinite(stacked).any(axis=0)
        rms = np.sqrt(np.nanmean(np.where(good, stacked, 0.0) ** 2, axis=0))
        sensor = np.where(good & (rms > 0), rms, sensor)
    u_ref = np.array([problem.means.get(n, 0.0) for n in d.inputs.names])
    return IdentifiedModel(
        dynamics=d,
        values=ParameterValues(values),
        covariance_names=tuple(problem.unknowns[i].name for i in shared),
        covariance=errors.matrix[np.ix_(shared, shared)],
        per_flight=per_flight,
        flight_spread=spread,
        flight_covariance=_with_means(problem, errors, shared, tuple(spread)),
        process_noise=process,
        sensor_noise=sensor,
        weak=100.0 * np.max([r.x0_sigma for r in problem.records], axis=0),
        reference_state=d.reference(problem.means),
        reference_inputs=u_ref,
        sample_time=problem.dt,
        domain=_domain(data),
        data_hash=data.hash,
        trained_on=problem.flights,
        trained_samples=frozenset().union(*(f.known_by for f in data)),
        recipes=data.recipes,
    )


def _with_means(
    problem: Problem, errors: _Errors, shared: Sequence[int], own: Sequence[str]
) -> FloatArray:
    """Covariance (n + k, k) of the `shared` unknowns, and of the means over the flights of the k
    parameters that every flight has of its `own`, with these means."""
    count = len(problem.unknowns)
    means = np.zeros((len(own), count))
    for row, name in zip(means, own, strict=True):
        places = [
            i for i, u in enumerate(problem.unknowns) if u.flight is not None and u.name == name
        ]
        row[places] = 1.0 / max(len(places), 1)
    rows = np.vstack([np.eye(count)[list(shared)], means])
    known = np.where(np.isfinite(errors.matrix), errors.matrix, 0.0)
    return np.asarray(rows @ known @ means.T)


def _domain(data: Dataset) -> dict[str, tuple[float, float]]:
    """Smallest and largest value of every channel."""
    domain: dict[str, tuple[float, float]] = {}
    for flight in data.flights:
        for s in flight.segments:
            for n, v in s.channels.items():
                seen = v[np.isfinite(v)]
                if seen.size:
                    low, high = domain.get(n, (np.inf, -np.inf))
                    domain[n] = (min(low, float(seen.min())), max(high, float(seen.max())))
    return domain
