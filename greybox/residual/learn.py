"""learn: from an identified model and its training flights to a hybrid model with calibrated uncertainty.

1. Disturbance states take up what the physics misses (fitted, where the model has none); smoothing gives its time series.
2. Candidate Gaussian processes: every set of features, with hyper-parameters by marginal likelihood (GPyTorch) on the
   smoothed discrepancy, and with a broad kernel that knows nothing but the scales of the data.
3. Their weights are fitted by multi-step prediction errors; the candidate and the strength of its prior are those that
   lower the errors of left-out flights most. Where none does, the result is the physics alone and says so.
4. The filter's noise levels are refitted with the learned part in place, and the growth of the uncertainty over the
   horizon is calibrated on the training flights.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from greybox.data import Dataset
from greybox.errors import ModelError, UnknownNameError
from greybox.model.identified import IdentifiedModel, library_versions
from greybox.model.layer import physics_of
from greybox.residual.discrepancy import Discrepancy, discrepancy, disturbed_model
from greybox.residual.feature_posterior import silent_features
from greybox.residual.features import available, default_features
from greybox.residual.hybrid import HybridModel
from greybox.residual.kernels import Kernel, split_name
from greybox.residual.learners import GP, Learner, learner_of
from greybox.residual.noise_levels import refit_noise
from greybox.residual.open_loop_fit import OpenLoopFit, fit_open_loop
from greybox.residual.posterior import Domain, GPPosterior
from greybox.residual.selection import place_points
from greybox.residual.train import check_extra, train_gp
from greybox.residual.weight_space import Candidate
from greybox.shown import Cell, Shown
from greybox.symbolic import evaluate
from greybox.validation.calibration import Calibration, calibrate_horizons

Progress = Callable[[str, float], None]
BROAD = 3.0
"""Length-scale of the broad kernel in standard deviations of a feature; its linear part reaches twice as far."""
SUBSET = 300
"""Rows of the exact marginal likelihood. It only shapes kernels: weights and judgement come from multi-step errors."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Learned(Shown):
    """The hybrid `model` (the physics with its disturbance states, where nothing could be learned: `null`), and how:
    the open-loop fit, the candidates with their share of held-out cost saved, the calibration factors, seconds."""

    model: IdentifiedModel
    base: IdentifiedModel
    null: bool
    fit: OpenLoopFit
    candidates: Mapping[str, float]
    chosen: str
    calibration: Calibration
    seconds: float
    training: tuple[Mapping[str, Any], ...]

    def to_dict(self) -> dict[str, Any]:
        """As in learn.json, schema "greybox.learn/1"."""
        posterior = self.fit.posterior
        return {
            "schema": "greybox.learn/1",
            "model": self.model.name,
            "kind": "dynamics",
            "null": self.null,
            "candidates": [{"name": n, "held_out_gain": g} for n, g in self.candidates.items()],
            "chosen": self.chosen,
            "features": list(posterior.inputs.names),
            "outputs": [
                {"name": s.name, "unit": s.unit, "learned": bool(np.isfinite(self.fit.strengths[s.name]))}
                for s in posterior.outputs
            ],
            "points": posterior.points,
            "fit": {
                "status": self.fit.status, "iterations": self.fit.iterations, "cost_before": self.fit.cost_before,
                "cost_after": self.fit.cost_after, "held_out_gain": self.fit.held_out_gain,
                "strengths": {n: s if np.isfinite(s) else None for n, s in self.fit.strengths.items()},
            },
            "calibration": {
                "factors": dict(self.calibration.factors), "learned": self.calibration.learned,
                "gain": self.calibration.gain, "new_flight": self.calibration.new_flight,
            },
            "training": [dict(t) for t in self.training],
            "trained_on": list(self.model.trained_on),
            "data_hash": self.model.data_hash,
            "seconds": self.seconds,
            "warnings": [],
            "versions": library_versions(),
        }  # fmt: skip

    def _shown_text(self) -> str:
        """The summary."""
        return self.summary()

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per candidate: the share of its held-out cost that it saves."""
        return [
            {"candidate": n, "saved on left-out flights": g, "chosen": n == self.chosen}
            for n, g in self.candidates.items()
        ]

    def summary(self) -> str:
        """What was learned, as text."""
        saved = 1 - self.fit.cost_after / self.fit.cost_before if self.fit.cost_before else 0.0
        lines = [
            "nothing was learned: no candidate lowers the multi-step errors of flights it has not seen"
            if self.null
            else f"learned {', '.join(n for n, s in self.fit.strengths.items() if np.isfinite(s))} from {self.chosen}"
        ]
        if not self.null:
            lines.append(
                f"multi-step cost: {saved:.1%} lower on the training flights, {self.fit.held_out_gain:.1%} on left-out ones"
            )
        lines += [f"  candidate {n}: {g:+.2%} on left-out flights" for n, g in self.candidates.items()]
        factors = ", ".join(f"{n} x {f:.2f}" for n, f in self.calibration.factors.items())
        lines.append(
            f"uncertainty ahead, process noise: {factors}; learned part x {self.calibration.learned:.2f}; of this for "
            f"flights not seen: x {self.calibration.new_flight:.2f}"
        )
        return "\n".join(lines)


def feature_sets(model: IdentifiedModel, *, place: bool = False) -> dict[str, tuple[str, ...]]:
    """Sets of features to try, by name: body velocity, motion, motion with the direction of gravity, with the rotors; on
    request the `place` alone and with the motion. Of a model that is not a vehicle's: its states, and states with inputs.
    Raises `ModelError` for the place where no position is measured."""
    full = default_features(model.dynamics)
    if physics_of(model.dynamics) is None:
        if place:
            raise ModelError("the place is a feature of vehicles", got=model.name, fix="leave place out")
        states = tuple(n for n in full if n not in model.dynamics.inputs)
        return {"states": states, "states and inputs": full} if len(model.dynamics.inputs) else {"states": states}
    motion = tuple(n for n in full if n.startswith("body_velocity.") or n in ("p", "q", "r"))
    sets = {"velocity": tuple(n for n in motion if n.startswith("body_velocity."))}
    sets |= {"motion": motion, "motion and rotors": full}
    gravity = tuple(n for n in available(model.dynamics) if n.startswith("gravity."))
    if gravity and motion:
        sets["motion and attitude"] = (*motion, *gravity)
    if place:
        if "position" not in model.sensors:
            raise ModelError("no position is measured: what depends on the place cannot be learned", fix="leave place out")
        where = tuple(f"position.{a}" for a in "xyz")
        sets |= {"place": where, "place and motion": (*where, *motion, *gravity)}
    return {n: s for n, s in sets.items() if s}


def learn(
    model: IdentifiedModel,
    train: Dataset,
    *,
    features: Sequence[str] | None = None,
    place: bool = False,
    kernel: str = "se",
    points: int | str = 50,
    learner: str | Learner = GP,
    seed: int = 0,
    progress: Progress | None = None,
) -> Learned:
    """Learn what `model` misses on the flights of `train` (those it was fitted on).

    `features` names the inputs of the Gaussian process (default: the sets of `feature_sets` compete; with `place` also those
    of what stands in the room, which do not carry over to another room). kernel: "se",
    "matern32", "matern52", or "linear+" one of these. `points`: number of support points, or "auto". `learner`: what is
    learned, "gp" or another name of `greybox.residual.learners`, a file of the user's own ("own.py:Name", which is run), or
    a `Learner`; `points` are then its features. Raises `MissingExtraError` without the extra `gp`, `UnknownNameError`,
    `DataError`, `ModelError` (a learner that returns what is not finite, too).
    """
    began = time.perf_counter()
    say = progress or (lambda _text, _share: None)
    if isinstance(model.dynamics, HybridModel):
        raise ModelError("the model has a learned part already", fix="learn from the model file of the fit")
    split_name(kernel)
    other = learner_of(learner) if isinstance(learner, str) else learner
    if other is not None and points == "auto":
        raise ModelError("points are chosen for a Gaussian process only", got=other.name, fix="give a number of points")
    if place:
        if features is not None:
            raise ModelError("place competes with other sets, features are the only one", fix="one of the two")
        feature_sets(model, place=True)
    if features is not None:
        there = available(model.dynamics)
        for n in features:
            if n not in there:
                raise UnknownNameError("feature", n, there)
    check_extra()
    say("disturbance states", 0.0)
    base = replace(disturbed_model(model, train), verdict=None)  # what is learned changes what was judged
    sets = {"the given features": tuple(features)} if features is not None else feature_sets(base, place=place)
    whole = discrepancy(base, train, tuple(dict.fromkeys(n for names in sets.values() for n in names)))
    found: dict[str, Candidate] = {}
    reports: list[Mapping[str, Any]] = []
    for i, (label, names) in enumerate(sets.items()):
        say(f"{'marginal likelihood' if other is None else other.name}: {label}", 0.1 + 0.3 * i / len(sets))
        seen = whole.select(names)
        if other is not None:
            found |= {f"{label}, {n}": c for n, c in feature_candidates(other, seen, points=int(points), seed=seed).items()}
            continue
        trained = train_gp(
            seen.z, seen.y, inputs=seen.inputs, outputs=seen.outputs, kernel=kernel, points=points, seed=seed,
            groups=seen.flights, noise_inflation=1.0, hold_out=0.25 if points == "auto" else 0.0, subset=SUBSET,
        )  # fmt: skip
        reports.append({"candidate": label, **trained.report.to_dict()})
        size = trained.posterior.points if points == "auto" else int(points)
        if any(trained.posterior.active):
            found[f"{label}, marginal likelihood"] = trained.posterior
        found[f"{label}, broad kernel"] = broad_posterior(seen, points=size, seed=seed)
    if not found:
        named = other.name if other else GP
        raise ModelError(f"the learner {named} offers no features", fix="another learner, or --learner gp")
    result, chosen, gains = fit_open_loop(base, found, train, progress=lambda text, share: say(text, 0.4 + 0.4 * share))
    null = result.status == "null"
    posterior = result.posterior
    hybrid = base
    if not null:
        say("noise levels", 0.85)
        hybrid = refit_noise(replace(base, dynamics=HybridModel(inner=base.dynamics, posterior=posterior)), train)
    say("calibration", 0.9)
    calibration = calibrate_horizons(hybrid, train, left_out=result.left_out)
    final = calibration.model
    if not null:
        posterior = posterior.with_spread(calibration.learned)
        final = replace(calibration.model, dynamics=HybridModel(inner=base.dynamics, posterior=posterior))
    return Learned(
        model=final, base=base, null=null, fit=result, candidates=gains, chosen=chosen,
        calibration=calibration, seconds=time.perf_counter() - began, training=tuple(reports),
    )  # fmt: skip


def feature_candidates(learner: Learner, seen: Discrepancy, *, points: int, seed: int) -> dict[str, Candidate]:
    """What a learner offers for the rows of `seen`, ready for `fit_open_loop`.

    Raises `ModelError` for features that are not finite on them, or not a column.
    """
    centred = bool(getattr(learner, "centred", True))
    size = np.where(seen.y.std(axis=0) > 0, seen.y.std(axis=0), 1.0)
    spread = np.where(seen.z.std(axis=0) > 0, seen.z.std(axis=0), 1.0)
    x = (seen.z - (seen.z.mean(axis=0) if centred else 0.0)) / spread
    out: dict[str, Candidate] = {}
    for label, made in learner.features(x, seen.y / size, points=points, seed=seed).items():
        s = ca.SX.sym("x", x.shape[1])
        column = ca.densify(ca.vcat([made(s)]))
        if column.shape[1] != 1 or not column.numel():
            raise ModelError(f"learner {learner.name}: {label} is no column", expected="(M, 1)", got=str(column.shape))
        phi = ca.Function("phi", [s], [column])
        if not np.isfinite(evaluate(phi, x)).all():
            raise ModelError(
                f"learner {learner.name}: {label} is not finite on the training flights",
                expected="finite features at standardised inputs", fix="bound what it divides by or takes the root of",
            )  # fmt: skip
        out[label] = silent_features(
            phi, method=learner.name, inputs=seen.inputs, outputs=seen.outputs, z=seen.z, y=seen.y, centred=centred
        )
    return out


def broad_posterior(seen: Discrepancy, *, points: int, seed: int) -> GPPosterior:
    """A Gaussian process with a broad linear-plus-SE kernel, ready for `fit_open_loop` (its weights are still zero)."""
    mean, scale = seen.z.mean(axis=0), seen.z.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    n_in, n_out = seen.z.shape[1], seen.y.shape[1]
    kernel = Kernel(
        family="se", lengthscales=np.full(n_in, BROAD), variance=1.0, slopes=np.ones(n_in),
        reach=np.full(n_in, 2 * BROAD),
    )  # fmt: skip
    x = (seen.z - mean) / scale
    support = place_points([kernel] * n_out, np.full(n_out, 0.1), x, points, seed=seed)
    m = len(support)
    size = seen.y.std(axis=0)
    size = np.where(size > 0, size, 1.0)
    return GPPosterior(
        inputs=seen.inputs, outputs=seen.outputs, method="svgp", kernels=(kernel,) * n_out, input_mean=mean,
        input_scale=scale, output_mean=np.zeros(n_out), output_scale=size, support=support,
        weights=np.zeros((m, n_out)), explained=np.zeros((n_out, m, m)), uncertain=np.zeros((n_out, m, m)),
        noise=size**2, domain=Domain(lower=seen.z.min(axis=0), upper=seen.z.max(axis=0), samples=len(x)),
    )  # fmt: skip
