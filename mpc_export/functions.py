"""model_functions: everything that a controller asks of a model, as named CasADi functions of (x,
u, p).

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
| follow_step | the same of the filter that follows standing forces and torques (standing.py) |
| innovation_gain | there -> K, S |
| adapt_step | x u p y there V memory -> x_next, p_next, V_next, e, y_hat: the filter that adapts (adaptation.py) |
| forecast_step | x x_next u p y there F clock -> F_next, clock_next, E, seen: errors of forecasts (calibration.py) |
| calibrate_step | theta E seen sigma level gain -> theta_next, scale: by how much wider they are than sigma says |
| output_covariance, output_consider | x u p S [c] -> Y: of the next measurement (innovation form); with "covariance" |
| target_step | x u p r -> x_next, u_next, residual: Newton step to the steady state that holds r (target.py) |
| pilot_step | x u p y there r -> x_next, u_next, e, y_hat: follow_step and a feedback to r (pilot.py) |
| f_d_nominal, f_d_nominal_jac_raw | as f_d and f_d_jac_raw, without the learned part: physics alone |
| lagrangian_hessian | x u p lam -> H (n_x + n_u square): of lam' f_d in raw coordinates |

Groups "covariance", "filter", "target", "hessian", "nominal", "adapt", "calibrate", "pilot" come on
request. Results are dense, column by column. x holds the model's own states and then the command
history (sampled.py); p the battery voltage where the model has one, the parameters asked for, and,
with "gp.weights", the weights of the learned part. Each family is a file of mpc_export/families, or
one of adaptation.py, calibration.py, target.py and pilot.py.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from greybox.errors import ModelError, UnknownNameError
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import physics_of
from greybox.model.linear import LinearModel
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.posterior import GPPosterior
from greybox.symbolic import Expr, FloatArray, Layout
from mpc_export.adaptation import NOTHING, Adapted, adapt_function, adapted, flight_parameters
from mpc_export.calibration import (
    UNCALIBRATED,
    Calibration,
    Stated,
    calibrate_function,
    calibration,
    forecast_function,
)
from mpc_export.families.covariance import add_covariance
from mpc_export.families.domain import add_domain
from mpc_export.families.filter import add_filter
from mpc_export.families.hessian import add_hessian
from mpc_export.families.learned import add_learned
from mpc_export.families.measurement import add_measurement
from mpc_export.families.motion import add_charts, add_motion
from mpc_export.model_parts import Exportable, ModelParts
from mpc_export.noise import Noise, identified_noise, innovation_noise
from mpc_export.pilot import UNPILOTED, Pilot, pilot_function
from mpc_export.predictors import Fitted, Learned, PredictorModel, predictor_model
from mpc_export.sampled import Sampled
from mpc_export.scales import command_limits, typical_sizes
from mpc_export.signals import told
from mpc_export.standing import PREFIX, in_flight
from mpc_export.target import target_function, tracked

GROUPS = ("covariance", "filter", "target", "hessian", "nominal", "adapt", "calibrate", "pilot")
PLANNED = frozenset({"covariance", "target", "hessian", "nominal"})
"""Groups that measure nothing."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelFunctions:
    """Named functions of one model and the numbers that belong to them. `functions[name]` or
    `self[name]`.

    Layouts give order, names and units. `parameter_values` (n_p,) are the identified values of p,
    `reference` = (x, u) the point of the stationary gain. `delay` maps a delayed input to its
    history length. `covariance_names` and `covariance` are the uncertain parameters of
    `consider_step`. `targets` names what `target_step` holds, `adapted` what `adapt_step` adapts,
    `calibration` holds the horizons of `calibrate_step`, `pilot` hover and gain of `pilot_step`.
    """

    name: str
    dt: float
    identified_dt: float
    functions: Mapping[str, ca.Function]
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
    pilot: Pilot
    discrete: bool
    posterior: Learned | None
    model: Exportable
    sampled: Sampled

    def __getitem__(self, name: str) -> ca.Function:
        try:
            return self.functions[name]
        except KeyError:
            raise UnknownNameError("function", name, self.functions) from None

    @property
    def sizes(self) -> dict[str, int]:
        """n_x, n_d, n_u, n_p, n_y, n_e, n_z (features), n_g (learned outputs), n_r (targets),
        n_theta, n_a (adapted), n_h (horizons), n_l (columns of calibrate_step's theta)."""
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
    measured: bool = True,
) -> ModelFunctions:
    """The functions of anything fitted (mpc_export/predictors.py says of what kinds).

    `dt` [s] is the sample time (None: the one that it was identified at).

    `with_` adds groups of `GROUPS`. `runtime_parameters` are model parameters that stay in p, by
    name, and "gp.weights". measured=False: functions of a plan, which measures nothing. Those of h
    are left out, and with them earlier commands that only a late sensor sees. Raises
    `UnknownNameError`, and `ModelError` for a discrete model at another sample time, a learned part
    inside another one, or one that looks at Euler angles.
    """
    groups = set(with_)
    for name in sorted(groups - set(GROUPS)):
        raise UnknownNameError("group of functions", name, GROUPS)
    if "calibrate" in groups:
        groups |= {"filter", "covariance"}
    if "pilot" in groups:
        groups |= {"filter"}
    if not isinstance(model, (IdentifiedModel, LinearModel, PredictorModel)):
        model = predictor_model(model, dt=dt)
    runtime = list(runtime_parameters)
    if "adapt" in groups:
        groups |= {"filter"}
        runtime += flight_parameters(model)
    seen = sorted(groups - PLANNED)
    if seen and not measured:
        raise ModelError(
            "measured=False leaves out what measurements need",
            expected=f"groups out of {', '.join(sorted(PLANNED))}",
            got=", ".join(seen),
        )
    made = _assembled(ModelParts(model, dt, tuple(dict.fromkeys(runtime)), measured), groups)
    if measured:
        return made
    kept = {n: f for n, f in made.functions.items() if n.split("_")[0] not in ("h", "output")}
    return replace(made, functions=kept)


