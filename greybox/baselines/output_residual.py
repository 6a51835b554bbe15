"""The paper's output residual: a Gaussian process on r(t) = y(t) - y_PEM(t|t-1), for linear and
physical models.

Ghoul, Bousserhane and Boufeldja 2026 (IJCAS 24(8), phase 2) learn r from z = [phi, theta, psi, p,
q, r, u1..u4] of time t, which hold the measurement that is to be predicted. Here z holds what is
known before it: the predicted state or outputs (t|t-1), attitude and commands one sample old. The
command that begins at t may be named (`u1[t]`); a flight controller computes it from y(t), so that
it gives the noise of y(t) away, and it is left out by default. So is psi: nothing that flies in
free air feels where north is.

Where errors are correlated in time (sensors with memory, resampled packets) the model's own last
errors foretell more than anything else: `error.ax[t-1]`. r is the mean of the next innovation. In a
free run it therefore moves the state as a measured innovation would
(`greybox.baselines.innovation_ahead`).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np
import numpy.typing as npt

from greybox.baselines.as_predictor import LINEAR_SCHEMAS, as_predictor, from_dict
from greybox.baselines.base_predictor import Base, BasePredictor
from greybox.baselines.decoupled import Terms
from greybox.baselines.innovation_ahead import run_with_spread
from greybox.baselines.output_learner import fit_features
from greybox.baselines.predictor_features import features_of, layout_of
from greybox.baselines.regressors import segments_of
from greybox.data import Dataset, Segment
from greybox.errors import DataError, FileFormatError, ModelError
from greybox.files import Json, checksum, read_json, to_plain, well_formed, write_json
from greybox.linear.logs import ChannelSpec, parse_channels
from greybox.model.effect import Effect
from greybox.model.identified import SCHEMA, library_versions
from greybox.model.linear import LinearModel
from greybox.residual.discrepancy import Discrepancy
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.learners import GP, Learner, LooksBack, learner_for
from greybox.residual.left_out import judged_on_left_out
from greybox.residual.options import GPChoices, GPOptions
from greybox.residual.posterior import GPPosterior
from greybox.residual.training_report import TrainingDocument
from greybox.residual.weight_space import Candidate, called, learned_numbers, read_part, written
from greybox.shown import Row, Shown
from greybox.symbolic import FloatArray, Layout, Signal

KIND = "output-hybrid"


class HybridReport(TypedDict, total=False):
    """How an output residual was trained; empty where nobody said."""

    settings: dict[str, Json]
    seed: int
    samples: int
    training: TrainingDocument


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class OutputHybrid(Shown):
    """`base` plus `posterior` on its one-step errors: a Gaussian process, or another learner's
    features. Plain numbers, no torch.

    The posterior's outputs are those of `base`, its inputs features of
    `greybox.baselines.predictor_features`. Raises `ModelError`.
    """

    base: BasePredictor
    posterior: Candidate
    train_seconds: float = 0.0
    report: HybridReport = field(default_factory=HybridReport)

    def __post_init__(self) -> None:
        if self.posterior.outputs.names != self.base.outputs:
            raise ModelError(
                "the learned part does not foretell the errors of this model",
                expected=", ".join(self.base.outputs),
                got=", ".join(self.posterior.outputs.names),
            )
        layout_of(self.base, self.posterior.inputs.names)

    def _shown_text(self) -> str:
        """What it is, and its learned part."""
        return f"{self.name}: foretells {', '.join(self.outputs)}\n{self.posterior._shown_text()}"

    def _shown_rows(self) -> Sequence[Row]:
        """That of the learned part."""
        return self.posterior._shown_rows()

    @property
    def name(self) -> str:
        """Name of the base model and what was learned."""
        return f"{self.base.model.name} + output {called(self.posterior)}"

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the predicted channels."""
        return self.base.outputs

    @property
    def features(self) -> tuple[str, ...]:
        """Names of what the learned part looks at."""
        return self.posterior.inputs.names

    @cached_property
    def parameters(self) -> int:
        """Those of the base, hyper-parameters, support points and weights."""
        gp = self.posterior
        if isinstance(gp, FeaturePosterior):
            return self.base.parameters + learned_numbers(gp)
        kernels = {id(k): k for k in gp.kernels}
        own = (
            sum(len(k.lengthscales) + 1 for k in kernels.values())
            + gp.noise.size
            + gp.support.size
            + gp.weights.size
        )
        return self.base.parameters + own

    def one_step(self, segment: Segment) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (n, n_o), noise included, of every sample from what is known before
        it; NaN where too little is (starts, holes in the features, the seconds that were adapted
        on)."""
        run = self.base.run(segment)
        z = features_of(self.base, segment, run, self.features)
        whole = np.isfinite(z).all(axis=1) & run.known
        mean, variance = np.full((2, segment.n, len(self.outputs)), np.nan)
        if whole.any():
            added, variance[whole] = self.posterior.evaluate(z[whole], noise=True)
            mean[whole] = run.mean[whole] + added
        return mean, variance

    def free_run(
        self, segment: Segment, origins: npt.ArrayLike, horizon: int
    ) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, horizon, n_o) of the samples k+1 .. k+horizon from every origin k;
        recorded commands."""
        return run_with_spread(self.base, segment, origins, horizon, self.posterior)

    def unadapted(self) -> OutputHybrid:
        """The same without adaptation to the flight."""
        return replace(self, base=self.base.unadapted())

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write one JSON file, atomically: schema "greybox.model/1", kind "output-hybrid". Raises
        `ModelError` for a base that is not made of catalogue parts."""
        base = self.base
        content: dict[str, object] = {
            "schema": SCHEMA,
            "kind": KIND,
            "name": self.name,
            **base.to_dict(),
            **written(self.posterior),
            "train_seconds": self.train_seconds,
            "report": {**self.report},
        }
        body = to_plain(content)
        return write_json(
            path, {**body, "versions": library_versions(), "checksum": checksum(body)}
        )

    @staticmethod
    def load(path: str | os.PathLike[str], *, effects: Iterable[Effect] = ()) -> OutputHybrid:
        """Read what `save` wrote; `effects` are those that are not in the catalogue. Raises
        `FileFormatError`."""
        where = str(path)
        data = read_json(path, schema=SCHEMA)
        if data.get("kind") != KIND:
            raise FileFormatError(
                "not an output hybrid",
                where=where,
                expected=KIND,
                got=repr(data.get("kind")),
                fix="read it with greybox.load",
            )
        body = {k: v for k, v in data.items() if k not in ("checksum", "versions")}
        if data.get("checksum") != checksum(body):
            raise FileFormatError(
                "the checksum does not fit", where=where, fix="the file was edited; write it again"
            )
        with well_formed(where):
            base = from_dict(body, where=where, effects=effects)
            return OutputHybrid(
                base=base,
                posterior=read_part(body),
                train_seconds=float(body["train_seconds"]),
                report=body["report"],
            )


def output_features(
    base: BasePredictor, channels: Iterable[str], learner: Learner | None = None
) -> tuple[str, ...]:
    """The default features: the predicted outputs of a linear model, or the motion and rotors of a
    physical one; roll and pitch; commands. Attitude and commands are one sample old; a `learner`
    that looks back has the commands before that, too. `channels` are those of the log."""
    there = set(channels)
    angles = tuple(
        f"{a}[t-1]" for a in ("phi", "theta") if {"qw", "qx", "qy", "qz"} <= there or a in there
    )
    commands = tuple(f"{c}[t-1]" for c in base.commands)
    earlier: tuple[str, ...] = ()
    if isinstance(learner, LooksBack):
        lags = range(2, learner.lags(base.dt) + 2)
        earlier = tuple(f"{c}[t-{k}]" for k in lags for c in base.commands)
    return base.default_features(angles, commands, earlier)


def residual_rows(
    base: BasePredictor, data: Dataset | Segment | Sequence[Segment], names: Sequence[str]
) -> tuple[FloatArray, FloatArray, npt.NDArray[np.str_]]:
    """(features (N, n_z), one-step errors (N, n_o), flight of each row (N,)) of all complete
    samples. Raises `DataError`.

    The first seconds, in which a model forgets its start, are left out.
    """
    z, r, flights = [], [], []
    for segment in segments_of(data):
        run = base.run(segment)
        rows = features_of(base, segment, run, names)
        errors = segment.matrix(base.outputs) - run.mean
        whole = np.asarray(np.isfinite(rows).all(axis=1) & np.isfinite(errors).all(axis=1))
        whole[: min(round(base.run_in / segment.dt), segment.n // 3)] = False
        z.append(rows[whole])
        r.append(errors[whole])
        flights.append(np.full(int(whole.sum()), segment.flight))
    if not z or not sum(map(len, z)):
        raise DataError(
            "no sample with all features and outputs", expected=", ".join((*names, *base.outputs))
        )
    return np.concatenate(z), np.concatenate(r), np.concatenate(flights)


def with_measured_noise(posterior: GPPosterior, z: FloatArray, y: FloatArray) -> GPPosterior:
    """The posterior with the noise (n_out,) that all rows z (N, n_in), y (N, n_out) show: their
    mean squared error.

    The marginal likelihood of a few hundred rows is too rough a measure of errors with heavy tails.
    The factor N/(N - M) is for the M weights fitted to the same rows. Outputs that nothing was
    learned of keep theirs.
    """
    e = y - posterior.evaluate_mean(z)
    lost = min(posterior.points, len(z) // 2)
    measured = np.mean(e**2, axis=0) * len(z) / (len(z) - lost)
    return replace(
        posterior, noise=np.where(posterior.active, measured, posterior.noise), group_noise={}
    )


def fit_output_residual(
    model: Base | Sequence[LinearModel] | BasePredictor,
    train: Dataset | Segment | Sequence[Segment],
    *,
    outputs: Sequence[str] = (),
    channels: Mapping[str, Terms] | None = None,
    features: Sequence[str] | None = None,
    adapt: float | None = None,
    learner: str | Learner = GP,
    progress: Callable[[str, float], None] | None = None,
    **choices: Unpack[GPChoices],
) -> OutputHybrid:
    """Learn the one-step errors of `model` (decoupled linear models: several) on the flights of
    `train`.

    `outputs`, `channels` and `adapt` are those of `as_predictor`; `features` default to
    `output_features`; the choices (`kernel`, `points`, `seed`, `hold_out`, ...) are those of
    `train_gp`, of which another `learner` (as in `greybox.residual.learn.learn`) knows `points` and
    `seed`. Raises `DataError`, `UnknownNameError`, `ModelError`; svgp and polish
    `MissingExtraError` without the extra `gp`.
    """
    options = GPOptions.of(GPOptions(noise_inflation=1.0), choices)
    other = learner_for(learner, options.points, options.kernel)
    began = time.perf_counter()
    base = as_predictor(model, outputs=outputs, channels=channels, adapt=adapt)
    rows = _errors(base, segments_of(train), features, other)
    posterior: Candidate
    if other is None:
        posterior, training = _process(base, rows, options, progress)
    else:
        posterior, training = _learned(base, rows, other, options)
    settings: dict[str, Json] = {
        "features": list(rows.inputs.names),
        "learner": GP if other is None else other.name,
        "points": options.points,
    }
    settings |= {"kernel": options.kernel} if other is None else {}
    return OutputHybrid(
        base=base,
        posterior=posterior,
        train_seconds=time.perf_counter() - began,
        report={
            "settings": settings,
            "seed": options.seed,
            "samples": len(rows.z),
            "training": training,
        },
    )


def _errors(
    base: BasePredictor,
    segments: Sequence[Segment],
    features: Sequence[str] | None,
    learner: Learner | None,
) -> Discrepancy:
    """One-step errors of `base` over its features, by default those that all segments have."""
    common = (
        [n for n in segments[0].names if all(n in s.channels for s in segments)] if segments else []
    )
    names = tuple(features) if features is not None else output_features(base, common, learner)
    inputs = layout_of(base, names)
    z, r, flights = residual_rows(base, segments, names)
    units = {s.name: s.unit for s in base.dynamics.outputs}
    return Discrepancy(
        inputs=inputs,
        outputs=Layout([Signal(name=n, unit=units[n]) for n in base.outputs]),
        z=z,
        y=r,
        flights=tuple(flights.tolist()),
    )


def _process(
    base: BasePredictor,
    rows: Discrepancy,
    options: GPOptions,
    progress: Callable[[str, float], None] | None,
) -> tuple[GPPosterior, TrainingDocument]:
    """A Gaussian process on the errors, judged, and how it was trained."""
    from greybox.residual.train import train_gp

    trained = train_gp(
        rows.z,
        rows.y,
        inputs=rows.inputs,
        outputs=rows.outputs,
        options=options,
        groups=np.array(rows.flights),
        progress=progress,
    )
    _, numbers = np.unique(rows.flights, return_inverse=True)
    posterior, scores = judged_on_left_out(trained.posterior, rows.z, rows.y, numbers, _own(base))
    return posterior, {
        **trained.report.to_dict(),
        "left_out": dict(zip(base.outputs, scores, strict=True)),
        "warnings": [
            *trained.report.warnings,
            *_refused(base.outputs, trained.posterior.active, posterior),
        ],
    }


def _learned(
    base: BasePredictor, rows: Discrepancy, learner: Learner, options: GPOptions
) -> tuple[FeaturePosterior, TrainingDocument]:
    """Another learner's features on the errors, judged, and how they were fitted."""
    found = fit_features(learner, rows, _own(base), points=int(options.points), seed=options.seed)
    return found.posterior, {
        "chosen": found.chosen,
        "candidates": dict(found.candidates),
        "left_out": dict(zip(base.outputs, found.scores, strict=True)),
        "warnings": _refused(base.outputs, (True,) * len(base.outputs), found.posterior),
    }


