"""learn: from an identified model and its training flights to a hybrid model with calibrated
uncertainty.

1. Disturbance states take up what the physics misses (fitted, where the model has none); smoothing
   gives its time series.
2. Candidates (`greybox.residual.candidates`): of every set of features a Gaussian process with
   hyper-parameters by marginal likelihood on the smoothed discrepancy, and one with a
   broad kernel that knows nothing but the scales of the data; or what another learner offers.
3. Their weights are fitted by multi-step prediction errors; the candidate and the strength of its
   prior are those that lower the errors of left-out flights most. Where none does, the result is
   the physics alone and says so.
4. On request (`refit`) the physics is refitted with the weights beside it, and the weights after
   that (`greybox.residual.beside`); both stay as they were unless that lowers the left-out errors.
   No default: stated regions then come out too wide, and where it is refused its time is lost.
5. The filter's noise levels are refitted with the learned part in place, and the growth of the
   uncertainty over the horizon is calibrated on the training flights.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np

from greybox.data import Dataset, Flight
from greybox.data.checks import check
from greybox.errors import DataError, GreyboxError, ModelError
from greybox.estimation.options import says_choices
from greybox.journal import spared
from greybox.model.faults import demand_sound
from greybox.model.identified import IdentifiedModel, library_versions
from greybox.model.layer import LongerWindow, physics_of
from greybox.model.verdict import demand_finished
from greybox.progress import in_notebooks, onward
from greybox.residual.beside import better, refit_beside
from greybox.residual.candidates import FeatureMaker, gp_candidates
from greybox.residual.discrepancy import Discrepancy, discrepancy, disturbed_model
from greybox.residual.document import CandidateRow, LearnDocument, MovedRow
from greybox.residual.feature_posterior import FeaturePosterior
from greybox.residual.features import available, default_features, feature_layout, reach, with_lags
from greybox.residual.hybrid import HybridModel
from greybox.residual.kept import fitted_once
from greybox.residual.learners import GP, Learner, LooksBack, learner_for
from greybox.residual.noise_levels import refit_noise
from greybox.residual.open_loop_fit import OpenLoopFit, fit_again, fit_open_loop
from greybox.residual.options import LearnChoices, LearnOptions
from greybox.residual.training_report import TrainingDocument
from greybox.residual.training_rows import LEAST
from greybox.residual.weight_space import Candidate
from greybox.shown import Cell, Shown
from greybox.takes import FLIGHTS, FUNCTION, MODEL, NAMES, takes
from greybox.validation.calibration import Calibration, calibrate_horizons

Progress = Callable[[str, float], None]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Learned(Shown):
    """The hybrid `model` (the physics with its disturbance states, where nothing could be learned:
    `null`), and how: the physics that it was learned for (`base`) and whether that was `refitted`
    beside it (None: not asked), the open-loop fit, the candidates with their share of held-out cost
    saved, the calibration factors, seconds."""

    model: IdentifiedModel
    base: IdentifiedModel
    null: bool
    refitted: bool | None
    fit: OpenLoopFit
    candidates: Mapping[str, float]
    chosen: str
    calibration: Calibration
    seconds: float
    training: tuple[TrainingDocument, ...]

    def to_dict(self) -> LearnDocument:
        """As in learn.json, schema "greybox.learn/1"."""
        posterior = self.fit.posterior
        document: LearnDocument = {
            "schema": "greybox.learn/1",
            "model": self.model.name,
            "kind": "dynamics",
            "learner": posterior.method if isinstance(posterior, FeaturePosterior) else GP,
            "null": self.null,
            "candidates": [self._candidate(n, g) for n, g in self.candidates.items()],
            "chosen": self.chosen,
            "features": list(posterior.inputs.names),
            "outputs": [
                {
                    "name": s.name,
                    "unit": s.unit,
                    "learned": bool(np.isfinite(self.fit.strengths[s.name])),
                }
                for s in posterior.outputs
            ],
            "points": posterior.points,
            "fit": {
                "status": self.fit.status,
                "iterations": self.fit.iterations,
                "cost_before": self.fit.cost_before,
                "cost_after": self.fit.cost_after,
                "held_out_gain": self.fit.held_out_gain,
                "strengths": {
                    n: s if np.isfinite(s) else None for n, s in self.fit.strengths.items()
                },
            },
            "calibration": {
                "factors": dict(self.calibration.factors),
                "gain": self.calibration.gain,
                "new_flight": self.calibration.new_flight,
            },
            "training": [t.copy() for t in self.training],
            "trained_on": list(self.model.trained_on),
            "data_hash": self.model.data_hash,
            "seconds": self.seconds,
            "warnings": [],
            "versions": library_versions(),
        }
        if self.refitted is not None:
            document["refit"] = self.moved
        return document

    def _candidate(self, name: str, gain: float) -> CandidateRow:
        row: CandidateRow = {"name": name, "held_out_gain": gain}
        return {**row, "features_saw": True} if name in self.fit.unasked else row

    @property
    def moved(self) -> list[MovedRow]:
        """The physics' estimates before and after, where it was refitted beside the learned part,
        with their standard errors before and after."""
        if not self.refitted:
            return []
        errors = self.base.standard_errors, self.model.standard_errors
        return [
            {
                "name": d.name,
                "unit": d.unit,
                "before": self.base.values[d.name],
                "after": self.model.values[d.name],
                "std_before": errors[0][d.name],
                "std_after": errors[1].get(d.name),
            }
            for d in self.base.dynamics.parameters
            if d.name in errors[0]
        ]

    def _shown_text(self) -> str:
        """The summary."""
        return self.summary()

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per candidate: the share of its held-out cost that it saves."""
        return [
            {
                "candidate": n,
                "saved on left-out flights": g,
                **({"its features saw them": n in self.fit.unasked} if self.fit.unasked else {}),
                "chosen": n == self.chosen,
            }
            for n, g in self.candidates.items()
        ]

    def summary(self) -> str:
        """What was learned, as text."""
        saved = 1 - self.fit.cost_after / self.fit.cost_before if self.fit.cost_before else 0.0
        lines = [
            "nothing was learned: no candidate lowers the multi-step errors of flights it has not "
            "seen by more than chance and a trace"
            if self.null
            else f"learned {', '.join(n for n, s in self.fit.strengths.items() if np.isfinite(s))} "
            f"from {self.chosen}"
        ]
        if not self.null:
            lines.append(
                f"multi-step cost: {saved:.1%} lower on the training flights, "
                f"{self.fit.held_out_gain:.1%} on left-out ones"
            )
        if self.refitted:
            lines.append("the physics was refitted beside it:")
            lines += [
                f"  {m['name']} {m['before']:.5g} -> {m['after']:.5g} {m['unit']}".rstrip()
                for m in self.moved
            ]
        elif self.refitted is not None:
            lines.append(
                "the physics was not refitted: left-out flights want no other, or none was found"
            )
        lines += [
            f"  candidate {n}: {g:+.2%} on left-out flights"
            + (", which its features saw" if n in self.fit.unasked else "")
            for n, g in self.candidates.items()
        ]
        factors = ", ".join(f"{n} x {f:.2f}" for n, f in self.calibration.factors.items())
        lines.append(
            f"uncertainty ahead, process noise: {factors}; of this for flights not seen: x "
            f"{self.calibration.new_flight:.2f}"
        )
        return "\n".join(lines)


