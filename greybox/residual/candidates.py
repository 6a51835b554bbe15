"""What competes to be learned: Gaussian processes of every set of features, or what another learner
offers.

Their weights are still open; `greybox.residual.open_loop_fit` fits and judges them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from greybox.errors import GreyboxError, ModelError
from greybox.residual.discrepancy import Discrepancy
from greybox.residual.feature_posterior import FeaturePosterior, silent_features
from greybox.residual.kept import trained_once
from greybox.residual.kernels import Kernel
from greybox.residual.learners import Learner, LooksBack
from greybox.residual.learners.learner import Features, is_centred, is_ensemble
from greybox.residual.posterior import Domain, GPPosterior
from greybox.residual.selection import place_points
from greybox.residual.train import train_gp
from greybox.residual.training_report import TrainedGP, TrainingDocument
from greybox.residual.weight_space import Candidate
from greybox.statistics.spread import spread_of
from greybox.symbolic import BoolArray, FloatArray, evaluate

BROAD = 3.0
"""Length-scale of the broad kernel in standard deviations of a feature; its linear part reaches
twice as far."""
SUBSET = 300
"""Rows of the exact marginal likelihood. It only shapes kernels: weights and judgement come from
multi-step errors."""
SLOPES = 200
"""Rows at which the slopes of a learner's features are looked at."""
Say = Callable[[str, float], None]


def gp_candidates(
    sets: Mapping[str, Discrepancy], *, kernel: str, points: int | str, seed: int, say: Say
) -> tuple[dict[str, GPPosterior], list[TrainingDocument]]:
    """Of every set of features a process by marginal likelihood and one with a broad kernel, and
    how they were trained."""
    labels = list(sets)

    def trained(label: str) -> TrainedGP:
        say(f"marginal likelihood: {label}", labels.index(label) / len(sets))
        seen = sets[label]
        return train_gp(
            seen.z,
            seen.y,
            inputs=seen.inputs,
            outputs=seen.outputs,
            kernel=kernel,
            points=points,
            seed=seed,
            groups=seen.flights,
            noise_inflation=1.0,
            hold_out=0.25 if points == "auto" else 0.0,
            subset=SUBSET,
        )

    found: dict[str, GPPosterior] = {}
    reports: list[TrainingDocument] = []
    for label, (posterior, report) in zip(labels, trained_once(labels, trained), strict=True):
        reports.append({"candidate": label, **report})
        size = posterior.points if points == "auto" else int(points)
        if any(posterior.active):
            found[f"{label}, marginal likelihood"] = posterior
        found[f"{label}, broad kernel"] = broad_posterior(sets[label], points=size, seed=seed)
    return found, reports


@dataclass(frozen=True, kw_only=True, eq=False)
class FeatureMaker:
    """What a learner offers for every set of features; also made again from some of the rows."""

    learner: Learner
    sets: Mapping[str, Discrepancy]
    points: int
    seed: int

    @property
    def flights(self) -> tuple[str, ...]:
        """Flight of every row."""
        return next(iter(self.sets.values())).flights

    def candidates(self, say: Say) -> dict[str, Candidate]:
        """Every candidate by its name. Raises `ModelError` (as `feature_candidates`; none at
        all)."""
        found: dict[str, Candidate] = {}
        for i, (label, seen) in enumerate(self.sets.items()):
            say(f"{self.learner.name}: {label}", i / len(self.sets))
            offered = feature_candidates(self.learner, seen, points=self.points, seed=self.seed)
            found |= {f"{label}, {name}": made for name, made in offered.items()}
        if not found:
            raise ModelError(
                f"the learner {self.learner.name} offers no features", fix="another --learner"
            )
        return found

    def again(self, label: str, rows: BoolArray) -> FeaturePosterior | None:
        """The candidate of this name from `rows` (N,) alone."""
        of = next(n for n in sorted(self.sets, key=len, reverse=True) if label.startswith(f"{n}, "))
        offered = feature_candidates(
            self.learner,
            self.sets[of].take(rows),
            points=self.points,
            seed=self.seed,
            scaled_as=self.sets[of],
        )
        return offered.get(label.removeprefix(f"{of}, "))


