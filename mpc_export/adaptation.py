"""adapt_step: the identified filter that learns the flight's own parameters, and on request the
learned weights, in flight.

    psi = -de/d(theta, x),   Z = S + psi V psi',   d = V psi' Z^-1 e,   V+ = V - V psi' Z^-1 psi V     the innovation's word
    theta+ = bounded(theta + d_theta),   x~ = x boxplus d_x,   c = K (e - psi d)
    x_next = f_d(x~, u, theta+) boxplus c
    F = [[k, 0], [M P, M A] - N K psi],   V_next = F V+ F' + (1 - k^2) V_0 for theta,   k = exp(-dt / memory)

M and N are the slopes of the error of x boxplus c in the error of x and in c: 1 but for rotations.
psi is the slope at the innovation as it is: C and H, its slopes at e = 0, bias parameters that a
flight hardly tells apart.

V (n_a, n_a) is the joint covariance of theta and of the error of the state beyond that of the
settled filter, whose gain K and innovation covariance S are constants. For a linear model this is
the Kalman filter of state and parameters together, written for what exceeds the settled covariance.
For constant theta it is the recursive form of the batch estimate in innovation form (Ljung 1999,
System Identification, section 11.4).

The start of the flight is not known as well as a settled filter knows its state: V begins with what
is missing there.

Forgetting: theta is a Gauss-Markov process whose stationary mean and spread are those of the
training flights. After `memory` seconds without information theta is back at 1/e of its distance
from the mean; its variance never exceeds that from flight to flight, however long nothing is
learned. What theta becomes has not been felt by the state yet, which is why the covariance of both
is carried, not a sensitivity. memory = 0: theta is constant, as in the fit. The discrepancy is a
state of the model (disturbance.*): it forgets by its own identified time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
import scipy.linalg

from greybox.errors import ModelError
from greybox.estimation.gain import linearisation_anywhere
from greybox.estimation.settling import kept_up
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.noise import lasting_errors
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.posterior import GPPosterior
from greybox.symbolic import Expr, FloatArray, Layout
from mpc_export.dense import cholesky

if TYPE_CHECKING:
    from greybox.model.linear import LinearModel
    from mpc_export.predictors import PredictorModel

UNBOUNDED = 1e30
STEADY = 50
"""Samples of a steady flight that a start is read off."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Adapted:
    """What adapt_step adapts: `names` (n_a), first those of theta with their places `rows` (n_t) in
    p, then error.* of the model's own states; the `mean` (n_t) of theta over the training flights,
    the `covariance` (n_a, n_a) before the flight (between flights; of learned weights their
    posterior's; of the start beyond that of the filter), and bounds (n_t,).

    `limits` maps states that are bounded too, to their largest size.
    """

    names: tuple[str, ...] = ()
    rows: tuple[int, ...] = ()
    mean: FloatArray
    covariance: FloatArray
    lower: FloatArray
    upper: FloatArray
    limits: Mapping[str, float]


NOTHING = Adapted(
    mean=np.zeros(0), covariance=np.zeros((0, 0)), lower=np.zeros(0), upper=np.zeros(0), limits={}
)


def flight_parameters(model: IdentifiedModel | LinearModel | PredictorModel) -> tuple[str, ...]:
    """The parameters whose values differ from flight to flight. Raises `ModelError` for another
    kind of model."""
    if not isinstance(model, IdentifiedModel):
        raise ModelError(
            "adapt needs the physics model of a fit, or a hybrid on it",
            got=model.name,
            fix="leave adapt out of --with",
        )
    own = {d.name for d in model.dynamics.parameters}
    return tuple(
        n for n, (_, s) in model.flight_spread.items() if n in own and s > 0 and math.isfinite(s)
    )


def with_flight_spread(model: IdentifiedModel, spread: Mapping[str, float]) -> IdentifiedModel:
    """The model with these standard deviations of parameters (name -> in its unit) from flight to
    flight, beside its own. Raises `ModelError`."""
    for name, sigma in spread.items():
        if name not in model.values:
            raise ModelError(
                f"adapt: the model has no parameter {name}",
                expected=", ".join(sorted(model.values)),
            )
        if not (math.isfinite(sigma) and sigma > 0):
            raise ModelError(
                f"adapt: {name} needs a standard deviation above zero", got=f"{sigma:g}"
            )
    # what they are off by is learned with them, and no error of the others any more
    covariance, names = model.covariance.copy(), model.covariance_names
    for name in spread:
        sigma, by = model.considered.get(name, (0.0, {}))
        moves = np.array([by.get(n, 0.0) for n in names])
        covariance -= sigma**2 * np.outer(moves, moves)
    return replace(
        model,
        covariance=covariance,
        flight_spread={
            **model.flight_spread,
            **{n: (model.values[n], s) for n, s in spread.items()},
        },
        considered={n: v for n, v in model.considered.items() if n not in spread},
    )