def feature_sets(model: IdentifiedModel, *, place: bool = False) -> dict[str, tuple[str, ...]]:
    """Sets of features to try, by name: body velocity, motion, motion with the direction of
    gravity, with the rotors; on request the `place` with the heading, and with the motion. Of a
    model that is not a vehicle's: its states, and states with inputs. Raises `ModelError` for the
    place where no position is measured."""
    full = default_features(model.dynamics)
    if physics_of(model.dynamics) is None:
        if place:
            raise ModelError(
                "the place is a feature of vehicles", got=model.name, fix="leave place out"
            )
        states = tuple(n for n in full if n not in model.dynamics.inputs)
        return (
            {"states": states, "states and inputs": full}
            if len(model.dynamics.inputs)
            else {"states": states}
        )
    motion = tuple(n for n in full if n.startswith("body_velocity.") or n in ("p", "q", "r"))
    sets = {"velocity": tuple(n for n in motion if n.startswith("body_velocity."))}
    sets |= {"motion": motion, "motion and rotors": full}
    gravity = tuple(n for n in available(model.dynamics) if n.startswith("gravity."))
    if gravity and motion:
        sets["motion and attitude"] = (*motion, *gravity)
    if place:
        if "position" not in model.sensors:
            raise ModelError(
                "no position is measured: what depends on the place cannot be learned",
                fix="leave place out",
            )
        # What stands in the room pushes in its axes, and what is learned is in the body's.
        heading = (n for n in available(model.dynamics) if n.startswith("heading."))
        where = (*(f"position.{a}" for a in "xyz"), *heading)
        sets |= {"place": where, "place and motion": (*where, *motion, *gravity)}
    return {n: s for n, s in sets.items() if s}


