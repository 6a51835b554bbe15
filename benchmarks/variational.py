"""Runge-Kutta 4 together with its Jacobians, from the stages' own: every stage evaluates f and its
slopes once.

With J_i = [df/dx, df/du] at stage i and W_i = dk_i/d(x, u) the chain rule runs beside the
integrator,

    W_1 = J_1,   W_2 = J_2 + h/2 F_2 W_1,   W_3 = J_3 + h/2 F_3 W_2,   W_4 = J_4 + h F_4 W_3   (F_i = df/dx at stage i)
    [A, B] = [I, 0] + h/6 (W_1 + 2 W_2 + 2 W_3 + W_4),

which is the exact derivative of the numerical integrator (Hairer, Norsett, Wanner, Solving Ordinary
Differential Equations I, II.6; the variational equation integrated by the same method). A learned
part costs one call of mean and Jacobian per stage: `derivative` hands its result to the physics, so
that nothing is differentiated through the Gaussian process.

This is the integrator of controllers that take dx/dt. The identified model steps differently:
rotors exactly, the learned push evaluated at the sample and held (`HybridModel.step`); its
Jacobians are `f_d_jac` of `mpc_export.functions`.
"""

from __future__ import annotations

import casadi as ca

from greybox.errors import ModelError
from greybox.model.dynamics import Dynamics
from greybox.residual.hybrid import HybridModel
from greybox.symbolic import Expr


def derivative(
    dynamics: Dynamics, *, name: str = "f_slope", learned: ca.Function | None = None
) -> ca.Function:
    """CasADi function (x, u, p) -> dx (n_x), J (n_x, n_x + n_u), the derivative f and its slopes in
    x and u, all dense.

    p is the model's whole parameter vector. For a `HybridModel` (not inside disturbance states)
    `learned` is the function z -> (mean, mean Jacobian) that is called, by default the posterior's
    own, named "gp_mean_jac" so that `c_kernels.GPKernel` can stand for it. Raw coordinates: a
    quaternion counts four.
    """
    x, u = ca.SX.sym("x", len(dynamics.states)), ca.SX.sym("u", len(dynamics.inputs))
    p = ca.SX.sym("p", len(dynamics.parameters))
    both = ca.vertcat(x, u)
    names = (["x", "u", "p"], ["dx", "J"])
    if not isinstance(dynamics, HybridModel):
        dx = dynamics.f(0, x, u, p)
        parts = ca.cse([ca.densify(dx), ca.densify(ca.jacobian(dx, both))])
        return ca.Function(name, [x, u, p], parts, *names)
    posterior = dynamics.posterior
    if learned is None:
        learned = posterior.function("gp_mean_jac", ("mean", "mean_jacobian"))
    past, future = dynamics.window
    z = dynamics.learned_inputs(x, ca.repmat(u, 1, past + 1 + future))
    push, slope = (
        ca.SX.sym("g", len(posterior.outputs)),
        ca.SX.sym("G", len(posterior.outputs), z.numel()),
    )
    w = ca.SX.sym("w", len(dynamics.inner.noises))
    rows = list(dynamics.learned_rows)
    spread = ca.DM.zeros(w.numel(), len(rows))
    for j, i in enumerate(rows):
        spread[i, j] = 1.0
    dx = dynamics.inner.f(0, x, u, p, w)
    jacobian = ca.jacobian(dx, both) + (ca.jacobian(dx, w) @ ca.sparsify(spread)) @ (
        slope @ ca.jacobian(z, both)
    )
    closed = ca.substitute([dx, jacobian], [w], [ca.densify(ca.sparsify(spread) @ push)])
    features = ca.Function(f"{name}_features", [x, u], [ca.densify(z)])
    physics = ca.Function(
        f"{name}_physics",
        [x, u, p, push, slope],
        ca.cse([ca.densify(v) for v in closed]),
        {"never_inline": True},
    )
    mx, mu, mp = ca.MX.sym("x", x.numel()), ca.MX.sym("u", u.numel()), ca.MX.sym("p", p.numel())
    mean, mean_slope = learned(features(mx, mu))
    return ca.Function(name, [mx, mu, mp], list(physics(mx, mu, mp, mean, mean_slope)), *names)


def rk4(slope: ca.Function, dt: float, *, name: str = "rk4", substeps: int = 1) -> ca.Function:
    """CasADi function (x, u, p) -> x_next (n_x), A (n_x, n_x), B (n_x, n_u) of Runge-Kutta 4 over
    dt [s] with u held.

    `slope` is a function as `derivative` makes it. Raises `ModelError` where its sizes do not fit.
    """
    n, m = slope.numel_in(0), slope.numel_in(1)
    if slope.n_out() != 2 or slope.size_out(0) != (n, 1) or slope.size_out(1) != (n, n + m):
        raise ModelError(
            f"{slope.name()} does not return dx and J",
            expected=f"sizes ({n}, 1) and ({n}, {n + m})",
        )
    x, u, p = (ca.MX.sym(k, slope.numel_in(i)) for i, k in enumerate("xup"))
    h = dt / substeps
    after: Expr = x
    total: Expr = ca.horzcat(ca.DM.eye(n), ca.DM.zeros(n, m))
    for step in range(substeps):
        k1, w1 = slope(after, u, p)
        k2, j2 = slope(after + h / 2 * k1, u, p)
        w2 = j2 + h / 2 * (j2[:, :n] @ w1)
        k3, j3 = slope(after + h / 2 * k2, u, p)
        w3 = j3 + h / 2 * (j3[:, :n] @ w2)
        k4, j4 = slope(after + h * k3, u, p)
        w4 = j4 + h * (j4[:, :n] @ w3)
        after = after + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        moved = h / 6 * (w1 + 2 * (w2 + w3) + w4)
        if step == 0:
            total = total + moved
        else:
            total = total + moved[:, :n] @ total + ca.horzcat(ca.MX(n, n), moved[:, n:])
    results: list[Expr] = [after, total[:, :n], total[:, n:]]
    return ca.Function(
        name, [x, u, p], [ca.densify(v) for v in results], ["x", "u", "p"], ["x_next", "A", "B"]
    )