def adapted(
    model: IdentifiedModel,
    p: Layout,
    values: FloatArray,
    weights: GPPosterior | FeaturePosterior | None,
    error_states: Layout,
    filtered: FloatArray,
) -> Adapted:
    """All of p that is adapted: per-flight parameters, and the `weights` of the learned outputs
    where they are in p.

    `values` (n_p,) are the identified ones, `error_states` (n_own) the model's own: the history of
    commands is known. `filtered` (n_d, n_d) is the covariance of the settled filter, theirs first.
    Raises `ModelError` where nothing is adapted.
    """
    names = list(flight_parameters(model))
    declared = {d.name: d for d in model.dynamics.parameters}
    covariance = [np.array([[model.flight_spread[n][1] ** 2]]) for n in names]
    low, high = [], []
    for d in (declared[n] for n in names):
        far = d.possible if d.null is not None else math.inf
        null = d.null or 0.0
        low.append(max(d.lower, null - far, -UNBOUNDED))
        high.append(min(d.upper, null + far, UNBOUNDED))
    if weights is not None:
        for j, output in enumerate(weights.outputs.names):
            if weights.active[j]:
                names += [n for n in p.names if n.startswith(f"gp.weights.{output}.")]
                covariance.append(weight_covariance(weights, j))
    if not names:
        raise ModelError(
            "adapt: no parameter of this model differs between its training flights",
            expected="per-flight parameters (`greybox fit --per-flight`, several flights) or "
            "--runtime gp.weights",
            fix="leave adapt out of --with: filter_step follows the disturbance states without it",
        )
    extra = len(names) - len(low)
    rows = tuple(p[n] for n in names)
    names += [f"error.{n.removeprefix('d_')}" for n in error_states.names]
    unknown = start_excess(model, np.diag(filtered))
    return Adapted(
        names=tuple(names),
        rows=rows,
        mean=values[list(rows)],
        covariance=scipy.linalg.block_diag(*covariance, np.diag(unknown)),
        lower=np.array([*low, *[-UNBOUNDED] * extra]),
        upper=np.array([*high, *[UNBOUNDED] * extra]),
        limits=authority(model),
    )


def starting_as(own: Adapted, model: IdentifiedModel, filtered: FloatArray) -> Adapted:
    """`own` with the start of `model`, whose disturbances may decay where those of the filter of
    covariance `filtered` (n_d, n_d) do not: a walk has no stationary state to start in."""
    excess, covariance = start_excess(model, np.diag(filtered)), own.covariance.copy()
    at = len(own.rows) + np.arange(len(excess))
    covariance[at, at] = excess
    return replace(own, covariance=covariance)


def start_excess(model: IdentifiedModel, filtered: FloatArray) -> FloatArray:
    """Variance (n_own,) of a start that is read off its first measurements, lasting noise in its
    stationary state, beyond that of the settled filter (n_d,)."""
    d = model.dynamics
    u = np.repeat(model.reference_inputs[:, None], sum(d.window) + 1, axis=1)
    p, w = ca.DM(model.parameter_vector()), ca.DM.zeros(len(d.noises))
    y = np.array(
        ca.DM(d.output(0, ca.DM(model.reference_state), ca.DM(u), p, w, model.sample_time))
    )
    columns = dict(
        zip((*d.outputs.names, *d.inputs.names), (*y.ravel(), *model.reference_inputs), strict=True)
    )
    samples = {n: np.full(STEADY, v) for n, v in columns.items()} | {
        "t": model.sample_time * np.arange(STEADY)
    }
    square = d.initial_state(samples)[1] ** 2
    lasting = np.flatnonzero(lasting_errors(d))
    values = linearisation_anywhere(d).values(
        model.reference_state, u, model.parameter_vector(), model.sample_time
    )
    square[lasting] = kept_up(values, model.process_noise**2, lasting)
    return np.asarray(np.maximum(square - filtered[: len(square)], 0.0))


def weight_covariance(posterior: GPPosterior | FeaturePosterior, output: int) -> FloatArray:
    """Covariance (M, M) of the weights of one output, in the standardised units in which they are
    stored."""
    if isinstance(posterior, FeaturePosterior):
        return np.asarray(posterior.root[output].T @ posterior.root[output])
    # Between the support points the prior's conditional variance is nobody's to learn; at them it
    # is L2' L2, and for an exact process, whose L1 takes more than the prior away, the difference.
    z, first, second = posterior.support.T, posterior.explained[output], posterior.uncertain[output]
    at = posterior.kernels[output].covariance(z, z)
    values = at - at @ first.T @ first @ at + at @ second.T @ second @ at
    inverse = np.linalg.pinv(at, hermitian=True, rcond=1e-10)
    found = inverse @ values @ inverse * posterior.variance_factor[output]
    return np.asarray(0.5 * (found + found.T))


