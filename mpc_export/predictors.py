"""PredictorModel: what `write_bundle` takes besides identified models: everything else that
greybox fits.

`predictor_model` turns an output hybrid, decoupled linear models, a NARX or LSTM model, or a GP
alone into one; `read_model` reads any file of a fitted thing.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import casadi as ca
import numpy as np

from greybox.baselines import lstm, narx
from greybox.baselines.as_predictor import LINEAR_SCHEMAS
from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.decoupled import combined
from greybox.baselines.innovation_ahead import foretold_covariance
from greybox.baselines.linear_predictor import LinearPredictor
from greybox.baselines.lstm import LSTMModel
from greybox.baselines.narx import NARXModel
from greybox.baselines.output_residual import KIND, OutputHybrid, read_linear
from greybox.errors import FileFormatError, ModelError, UnknownNameError
from greybox.files import read_json
from greybox.model.effect import Effect
from greybox.model.identified import SCHEMA as MODEL
from greybox.model.identified import IdentifiedModel
from greybox.model.linear import SCHEMA as LINEAR
from greybox.model.linear import LinearModel
from greybox.residual import gaussian_process, posterior
from greybox.residual.files import load_model
from greybox.residual.gaussian_process import GaussianProcess
from greybox.residual.posterior import QUANTITIES, Domain, GPPosterior
from greybox.symbolic import Expr, FloatArray, Layout
from mpc_export.innovation_form import BaseForm, InnovationForm, LagForm, StaticForm

Fitted = (
    IdentifiedModel
    | LinearModel
    | OutputHybrid
    | NARXModel
    | LSTMModel
    | GPPosterior
    | GaussianProcess
    | BasePredictor
)
MANY_LINEAR = LINEAR_SCHEMAS[1]


class Learned(Protocol):
    """The learned part of a model: a mean and a variance of features, as CasADi expressions."""

    @property
    def inputs(self) -> Layout:
        """Features z."""

    @property
    def outputs(self) -> Layout:
        """What it foretells."""

    @property
    def active(self) -> tuple[bool, ...]:
        """Per output: whether it says anything."""

    @property
    def points(self) -> int:
        """Number of support points, 0 of a network."""

    @property
    def method(self) -> str:
        """How it was made."""

    @property
    def domain(self) -> Domain:
        """Where its training inputs lie."""

    @property
    def noise(self) -> FloatArray:
        """Noise variance of a new sample (n_out,)."""

    @property
    def input_mean(self) -> FloatArray:
        """Typical features."""

    @property
    def input_scale(self) -> FloatArray:
        """Their spread."""

    def expressions(
        self,
        z: Expr,
        which: Iterable[str],
        *,
        noise: bool | str = False,
        weights: Expr | None = None,
    ) -> dict[str, Expr]:
        """Quantities of one z by name."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkPart:
    """An LSTM as a learned part: it has a mean; its variance (from validation data) is that of the
    innovation."""

    model: LSTMModel

    @property
    def inputs(self) -> Layout:
        """The regressors."""
        return self.model.lags.layout

    @property
    def outputs(self) -> Layout:
        """The predicted channels."""
        return self.model.lags.output_layout

    @property
    def active(self) -> tuple[bool, ...]:
        """All outputs."""
        return (True,) * len(self.model.outputs)

    points = 0
    method = "lstm"

    @property
    def domain(self) -> Domain:
        """Three deviations around the training mean."""
        center, width = self.model.input_mean, 3.0 * self.model.input_scale
        return Domain(lower=center - width, upper=center + width)

    @property
    def noise(self) -> FloatArray:
        """One-step error on validation data."""
        return self.model.variance[0]

    @property
    def input_mean(self) -> FloatArray:
        """Of the training regressors."""
        return self.model.input_mean

    @property
    def input_scale(self) -> FloatArray:
        """Of the training regressors."""
        return self.model.input_scale

    def expressions(
        self,
        z: Expr,
        which: Iterable[str],
        *,
        noise: bool | str = False,
        weights: Expr | None = None,
    ) -> dict[str, Expr]:
        """Mean and its Jacobian; variance, its Jacobian and distance are zero. Raises
        `UnknownNameError`."""
        wanted, n, m = set(which), len(self.outputs), len(self.inputs)
        for name in wanted - set(QUANTITIES):
            raise UnknownNameError("quantity", name, QUANTITIES)
        if weights is not None:
            raise ModelError("the weights of a network cannot change at run time")
        out = {
            "variance": ca.DM.zeros(n),
            "variance_jacobian": ca.DM.zeros(n, m),
            "distance": ca.DM(0.0),
            "mean": self.model.function()(z),
        }
        if "mean_jacobian" in wanted:
            out["mean_jacobian"] = ca.jacobian(out["mean"], z)
        return {k: v for k, v in out.items() if k in wanted}


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictorModel:
    """A predictor in innovation form: `form`, its learned part, cov(e) = `noise` (n_e, n_e),
    sample time `dt` [s].

    `kind` is the manifest's word for it, `domain` the training range of signals by name,
    `reference` = (x, u) a typical point (u with exogenous inputs, in the form's order).
    """

    name: str
    kind: str
    form: InnovationForm
    learned: Learned | None
    noise: FloatArray
    dt: float
    domain: Mapping[str, tuple[float, float]]
    reference: tuple[FloatArray, FloatArray]
    trained_on: tuple[str, ...] = ()