def _assembled(parts: ModelParts, groups: set[str]) -> ModelFunctions:
    """All of it, in the order in which one family uses another."""
    slopes = add_motion(parts, nominal="nominal" in groups)
    noise_output = add_measurement(parts)
    add_charts(parts)
    add_learned(parts, slopes.learned)
    add_domain(parts)
    x, u, p = _reference(parts)
    noise, flying = _noise(parts, (x, u, p), (slopes.noise, noise_output))
    if "covariance" in groups:
        add_covariance(parts, noise, noise_output)
    if "filter" in groups:
        add_filter(parts, noise, flying)
    own = _add_adaptation(parts, noise, p) if "adapt" in groups else NOTHING
    forecasts = UNCALIBRATED
    if "calibrate" in groups:
        forecasts = _add_calibration(parts, noise, (x, u, p))
    targets, pilot = _add_steering(parts, groups, (x, u, p))
    if "hessian" in groups:
        add_hessian(parts)
    parts.functions.pop(f"{parts.prefix}_features_own", None)
    s, functions = parts.sampled, parts.functions
    if not len(s.states):  # a function alone has nothing to say of a state
        functions = {n: f for n, f in functions.items() if f.numel_out(0)}
    return ModelFunctions(
        name=_name(parts),
        dt=parts.dt,
        identified_dt=parts.own_dt,
        functions=functions,
        states=s.states,
        error_states=s.error_states,
        inputs=told(s.inputs, parts.model, s.dynamics),
        parameters=told(parts.parameters, parts.model, s.dynamics),
        outputs=told(s.dynamics.outputs, parts.model, s.dynamics),
        innovations=s.dynamics.innovations,
        features=parts.learned_inputs,
        learned=parts.learned_outputs,
        own_states=len(s.dynamics.states),
        own_error_states=len(s.dynamics.error_states),
        parameter_values=p,
        reference=(x, u),
        noise=noise,
        covariance_names=parts.theta_names,
        covariance=parts.theta_covariance,
        bounds=command_limits(parts),
        scales=typical_sizes(parts),
        delay={s.dynamics.inputs.names[i]: lag for i, lag in s.history},
        targets=targets,
        adapted=own,
        calibration=forecasts,
        pilot=pilot,
        discrete=parts.discrete,
        posterior=parts.posterior,
        model=parts.model,
        sampled=s,
    )


def _add_steering(
    parts: ModelParts, groups: set[str], point: tuple[FloatArray, FloatArray, FloatArray]
) -> tuple[Layout, Pilot]:
    """The functions of the groups target and pilot; (targets, the pilot's numbers)."""
    if not groups & {"target", "pilot"}:
        return Layout([]), UNPILOTED
    targets, pilot = tracked(parts.sampled), UNPILOTED
    parts.functions["target_step"] = target_function(
        parts.sampled, parts.functions, targets, len(parts.parameters)
    )
    if "pilot" in groups:
        layouts = (parts.sampled.states, parts.sampled.error_states, parts.parameters)
        parts.functions["pilot_step"], pilot = pilot_function(
            parts.functions, layouts, _name(parts), point, command_limits(parts)
        )
        if "target" not in groups:  # by far the largest; no pilot calls it
            del parts.functions["target_step"]
    return targets, pilot