def _own(base: BasePredictor) -> FloatArray:
    """Variances (n_o,) that a model states for its one-step errors."""
    return np.asarray(np.diag(base.gain[1])[base.rows])


def _refused(outputs: Sequence[str], before: Sequence[bool], posterior: Candidate) -> list[str]:
    """What is to be said of the outputs that the left-out flights switched off."""
    what = posterior.method if isinstance(posterior, FeaturePosterior) else "GP"
    return [
        f"{n}: left-out flights do not prefer the {what} to the model alone, which stays as it was"
        for n, was, on in zip(outputs, before, posterior.active, strict=True)
        if was and not on
    ]


def read_linear(
    path: str | os.PathLike[str], *, channels: str | None = None
) -> tuple[
    tuple[LinearModel, ...], tuple[ChannelSpec, ...], tuple[ChannelSpec, ...], tuple[str, ...]
]:
    """(models, input channels, output channels, flights fitted to) of a file that `greybox linear`
    wrote.

    What sums of columns the channels are stands in fit.json beside the file; `channels`
    ("roll=u4+u3-u2-u1,...") goes before it. A channel that neither names is the column of its own
    name. Raises `FileFormatError`, `DataError`.
    """
    where = str(path)
    data = read_json(path)
    if data.get("schema") not in LINEAR_SCHEMAS:
        raise FileFormatError(
            "not a linear model",
            where=where,
            expected=" or ".join(LINEAR_SCHEMAS),
            got=repr(data.get("schema")),
        )
    parts = data["models"] if data["schema"] == LINEAR_SCHEMAS[1] else [data]
    models = tuple(LinearModel.from_dict(m, where=where) for m in parts)
    told = {s.name: s for s in parse_channels(channels or "", "inputs")}
    trained: tuple[str, ...] = ()
    beside = Path(path).with_name("fit.json")
    if beside.exists() and beside != Path(path):
        fit = read_json(beside)
        if fit.get("schema") == "greybox.linear_fit/1":
            trained = tuple(t["name"] for t in fit["train"])
            for c in (*fit["inputs"], *fit["outputs"]):
                terms = tuple((float(w), str(n)) for w, n in c["terms"])
                told.setdefault(c["name"], ChannelSpec(name=c["name"], terms=terms))

    def specs(names: Iterable[str]) -> tuple[ChannelSpec, ...]:
        return tuple(
            told.get(n, ChannelSpec(name=n, terms=((1.0, n),))) for n in dict.fromkeys(names)
        )

    return (
        models,
        specs(n for m in models for n in m.inputs.names),
        specs(n for m in models for n in m.outputs.names),
        trained,
    )