def feature_candidates(
    learner: Learner,
    seen: Discrepancy,
    *,
    points: int,
    seed: int,
    scaled_as: Discrepancy | None = None,
) -> dict[str, FeaturePosterior]:
    """What a learner offers for the rows of `seen`, ready for `fit_open_loop`; inputs and outputs
    in units of the spread of `scaled_as` (default `seen`).

    Raises `ModelError` for features that are no column or not finite on the rows, and for a learner
    that fails.
    """
    of = scaled_as or seen
    middle = of.z.mean(axis=0) if is_centred(learner) else np.zeros(of.z.shape[1])
    spread, size = spread_of(of.z), spread_of(of.y)
    x = (seen.z - middle) / spread
    told = learner.of(seen.inputs.names) if isinstance(learner, LooksBack) else learner
    try:
        offered = dict(told.features(x, seen.y / size, points=points, seed=seed))
        columns = {label: _column(made, x.shape[1]) for label, made in offered.items()}
    except GreyboxError:
        raise
    except Exception as error:  # a user's own code may raise anything
        raise ModelError(
            f"the learner {learner.name} failed: {type(error).__name__}: {error}",
            expected="features(x, y, points, seed) -> {name: column of a CasADi column}",
            fix="see docs/own_learner.md",
        ) from None
    out: dict[str, FeaturePosterior] = {}
    members = len(columns) if is_ensemble(learner) else 1
    if members > 1:
        columns = {f"ensemble of {members}": _side_by_side(learner, list(columns.values()))}
    for label, phi in columns.items():
        if phi.size2_out(0) != 1 or not phi.numel_out(0):
            raise ModelError(
                f"learner {learner.name}: {label} is no column",
                expected="(M, 1)",
                got=str(phi.size_out(0)),
            )
        if not _finite(phi, x):
            raise ModelError(
                f"learner {learner.name}: {label} is not finite on the training flights",
                expected="finite features and slopes at standardised inputs",
                fix="bound what it divides by or takes the root of",
            )
        out[label] = silent_features(
            phi,
            method=learner.name,
            inputs=seen.inputs,
            outputs=seen.outputs,
            input_mean=middle,
            input_scale=spread,
            output_scale=size,
            members=members,
            domain=Domain(lower=of.z.min(axis=0), upper=of.z.max(axis=0), samples=len(of.z)),
        )
    return out


def _column(made: Features, inputs: int) -> ca.Function:
    """The features as a CasADi function of standardised inputs."""
    s = ca.SX.sym("x", inputs)
    return ca.Function("phi", [s], [ca.densify(ca.SX(made(s)))])


def _finite(phi: ca.Function, x: FloatArray) -> bool:
    """Whether features are finite at all rows x (N, n_in), and their slopes at some of them and in
    the middle."""
    s = ca.SX.sym("x", x.shape[1])
    slope = ca.Function("slope", [s], [ca.densify(ca.vec(ca.jacobian(phi(s), s)))])
    some = np.vstack([np.zeros(x.shape[1]), x[:: max(1, len(x) // SLOPES)]])
    return bool(np.isfinite(evaluate(phi, x)).all() and np.isfinite(evaluate(slope, some)).all())


def _side_by_side(learner: Learner, members: list[ca.Function]) -> ca.Function:
    """The features of all members of an ensemble as one column. Raises `ModelError` where they are
    not alike."""
    sizes = sorted({phi.numel_out(0) for phi in members})
    if len(sizes) > 1:
        raise ModelError(
            f"learner {learner.name}: members of an ensemble of different size",
            expected="as many features each",
            got=" and ".join(map(str, sizes)),
        )
    s = ca.SX.sym("x", members[0].numel_in(0))
    return ca.Function("phi", [s], [ca.vertcat(*(phi(s) for phi in members))])


def broad_posterior(seen: Discrepancy, *, points: int, seed: int) -> GPPosterior:
    """A Gaussian process with a broad linear-plus-SE kernel, ready for `fit_open_loop` (its weights
    are still zero)."""
    mean, scale, size = seen.z.mean(axis=0), spread_of(seen.z), spread_of(seen.y)
    n_in, n_out = seen.z.shape[1], seen.y.shape[1]
    kernel = Kernel(
        family="se",
        lengthscales=np.full(n_in, BROAD),
        variance=1.0,
        slopes=np.ones(n_in),
        reach=np.full(n_in, 2 * BROAD),
    )
    x = (seen.z - mean) / scale
    support = place_points([kernel] * n_out, np.full(n_out, 0.1), x, points, seed=seed)
    m = len(support)
    return GPPosterior(
        inputs=seen.inputs,
        outputs=seen.outputs,
        method="svgp",
        kernels=(kernel,) * n_out,
        input_mean=mean,
        input_scale=scale,
        output_mean=np.zeros(n_out),
        output_scale=size,
        support=support,
        weights=np.zeros((m, n_out)),
        explained=np.zeros((n_out, m, m)),
        uncertain=np.zeros((n_out, m, m)),
        noise=size**2,
        domain=Domain(lower=seen.z.min(axis=0), upper=seen.z.max(axis=0), samples=len(x)),
    )