@in_notebooks(progress="share")
@says_choices(LearnOptions)
@takes(model=MODEL, train=FLIGHTS, accept=NAMES, progress=FUNCTION)
def learn(
    model: IdentifiedModel,
    train: Dataset | Flight,
    options: LearnOptions | None = None,
    *,
    accept: Iterable[str] = (),
    progress: Progress | None = None,
    **choices: Unpack[LearnChoices],
) -> Learned:
    """Learn what `model` misses on the flights of `train` (those it was fitted on).

    The choices are keywords, fields of `LearnOptions` with its defaults, or `options` as a whole:
    features, place, kernel, points, learner, seed, refit.

    `features` names the inputs of the Gaussian process (default: the sets of `feature_sets`
    compete; with `place` also those of what stands in the room, which do not carry over to another
    room). kernel: "se", "matern32", "matern52", or "linear+" one of these. `points`: number of
    support points, or "auto". `learner`: what is learned, "gp" or another name of
    `greybox.residual.learners`, a file of the user's own ("own.py:Name", which is run), or a
    `Learner`; `points` are then its features. `refit`: refit the physics beside what is learned;
    kept where left-out flights want it. Findings of the checks named in `accept` do not block.
    Raises `UnknownNameError`, `DataError` (`BadDataError` for flights of a vehicle with faults that
    block), `ModelError` (an unfinished model, a learner that returns what is not finite, too).
    """
    chosen = LearnOptions.of(options, choices)
    demand_finished(model)
    train, physics = Dataset.of(train), physics_of(model.dynamics)
    if physics is not None:
        demand_sound(check(train, physics.vehicle, accept=accept), "learning")
    return learn_checked(model, train, chosen, progress=progress)


def learn_checked(
    model: IdentifiedModel,
    train: Dataset,
    options: LearnOptions | None = None,
    *,
    progress: Progress | None = None,
    **choices: Unpack[LearnChoices],
) -> Learned:
    """`learn` on flights whose faults were looked for."""
    began, o = time.perf_counter(), LearnOptions.of(options, choices)
    say = onward(progress or (lambda _text, _share: None))
    other = _learner(model, o.learner, o.points, o.kernel)
    _check_features(model, o.features, o.place)
    say("disturbance states", 0.0)
    # What is learned changes what was judged.
    base = replace(disturbed_model(model, train), verdict=None)
    seen = _seen(base, train, o.features, o.place, other)
    offered = _offered(seen.sets, other, o.kernel, o.points, o.seed, _within(say, 0.1, 0.3))
    width = 0.3 if o.refit else 0.4
    result, chosen, gains = fitted_once(
        lambda: fit_open_loop(
            seen.model, offered.found, train, maker=offered.maker, progress=_within(say, 0.4, width)
        )
    )
    physics = base
    if o.refit:
        physics, result = _beside(
            base, seen.model, offered.found[chosen], result, train, _within(say, 0.7, 0.15)
        )
    final, calibration = _calibrated(physics, result, seen.whole, train, say)
    return Learned(
        model=final,
        base=base,
        null=result.status == "null",
        refitted=physics is not base if o.refit else None,
        fit=result,
        candidates=gains,
        chosen=chosen,
        calibration=calibration,
        seconds=time.perf_counter() - began + spared(),
        training=offered.reports,
    )


def _learner(
    model: IdentifiedModel, learner: str | Learner, points: int | str, kernel: str
) -> Learner | None:
    """The learner itself, None for a Gaussian process. Raises `ModelError`, `UnknownNameError`."""
    if isinstance(model.dynamics, HybridModel):
        raise ModelError(
            "the model has a learned part already", fix="learn from the model file of the fit"
        )
    return learner_for(learner, points, kernel)


def _check_features(model: IdentifiedModel, features: Sequence[str] | None, place: bool) -> None:
    """Raises `ModelError` or `UnknownNameError` for features that the model does not have."""
    if place:
        if features is not None:
            raise ModelError(
                "place competes with other sets, features are the only one", fix="one of the two"
            )
        feature_sets(model, place=True)
    if features is not None:
        feature_layout(model.dynamics, features)


