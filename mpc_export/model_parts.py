"""One model taken apart for export: sampled physics, learned part, and how both are closed into one
function.

A family of functions (mpc_export/families) writes its physics as an expression of x, u, p and the
push w, and adds it here under its name. With a learned part w is the learned mean of (x, u, p), and
slopes follow by the chain rule

    d/dx = physics_x + physics_w spread mean_z features_x        (and so on in u and p).

Physics is SX inside; a learned part is MX: one `exp` over its support points, with analytic
Jacobians. Without a learned part w is zero and everything is SX.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from greybox.errors import ModelError
from greybox.model.dynamics import Dynamics
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import LongerWindow, learned_push_of, physics_of
from greybox.model.linear import LinearModel
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.features import lag_of, reach
from greybox.residual.hybrid import HybridModel
from greybox.residual.posterior import GPPosterior
from greybox.symbolic import Expr, Layout, Signal
from mpc_export.innovation_form import SampledForm
from mpc_export.noise import parameter_covariance
from mpc_export.predictors import Learned, NetworkPart, PredictorModel
from mpc_export.sampled import Sampled, at_sample_time, is_discrete

WEIGHTS = "gp.weights"
EULER = ("phi", "theta", "psi")

Exportable = IdentifiedModel | LinearModel | PredictorModel


def shared(columns: Sequence[Sequence[str]]) -> list[list[int]]:
    """Per innovation, of the channels `columns` that each is formed from, those that share one."""
    return [
        [j for j, other in enumerate(columns) if set(own) & set(other)] or [i]
        for i, own in enumerate(columns)
    ]


class ModelParts:
    """Sampled physics, learned part and the functions made of them, each once.

    `x`, `u`, `p`, `w` are the SX symbols of the physics; `spread` (n_w, n_g) puts the learned
    outputs into w.
    """

    def __init__(
        self,
        model: Exportable,
        dt: float | None,
        runtime: tuple[str, ...],
        measured: bool = True,
    ) -> None:
        self.model = model
        dynamics = _dynamics(model)
        self.discrete = isinstance(model, PredictorModel) or is_discrete(dynamics)
        self.own_dt = float(model.sample_time if isinstance(model, IdentifiedModel) else model.dt)
        self.dt = self.own_dt if dt is None else float(dt)
        dynamics = self._at_dt(dynamics)
        self.posterior: Learned | None = (
            model.learned if isinstance(model, PredictorModel) else None
        )
        looks_back: dict[str, int] = {}
        if isinstance(dynamics, HybridModel):
            self.posterior = dynamics.posterior
            dynamics, looks_back = self._looking_back(dynamics)
        self.weights = WEIGHTS in runtime
        self._refuse(dynamics)
        self.theta_names, self.theta_covariance = parameter_covariance(model)
        # What an output hybrid did not learn keeps the prior's variance, as in its own predictions.
        self.silent = not isinstance(model, PredictorModel)
        self.prefix = "network" if isinstance(self.posterior, NetworkPart) else "gp"
        if isinstance(model, PredictorModel):
            self.sampled: Sampled = SampledForm(
                dynamics=model.form, dt=self.dt, values={}, runtime=runtime
            )
        else:
            self.sampled = Sampled(
                dynamics=dynamics,
                dt=self.dt,
                values=dict(model.values),
                runtime=tuple(n for n in runtime if n != WEIGHTS),
                sensitive=self.theta_names,
                looks_back=looks_back,
                measured=measured,
            )
        self.x, self.u, self.p, self.w = self.sampled.symbols()
        self.chart_in, _ = self.sampled.chart(self.x, self.x)
        self.spread = ca.DM(self.w.numel(), len(self.learned_outputs))
        for j, n in enumerate(self.learned_outputs.names):
            self.spread[dynamics.noises[n], j] = 1.0
        self.functions: dict[str, ca.Function] = {}

    def _at_dt(self, dynamics: Dynamics) -> Dynamics:
        """The dynamics at this sample time."""
        if not (self.dt > 0 and math.isfinite(self.dt)):
            raise ModelError("the sample time must be positive", got=f"{self.dt:g} s")
        if self._as_identified:
            return dynamics
        if self.discrete:
            raise ModelError(
                f"{dynamics.name} is a discrete model",
                expected=f"dt = {self.own_dt:g} s",
                got=f"{self.dt:g} s",
            )
        if isinstance(self.model, PredictorModel):
            raise ModelError(f"{self.model.name} predicts samples: it has one sample time")
        return at_sample_time(self.model, dynamics, self.dt)

    @property
    def _as_identified(self) -> bool:
        return math.isclose(self.dt, self.own_dt, rel_tol=1e-9)

    def _looking_back(self, hybrid: HybridModel) -> tuple[Dynamics, dict[str, int]]:
        """(physics with a window as long as the learned part looks back, lags in samples by
        command)."""
        names = hybrid.posterior.inputs.names
        lags = {of: lag for of, lag in sorted(map(lag_of, names)) if lag}
        if not lags:
            return hybrid.inner, lags
        if not self._as_identified:
            raise ModelError(
                "the learned part looks at earlier commands, sample by sample",
                expected=f"dt = {self.own_dt:g} s, at which it was learned",
                got=f"{self.dt:g} s",
            )
        return LongerWindow(inner=hybrid.inner, past=reach(names)), lags

    def _refuse(self, dynamics: Dynamics) -> None:
        """Says what cannot be exported."""
        if learned_push_of(dynamics) is not None:
            raise ModelError(
                "a learned part inside another one cannot be exported", got=dynamics.name
            )
        euler = tuple(n for n in self.learned_inputs.names if n in EULER)
        if euler and not isinstance(self.model, PredictorModel):
            raise ModelError(
                f"the learned part looks at Euler angles ({', '.join(euler)})",
                fix="learn it on gravity.x, gravity.y, gravity.z: they have no singularity",
            )
        if self.weights and self.posterior is None:
            raise ModelError(f"no learned part, so no {WEIGHTS} to change at run time")
        if self.weights and not isinstance(self.posterior, (GPPosterior, FeaturePosterior)):
            raise ModelError(
                f"{WEIGHTS} cannot change at run time here",
                expected="a learned part of `greybox learn`",
            )

    # ------------------------------------------------------------------------------------- layouts

    @property
    def learned_inputs(self) -> Layout:
        """What the learned part looks at; empty without one."""
        return Layout([]) if self.posterior is None else self.posterior.inputs

    @property
    def learned_outputs(self) -> Layout:
        """What the learned part pushes; empty without one."""
        return Layout([]) if self.posterior is None else self.posterior.outputs

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

    def arguments(self, own: bool = False) -> tuple[Expr, Expr, Expr]:
        """MX symbols x (own states only, on request), u, p."""
        n = len(self.sampled.dynamics.states) if own else self.x.numel()
        return (
            ca.MX.sym("x", n),
            ca.MX.sym("u", self.u.numel()),
            ca.MX.sym("p", len(self.parameters)),
        )

    def own_p(self, p: Expr) -> Expr:
        """p without the learned weights."""
        return p[: self.p.numel()]

    def learned(self, what: str, which: tuple[str, ...]) -> ca.Function:
        """A function of (z, p) with some of the learned part's quantities; a push that is off has
        no variance."""
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

    @property
    def states_variance(self) -> bool:
        """Whether the learned part states a variance of its own; that of a network is the
        innovation's."""
        return self.posterior is not None and self.prefix == "gp"

    def variance(self, x: Expr, u: Expr, p: Expr) -> Expr:
        """Learned variance (n_g,) at x, u, p, never negative, as MX."""
        return ca.fmax(self.functions["gp_variance"](self.features("raw")(x, u, p)[0], p), 0.0)

    def mean(self) -> ca.Function:
        """(z, p) -> mean of the learned part."""
        return self.learned("mean", ("mean",))

    def mean_jacobian(self) -> ca.Function:
        """(z, p) -> mean of the learned part and its slope in z."""
        return self.learned("mean_jac", ("mean", "mean_jacobian"))

    def features(self, kind: str) -> ca.Function:
        """(x, u, p) -> z, z_x, z_u, z_p; x in error ("error"), raw ("raw") or the model's own raw
        coordinates ("own")."""
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

    def push(self, x: Expr, u: Expr, p: Expr, kind: str) -> Expr:
        """w of the learned mean, as MX."""
        return self.spread @ self.mean()(self.features(kind)(x, u, p)[0], p)

    @cached_property
    def innovation(self) -> ca.Function:
        """(y, y_hat, x) -> e."""
        ny = len(self.sampled.dynamics.outputs)
        y, y_hat = ca.SX.sym("y", ny), ca.SX.sym("y_hat", ny)
        found = self.sampled.innovation(y, y_hat, self.x)
        return ca.Function("innovation", [y, y_hat, self.x], [ca.densify(found)])

    @cached_property
    def together(self) -> list[list[int]]:
        """Per innovation those that need a channel which it needs too, itself among them."""
        return shared(self.sampled.dynamics.innovation_columns)

    @cached_property
    def whole(self) -> ca.Function:
        """there (n_e) -> the same without the innovations whose channels are not all there: one
        that is missing says that one of its channels is."""
        there = ca.SX.sym("there", len(self.together))
        on = [there[i] != 0 for i in range(len(self.together))]
        both = [functools.reduce(ca.logic_and, [on[j] for j in own]) for own in self.together]
        return ca.Function("whole", [there], [ca.densify(ca.vertcat(*both))])

    @cached_property
    def counted(self) -> ca.Function:
        """(there, y) -> `whole` of what is there and can be a reading: a quaternion of no length,
        which no attitude has, counts as missing."""
        there = ca.SX.sym("there", len(self.together))
        y = ca.SX.sym("y", len(self.sampled.dynamics.outputs))
        given = there[:]
        for read in readings(self.sampled.dynamics):
            square = ca.sumsqr(y[read.columns])
            can_be = ca.logic_and(square >= read.shortest**2, square <= read.longest**2)
            for i in read.innovations:
                given[i] = ca.if_else(can_be, there[i], 0.0)
        return ca.Function("counted", [there, y], [self.whole(given)])

    def add_value(self, name: str, result: str, expression: Expr, *, own: bool = False) -> None:
        """Adds name(x, u, p) -> result from an expression of x, u, p, w, closed with the learned
        mean."""
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
        mx, mu, mp = self.arguments(own)
        value = physics(mx, mu, self.own_p(mp), self.push(mx, mu, mp, "own" if own else "raw"))
        self.functions[name] = ca.Function(name, [mx, mu, mp], [value], ["x", "u", "p"], [result])

    def add_jacobians(
        self,
        name: str,
        results: tuple[str, str, str, str],
        value: Expr,
        slopes: tuple[Expr, ...],
        kind: str,
    ) -> None:
        """Adds name(x, u, p) -> value and its slopes in x, u, p; `slopes` are those of the physics
        in x, u, p and w."""
        self.add_closed(name, results, self.physics(name, value, slopes, own=kind == "own"), kind)

    def physics(
        self, name: str, value: Expr, slopes: tuple[Expr, ...], *, own: bool = False
    ) -> ca.Function:
        """(x, u, p, w) -> value, slopes in x, u, p and the learned outputs; without one (x, u, p)
        -> the first four."""
        x = self.x[: len(self.sampled.dynamics.states)] if own else self.x
        values = [ca.densify(value), *(ca.sparsify(v) for v in slopes[:3])]
        if self.posterior is None:
            values = ca.substitute(values, [self.w], [ca.DM.zeros(self.w.numel())])
            return ca.Function(f"physics_{name}", [x, self.u, self.p], ca.cse(values))
        values.append(ca.sparsify(slopes[3] @ self.spread))
        return ca.Function(f"physics_{name}", [x, self.u, self.p, self.w], ca.cse(values))

    def add_closed(
        self,
        name: str,
        results: tuple[str, str, str, str],
        physics: ca.Function,
        kind: str,
        turn: ca.Function | None = None,
    ) -> None:
        """Adds name(x, u, p) from `physics`(x, u, p[, w]) -> value, slopes in x, u, p[, w];
        `turn`(x, value, slopes) changes their coordinates.

        The chain rule of the head of this file.
        """
        mx, mu, mp = self.arguments(kind == "own")
        if self.posterior is None:
            y, *slopes = physics(mx, mu, mp)
            if turn is not None:
                slopes = list(turn(mx, y, *slopes))
            values = [ca.densify(v) for v in (y, *slopes)]
        else:
            z, z_x, z_u, z_p = self.features(kind)(mx, mu, mp)
            mean, slope = self.mean_jacobian()(z, mp)
            y, *slopes = physics(mx, mu, self.own_p(mp), self.spread @ mean)
            if turn is not None:
                slopes = list(turn(mx, y, *slopes))
            y_x, y_u, physics_p, y_g = slopes
            by_z = y_g @ slope
            y_p: Expr = (
                ca.horzcat(physics_p, ca.MX(y_x.shape[0], len(self.parameters) - self.p.numel()))
                + by_z @ z_p
            )
            if self.weights:
                q = ca.MX.sym("q", len(self.parameters))
                fixed = ca.MX.sym("z", z.numel())
                by_weight = ca.Function(
                    "gp_mean_by_weight", [fixed, q], [ca.jacobian(self.mean()(fixed, q), q)]
                )
                y_p = y_p + y_g @ by_weight(z, mp)
            values = [ca.densify(v) for v in (y, y_x + by_z @ z_x, y_u + by_z @ z_u, y_p)]
        self.functions[name] = ca.Function(
            name, [mx, mu, mp], values, ["x", "u", "p"], list(results)
        )


@dataclass(frozen=True, kw_only=True)
class Reading:
    """A sensor whose reading has a length: rows of y, rows of e, and what it lies between."""

    columns: list[int]
    innovations: list[int]
    shortest: float
    longest: float


def readings(dynamics: Dynamics) -> list[Reading]:
    """The sensors of a model that state the length of a reading; none for what is no physics."""
    physics = physics_of(dynamics)
    if physics is None:
        return []
    out, rows, of_e = [], 0, 0
    for sensor in physics.sensors:
        columns = len(sensor.signals(physics.vehicle))
        innovations = len(sensor.innovation_signals(physics.vehicle))
        if sensor.length is not None:
            out.append(
                Reading(
                    columns=list(range(rows, rows + columns)),
                    innovations=list(range(of_e, of_e + innovations)),
                    shortest=sensor.length[0],
                    longest=sensor.length[1],
                )
            )
        rows, of_e = rows + columns, of_e + innovations
    return out


def _dynamics(model: Exportable) -> Dynamics:
    if isinstance(model, IdentifiedModel):
        return model.dynamics
    return model if isinstance(model, LinearModel) else model.form