def authority(model: IdentifiedModel) -> dict[str, float]:
    """State -> largest size of a disturbance: of a force [N] all thrust, of a torque [N m] about
    the centre of mass the most that rotors make about that axis, each somewhere in the range of its
    command.
    """
    physics = physics_of(model.dynamics)
    if physics is None:
        return {}
    vehicle, values = physics.vehicle, model.values
    ends = (vehicle.actuator.u_min, vehicle.actuator.u_max)
    thrust, torque = (
        np.array([sum(values[f"{kind}.c{k}"] * u**k for k in range(3)) for u in ends])
        for kind in ("thrust", "torque")
    )
    center = [values[f"center_of_mass.{a}"] for a in "xyz"]
    arms = np.array([r.position for r in vehicle.rotors], dtype=float) - center
    most = {f"force.{a}": len(arms) * thrust.max() for a in "xyz"}
    for axis, levers, each in (
        ("x", arms[:, 1], thrust),
        ("y", -arms[:, 0], thrust),
        ("z", [-r.spin for r in vehicle.rotors], torque),
    ):
        either = np.outer(levers, each)
        most[f"torque.{axis}"] = max(either.max(axis=1).sum(), -either.min(axis=1).sum())
    return {f"disturbance.{n}": float(v) for n, v in most.items() if v > 0}


def adapt_function(
    functions: Mapping[str, ca.Function],
    formed: tuple[ca.Function, ca.Function],
    own: Adapted,
    states: Layout,
    dt: float,
) -> ca.Function:
    """adapt_step(x, u, p, y, there, V, memory) -> x_next, p_next, V_next, e, y_hat.

    `formed` map (y, y_hat, x) to e, and (there, y) to which of e count. `p_next` differs from p in what is adapted.
    """
    innovation, counted = formed
    n_a, n_t = len(own.names), len(own.rows)
    n_own, plus = n_a - n_t, _moved(functions["boxplus"], n_a - n_t)
    n_y, n_e = innovation.numel_in(0), innovation.numel_out(0)
    x, u, p = (ca.MX.sym(n, functions["f_d"].numel_in(n)) for n in ("x", "u", "p"))
    y, there, memory = ca.MX.sym("y", n_y), ca.MX.sym("there", n_e), ca.MX.sym("memory")
    v = ca.MX.sym("V", n_a, n_a)
    rows = list(own.rows)
    seen, by_x, _, by_p = functions["h_jac_raw"](x, u, p)
    on = counted(there, y)
    gain, spread = functions["innovation_gain"](on)
    gain = gain[:n_own, :]  # the history of commands is known
    found = innovation(y, seen, x)
    e = ca.if_else(on != 0, found, 0.0)
    slopes = _slopes(innovation, plus, n_t)(y, seen, x, by_x, by_p[:, rows])
    psi = ca.if_else(ca.repmat(on != 0, 1, n_a), slopes, 0.0)
    through = psi @ v
    scaled = _whitened(n_e, n_a)(spread + through @ psi.T, ca.horzcat(through, e))
    across, left = scaled[:, :n_a], scaled[:, n_a]
    left_over = v - across.T @ across
    said = _given_the_bounds(across.T @ left, left_over, p, own)
    theta = _between(p[rows] + said[:n_t], own.lower, own.upper)
    moved = ca.vertcat(theta - p[rows], said[n_t:])
    # After the measurement, before time goes on.
    at = plus(x, said[n_t:])
    q = ca.MX(p)
    q[rows] = theta
    after, a, _, by = functions["f_d_jac"](at, u, q)
    pushed = gain @ (e - psi @ moved)
    turned, by_push = _slopes_of_moved(plus, functions["boxminus"])(after, pushed)
    after = plus(after, pushed)
    keep = ca.if_else(memory > 0, ca.exp(-dt / ca.fmax(memory, 1e-12)), 1.0)
    q[rows] = own.mean + keep * (theta - own.mean)
    on_step = ca.vertcat(
        keep * ca.MX(ca.DM(np.eye(n_t, n_a))),
        turned @ ca.horzcat(by[:n_own, rows], a[:n_own, :n_own]) - by_push @ gain @ psi,
    )
    v_next = on_step @ left_over @ on_step.T
    v_next[:n_t, :n_t] += (1 - keep**2) * ca.DM(own.covariance[:n_t, :n_t])
    # Rounding must not grow into two covariances of the same pair.
    results = [limited(after, own.limits, states), q, 0.5 * (v_next + v_next.T), found, seen]
    return ca.Function(
        "adapt_step",
        [x, u, p, y, there, v, memory],
        [ca.densify(r) for r in results],
        ["x", "u", "p", "y", "there", "V", "memory"],
        ["x_next", "p_next", "V_next", "e", "y_hat"],
    )


