"""The same criterion minimised by IPOPT with CasADi's exact derivatives: an independent check of
Gauss-Newton, and slow.

N log det( 1/N sum e e' ) of the predictor as one CasADi expression over the whole record
(`mapaccum`), exact gradient, Gauss-Newton Hessian 2 J' (Lambda^-1 x I) J from CasADi's Jacobian
(the exact Hessian is indefinite away from the optimum and leads IPOPT astray), in the coordinates
of the tangent at the start scaled to unit curvature, with initial states and output offsets as
further unknowns (Wachter and Biegler 2006, Math. Program. 106(1)). Every derivative is a sweep
through an unrolled recursion: for anything but a check use the default solver, which reaches the
same optimum far sooner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from greybox.errors import DataError, FitError
from greybox.linear.parametrisation import Free
from greybox.linear.pem import Nuisance, Settings, Solution, Status, minimise, normal_equations
from greybox.linear.predictor import from_full_vector, full_vector
from greybox.linear.records import Record
from greybox.model.matrices import spectral_radius
from greybox.symbolic import Expr, FloatArray

REACH = 3.0
"""How far IPOPT may go in one chart, in standard errors of each direction, before the coordinates
are renewed."""
CHARTS = 40


def minimise_ipopt(start: Solution, records: Sequence[Record], settings: Settings) -> Solution:
    """The optimum from `start` (scaled records, a `Free` point). The box of each chart keeps it
    near a stable predictor.

    Raises `DataError` for missing outputs, and `FitError` for structured models or where IPOPT
    leaves the stable predictors.
    """
    if any(r.missing for r in records):
        raise DataError(
            "IPOPT cannot bridge missing outputs",
            fix="solver='gauss-newton', or cut the records there",
        )
    here, iterations = start, 0
    for _ in range(CHARTS):
        point, nuisances, done = _solved(here, records, settings)
        if spectral_radius(point.system.predictor) >= settings.radius:
            raise FitError(
                "IPOPT ended at an unstable predictor", fix="start nearer, or solver='gauss-newton'"
            )
        # no iteration: only the evaluation, the information and the tangent there
        here = minimise(point, records, replace(settings, max_iterations=0), nuisances=nuisances)
        iterations += done
        gradient = normal_equations(here.point, records, here.evaluation, settings).gradient
        decrement = float(
            gradient @ np.linalg.pinv(here.information, rcond=1e-10, hermitian=True) @ gradient
        )
        if decrement < settings.tolerance or iterations >= settings.max_iterations:
            break
    status = Status.CONVERGED if decrement < settings.tolerance else Status.MAX_ITERATIONS
    return replace(here, status=status, iterations=iterations, decrement=decrement)


def _solved(
    start: Solution, records: Sequence[Record], settings: Settings
) -> tuple[Free, tuple[Nuisance, ...], int]:
    """One IPOPT run in the chart at `start`: point, nuisances, and iterations."""
    point = start.point
    if not isinstance(point, Free):
        raise FitError("IPOPT works on the free linear model only", fix="solver='gauss-newton'")
    directions = start.tangent @ _unit(start.information)
    count, (n, _, p) = directions.shape[1], point.system.sizes
    theta = ca.MX.sym("theta", count)
    base = full_vector(point.system)
    unknowns, errors, first = [theta], [], [np.zeros(count)]
    for record, nuisance in zip(records, start.nuisances):
        x0, offset = ca.MX.sym("x0", n), ca.MX.sym("offset", p)
        unknowns += [x0] * settings.free_start + [offset] * settings.offsets
        first += [nuisance.x0] * settings.free_start + [nuisance.offset] * settings.offsets
        begin = x0 if settings.free_start else ca.DM(nuisance.x0)
        shift = offset if settings.offsets else ca.DM(nuisance.offset)
        errors.append(_innovations(point, record, base + directions @ theta, begin, shift))
    e: Expr = ca.horzcat(*errors)
    x: Expr = ca.vertcat(*unknowns)
    samples, size = e.shape[1], x.shape[0]
    noise = e @ e.T / samples
    jacobian = ca.jacobian(ca.vec(e), x)
    weighted = ca.reshape(
        ca.solve(noise, ca.reshape(jacobian, p, samples * size)), samples * p, size
    )
    factor = ca.MX.sym("lam_f")
    hessian = ca.Function(
        "hessian",
        [x, ca.MX.sym("p", 0), factor, ca.MX.sym("lam_g", 0)],
        [2.0 * factor * ca.triu(jacobian.T @ weighted)],
    )
    options: dict[str, ca.Function | bool | str | int | float] = {
        "hess_lag": hessian,
        "print_time": False,
        "show_eval_warnings": False,
        "error_on_fail": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.max_iter": 30,
        "ipopt.tol": 1e-6,
    }
    solver = ca.nlpsol("linear", "ipopt", {"x": x, "f": samples * ca.log(ca.det(noise))}, options)
    box = np.concatenate([np.full(count, REACH), np.full(size - count, np.inf)])
    answer = np.asarray(solver(x0=np.concatenate(first), lbx=-box, ubx=box)["x"].full()).ravel()
    nuisances, at = [], count
    for nuisance in start.nuisances:
        state, level = nuisance.x0, nuisance.offset
        if settings.free_start:
            state, at = answer[at : at + n], at + n
        if settings.offsets:
            level, at = answer[at : at + p], at + p
        nuisances.append(Nuisance(x0=state, offset=level))
    system = from_full_vector(base + directions @ answer[:count], point.system.sizes)
    return replace(point, system=system), tuple(nuisances), int(solver.stats()["iter_count"])


def _unit(information: FloatArray) -> FloatArray:
    """S with S' H S = I on the range of H and ones of its scale elsewhere."""
    scale = np.sqrt(
        np.maximum(np.diag(information), 1e-14 * max(float(np.diag(information).max()), 1e-300))
    )
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    return np.asarray(vectors / np.sqrt(np.maximum(values, 1e-6 * values[-1])) / scale[:, None])


def _innovations(point: Free, record: Record, vector: Expr, x0: Expr, offset: Expr) -> Expr:
    """Innovations (p, N) as an expression of the full vector, the initial state and the output
    offset."""
    n, m, p = point.system.sizes
    width = n + m + p
    v, x, z = ca.SX.sym("v", vector.shape[0]), ca.SX.sym("x", n), ca.SX.sym("z", m + p)
    shift = ca.SX.sym("offset", p)
    fg = ca.reshape(v[: n * width], width, n).T
    c = ca.reshape(v[n * width : n * width + p * n], n, p).T
    level = z[m:] - shift
    e = level - c @ x
    if m:
        e = e - ca.reshape(v[n * width + p * n :], m, p).T @ z[:m]
    step = ca.Function("step", [x, z, v, shift], [fg @ ca.vertcat(x, z[:m], level), e])
    data = ca.DM(np.hstack([record.u, record.y]).T)
    count = len(record)
    return step.mapaccum("predictor", count)(
        x0, data, ca.repmat(vector, 1, count), ca.repmat(offset, 1, count)
    )[1]
