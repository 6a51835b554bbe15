"""model_functions: everything that a controller asks of a model, as named CasADi functions of (x, u, p).

| function | arguments -> results |
|---|---|
| f | x u p -> dx; continuous, of the model's own states, without delay (not for discrete models) |
| f_jac_raw | x u p -> dx, dx_x, dx_u, dx_p in raw coordinates |
| f_d | x u p -> x_next; one sample, command held, the identified integrator: the authoritative model |
| f_d_jac | x u p -> x_next, A (n_d, n_d), B (n_d, n_u), P (n_d, n_p) in error coordinates |
| f_d_jac_raw | x u p -> x_next, A_raw (n_x, n_x), B_raw (n_x, n_u), P_raw (n_x, n_p) |
| h | x u p -> y |
| h_jac | x u p -> y, C (n_e, n_d), D (n_e, n_u), H (n_e, n_p): of y - y_hat as the filter forms it, error coordinates |
| h_jac_raw | x u p -> y, C_raw (n_y, n_x), D_raw (n_y, n_u), H_raw (n_y, n_p) |
| boxplus, boxminus | x d -> x_moved; x2 x1 -> d: the chart between raw and error coordinates |
| out_of_domain | x u p -> number, box, distance; 0 inside the training domain |
| gp_features | x u p -> z, z_x (n_z, n_d), z_u, z_p; gp_features_raw the same with z_x in raw coordinates |
| gp_mean, gp_mean_jac, gp_variance, gp_all, gp_distance | z p -> the learned push, its variance, their Jacobians in z |
| network_mean, network_mean_jac, network_features, ... | the same of an LSTM, whose variance is that of the innovation |
| B_d, B_d_raw | x u p -> derivative of x_next in the learned push, (n_d or n_x, n_g) |
| covariance_step, covariance_feedback | x u p S [K] -> S_next = A S A' + B_d Var B_d' + Q; A + B K for A with u = K d |
| consider_step | x u p K S c b -> S_next, c_next, b_next, total: learned and parameter errors constant over the horizon |
| P_theta | x u p -> derivative of x_next in the uncertain parameters (n_d, n_theta); with "covariance" |
| filter_step | x u p y there -> x_next, e, y_hat: one step of the identified filter |
| innovation_gain | there -> K, S |
| adapt_step | x u p y there V memory -> x_next, p_next, V_next, e, y_hat: the filter that adapts (adaptation.py) |
| forecast_step | x x_next u p y there F clock -> F_next, clock_next, E, seen: errors of forecasts (calibration.py) |
| calibrate_step | theta E seen sigma level gain -> theta_next, scale: by how much wider they are than sigma says |
| output_covariance, output_consider | x u p S [c] -> Y: of the next measurement (innovation form); with "covariance" |
| target_step | x u p r -> x_next, u_next, residual: Newton step to the steady state that holds r (target.py) |
| f_d_nominal, f_d_nominal_jac_raw | as f_d and f_d_jac_raw, without the learned part: physics alone |
| lagrangian_hessian | x u p lam -> H (n_x + n_u square): of lam' f_d in raw coordinates |

Groups "covariance", "filter", "target", "hessian", "nominal", "adapt", "calibrate" come on request. All results are
dense, column by column. x holds the model's own states and then the command history (sampled.py); p the battery voltage
where the model has one, the parameters asked for, and, with "gp.weights", the weights of the learned part. Physics is SX
inside; a learned part is MX (one `exp` over the support points, analytic Jacobians).

This file is long because the functions of one model are one thing: they share their parts and their order.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.engine import unfelt_place
from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import LongerWindow, learned_push_of, physics_of
from greybox.model.linear import LinearModel
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.features import lag_of, reach
from greybox.residual.hybrid import HybridModel
from greybox.residual.posterior import GPPosterior
from greybox.symbolic import Expr, FloatArray, Layout, Signal
from mpc_export.adaptation import NOTHING, Adapted, adapt_function, adapted, flight_parameters
from mpc_export.calibration import (
    UNCALIBRATED,
    Calibration,
    Stated,
    calibrate_function,
    calibration,
    forecast_function,
)
from mpc_export.dense import cholesky, cholesky_solve
from mpc_export.innovation_form import SampledForm
from mpc_export.noise import Noise, identified_noise, innovation_noise, parameter_covariance
from mpc_export.predictors import Fitted, Learned, NetworkPart, PredictorModel, predictor_model
from mpc_export.sampled import Sampled, at_sample_time, is_discrete
from mpc_export.target import target_function, tracked

GROUPS = ("covariance", "filter", "target", "hessian", "nominal", "adapt", "calibrate")
WEIGHTS = "gp.weights"
EULER = ("phi", "theta", "psi")
NOWHERE = 1e30
"""Out-of-domain number of arguments that are NaN or absurd."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelFunctions:
    """Named functions of one model and the numbers that belong to them. `functions[name]` or `self[name]`.

    Layouts give order, names and units. `parameter_values` (n_p,) are the identified values of p, `reference` = (x, u)
    the point of the stationary gain. `delay` maps a delayed input to its history length. `covariance_names` and
    `covariance` are the uncertain parameters of `consider_step`. `targets` names what `target_step` holds, `adapted` what
    `adapt_step` adapts, `calibration` holds the horizons of `calibrate_step`.
    """

    name: str
    dt: float
    identified_dt: float
    functions: Mapping[str, Any]
    states: Layout
    error_states: Layout
    inputs: Layout
    parameters: Layout
    outputs: Layout
    innovations: Layout
    features: Layout
    learned: Layout
    own_states: int
    own_error_states: int
    parameter_values: FloatArray
    reference: tuple[FloatArray, FloatArray]
    noise: Noise
    covariance_names: tuple[str, ...]
    covariance: FloatArray
    bounds: tuple[FloatArray, FloatArray]
    scales: tuple[FloatArray, FloatArray, FloatArray]
    delay: Mapping[str, int]
    targets: Layout
    adapted: Adapted
    calibration: Calibration
    discrete: bool
    posterior: Learned | None
    model: IdentifiedModel | LinearModel | PredictorModel
    sampled: Sampled

    def __getitem__(self, name: str) -> Any:
        try:
            return self.functions[name]
        except KeyError:
            raise UnknownNameError("function", name, self.functions) from None

    @property
    def sizes(self) -> dict[str, int]:
        """n_x, n_d, n_u, n_p, n_y, n_e, n_z (features), n_g (learned outputs), n_r (targets), n_theta, n_a (adapted), n_h
        (horizons), n_l (columns of calibrate_step's theta)."""
        return {
            "n_x": len(self.states),
            "n_d": len(self.error_states),
            "n_u": len(self.inputs),
            "n_p": len(self.parameters),
            "n_y": len(self.outputs),
            "n_e": len(self.innovations),
            "n_z": len(self.features),
            "n_g": len(self.learned),
            "n_r": len(self.targets),
            "n_theta": len(self.covariance_names),
            "n_a": len(self.adapted.names),
            "n_h": len(self.calibration.multiples),
            "n_l": self.calibration.remembered,
        }