def predictor_model(
    fitted: object, *, dt: float | None = None, name: str | None = None
) -> PredictorModel:
    """What is fitted as a `PredictorModel`; `dt` [s] is needed where the model does not know its
    own sample time.

    Raises `ModelError` for a thing of another kind, another `dt` than its own, or none.
    """
    if isinstance(fitted, PredictorModel):
        return fitted
    if isinstance(fitted, OutputHybrid):
        return _hybrid(fitted, dt)
    if isinstance(fitted, BasePredictor):
        return _base(fitted, dt)
    if isinstance(fitted, (NARXModel, LSTMModel)):
        return _lagged(fitted, dt)
    if isinstance(fitted, (GPPosterior, GaussianProcess)):
        return _alone(fitted, dt, name)
    raise ModelError(
        f"cannot export a {type(fitted).__name__}",
        expected="a model of fit, learn or linear, an output hybrid, NARX, LSTM or GP",
        fix="fit it, or load a model file",
    )


def _time(own: float | None, dt: float | None, what: str) -> float:
    if own is None and dt is None:
        raise ModelError(
            f"{what} does not know its sample time", fix="give it: --dt 0.01 (in Python dt=0.01)"
        )
    if own is not None and dt is not None and abs(own - dt) > 1e-9 * own:
        raise ModelError(f"{what} is a discrete model", expected=f"dt = {own:g} s", got=f"{dt:g} s")
    return float(own if own is not None else dt or 0.0)


def _ranges(learned: Learned) -> dict[str, tuple[float, float]]:
    """Training ranges of the features and, from their lags, of the columns themselves."""
    out: dict[str, tuple[float, float]] = {}
    for n, low, high in zip(
        learned.inputs.names, learned.domain.lower.tolist(), learned.domain.upper.tolist()
    ):
        out[n] = (low, high)
        column, _, late = n.partition("[")
        if late and column not in out:
            out[column] = (low, high)
    return out