def _given_the_bounds(said: Expr, covariance: Expr, p: Expr, own: Adapted) -> Expr:
    """What a measurement `said` (n_a,) of parameters and state, with parameters inside their bounds;
    `covariance` (n_a, n_a) is that after it. What a bound takes from one parameter, the others are
    told: their mean, given the bound."""
    for i in np.flatnonzero((own.lower > -UNBOUNDED) | (own.upper < UNBOUNDED)).tolist():
        there_is = p[own.rows[i]] + said[i]
        short = _between(there_is, own.lower[i : i + 1], own.upper[i : i + 1]) - there_is
        said += covariance[:, i] * (short / ca.fmax(covariance[i, i], 1 / UNBOUNDED))
    return said


def _moved(boxplus: ca.Function, n_own: int) -> ca.Function:
    """(x, d (n_own,)) -> x moved by errors of the model's own states, the first ones."""
    x, d = ca.MX.sym("x", boxplus.numel_in(0)), ca.MX.sym("d", n_own)
    whole = ca.vertcat(d, ca.DM.zeros(boxplus.numel_in(1) - n_own))
    return ca.Function("moved", [x, d], [boxplus(x, whole)])


def _slopes(innovation: ca.Function, plus: ca.Function, n_t: int) -> ca.Function:
    """(y, y_hat, x, dy_hat/dx raw, dy_hat/dtheta) -> psi (n_e, n_a), how the innovation falls
    with theta and the error of the state. It is not that at y = y_hat: a rotation that is some way
    off turns the slopes."""
    n_y, n_x, n_own = innovation.numel_in(0), plus.numel_in(0), plus.numel_in(1)
    y, seen, x, d = (
        ca.MX.sym(n, k) for n, k in (("y", n_y), ("y_hat", n_y), ("x", n_x), ("d", n_own))
    )
    by_x, by_theta = ca.MX.sym("by_x", n_y, n_x), ca.MX.sym("by_theta", n_y, n_t)
    chart = ca.substitute(ca.jacobian(plus(x, d), d), d, ca.DM.zeros(n_own))
    e = innovation(y, seen, x)
    by_seen, direct = ca.jacobian(e, seen), ca.jacobian(e, x)
    psi = -ca.horzcat(by_seen @ by_theta, (by_seen @ by_x + direct) @ chart)
    return ca.Function("slopes", [y, seen, x, by_x, by_theta], [ca.densify(psi)])


def _slopes_of_moved(plus: ca.Function, minus: ca.Function) -> ca.Function:
    """(x, d) -> slopes (n_own, n_own) of the error of x moved by d in the error of x, and in d."""
    n_own = plus.numel_in(1)
    x = ca.MX.sym("x", plus.numel_in(0))
    own, d, small = (ca.MX.sym(n, n_own) for n in ("own", "d", "small"))
    apart = minus(plus(plus(x, own), d + small), plus(x, d))[:n_own]
    none = [ca.DM.zeros(n_own)] * 2
    found = ca.substitute([ca.jacobian(apart, own), ca.jacobian(apart, small)], [own, small], none)
    return ca.Function("slopes_of_moved", [x, d], [ca.densify(v) for v in found])


def _whitened(n: int, m: int) -> ca.Function:
    """(Z (n, n), B (n, m + 1)) -> L^-1 B with L L' = Z."""
    z, b = ca.SX.sym("Z", n, n), ca.SX.sym("B", n, m + 1)
    low = cholesky(z)
    out: list[Expr] = []
    for i in range(n):
        rest = b[i, :]
        for k in range(i):
            rest = rest - low[i][k] * out[k]
        out.append(rest / low[i][i])
    return ca.Function("whitened", [z, b], [ca.densify(ca.vertcat(*out))])


def _between(value: Expr, lower: FloatArray, upper: FloatArray) -> Expr:
    """value, at most `upper` and at least `lower`; what is not a number stays so."""
    return ca.if_else(value < lower, lower, ca.if_else(value > upper, upper, value))


def limited(x: Expr, limits: Mapping[str, float], states: Layout) -> Expr:
    """x with its disturbances inside what the rotors could hold against, `limits` (authority)."""
    out = ca.MX(x)
    for row, most in ((states[n], m) for n, m in limits.items() if n in states.names):
        out[row] = _between(x[row], np.array(-most), np.array(most))
    return out