def _within(say: Progress, begin: float, width: float) -> Progress:
    """Progress of a part of the work that begins at the share `begin` of all."""
    return lambda text, share: say(text, begin + width * share)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    """The discrepancy of every set of features (`sets`) and of all (`whole`), and the model that
    sees as many earlier commands as the features do."""

    model: IdentifiedModel
    whole: Discrepancy
    sets: dict[str, Discrepancy]


def _seen(
    base: IdentifiedModel,
    train: Dataset,
    features: Sequence[str] | None,
    place: bool,
    learner: Learner | None,
) -> _Seen:
    names = (
        {"the given features": tuple(features)}
        if features is not None
        else feature_sets(base, place=place)
    )
    if isinstance(learner, LooksBack) and (lags := learner.lags(base.sample_time)):
        names = {label: with_lags(base.dynamics, own, lags) for label, own in names.items()}
    every = tuple(dict.fromkeys(n for own in names.values() for n in own))
    # Who looks back sees more commands than the physics does.
    seeing = (
        replace(base, dynamics=LongerWindow(inner=base.dynamics, past=reach(every)))
        if reach(every)
        else base
    )
    whole = discrepancy(seeing, train, every)
    if learner is None and len(whole.z) < LEAST:
        flown = sum(s.n for f in train for s in f.segments) * base.sample_time
        raise DataError(
            "too little flight for a Gaussian process",
            expected=f"at least {LEAST} stretches as long as unnamed pushes last",
            got=f"{len(whole.z)} of {flown:.3g} s",
            fix="more or longer flights",
        )
    sets = {label: whole.select(own) for label, own in names.items()}
    return _Seen(model=seeing, whole=whole, sets=sets)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Offered:
    """The candidates by name, how they were trained, and what makes them again from some rows."""

    found: Mapping[str, Candidate]
    reports: tuple[TrainingDocument, ...] = ()
    maker: FeatureMaker | None = None


def _offered(
    sets: Mapping[str, Discrepancy],
    learner: Learner | None,
    kernel: str,
    points: int | str,
    seed: int,
    say: Progress,
) -> _Offered:
    if learner is None:
        found, reports = gp_candidates(sets, kernel=kernel, points=points, seed=seed, say=say)
        return _Offered(found=found, reports=tuple(reports))
    maker = FeatureMaker(learner=learner, sets=sets, points=int(points), seed=seed)
    return _Offered(found=maker.candidates(say), maker=maker)


def _beside(
    base: IdentifiedModel,
    seeing: IdentifiedModel,
    candidate: Candidate,
    before: OpenLoopFit,
    train: Dataset,
    say: Progress,
) -> tuple[IdentifiedModel, OpenLoopFit]:
    """The physics as found beside the learned part, and what is learned of it then; both as they
    were where the left-out flights do not want the physics to move. `seeing` is `base` with the
    command window of the features."""
    if before.status == "null":
        return base, before
    try:
        moved = refit_beside(seeing, candidate, before.strengths, train, _within(say, 0.0, 0.7))
        if moved is None:
            return base, before
        after = fit_again(moved, candidate, train, before, progress=_within(say, 0.7, 0.3))
    except (GreyboxError, np.linalg.LinAlgError):  # physics that cannot be flown
        return base, before
    return (
        (replace(moved, dynamics=base.dynamics), after) if better(after, before) else (base, before)
    )


def _calibrated(
    base: IdentifiedModel, fit: OpenLoopFit, whole: Discrepancy, train: Dataset, say: Progress
) -> tuple[IdentifiedModel, Calibration]:
    """The model with what was learned, if anything: noise levels refitted with it in place, and its
    uncertainty ahead calibrated."""
    if fit.status == "null":
        say("calibration", 0.9)
        calibration = calibrate_horizons(base, train)
        return calibration.model, calibration
    posterior = fit.posterior
    if isinstance(posterior, FeaturePosterior):
        posterior = posterior.at_home(whole.select(posterior.inputs.names).z)
    say("noise levels", 0.85)
    hybrid = refit_noise(
        replace(base, dynamics=HybridModel(inner=base.dynamics, posterior=posterior)), train
    )
    say("calibration", 0.9)
    calibration = calibrate_horizons(hybrid, train)
    return calibration.model, calibration