def _reference(
    form: InnovationForm, typical: Mapping[str, float], x: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    state = form.reference(typical) if x is None else x
    inputs = [typical.get(n, typical.get(f"{n}[t-1]", 0.0)) for n in form.inputs.names]
    return state, np.array(inputs)


def _typical(learned: Learned | None) -> dict[str, float]:
    return {} if learned is None else dict(zip(learned.inputs.names, learned.input_mean.tolist()))


def _base_state(form: BaseForm, typical: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    """The base's own reference, the lags and errors beside it."""
    _, inputs = _reference(form, typical)
    own, known = form.base.reference
    inputs = np.array([known.get(n, v) for n, v in zip(form.inputs.names, inputs.tolist())])
    command = [
        sum(w * inputs[form.inputs[c]] for w, c in form.base.terms(n))
        for n in form.base.dynamics.inputs.names
    ]
    state = form.sampled.extended(own, np.array(command))[0]
    rest = form.states.names[len(state) :]
    lags = [typical.get(n, 0.0) for n in rest]
    return np.concatenate([state, lags]), inputs


def _base(base: BasePredictor, dt: float | None) -> PredictorModel:
    """A linear or physical model alone, driven by columns of the log."""
    form = BaseForm(base=base)
    form.check()
    return PredictorModel(
        name=str(base.model.name),
        kind=base.kind,
        form=form,
        learned=None,
        noise=base.gain[1],
        dt=_time(base.dt, dt, str(base.model.name)),
        domain=base.model.domain,
        reference=_base_state(form, {}),
    )


def _hybrid(hybrid: OutputHybrid, dt: float | None) -> PredictorModel:
    """The paper's hybrid; its base alone where nothing was learned. What is left of the innovations
    that the GP foretells is its noise."""
    if not any(hybrid.posterior.active):
        return _base(hybrid.base, dt)
    base, learned = hybrid.base, hybrid.posterior
    form = BaseForm(base=base, looked_at=tuple(learned.inputs.names))
    form.check()
    return PredictorModel(
        name=hybrid.name,
        kind="output-hybrid",
        form=form,
        learned=learned,
        noise=foretold_covariance(base, learned),
        dt=_time(base.dt, dt, hybrid.name),
        domain={**base.model.domain, **_ranges(learned)},
        reference=_base_state(form, _typical(learned)),
        trained_on=base.model.trained_on,
    )


def _lagged(model: NARXModel | LSTMModel, dt: float | None) -> PredictorModel:
    """NARX or LSTM on its regressors."""
    network = isinstance(model, LSTMModel)
    learned: Learned = NetworkPart(model=model) if isinstance(model, LSTMModel) else model.posterior
    kind = "lstm" if network else "narx"
    # The network's own function adds the last output where it learned increments.
    form = LagForm(label=kind, lags=model.lags, increments=model.increments and not network)
    return PredictorModel(
        name=kind,
        kind=kind,
        form=form,
        learned=learned,
        noise=np.diag(learned.noise),
        dt=_time(model.dt, dt, f"a {kind.upper()} model"),
        domain=_ranges(learned),
        reference=_reference(form, _typical(learned)),
    )


def _alone(gp: GPPosterior | GaussianProcess, dt: float | None, name: str | None) -> PredictorModel:
    """A Gaussian process of its inputs; it knows no time, and its sample time is 1 s unless
    given."""
    form = StaticForm(label=name or "gp", arguments=gp.inputs, results=gp.outputs)
    return PredictorModel(
        name=form.name,
        kind="gp",
        form=form,
        learned=gp,
        noise=np.diag(gp.noise),
        dt=1.0 if dt is None else float(dt),
        domain=_ranges(gp),
        reference=_reference(form, _typical(gp)),
    )


# -------------------- files


def read_model(path: str | os.PathLike[str], *, effects: Iterable[Effect] = ()) -> Fitted:
    """Any file of a fitted thing: what `write_bundle` takes. Raises `FileFormatError` for a file
    of another kind."""
    data = read_json(path)
    schema = data.get("schema")
    if schema == LINEAR:
        return LinearModel.load(path)
    if schema == MANY_LINEAR:
        models, inputs, _, _ = read_linear(path)
        model, channels = combined(models, {s.name: s.terms for s in inputs})
        return LinearPredictor(model=model, outputs=model.outputs.names, channels=channels)
    if schema == MODEL:
        return (
            OutputHybrid.load(path, effects=effects)
            if data.get("kind") == KIND
            else load_model(path, effects=effects)
        )
    known: dict[str, Callable[[str | os.PathLike[str]], Fitted]] = {
        lstm.SCHEMA: LSTMModel.load,
        narx.SCHEMA: NARXModel.load,
        posterior.SCHEMA: GPPosterior.load,
        gaussian_process.SCHEMA: GaussianProcess.load,
    }
    if schema not in known:
        raise FileFormatError(
            "not a fitted model",
            where=str(path),
            expected=", ".join((MODEL, *LINEAR_SCHEMAS, *known)),
            got=repr(schema),
            fix="pass model.json, hybrid.json, or what save() of a NARX, LSTM or GP wrote",
        )
    return known[schema](path)
