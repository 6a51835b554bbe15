"""fit: estimate a model's parameters from flights by the prediction error method, and say how sure
the numbers are.

fit is a function from values to a value: model, data and choices in, a frozen `Fit` out; nothing is
changed in place.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Unpack

import numpy as np
from threadpoolctl import threadpool_limits

from greybox.data import Dataset
from greybox.errors import FitError, UnknownNameError
from greybox.estimation.conclusion import concluded
from greybox.estimation.considered import demand_considerable
from greybox.estimation.elsewhere import elsewhere
from greybox.estimation.few_samples import demand_samples
from greybox.estimation.options import FitChoices, FitOptions, member, says_choices
from greybox.estimation.problem import Problem, make_problem
from greybox.estimation.result import Estimate, Fit
from greybox.estimation.solved import solved
from greybox.estimation.solver import Progress, Solver
from greybox.estimation.solvers.levenberg_marquardt import GOOD, POOR, LevenbergMarquardt
from greybox.estimation.status import Code, Interrupted, Status
from greybox.model.dynamics import Dynamics
from greybox.model.given_values import demand_given
from greybox.model.identified import IdentifiedModel
from greybox.model.noise import part_named, with_disturbance, with_parts
from greybox.symbolic import FloatArray

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
    levels of its own wants). `values` are numbers that their parameters, and a body, can have (see
    `greybox.model.given_values`). `progress(iteration, cost, decrement)` is called every iteration. The
    result says whether the fit converged; a fit that did not never looks like one that did. Raises
    `DataError`, `ModelError`, `UnknownNameError` (of a choice, too), and `Interrupted`, a
    KeyboardInterrupt whose `kept` is the `Fit` with the best values so far.
    """
    began = time.perf_counter()
    options = FitOptions.of(options, choices)
    dynamics = with_noise_of(model, options)
    demand_given(dynamics, options.values)
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
        start = _initialise(problem, options, solver) if first is None else _as_in(first, problem)
        # Multiple shooting closes its gaps first.
        start = predictor.approach(problem, start, progress)
        try:
            theta, status = solved(problem, solver, problem.inside(start), progress)
            if status.converged and (predictor.one_step is predictor or not _rough(solver)):
                theta, status = _lowest(problem, solver, theta, status, progress)
        except Interrupted as stop:
            theta, status = stop.kept
        result = concluded(problem, data, options, theta, status, began)
    if status.code is Code.INTERRUPTED:
        raise Interrupted(result)
    return result


def with_noise_of(model: Dynamics, options: FitOptions) -> Dynamics:
    """The model that is fitted: with the noise parts and disturbances of the options. Raises
    `UnknownNameError` for one that there is not."""
    noisy = with_parts(model, map(part_named, options.noise_parts))
    return with_disturbance(noisy, options.disturbance)


def _rough(solver: Solver) -> bool:
    """Whether a search is a trial that ends before its optimum."""
    return isinstance(solver, LevenbergMarquardt) and (
        solver.tolerance > LevenbergMarquardt().tolerance
    )


def _lowest(
    problem: Problem,
    solver: Solver,
    theta: FloatArray,
    status: Status,
    progress: Progress | None,
) -> tuple[FloatArray, Status]:
    """Where a search ended, or ends from other values of lag and delay, if that is lower."""
    try:
        # A trial does not search in vain.
        start = elsewhere(problem, theta, GOOD if _rough(solver) else POOR)
        if start is None:
            return theta, status
        other, how = solved(problem, solver, start, progress)
        better = problem.evaluate(other, 0).cost < problem.evaluate(theta, 0).cost
    except KeyboardInterrupt:
        raise Interrupted((theta, replace(status, code=Code.INTERRUPTED))) from None
    return (other, how) if how.converged and better else (theta, status)


def _as_in(first: Fit, problem: Problem) -> FloatArray:
    """The unknowns (n,) as a fit found them; what it had not keeps its start."""
    found = {
        (u.name, u.flight): t for u, t in zip(first.problem.unknowns, first.theta, strict=True)
    }
    return np.array([found.get((u.name, u.flight), u.start) for u in problem.unknowns])


def _initialise(problem: Problem, options: FitOptions, solver: Solver) -> FloatArray:
    how = options.initialisation
    if how == "nominal":
        return problem.start
    from greybox.estimation import initialisation as init

    has_noise = problem.predictor.has_noise
    if how == "noise":
        return init.noise_start(problem)
    if how == "equation-error":
        # Where the user's values, or the vehicle's, predict better, the equation error's wait.
        starts = [problem.start, init.noise_start(problem)] if has_noise else [problem.start]
        try:
            found = problem.inside(init.equation_error(problem))
            starts.append(init.noise_start(problem, found) if has_noise else found)
        except FitError:
            pass
        return min(starts, key=lambda at: problem.evaluate(at, 0).cost)
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