def _name(parts: ModelParts) -> str:
    if isinstance(parts.model, PredictorModel):
        return parts.model.name
    own = parts.sampled.dynamics.name
    if parts.posterior is None:
        return own
    return f"{own} + {parts.posterior.method if isinstance(parts.posterior, FeaturePosterior) else 'GP'}"


def _reference(parts: ModelParts) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(x, u, p) where the stationary gain is computed."""
    model = parts.model
    if isinstance(model, LinearModel):
        state, inputs = np.zeros(model.order), model.input_offset
    elif isinstance(model, PredictorModel):
        state, inputs = model.reference
    else:
        state, inputs = model.reference_state, model.reference_inputs
    x, u, p = parts.sampled.extended(state, inputs)
    if parts.weights and isinstance(parts.posterior, (GPPosterior, FeaturePosterior)):
        p = np.concatenate([p, parts.posterior.weights.ravel(order="F")])
    return x, u, p


def _noise(
    parts: ModelParts, point: tuple[FloatArray, FloatArray, FloatArray], through: tuple[Expr, Expr]
) -> tuple[Noise, Noise | None]:
    """(The identified noise at `point` = (x, u, p), that of a filter in flight where the model has
    disturbances); `through` are the slopes of x_next and of y - y_hat in w."""
    (x, u, p), extra, model = point, len(parts.sampled.history), parts.model
    if isinstance(model, (LinearModel, PredictorModel)):
        gain = model.form.gain if isinstance(model, PredictorModel) else model.matrices.k
        return innovation_noise(gain, model.noise, extra), None
    slopes = ca.Function(
        "noise", [parts.x, parts.u, parts.p, parts.w], [ca.densify(v) for v in through]
    )
    w = ca.DM.zeros(parts.w.numel())
    if parts.posterior is not None:
        w = parts.push(x, u, p, "error")
    g, d = (v.full() for v in slopes(x, u, p[: parts.p.numel()], w))
    a, c = (
        parts.functions["f_d_jac"](x, u, p)[1].full(),
        parts.functions["h_jac"](x, u, p)[1].full(),
    )
    n = len(parts.sampled.dynamics.error_states)
    a, g, c = a[:n, :n], g[:n], c[:, :n]
    own = identified_noise(model, parts.dt, (a, g, c, d), extra)
    names = parts.sampled.dynamics.error_states.names
    stays = [i for i, name in enumerate(names) if name.startswith(f"d_{PREFIX}")]
    if not stays:
        return own, None
    kept = a.copy()
    kept[stays] = np.eye(n)[stays]
    return own, identified_noise(in_flight(model), parts.dt, (kept, g, c, d), extra)


def _add_adaptation(parts: ModelParts, noise: Noise, values: FloatArray) -> Adapted:
    """adapt_step; `values` (n_p,) are the identified ones."""
    assert isinstance(parts.model, IdentifiedModel)
    learned = (
        parts.posterior if isinstance(parts.posterior, (GPPosterior, FeaturePosterior)) else None
    )
    weights = learned if parts.weights else None
    states = parts.sampled.dynamics.error_states
    own = adapted(parts.model, parts.parameters, values, weights, states, noise.covariance)
    parts.functions["adapt_step"] = adapt_function(
        parts.functions, (parts.innovation, parts.counted), own, parts.sampled.states, parts.dt
    )
    return own


def _add_calibration(
    parts: ModelParts, noise: Noise, point: tuple[FloatArray, FloatArray, FloatArray]
) -> Calibration:
    """forecast_step and calibrate_step; `point` = (x, u, p) is where sigma is stated."""
    stated = Stated(
        point=point,
        predicted=noise.covariance,
        process=noise.process,
        innovation=noise.innovation,
        theta=parts.theta_covariance,
    )
    physics = physics_of(parts.sampled.dynamics)
    sensors = () if physics is None else physics.channel_groups
    own = calibration(parts.functions, stated, sensors, parts.dt)
    parts.functions["forecast_step"] = forecast_function(
        parts.functions, (parts.innovation, parts.counted), own
    )
    parts.functions["calibrate_step"] = calibrate_function(own)
    return own
