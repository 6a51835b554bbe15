"""fit: estimate a model's parameters from flights by the prediction error method, and say how sure
the numbers are.

fit is a function from values to a value: model, data and choices in, a frozen `Fit` out; nothing is
changed in place.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Unpack

import casadi as ca
import numpy as np
from threadpoolctl import threadpool_limits

from greybox.data import Dataset
from greybox.errors import FitError, UnknownNameError
from greybox.estimation.build import trouble
from greybox.estimation.considered import NOTHING, Considered, considered, demand_considerable
from greybox.estimation.covariance import Covariance, correlation, covariance, scaled_inverse
from greybox.estimation.feasible import wall
from greybox.estimation.few_samples import demand_samples, too_short_for_errors
from greybox.estimation.identifiability import marginal_information, unidentified
from greybox.estimation.options import FitChoices, FitOptions, member, says_choices
from greybox.estimation.problem import Problem, make_problem
from greybox.estimation.result import Diagnostics, Estimate, Estimates, Fit, Provenance
from greybox.estimation.solver import Progress, Solver, Value
from greybox.estimation.solvers.levenberg_marquardt import newton_decrement
from greybox.estimation.status import Code, Interrupted, Status
from greybox.estimation.unknown import Unknown
from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.noise import part_named, with_disturbance, with_parts
from greybox.model.parameter import ParameterValues
from greybox.statistics.blocks import block_samples
from greybox.statistics.whiteness import is_coloured
from greybox.symbolic import BoolArray, FloatArray

__all__ = ["Estimate", "Fit", "FitOptions", "concluded", "fit", "member", "noise_of"]


@says_choices(FitOptions)
def fit(
    model: Dynamics,
    data: Dataset,
    options: FitOptions | None = None,
    *,
    progress: Progress | None = None,
    **choices: Unpack[FitChoices],
) -> Fit:
    """Fit `model` to `data` by the prediction error method.

    The choices are keywords, fields of `FitOptions` with its defaults, or `options` as a whole;
    keywords go before it: predictor, criterion, solver, initialisation, disturbance, noise_parts,
    free, fixed, per_flight, shared, values, priors, flight_priors, noise, estimate_noise,
    estimate_initial, seed, starts, build, use_compiler.

    predictor x criterion x solver x initialisation are names or objects (see greybox.estimation).
    `disturbance` names the process-noise groups ("force", "torque") that also get a slowly varying
    disturbance state, `noise_parts` what else of the noise is correlated in time. Which parameters
    are free, fixed, per flight or shared, start values, priors and noise levels: see
    `greybox.estimation.problem.make_problem`. `initialisation`: "nominal", "noise" (start noise
    levels from the data), "equation-error", "multistart" (`starts` random starts with `seed`) or
    "innovation" (a maximum likelihood fit in innovation form first, whose estimates and noise
    levels the predictor proper starts from: what a predictor without noise
    levels of its own wants). `progress(iteration, cost, decrement)` is called every iteration. The
    result says whether the fit converged; a fit that did not never looks like one that did. Raises
    `DataError`, `ModelError`, `UnknownNameError` (of a choice, too), and `Interrupted`, a
    KeyboardInterrupt whose `kept` is the `Fit` with the best values so far.
    """
    began = time.perf_counter()
    options = FitOptions.of(options, choices)
    dynamics = with_parts(model, map(part_named, options.noise_parts))
    dynamics = with_disturbance(dynamics, options.disturbance)
    predictor, solver = options.chosen_predictor(), options.chosen_solver()
    demand_considerable(dynamics, options)
    first: Fit | None = None
    if options.initialisation == "innovation":
        before = options.but(predictor="innovation", initialisation="equation-error", considered=())
        first = fit(model, data, before, progress=progress)
        options = options.but(noise=noise_of(first.model))
    with threadpool_limits(limits=1):
        problem = make_problem(dynamics, data, options)
        demand_samples(problem)
        if first is not None:
            found = {
                (u.name, u.flight): t
                for u, t in zip(first.problem.unknowns, first.theta, strict=True)
            }
            start = np.array([found.get((u.name, u.flight), u.start) for u in problem.unknowns])
        else:
            start = _initialise(problem, options, solver)
        start = predictor.approach(
            problem, start, progress
        )  # multiple shooting closes its gaps first
        try:
            theta, status = solver.solve(problem, problem.inside(start), progress)
        except Interrupted as stop:
            theta, status = stop.kept
        result = concluded(problem, data, options, theta, status, began)
    if status.code is Code.INTERRUPTED:
        raise Interrupted(result)
    return result


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
    held = considered(problem, data, options, theta)
    return _finish(problem, data, theta, status, began, _settings(problem, options), held)


def _settings(problem: Problem, options: FitOptions) -> dict[str, Any]:
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


def _initialise(problem: Problem, options: FitOptions, solver: Solver) -> FloatArray:
    how = options.initialisation
    if how == "nominal":
        return problem.start
    from greybox.estimation import initialisation as init

    if how == "noise":
        return init.noise_start(problem)
    if how == "equation-error":
        try:
            start = problem.inside(init.equation_error(problem))
            start = init.noise_start(problem, start) if problem.predictor.has_noise else start
        except FitError:
            return problem.start
        better = problem.evaluate(start, 0).cost < problem.evaluate(problem.start, 0).cost
        return start if better else problem.start
    if how == "multistart":
        from greybox.estimation.multistart import multistart

        return multistart(problem, solver, n=options.starts, seed=options.seed).theta[0]
    raise UnknownNameError(
        "initialisation", how, ("nominal", "noise", "equation-error", "multistart", "innovation")
    )


def noise_of(model: IdentifiedModel) -> dict[str, float]:
    """Noise levels of a model under the names that `noise` takes."""
    d = model.dynamics
    process = dict(
        zip(
            (f"noise.process.{n}" for n in d.noises.names),
            model.process_noise.tolist(),
            strict=True,
        )
    )
    sensor = dict(
        zip(
            (f"noise.sensor.{n}" for n in d.innovations.names),
            model.sensor_noise.tolist(),
            strict=True,
        )
    )
    return process | sensor


def _finish(
    problem: Problem,
    data: Dataset,
    theta: FloatArray,
    status: Status,
    began: float,
    settings: Mapping[str, Any],
    considered: Considered = NOTHING,
) -> Fit:
    """Errors, identifiability and the identified model at the solution; what `considered`
    parameters add joins the covariance."""
    block = _block(problem)
    value = problem.evaluate(theta, scores=block)
    # A wall says where no body is. It is no measurement: errors are those without it.
    told = None if value.hessian is None else value.hessian - wall(problem.bodies, theta).hessian
    precision = np.array(
        [0.0 if not np.isfinite(u.sigma) else u.sigma**-2 for u in problem.unknowns]
    )
    spread, held = _spread(problem, theta, value, told, precision, considered)
    one_step = problem.predictor.one_step
    blocks = list(one_step.blocks(problem, theta, False)) if value.valid else []
    innovations: dict[str, list[FloatArray]] = {}
    whitened: list[FloatArray] = []
    for b in blocks:
        e = np.where(b.mask != 0, b.e, np.nan)
        innovations.setdefault(b.record.flight, []).append(e)
        whitened.append(e)
    coloured = one_step is not problem.predictor or is_coloured(whitened)
    matrix = spread.chosen(coloured)
    alone = _without_priors(problem, told, precision, held)
    estimates = _estimates(problem, theta, matrix, spread.fisher, held, alone)
    levels = any(u.kind == "noise" for u in problem.unknowns)
    if value.gradient is not None and not spread.enough and (levels or coloured):
        doubt = too_short_for_errors(spread.blocks, block * problem.dt, levels, coloured)
        spread = replace(spread, doubt=doubt)
    nearer = considered.told if status.converged and not coloured else {}
    keep = [i for i, u in enumerate(problem.unknowns) if u.kind == "parameter" and not held[i]]
    labels = [_label(problem.unknowns[i]) for i in keep]
    n = problem.n
    data_hessian = np.zeros((n, n)) if value.data_hessian is None else value.data_hessian
    information = marginal_information(data_hessian, keep)
    combinations = unidentified(information, labels, [theta[i] for i in keep])
    unfinished = status.converged and _unfinished(value, held)
    warnings = [
        *([] if status.converged else [status.advice]),
        *([spread.doubt] if spread.doubt else []),
        *([UNFINISHED] if unfinished else []),
        *_bound_warnings(estimates),
        *_nearer_warnings(nearer),
        *_record_warnings(problem),
    ]
    for c in combinations:
        decided = any(np.isfinite(problem.unknowns[keep[labels.index(n)]].sigma) for n in c.names)
        warnings.append(
            f"not identified by these data: {c.text}" + ("; the priors decide" if decided else "")
        )
    shared = [i for i in keep if problem.unknowns[i].flight is None]
    names = tuple(problem.unknowns[i].name for i in shared)
    cov = matrix[np.ix_(shared, shared)]
    noise: dict[str, tuple[float, float, str]] = {}
    for i, u in enumerate(problem.unknowns):
        if u.kind == "noise":
            level = float(np.exp(theta[i]))
            noise[u.name] = (level, level * float(np.sqrt(max(matrix[i, i], 0.0))), u.unit)
    n_samples = int(sum(r.n for r in problem.records))
    free = [i for i, u in enumerate(problem.unknowns) if u.kind != "initial"]
    model = _identified(problem, data, theta, estimates, names, cov, whitened)
    moved = {n: (s, _moves(problem, keep, by)) for n, (s, by) in considered.moves.items()}
    model = replace(model, considered=moved)
    return Fit(
        estimates=Estimates(
            model=model,
            parameters=estimates,
            derived=_derived(problem, theta, matrix),
            noise=noise,
            correlation_names=names,
            correlations=correlation(cov),
            theta=theta,
            told=nearer,
        ),
        diagnostics=Diagnostics(
            status=replace(status, seconds=time.perf_counter() - began),
            cost=value.cost,
            loglik=-value.likelihood,
            unidentifiable=combinations,
            innovations=innovations,
            coloured=coloured,
            covariance=spread,
            warnings=tuple(warnings),
        ),
        provenance=Provenance(
            problem=problem,
            settings=settings,
            data_hash=data.hash,
            n_samples=n_samples,
            n_parameters=len(free),
            flights=tuple(
                {"name": f.name, "samples": f.n, "seconds": f.duration, "notes": list(f.notes)}
                for f in data.flights
            ),
        ),
    )


def _block(problem: Problem) -> int:
    """Samples that scores are summed over, longer than the errors' correlation: half a second,
    twice the window of a predictor that looks further ahead."""
    ahead = max(problem.predictor.horizons)
    return max(
        block_samples(problem.dt),
        min(r.n for r in problem.records) // 200,
        2 * ahead if ahead > 1 else 1,
    )


def _spread(
    problem: Problem,
    theta: FloatArray,
    value: Value,
    told: FloatArray | None,
    precision: FloatArray,
    considered: Considered,
) -> tuple[Covariance, BoolArray]:
    """(covariances of the unknowns, with what `considered` parameters add; which unknowns are held
    at a bound), nan and none where the cost has no derivatives. `told` (n, n) is the Hessian
    without walls, `precision` (n,) that of the priors."""
    n = problem.n
    if value.gradient is None or told is None or value.data_hessian is None:
        unknown = np.full((n, n), np.nan)
        return Covariance(fisher=unknown, sandwich=unknown, blocks=0), np.zeros(n, dtype=bool)
    low, high = theta <= problem.lower, theta >= problem.upper
    held = (low & (value.gradient > 0)) | (high & (value.gradient < 0))
    spread = covariance(told, value.scores, precision, held)
    if considered.spread is not None:
        free_rows = np.where(held, 0.0, 1.0)
        more = considered.spread * np.outer(free_rows, free_rows)
        spread = replace(spread, fisher=spread.fisher + more, sandwich=spread.sandwich + more)
    return spread, held


UNFINISHED = "the solver stopped at its own tolerance, but a full step would still lower the cost"


def _unfinished(value: Value, held: BoolArray) -> bool:
    """Whether a full Newton step would still lower the cost."""
    if value.gradient is None or value.hessian is None or value.data_hessian is None:
        return False
    return newton_decrement(value.gradient, value.hessian, held) > 1e-2


def _bound_warnings(estimates: Mapping[str, Estimate]) -> list[str]:
    return [
        f"{n} is at its bound {e.value:.4g} {e.unit}: no error bar; check the vehicle file or the "
        "effect list"
        for n, e in estimates.items()
        if e.at_bound
    ]


def _nearer_warnings(nearer: Mapping[str, tuple[float, float]]) -> list[str]:
    return [
        f"{n} is held, but these flights tell it to {error:.2g}, nearer than its stated error of "
        f"{stated:.2g}: "
        "estimate it (leave it out of --fixed and --considered)"
        for n, (error, stated) in nearer.items()
    ]


def _record_warnings(problem: Problem) -> Iterator[str]:
    """What the records lack, and what ran them."""
    gaps = _gappy(problem)
    if gaps and problem.predictor.name == "innovation":
        yield (
            f"{', '.join(gaps)} missing in more than 5 % of the samples, without a rhythm: the "
            "gain assumes that they are "
            "there; use the kalman predictor"
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
    matrix: FloatArray,
    fisher: FloatArray,
    held: BoolArray,
    alone: FloatArray,
) -> dict[str, Estimate]:
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
        common: dict[str, Any] = {
            "name": d.name,
            "unit": d.unit,
            "prior": (first.mean, first.sigma) if has_prior else None,
            "prior_influence": influence,
            "at_bound": bool(held[places].any()),
        }
        if first.flight is None:
            i = places[0]
            out[d.name] = Estimate(
                value=float(theta[i]),
                std=std(matrix, i),
                std_fisher=std(fisher, i),
                scope="shared",
                **common,
            )
            continue
        each = {str(problem.unknowns[i].flight): (float(theta[i]), std(matrix, i)) for i in places}
        numbers = np.array([v for v, _ in each.values()])
        loose = [i for i in places if not held[i]]
        out[d.name] = Estimate(
            value=float(numbers.mean()),
            std=max(_mean_error(matrix, loose), _between(numbers) / np.sqrt(numbers.size))
            if loose
            else float("nan"),
            std_fisher=_mean_error(fisher, loose) if loose else float("nan"),
            scope="flight",
            per_flight=each,
            **common,
        )
    return out


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
    names: tuple[str, ...],
    cov: FloatArray,
    innovations: list[FloatArray],
) -> IdentifiedModel:
    d = problem.dynamics
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
    if problem.predictor.misfit_is_sensor_noise and innovations:
        stacked = np.concatenate(innovations)
        good = np.isfinite(stacked).any(axis=0)
        rms = np.sqrt(np.nanmean(np.where(good, stacked, 0.0) ** 2, axis=0))
        sensor = np.where(good & (rms > 0), rms, sensor)
    x_ref = d.reference(problem.means)
    u_ref = np.array([problem.means.get(n, 0.0) for n in d.inputs.names])
    domain: dict[str, tuple[float, float]] = {}
    for flight in data.flights:
        for s in flight.segments:
            for n, v in s.channels.items():
                seen = v[np.isfinite(v)]
                if seen.size:
                    low, high = domain.get(n, (np.inf, -np.inf))
                    domain[n] = (min(low, float(seen.min())), max(high, float(seen.max())))
    return IdentifiedModel(
        dynamics=d,
        values=ParameterValues(values),
        covariance_names=names,
        covariance=cov,
        per_flight=per_flight,
        flight_spread=spread,
        process_noise=process,
        sensor_noise=sensor,
        weak=100.0 * np.max([r.x0_sigma for r in problem.records], axis=0),
        reference_state=x_ref,
        reference_inputs=u_ref,
        sample_time=problem.dt,
        domain=domain,
        data_hash=data.hash,
        trained_on=problem.flights,
    )