def model_functions(
    model: Fitted | PredictorModel,
    *,
    dt: float | None = None,
    with_: Iterable[str] = (),
    runtime_parameters: Iterable[str] = (),
) -> ModelFunctions:
    """The functions of anything fitted (mpc_export/predictors.py says of what kinds).

    `dt` [s] is the sample time (None: the one that it was identified at).

    `with_` adds groups of `GROUPS`. `runtime_parameters` are model parameters that stay in p, by name, and "gp.weights".
    Raises `UnknownNameError`, and `ModelError` for a discrete model at another sample time, a learned part inside
    another one, or one that looks at Euler angles.
    """
    groups = set(with_)
    for name in sorted(groups - set(GROUPS)):
        raise UnknownNameError("group of functions", name, GROUPS)
    return _Builder(model, dt, groups, tuple(dict.fromkeys(runtime_parameters))).build()


class _Builder:
    """Builds the functions of one model; every part is built once."""

    def __init__(
        self, model: Any, dt: float | None, groups: set[str], runtime: tuple[str, ...]
    ) -> None:
        if not isinstance(model, (IdentifiedModel, LinearModel, PredictorModel)):
            model = predictor_model(model, dt=dt)
        if "calibrate" in groups:
            groups = groups | {"filter", "covariance"}
        if "adapt" in groups:
            groups = groups | {"filter"}
            runtime = tuple(dict.fromkeys((*runtime, *flight_parameters(model))))
        self.model, self.groups = model, groups
        dynamics: Dynamics = _dynamics(model)
        self.own_dt = float(model.sample_time if isinstance(model, IdentifiedModel) else model.dt)
        self.dt = self.own_dt if dt is None else float(dt)
        if not (self.dt > 0 and math.isfinite(self.dt)):
            raise ModelError("the sample time must be positive", got=f"{self.dt:g} s")
        self.discrete = isinstance(model, PredictorModel) or is_discrete(dynamics)
        same = math.isclose(self.dt, self.own_dt, rel_tol=1e-9)
        if self.discrete and not same:
            raise ModelError(
                f"{dynamics.name} is a discrete model",
                expected=f"dt = {self.own_dt:g} s",
                got=f"{self.dt:g} s",
            )
        if not same:
            dynamics = at_sample_time(dynamics, self.dt)
        self.posterior: Learned | None = None
        self.looks_back: dict[str, int] = {}
        if isinstance(model, PredictorModel):
            self.posterior = model.learned
        elif isinstance(dynamics, HybridModel):
            self.posterior, dynamics = dynamics.posterior, dynamics.inner
            self.looks_back = {
                of: lag for of, lag in sorted(map(lag_of, self.posterior.inputs.names)) if lag
            }
            if self.looks_back and not same:
                raise ModelError(
                    "the learned part looks at earlier commands, sample by sample",
                    expected=f"dt = {self.own_dt:g} s, at which it was learned",
                    got=f"{self.dt:g} s",
                )
            if self.looks_back:
                dynamics = LongerWindow(inner=dynamics, past=reach(self.posterior.inputs.names))
        if learned_push_of(dynamics) is not None:
            raise ModelError(
                "a learned part inside another one cannot be exported", got=dynamics.name
            )
        euler = (
            ()
            if self.posterior is None
            else tuple(n for n in self.posterior.inputs.names if n in EULER)
        )
        if euler and not isinstance(model, PredictorModel):
            raise ModelError(
                f"the learned part looks at Euler angles ({', '.join(euler)})",
                fix="learn it on gravity.x, gravity.y, gravity.z: they have no singularity",
            )
        self.weights = WEIGHTS in runtime
        if self.weights and self.posterior is None:
            raise ModelError(f"no learned part, so no {WEIGHTS} to change at run time")
        if self.weights and not isinstance(self.posterior, (GPPosterior, FeaturePosterior)):
            raise ModelError(
                f"{WEIGHTS} cannot change at run time here",
                expected="a learned part of `greybox learn`",
            )
        self.theta_names, self.theta_covariance = parameter_covariance(model)
        # What an output hybrid did not learn keeps the prior's variance, as in its own predictions.
        self.silent = not isinstance(model, PredictorModel)
        self.prefix = "network" if isinstance(self.posterior, NetworkPart) else "gp"
        values = (
            dict(model.values)
            if isinstance(model, IdentifiedModel)
            else {d.name: d.nominal for d in dynamics.parameters}
        )
        self.sampled = (
            SampledForm(dynamics=model.form, dt=self.dt, values={}, runtime=runtime)
            if isinstance(model, PredictorModel)
            else Sampled(
                dynamics=dynamics,
                dt=self.dt,
                values=values,
                runtime=tuple(n for n in runtime if n != WEIGHTS),
                sensitive=self.theta_names,
                looks_back=self.looks_back,
            )
        )
        self.x, self.u, self.p, self.w = self.sampled.symbols()
        self.chart_in, _ = self.sampled.chart(self.x, self.x)
        self.spread = ca.DM(
            self.w.numel(), 0 if self.posterior is None else len(self.posterior.outputs)
        )
        if self.posterior is not None:
            for j, n in enumerate(self.posterior.outputs.names):
                self.spread[dynamics.noises[n], j] = 1.0
        self.functions: dict[str, Any] = {}

    # ------------------------------------------------------------------------------------------------ parts

    @cached_property
    def parameters(self) -> Layout:
        """p: exogenous inputs and run-time parameters, then the learned weights."""
        if self.posterior is None or not self.weights:
            return self.sampled.parameters
        names = [
            f"{WEIGHTS}.{o}.{i + 1}"
            for o in self.posterior.outputs.names
            for i in range(self.posterior.points)
        ]
        return self.sampled.parameters + Layout(
            [Signal(name=n, unit="-", meaning="weight, standardised") for n in names]
        )

    def _arguments(self, own: bool = False) -> tuple[Expr, Expr, Expr]:
        """MX symbols x (own states only, on request), u, p."""
        n = len(self.sampled.dynamics.states) if own else self.x.numel()
        return (
            ca.MX.sym("x", n),
            ca.MX.sym("u", self.u.numel()),
            ca.MX.sym("p", len(self.parameters)),
        )

    def _own_p(self, p: Expr) -> Expr:
        return p[: self.p.numel()]

    def _gp(self, what: str, which: tuple[str, ...]) -> Any:
        """A function of (z, p) with some of the learned part's quantities; a push that is off has no variance."""
        name = f"{self.prefix}_{what}"
        if name in self.functions:
            return self.functions[name]
        posterior = self.posterior
        assert posterior is not None
        z, p = ca.MX.sym("z", len(posterior.inputs)), ca.MX.sym("p", len(self.parameters))
        weights = (
            ca.reshape(p[self.p.numel() :], posterior.points, len(posterior.outputs))
            if self.weights
            else None
        )
        found = posterior.expressions(z, which, weights=weights)
        if self.silent and not all(posterior.active):
            on = np.array(posterior.active, dtype=float)
            if "variance" in found:
                found["variance"] = on * found["variance"]
            if "variance_jacobian" in found:
                found["variance_jacobian"] = (
                    np.outer(on, np.ones(len(posterior.inputs))) * found["variance_jacobian"]
                )
        made = ca.Function(
            name, [z, p], [ca.densify(found[n]) for n in which], ["z", "p"], list(which)
        )
        self.functions[name] = made
        return made

    def _mean(self) -> Any:
        return self._gp("mean", ("mean",))

    def _mean_jacobian(self) -> Any:
        return self._gp("mean_jac", ("mean", "mean_jacobian"))

    def _features(self, kind: str) -> Any:
        """(x, u, p) -> z, z_x, z_u, z_p; x in error ("error"), raw ("raw") or the model's own raw coordinates ("own")."""
        name = (
            self.prefix
            + {"error": "_features", "raw": "_features_raw", "own": "_features_own"}[kind]
        )
        if name in self.functions:
            return self.functions[name]
        assert self.posterior is not None
        s, x, into = self.sampled, self.x, self.chart_in
        z = s.features(self.posterior.inputs.names, x, self.u, self.p)
        if kind == "own":  # commands have been the same for long
            n, now = len(s.dynamics.states), s.current(self.u, self.p)
            x = x[:n]
            z = ca.substitute(z, self.x, ca.vertcat(x, *(now[i] for i, _ in s.history)))
        by_x = ca.jacobian(z, x)
        zeros = ca.SX(len(self.posterior.inputs), len(self.parameters) - self.p.numel())
        parts = [z, by_x @ into if kind == "error" else by_x, ca.jacobian(z, self.u)]
        parts.append(ca.horzcat(ca.jacobian(z, self.p), zeros))
        p = ca.SX.sym("p", len(self.parameters))
        values = [ca.densify(ca.substitute(v, self.p, p[: self.p.numel()])) for v in parts]
        made = ca.Function(
            name, [x, self.u, p], values, ["x", "u", "p"], ["z", "z_x", "z_u", "z_p"]
        )
        self.functions[name] = made
        return made

    def _push(self, x: Expr, u: Expr, p: Expr, kind: str) -> Expr:
        """w of the learned mean, as MX."""
        return self.spread @ self._mean()(self._features(kind)(x, u, p)[0], p)

    def _value(self, name: str, result: str, expression: Expr, *, own: bool = False) -> None:
        """Adds name(x, u, p) -> result from an expression of x, u, p, w, closed with the learned mean."""
        x = self.x[: len(self.sampled.dynamics.states)] if own else self.x
        if self.posterior is None:
            value = ca.densify(ca.substitute(expression, self.w, ca.DM.zeros(self.w.numel())))
            self.functions[name] = ca.Function(
                name, [x, self.u, self.p], [ca.cse(value)], ["x", "u", "p"], [result]
            )
            return
        physics = ca.Function(
            f"physics_{name}", [x, self.u, self.p, self.w], [ca.densify(ca.cse(expression))]
        )
        mx, mu, mp = self._arguments(own)
        value = physics(mx, mu, self._own_p(mp), self._push(mx, mu, mp, "own" if own else "raw"))
        self.functions[name] = ca.Function(name, [mx, mu, mp], [value], ["x", "u", "p"], [result])

    def _jacobians(
        self,
        name: str,
        results: tuple[str, str, str, str],
        value: Expr,
        slopes: tuple[Expr, ...],
        kind: str,
    ) -> None:
        """Adds name(x, u, p) -> value and its slopes in x, u, p; `slopes` are those of the physics in x, u, p and w."""
        x = self.x[: len(self.sampled.dynamics.states)] if kind == "own" else self.x
        parts = [
            ca.densify(value),
            *(ca.sparsify(v) for v in slopes[:3]),
            ca.sparsify(slopes[3] @ self.spread),
        ]
        if self.posterior is None:
            parts = ca.substitute(parts[:4], [self.w], [ca.DM.zeros(self.w.numel())])
            physics = ca.Function(f"physics_{name}", [x, self.u, self.p], ca.cse(parts))
        else:
            physics = ca.Function(f"physics_{name}", [x, self.u, self.p, self.w], ca.cse(parts))
        self._close(name, results, physics, kind)

    def _close(
        self,
        name: str,
        results: tuple[str, str, str, str],
        physics: Any,
        kind: str,
        turn: Any = None,
    ) -> None:
        """Adds name(x, u, p) from `physics`(x, u, p[, w]) -> value, slopes in x, u, p[, w]; `turn`(x, value, slopes) changes
        their coordinates.

        With a learned part: d/dx = physics_x + physics_w spread gp_jacobian features_x, and so on.
        """
        mx, mu, mp = self._arguments(kind == "own")
        if self.posterior is None:
            y, *slopes = physics(mx, mu, mp)
            if turn is not None:
                slopes = list(turn(mx, y, *slopes))
            values = [ca.densify(v) for v in (y, *slopes)]
        else:
            z, z_x, z_u, z_p = self._features(kind)(mx, mu, mp)
            mean, slope = self._mean_jacobian()(z, mp)
            y, *slopes = physics(mx, mu, self._own_p(mp), self.spread @ mean)
            if turn is not None:
                slopes = list(turn(mx, y, *slopes))
            y_x, y_u, y_p, y_g = slopes
            by_z = y_g @ slope
            y_p = (
                ca.horzcat(y_p, ca.MX(y_p.shape[0], len(self.parameters) - self.p.numel()))
                + by_z @ z_p
            )
            if self.weights:
                q = ca.MX.sym("q", len(self.parameters))
                fixed = ca.MX.sym("z", z.numel())
                by_weight = ca.Function(
                    "gp_mean_by_weight", [fixed, q], [ca.jacobian(self._mean()(fixed, q), q)]
                )
                y_p = y_p + y_g @ by_weight(z, mp)
            values = [ca.densify(v) for v in (y, y_x + by_z @ z_x, y_u + by_z @ z_u, y_p)]
        self.functions[name] = ca.Function(
            name, [mx, mu, mp], values, ["x", "u", "p"], list(results)
        )

    # ------------------------------------------------------------------------------------------------ families

    def _motion(self) -> None:
        s, x, u, p, w = self.sampled, self.x, self.u, self.p, self.w
        if not self.discrete:
            own = x[: len(s.dynamics.states)]
            dx = s.derivative(x, u, p, w)
            self._value("f", "dx", dx, own=True)
            slopes = tuple(ca.jacobian(dx, v) for v in (own, u, p, w))
            self._jacobians("f_jac_raw", ("dx", "dx_x", "dx_u", "dx_p"), dx, slopes, "own")
        after = s.step(x, u, p, w)
        self._value("f_d", "x_next", after)
        raw = [ca.jacobian(after, v) for v in (x, u, p, w)]
        names = ("x_next", "A_raw", "B_raw", "P_raw")
        learned = self.posterior is not None
        parts = [ca.densify(after), *(ca.sparsify(v) for v in raw[:3])]
        if learned:
            physics = ca.Function(
                "physics_f_d", [x, u, p, w], ca.cse([*parts, ca.sparsify(raw[3] @ self.spread)])
            )
        else:
            parts = ca.substitute(parts, [w], [ca.DM.zeros(w.numel())])
            physics = ca.Function("physics_f_d", [x, u, p], ca.cse(parts))
        self._close("f_d_jac_raw", names, physics, "raw")
        if learned and "nominal" in self.groups:
            self._nominal(physics)
        # The same physics serves both, so that the code holds it once.
        ends, coded = (
            ca.SX.sym("x_next", x.numel()),
            [ca.SX.sym("m", physics.sparsity_out(k + 1)) for k in range(3 + learned)],
        )
        into, out = s.chart(x, ends)
        turned = [out @ coded[0] @ into, *(out @ v for v in coded[1:])]
        turn = ca.Function(
            "to_error_coordinates", [x, ends, *coded], [ca.sparsify(v) for v in turned]
        )
        self._close("f_d_jac", ("x_next", "A", "B", "P"), physics, "error", turn)
        into, out = s.chart(x, after)
        error = tuple(out @ v for v in raw)
        self.through = {"B_d": error[3] @ self.spread, "B_d_raw": raw[3] @ self.spread}
        self.noise_input = error[3]

    def _nominal(self, physics: Any) -> None:
        """The step of the physics alone and its raw Jacobians; the weights of a learned part in p change nothing."""
        x, u, p = self._arguments()
        values = list(physics(x, u, self._own_p(p), ca.DM.zeros(self.w.numel())))[:4]
        values[3] = ca.horzcat(values[3], ca.MX(x.numel(), p.numel() - self.p.numel()))
        names = ["x_next", "A_raw", "B_raw", "P_raw"]
        for name, n in (("f_d_nominal", 1), ("f_d_nominal_jac_raw", 4)):
            results = [ca.densify(v) for v in values[:n]]
            self.functions[name] = ca.Function(name, [x, u, p], results, ["x", "u", "p"], names[:n])

    def _outputs(self) -> None:
        s, x, u, p, w = self.sampled, self.x, self.u, self.p, self.w
        y_hat = s.output(x, u, p, w)
        self._value("h", "y", y_hat)
        raw = tuple(ca.jacobian(y_hat, v) for v in (x, u, p, w))
        self._jacobians("h_jac_raw", ("y", "C_raw", "D_raw", "H_raw"), y_hat, raw, "raw")
        y = ca.SX.sym("y", y_hat.numel())
        e = s.innovation(y, y_hat, x)
        slopes = [-ca.jacobian(e, v) for v in (x, u, p, w)]
        slopes[0] = slopes[0] @ self.chart_in
        error = tuple(ca.substitute(slopes, [y], [y_hat]))
        self._jacobians("h_jac", ("y", "C", "D", "H"), y_hat, error, "error")
        self.noise_output = error[3]

    def _charts(self) -> None:
        s = self.sampled
        d, x2 = ca.SX.sym("d", len(s.error_states)), ca.SX.sym("x2", self.x.numel())
        moved, between = ca.densify(s.boxplus(self.x, d)), ca.densify(s.boxminus(x2, self.x))
        self.functions["boxplus"] = ca.Function(
            "boxplus", [self.x, d], [moved], ["x", "d"], ["x_moved"]
        )
        self.functions["boxminus"] = ca.Function(
            "boxminus", [x2, self.x], [between], ["x2", "x1"], ["d"]
        )

    def _learned(self) -> None:
        if self.posterior is None:
            return
        self._features("error")
        self._features("raw")
        self._mean()
        self._mean_jacobian()
        if self.prefix == "gp":  # the variance of a network is that of the innovation
            self._gp("variance", ("variance",))
            self._gp("all", ("mean", "variance", "mean_jacobian", "variance_jacobian"))
            self._gp("distance", ("distance",))
        for name, expression in self.through.items():
            self._value(name, name, expression)

    def _domain(self) -> None:
        """number > 0 outside (NOWHERE for NaN): the larger of `box` (overshoot over the range seen in training, relative to
        it) and the learned part's distance over the 99 % quantile of its training inputs, minus one."""
        box, distance = self._box(), self.posterior
        x, u, p = self._arguments()
        overshoot = box(x, u, p) if box is not None else ca.MX(0.0)
        far = ca.MX(0.0)
        number = overshoot
        if distance is not None and self.prefix == "gp":
            far = self.functions["gp_distance"](self._features("raw")(x, u, p)[0], p)
            usual = distance.domain.distance[2]
            number = ca.fmax(overshoot, far / (usual if usual > 0 else 1.0) - 1.0)
        # fmax drops NaN, and a state that is not a number is in no domain.
        sane = ca.sumsqr(ca.vertcat(x, u, self._own_p(p))) < NOWHERE
        number = ca.if_else(sane, ca.fmax(number, 0.0), NOWHERE)
        values = [ca.densify(v) for v in (number, overshoot, far)]
        self.functions["out_of_domain"] = ca.Function(
            "out_of_domain", [x, u, p], values, ["x", "u", "p"], ["number", "box", "distance"]
        )

    def _box(self) -> Any:
        """Largest relative overshoot of commands and outputs over their training range.

        Quaternions are left out, and coordinates of the place that no motion depends on: physics
        that was learned in one corner of a room holds in the other.
        """
        domain = _domain_of(self.model)
        s = self.sampled
        u, p = self.u, self.p
        signals = {n: u[i] for i, n in enumerate(s.inputs.names)}
        signals |= {n: p[s.parameters[n]] for n in s.exogenous}
        felt = any(n.startswith("position.") for n in s.states.names)
        free = {*(unfelt_place(s.dynamics) if felt else "xy"), "qw", "qx", "qy", "qz"}
        quiet = ca.DM.zeros(self.w.numel())
        y = s.output(self.x, u, p, quiet)
        signals |= {n: y[i] for i, n in enumerate(s.dynamics.outputs.names) if n not in free}
        terms = []
        for name, value in signals.items():
            low, high = domain.get(name, (-math.inf, math.inf))
            if math.isfinite(low) and math.isfinite(high) and high > low:
                terms.append(ca.fmax(low - value, value - high) / (high - low))
        if not terms:
            return None
        whole = ca.SX.sym("p", len(self.parameters))
        worst = ca.fmax(ca.mmax(ca.vertcat(*terms)), 0.0)
        worst = ca.substitute(worst, p, whole[: p.numel()])
        return ca.Function("domain_box", [self.x, u, whole], [ca.cse(ca.densify(worst))])

    def _covariance(self) -> None:
        nd = len(self.sampled.error_states)
        x, u, p = self._arguments()
        sigma, gain = ca.MX.sym("S", nd, nd), ca.MX.sym("K", self.u.numel(), nd)
        _, a, b, _ = self.functions["f_d_jac"](x, u, p)
        fresh = ca.MX(ca.DM(self.noise.process))
        spread = None
        if self.posterior is not None and self.prefix == "gp":
            variance = self.functions["gp_variance"](self._features("raw")(x, u, p)[0], p)
            spread = self.functions["B_d"](x, u, p)
            learned = (spread * ca.repmat(ca.fmax(variance, 0.0).T, nd, 1)) @ spread.T
            deviation = ca.sqrt(ca.fmax(variance, 0.0))
        else:
            learned = ca.DM.zeros(nd, nd)
        closed = a + b @ gain
        for name, arguments, labels, matrix in (
            ("covariance_step", [x, u, p, sigma], ["x", "u", "p", "S"], a),
            ("covariance_feedback", [x, u, p, sigma, gain], ["x", "u", "p", "S", "K"], closed),
        ):
            after = ca.densify(matrix @ sigma @ matrix.T + learned + fresh)
            self.functions[name] = ca.Function(name, arguments, [after], labels, ["S_next"])
        # Errors that stay the same over the whole horizon travel as columns of their own (Schmidt 1966).
        total = sigma
        arguments, labels = [x, u, p, gain, sigma], ["x", "u", "p", "K", "S"]
        results, names = [closed @ sigma @ closed.T + fresh], ["S_next"]
        if spread is not None:
            c = ca.MX.sym("c", nd, spread.shape[1])
            arguments, labels = [*arguments, c], [*labels, "c"]
            total = total + c @ c.T
            results.append(closed @ c + spread * ca.repmat(deviation.T, nd, 1))
            names.append("c_next")
        if self.theta_names:
            bias = ca.MX.sym("b", nd, len(self.theta_names))
            arguments, labels = [*arguments, bias], [*labels, "b"]
            total = total + bias @ ca.DM(self.theta_covariance) @ bias.T
            results.append(closed @ bias + self._by_theta()(x, u, p))
            names.append("b_next")
        results, names = [*results, total], [*names, "total"]
        self.functions["consider_step"] = ca.Function(
            "consider_step", arguments, [ca.densify(v) for v in results], labels, names
        )
        if isinstance(self.model, (PredictorModel, LinearModel)):
            self._output_covariance()

    def _output_covariance(self) -> None:
        """Of the next measurement, S and c being those of the state: C S C' + D_g Var D_g' + cov(e),
        and with the learned error as the same over the horizon (C c + D_g sigma)(...)' in place of
        the middle term. With S = 0 (and c = 0) it is the one-step variance."""
        nd = len(self.sampled.error_states)
        x, u, p = self._arguments()
        sigma = ca.MX.sym("S", nd, nd)
        c = self.functions["h_jac"](x, u, p)[1]
        plain = c @ sigma @ c.T + ca.DM(self.noise.innovation)
        arguments, labels = [x, u, p, sigma], ["x", "u", "p", "S"]
        if self.posterior is None or self.prefix != "gp":
            self.functions["output_covariance"] = ca.Function(
                "output_covariance", arguments, [ca.densify(plain)], labels, ["Y"]
            )
            return
        variance = ca.fmax(self.functions["gp_variance"](self._features("raw")(x, u, p)[0], p), 0.0)
        slope = ca.densify(self.noise_output @ self.spread)
        through = ca.Function("noise_output", [self.x, self.u, self.p, self.w], [slope])
        d = through(x, u, self._own_p(p), ca.DM.zeros(self.w.numel()))
        wide = ca.repmat(variance.T, d.shape[0], 1)
        fresh = plain + (d * wide) @ d.T
        self.functions["output_covariance"] = ca.Function(
            "output_covariance", arguments, [ca.densify(fresh)], labels, ["Y"]
        )
        bias = ca.MX.sym("c", nd, d.shape[1])
        now = c @ bias + d * ca.sqrt(wide)
        self.functions["output_consider"] = ca.Function(
            "output_consider",
            [*arguments, bias],
            [ca.densify(plain + now @ now.T)],
            [*labels, "c"],
            ["Y"],
        )

    def _by_theta(self) -> Any:
        """(x, u, p) -> derivative of x_next in the uncertain parameters, error coordinates (n_d, n_theta)."""
        s, theta = self.sampled, ca.SX.sym("theta", len(self.theta_names))
        after = s.step(self.x, self.u, self.p, self.w, theta)
        _, out = s.chart(self.x, after)
        slope = ca.substitute(
            out @ ca.jacobian(after, theta), theta, s._baked(self.p, self.theta_names)
        )
        self._value("P_theta", "P_theta", slope)
        return self.functions["P_theta"]

    def _filter(self) -> None:
        s, noise = self.sampled, self.noise
        ne, ny = len(s.dynamics.innovations), len(s.dynamics.outputs)
        # A missing innovation is replaced by its expectation given the others, then the stationary gain applies: with
        # W = S^-1 that is e_gone = -W_gone,gone^-1 W_gone,there e_there, and K of a pattern is K times this map. Numbers
        # are scaled to a unit diagonal of W, which single precision needs.
        inverse = np.linalg.inv(noise.innovation)
        size = 1 / np.sqrt(np.diag(inverse))
        weight = ca.DM(inverse * np.outer(size, size))
        there, e = ca.SX.sym("there", ne), ca.SX.sym("e", ne)
        gone = ca.if_else(there != 0, 0.0, 1.0)
        known = ca.vertcat(*(ca.if_else(there[i] != 0, e[i] / size[i], 0.0) for i in range(ne)))
        both = weight * (gone @ gone.T - ca.diag(gone)) + ca.SX.eye(ne)
        filled = (known - gone * cholesky_solve(cholesky(both), gone * (weight @ known))) * size
        fill = ca.Function("fill_innovation", [e, there], [ca.cse(ca.densify(filled))])
        mt = ca.MX.sym("there", ne)
        on = ca.if_else(mt != 0, 1.0, 0.0)
        gain = ca.MX(ca.DM(noise.gain)) @ ca.horzcat(
            *(fill(ca.DM.eye(ne)[:, i], mt) for i in range(ne))
        )
        spread = ca.DM(noise.innovation) * (on @ on.T) + ca.diag(1 - on)
        self.functions["innovation_gain"] = ca.Function(
            "innovation_gain", [mt], [ca.densify(gain), ca.densify(spread)], ["there"], ["K", "S"]
        )
        innovation = self._innovation
        mx, mu, mp = self._arguments()
        my = ca.MX.sym("y", ny)
        seen = self.functions["h"](mx, mu, mp)
        found = innovation(my, seen, mx)
        if isinstance(self.model, PredictorModel):
            # What was foretold of the innovation and what was not enter together, as in the predictor itself.
            push = fill(found, mt)
            if self.posterior is not None:
                push = push + self._push(mx, mu, mp, "raw")
            step = s.step(self.x, self.u, self.p, self.w)
            moved = ca.Function(
                "innovate", [self.x, self.u, self.p, self.w], [ca.cse(ca.densify(step))]
            )
            after = moved(mx, mu, self._own_p(mp), push)
        else:
            correction = ca.mtimes(ca.DM(noise.gain), fill(found, mt))
            after = self.functions["boxplus"](self.functions["f_d"](mx, mu, mp), correction)
        self.functions["filter_step"] = ca.Function(
            "filter_step",
            [mx, mu, mp, my, mt],
            [after, found, seen],
            ["x", "u", "p", "y", "there"],
            ["x_next", "e", "y_hat"],
        )

    @cached_property
    def _innovation(self) -> Any:
        """(y, y_hat, x) -> e."""
        ny = len(self.sampled.dynamics.outputs)
        y, y_hat = ca.SX.sym("y", ny), ca.SX.sym("y_hat", ny)
        found = self.sampled.innovation(y, y_hat, self.x)
        return ca.Function("innovation", [y, y_hat, self.x], [ca.densify(found)])

    def _adapt(self, values: FloatArray) -> Adapted:
        """Adds adapt_step; `values` (n_p,) are the identified ones."""
        assert isinstance(self.model, IdentifiedModel)
        learned = (
            self.posterior if isinstance(self.posterior, (GPPosterior, FeaturePosterior)) else None
        )
        own = adapted(
            self.model,
            self.parameters,
            values,
            learned if self.weights else None,
            self.sampled.error_states,
            self.noise.covariance,
        )
        self.functions["adapt_step"] = adapt_function(
            self.functions, self._innovation, own, self.sampled.states, self.dt
        )
        return own

    def _calibrate(self, point: tuple[FloatArray, FloatArray, FloatArray]) -> Calibration:
        """Adds forecast_step and calibrate_step; `point` = (x, u, p) is where sigma is stated."""
        noise = self.noise
        stated = Stated(
            point=point,
            predicted=noise.covariance,
            process=noise.process,
            innovation=noise.innovation,
            theta=self.theta_covariance,
        )
        own = calibration(self.functions, stated, self.dt)
        self.functions["forecast_step"] = forecast_function(self.functions, self._innovation, own)
        self.functions["calibrate_step"] = calibrate_function(own)
        return own

    def _hessian(self) -> None:
        lam: Any = ca.MX.sym("lam", self.x.numel())
        x, u, p = self._arguments()
        if self.posterior is None:
            lam = ca.SX.sym("lam", self.x.numel())
            x, u, p = self.x, self.u, self.p
            value = ca.dot(lam, self.sampled.step(x, u, p, ca.DM.zeros(self.w.numel())))
            hessian = ca.densify(ca.hessian(value, ca.vertcat(x, u))[0])
        else:
            v = ca.MX.sym("v", x.numel() + u.numel())
            value = ca.dot(lam, self.functions["f_d"](v[: x.numel()], v[x.numel() :], p))
            inner = ca.Function(
                "hessian_of_both", [v, p, lam], [ca.densify(ca.hessian(value, v)[0])]
            )
            hessian = inner(ca.vertcat(x, u), p, lam)
        self.functions["lagrangian_hessian"] = ca.Function(
            "lagrangian_hessian", [x, u, p, lam], [hessian], ["x", "u", "p", "lam"], ["H"]
        )

    # ------------------------------------------------------------------------------------------------ numbers

    def _reference(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        if isinstance(self.model, LinearModel):
            state, inputs = np.zeros(self.model.order), self.model.input_offset
        elif isinstance(self.model, PredictorModel):
            state, inputs = self.model.reference
        else:
            state, inputs = self.model.reference_state, self.model.reference_inputs
        x, u, p = self.sampled.extended(state, inputs)
        if self.weights and isinstance(self.posterior, (GPPosterior, FeaturePosterior)):
            p = np.concatenate([p, self.posterior.weights.ravel(order="F")])
        return x, u, p

    def _noise(self, x: FloatArray, u: FloatArray, p: FloatArray) -> Noise:
        extra = len(self.sampled.history)
        if isinstance(self.model, (LinearModel, PredictorModel)):
            own = self.model.noise
            gain = (
                self.model.form.gain
                if isinstance(self.model, PredictorModel)
                else self.model.matrices.k
            )
            return innovation_noise(gain, own, extra)
        inputs = [self.x, self.u, self.p, self.w]
        through = ca.Function(
            "noise", inputs, [ca.densify(self.noise_input), ca.densify(self.noise_output)]
        )
        w = ca.DM.zeros(self.w.numel())
        if self.posterior is not None:
            w = self.spread @ self._mean()(self._features("error")(x, u, p)[0], p)
        g, d = (v.full() for v in through(x, u, p[: self.p.numel()], w))
        a, c = (
            self.functions["f_d_jac"](x, u, p)[1].full(),
            self.functions["h_jac"](x, u, p)[1].full(),
        )
        n = len(self.sampled.dynamics.error_states)
        return identified_noise(self.model, self.dt, (a[:n, :n], g[:n], c[:, :n], d), extra)

    def build(self) -> ModelFunctions:
        """All of it."""
        s = self.sampled
        self._motion()
        self._outputs()
        self._charts()
        self._learned()
        self._domain()
        x, u, p = self._reference()
        self.noise = self._noise(x, u, p)
        targets, own, forecasts = Layout([]), NOTHING, UNCALIBRATED
        if "covariance" in self.groups:
            self._covariance()
        if "filter" in self.groups:
            self._filter()
        if "adapt" in self.groups:
            own = self._adapt(p)
        if "calibrate" in self.groups:
            forecasts = self._calibrate((x, u, p))
        if "target" in self.groups:
            targets = tracked(s)
            self.functions["target_step"] = target_function(
                s, self.functions, targets, len(self.parameters)
            )
        if "hessian" in self.groups:
            self._hessian()
        self.functions.pop(f"{self.prefix}_features_own", None)
        if not len(s.states):  # a function alone has nothing to say of a state
            for name in [n for n, f in self.functions.items() if f.numel_out(0) == 0]:
                del self.functions[name]
        longest: dict[str, int] = {}
        for i, lag in s.history:
            longest[s.dynamics.inputs.names[i]] = lag
        none = Layout([])
        return ModelFunctions(
            name=_name(self),
            dt=self.dt,
            identified_dt=self.own_dt,
            functions=self.functions,
            states=s.states,
            error_states=s.error_states,
            inputs=s.inputs,
            parameters=self.parameters,
            outputs=s.dynamics.outputs,
            innovations=s.dynamics.innovations,
            features=none if self.posterior is None else self.posterior.inputs,
            learned=none if self.posterior is None else self.posterior.outputs,
            own_states=len(s.dynamics.states),
            own_error_states=len(s.dynamics.error_states),
            parameter_values=p,
            reference=(x, u),
            noise=self.noise,
            covariance_names=self.theta_names,
            covariance=self.theta_covariance,
            bounds=_bounds(self),
            scales=_scales(self),
            delay=longest,
            targets=targets,
            adapted=own,
            calibration=forecasts,
            discrete=self.discrete,
            posterior=self.posterior,
            model=self.model,
            sampled=s,
        )


def _dynamics(model: IdentifiedModel | LinearModel | PredictorModel) -> Dynamics:
    if isinstance(model, IdentifiedModel):
        return model.dynamics
    return model if isinstance(model, LinearModel) else model.form


def _domain_of(
    model: IdentifiedModel | LinearModel | PredictorModel,
) -> Mapping[str, tuple[float, float]]:
    """Training ranges by name, where they are known."""
    return {} if isinstance(model, LinearModel) else model.domain


def _name(builder: _Builder) -> str:
    if isinstance(builder.model, PredictorModel):
        return builder.model.name
    own = builder.sampled.dynamics.name
    if builder.posterior is None:
        return own
    return f"{own} + {builder.posterior.method if isinstance(builder.posterior, FeaturePosterior) else 'GP'}"


def _bounds(builder: _Builder) -> tuple[FloatArray, FloatArray]:
    """(lower, upper) of the commands: 0 .. 1, rotor speeds 0 .. speed_max, else what was seen in training."""
    domain = _domain_of(builder.model)
    physics = physics_of(builder.sampled.dynamics)
    rows = []
    for name in builder.sampled.inputs.names:
        if physics is not None:
            top = physics.vehicle.actuator.speed_max if name.startswith("omega") else 1.0
            rows.append((0.0, math.inf if top is None else float(top)))
        else:
            rows.append(domain.get(name, (-math.inf, math.inf)))
    values = np.array(rows, dtype=float).reshape(-1, 2)
    return values[:, 0], values[:, 1]


SCALES = {"position": 1.0, "velocity": 1.0, "attitude": 1.0, "rate": 1.0, "rotor": 1.0}


def _scales(builder: _Builder) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Typical sizes of x, u and y: dimensionless = value / scale. Of outputs half the range seen in training."""
    s, model = builder.sampled, builder.model
    domain = _domain_of(model)

    def half(name: str, default: float) -> float:
        low, high = domain.get(name, (0.0, 0.0))
        size = max(abs(low), abs(high)) if math.isfinite(low) and math.isfinite(high) else 0.0
        return size if size > 0 else default

    rates = dict(zip(("rate.x", "rate.y", "rate.z"), "pqr"))
    speeds = dict(zip(("velocity.x", "velocity.y", "velocity.z"), ("vx", "vy", "vz")))
    pushes = {
        f"disturbance.{n}": v for n, v in zip(s.dynamics.noises.names, s.dynamics.noise_scale(0.01))
    }
    physics = physics_of(s.dynamics)
    remembered: Mapping[str, float] = {} if physics is None else physics.memory_sizes
    lower, upper = _bounds(builder)
    width = np.where(np.isfinite(upper - lower), np.maximum(np.abs(lower), np.abs(upper)), 1.0)
    commands = dict(zip(s.inputs.names, np.where(width > 0, width, 1.0).tolist()))
    x = []
    for name in s.states.names:
        head = name.split(".")[0]
        if head == "history":
            x.append(commands.get(name.split(".")[1], 1.0))
        elif name in pushes:
            x.append(float(pushes[name]) or 1.0)
        else:
            x.append(
                half((rates | speeds).get(name, name), remembered.get(name, SCALES.get(head, 1.0)))
            )
    y = [half(n, 1.0) for n in s.dynamics.outputs.names]
    return np.array(x), np.array(list(commands.values())), np.array(y)
