"""The methods of a comparison: each takes a `Bench` and gives an `Outcome`. `METHODS` lists them in
the order of the run.

What has choices is tuned with `Bench.budget` candidates on training flights that are held back for
it (`Bench.split`), then fitted to all of them (networks stop early by these flights and keep their
weights).
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Protocol, TypedDict

import numpy as np

from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.compare_bench import Ahead, Bench, OneStep, Outcome
from greybox.baselines.filter_predictor import FilterPredictor
from greybox.baselines.kinematics import BODY_VELOCITY, GRAVITY_DIRECTION, black_box_view
from greybox.baselines.output_residual import (
    fit_output_residual,
    output_features,
    with_measured_noise,
)
from greybox.baselines.regressors import Choice, NetworkReport, Point, Predictor, Space
from greybox.data import Segment
from greybox.errors import DataError
from greybox.estimation.record import hold_missing
from greybox.residual.learn import learn_checked
from greybox.residual.learners import GP, learner_of
from greybox.residual.weight_space import learned_numbers
from greybox.symbolic import FloatArray, IntArray

if TYPE_CHECKING:
    from greybox.baselines.narx import NARXModel


class Network(Predictor, Protocol):
    """A trained network, and how it was trained."""

    @property
    def report(self) -> NetworkReport:
        """Of `descend`."""
        ...


class Schedule(TypedDict):
    """Keywords that say how long a network is trained."""

    batch: int
    epochs: int
    patience: int


class Training(TypedDict):
    """Keywords of every training of a network."""

    train: Sequence[Segment]
    validation: Sequence[Segment]
    outputs: Sequence[str]
    inputs: Sequence[str]
    seed: int
    progress: Callable[[str], None]


KERNELS = ("se", "linear+se")
POINTS = (100, 200)
FEATURES = (25, 50)
"""Sizes that the search of other learners draws from."""
NARX_LAGS = (2, 4)
"""Lags that the search of the GP alone draws from (both of outputs and inputs)."""


@dataclass(frozen=True, kw_only=True)
class Persistence:
    """The last measured value; the variance is that of its errors on the training flights."""

    outputs: tuple[str, ...]
    variance: FloatArray
    parameters: int = 0

    def one_step(self, segment: Segment) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (n, n_c)."""
        y = hold_missing(segment.matrix(self.outputs))[0]
        mean = np.vstack([np.full((1, y.shape[1]), np.nan), y[:-1]])
        return mean, np.where(np.isfinite(mean), self.variance, np.nan)


def _persistence(bench: Bench) -> Outcome:
    held = Persistence(outputs=bench.outputs, variance=np.ones(len(bench.outputs)))
    moved = [(s.matrix(bench.outputs) - held.one_step(s)[0]) ** 2 for s in bench.train_segments]
    held = replace(held, variance=np.nanmean(np.concatenate(moved), axis=0))
    mean, variance, microseconds = bench.channels_of(held, bench.segments)
    table = bench.rolled("persistence", None)
    return Outcome(
        mean=mean,
        variance=variance,
        table=table,
        parameters=0,
        seconds=0.0,
        microseconds=microseconds,
    )


def _siso(bench: Bench) -> Outcome:
    base, fits = bench.siso
    return bench.outcome(
        "linear SISO PEM",
        base,
        views=False,
        seconds=base.train_seconds,
        settings={"orders": {n: f.order for n, f in zip(bench.outputs, fits, strict=True)}},
    )


def _mimo(bench: Bench) -> Outcome:
    base, order = bench.mimo
    return bench.outcome(
        "linear MIMO PEM", base, views=False, seconds=base.train_seconds, settings={"order": order}
    )


def _nonlinear(bench: Bench) -> Outcome:
    model, seconds = bench.physics
    return bench.physical(model, seconds, settings={"effects": list(model.effects)})


def _hybrid(bench: Bench, learner: str = GP) -> Outcome:
    model, seconds = bench.physics
    learned = learn_checked(
        model,
        bench.train,
        points=bench.options.points,
        learner=learner,
        seed=bench.options.seed,
        progress=lambda text, _s: bench.say(f"learn: {text}"),
    )
    found = bench.physical(
        learned.model,
        seconds + learned.seconds,
        search=[{"candidate": n, "held_out_gain": g} for n, g in learned.candidates.items()],
        settings={"chosen": learned.chosen, "null": learned.null, "points": bench.options.points},
    )
    added = 0 if learned.null else learned_numbers(learned.fit.posterior)
    return replace(found, parameters=found.parameters + added)


def _output_hybrid(
    bench: Bench,
    base: BasePredictor,
    choices: Mapping[str, Sequence[str]],
    label: str,
    learner: str = GP,
) -> Outcome:
    """`base` + what is learned of its one-step errors; features, kernel and size by the error on
    the held-back flights."""
    began = time.perf_counter()
    space: dict[str, Sequence[Choice]] = {"points": FEATURES}
    if learner == GP:
        space = {"kernel": KERNELS, "points": POINTS}
    points_tried = candidates(bench, {"features": tuple(choices), **space}, "features")
    own, judge = bench.split
    tried: list[Point] = []
    for point in points_tried:
        rest = {k: v for k, v in point.items() if k != "features"}
        hybrid = fit_output_residual(
            base,
            own,
            features=choices[point["features"]],
            learner=learner,
            seed=bench.options.seed,
            hold_out=0.0,
            **rest,
        )
        error = validation_error(hybrid, judge, bench.outputs, bench.spread)
        tried.append({**point, "validation": error})
        bench.say(f"{label}: candidate {len(tried)} of {len(points_tried)}: {tried[-1]}")
    best = min(tried, key=lambda t: t["validation"])
    final = fit_output_residual(
        base,
        bench.train_segments,
        features=choices[best["features"]],
        learner=learner,
        seed=bench.options.seed,
        **{k: v for k, v in best.items() if k not in ("features", "validation")},
    )
    seconds = base.train_seconds + time.perf_counter() - began
    settings = {**best, "null": [n for n, a in zip(final.outputs, final.posterior.active) if not a]}
    return bench.outcome(
        label, final, views=False, seconds=seconds, search=tried, settings=settings
    )


def _linear_hybrid(
    bench: Bench,
    *,
    model: Callable[[Bench], tuple[BasePredictor, object]],
    label: str,
    learner: str = GP,
) -> Outcome:
    base, _ = model(bench)
    plain = output_features(base, bench.train_segments[0].names, learner_of(learner))
    return _output_hybrid(bench, base, _choices(bench, plain), label, learner)


def _choices(bench: Bench, plain: Sequence[str]) -> dict[str, Sequence[str]]:
    """What is predicted alone, or also the model's last errors: black boxes see their last samples
    too."""
    return {
        "prediction": tuple(plain),
        "and last errors": (*plain, *(f"error.{n}[t-1]" for n in bench.outputs)),
    }


def _nonlinear_output(bench: Bench) -> Outcome:
    model, seconds = bench.physics
    base = FilterPredictor(
        model=model, outputs=bench.outputs, adapt=bench.options.adapt, train_seconds=seconds
    )
    state = output_features(base, bench.train_segments[0].names)
    return _output_hybrid(bench, base, _choices(bench, state), "nonlinear PEM + output GP")


def candidates(bench: Bench, space: Space, first: str) -> list[Point]:
    """`bench.options.budget` points of the grid `space`, drawn without repetition; all values of
    `first` take turns."""
    grid = [dict(zip(space, values)) for values in itertools.product(*space.values())]
    drawn = [grid[i] for i in np.random.default_rng(bench.options.seed).permutation(len(grid))]
    turns = [[p for p in drawn if p[first] == v] for v in space[first]]
    return [p for together in itertools.zip_longest(*turns) for p in together if p is not None][
        : bench.options.budget
    ]


def _black_box(bench: Bench) -> tuple[tuple[Segment, ...], tuple[Segment, ...], tuple[str, ...]]:
    """(views to train on, views to judge on, channels that black boxes predict)."""
    own, judge = (tuple(black_box_view(s) for s in part) for part in bench.split)
    more = [
        n
        for n in (*BODY_VELOCITY, *GRAVITY_DIRECTION)
        if all(n in v.channels for v in (*own, *judge, *bench.views))
    ]
    return own, judge, (*bench.outputs, *more)


def _gp(bench: Bench) -> Outcome:
    from greybox.baselines.narx import SPACE, fit_narx

    began = time.perf_counter()
    own, judge, outputs = _black_box(bench)
    space = {**SPACE, "lags": NARX_LAGS}
    tried: list[Point] = []

    def trained(views: Sequence[Segment], point: Point) -> NARXModel:
        rest = {k: v for k, v in point.items() if k != "lags"}
        lags = point["lags"]
        return fit_narx(
            views,
            outputs=outputs,
            inputs=bench.inputs,
            n_a=lags,
            n_b=lags,
            seed=bench.options.seed,
            **rest,
        )

    for point in candidates(bench, space, "increments"):
        error = validation_error(trained(own, point), judge, bench.outputs, bench.spread)
        tried.append({**point, "validation": error})
        bench.say(f"GP alone: candidate {len(tried)} of {bench.options.budget}: {tried[-1]}")
    best = dict(min(tried, key=lambda t: t["validation"]))
    best.pop("validation")
    final = trained((*own, *judge), best)
    z, y, _ = final.lags.pairs((*own, *judge))
    target = y - z[:, : len(outputs)] if final.increments else y
    final = replace(final, posterior=with_measured_noise(final.posterior, z, target))
    seconds = time.perf_counter() - began
    return bench.outcome(
        "GP alone", final, views=True, seconds=seconds, search=tried, settings=best
    )


def _lstm(bench: Bench) -> Outcome:
    from greybox.baselines.lstm_train import SPACE, LSTMSettings, train_lstm

    def trained(point: Point, given: Training) -> tuple[Network, float]:
        rest = {k: v for k, v in point.items() if k != "window"}
        model = train_lstm(
            settings=LSTMSettings(
                n_a=point["window"], n_b=point["window"], **_schedule(given["train"]), **rest
            ),
            **given,
        )
        return model, validation_error(model, given["validation"], bench.outputs, bench.spread)

    return _network(bench, "LSTM", SPACE, trained)


def _tcn(bench: Bench) -> Outcome:
    from greybox.baselines.tcn import SPACE, TCNSettings, train_tcn

    def trained(point: Point, given: Training) -> tuple[Network, float]:
        model = train_tcn(settings=TCNSettings(**_schedule(given["train"]), **point), **given)
        return model, model.report["validation"]

    return _network(bench, "TCN", SPACE, trained)


def _on_physics(bench: Bench, *, label: str, space: str) -> Outcome:
    """The fitted model without its disturbance states, with a network for what one step misses."""
    from greybox.baselines import residual_network as rn

    model, seconds = bench.physics
    began = time.perf_counter()
    base = FilterPredictor(model=model, outputs=bench.outputs, adapt=bench.options.adapt)
    physics = rn.PhysicsAlone(base)
    own, judge = (rn.known(base, part) for part in bench.parts)
    tried: list[Point] = []
    best: rn.ResidualNetwork | None = None
    for number, point in enumerate(candidates(bench, getattr(rn, space), "ahead")):
        found = rn.train_residual(
            physics,
            own,
            judge,
            settings=rn.ResidualSettings(**_schedule(bench.split[0]), **point),
            seed=bench.options.seed + number,
            progress=lambda text: bench.say(f"{label}: {text}"),
        )
        ended = {k: found.report[k] for k in ("epochs", "ended")}
        tried.append({**point, "validation": found.error, **ended})
        bench.say(f"{label}: candidate {number + 1} of {bench.options.budget}: {tried[-1]}")
        if best is None or found.error < best.error:
            best = found
    assert best is not None
    chosen = best
    seconds += time.perf_counter() - began
    stated = rn.spread(rn.free_run_errors(chosen, judge, bench.steps))
    runs = [base.run(s) for s in bench.segments]

    def ahead(i: int, origins: IntArray) -> Ahead:
        told = chosen.rolled(runs[i], origins, bench.steps)
        return told, {
            g: np.broadcast_to(c, (len(origins), *c.shape)) for g, c in stated.items() if g in told
        }

    mean, variance, microseconds = bench.channels_of(base, bench.segments)
    return Outcome(
        mean=mean,
        variance=[bench.level(base) * v for v in variance],
        table=bench.rolled(label, ahead),
        parameters=base.parameters + chosen.parameters,
        seconds=seconds,
        microseconds=microseconds,
        search=tried,
        settings=min(tried, key=lambda t: t["validation"]),
    )


def _schedule(segments: Sequence[Segment]) -> Schedule:
    """Long logs get larger batches and fewer epochs, which are then as many steps."""
    few = sum(s.n for s in segments) < 5000
    return (
        {"batch": 64, "epochs": 200, "patience": 25}
        if few
        else {"batch": 256, "epochs": 60, "patience": 10}
    )


def _network(
    bench: Bench,
    label: str,
    space: Space,
    trained: Callable[[Point, Training], tuple[Network, float]],
) -> Outcome:
    """The best of `bench.options.budget` networks; `trained(point of the space, keywords of every
    training)` gives one and its error on the held-back flights, which also stop the training."""
    began = time.perf_counter()
    own, judge, outputs = _black_box(bench)
    tried: list[Point] = []
    best: Network | None = None
    for number, point in enumerate(candidates(bench, space, "increments")):
        given: Training = {
            "train": own,
            "validation": judge,
            "outputs": outputs,
            "inputs": bench.inputs,
            "seed": bench.options.seed + number,
            "progress": lambda text: bench.say(f"{label}: {text}"),
        }
        model, error = trained(point, given)
        ended = {k: model.report[k] for k in ("epochs", "ended")}
        tried.append({**point, "validation": error, **ended})
        bench.say(f"{label}: candidate {number + 1} of {bench.options.budget}: {tried[-1]}")
        if error <= min(t["validation"] for t in tried):
            best = model
    if best is None:
        raise DataError("no network predicts the held-back flights", fix="more --budget")
    seconds = time.perf_counter() - began
    used = min(tried, key=lambda t: t["validation"])
    return bench.outcome(label, best, views=True, seconds=seconds, search=tried, settings=used)


def validation_error(
    predictor: OneStep, segments: Sequence[Segment], names: Sequence[str], spread: FloatArray
) -> float:
    """Mean over channels of the squared one-step error in units of the training variance."""
    at = [predictor.outputs.index(n) for n in names]
    errors = [(s.matrix(names) - predictor.one_step(s)[0][:, at]) ** 2 for s in segments]
    return float(np.mean(np.nanmean(np.concatenate(errors), axis=0) / spread**2))


METHODS: Mapping[str, Callable[[Bench], Outcome]] = {
    "persistence": _persistence,
    "linear SISO PEM": _siso,
    "linear MIMO PEM": _mimo,
    "nonlinear PEM": _nonlinear,
    "nonlinear PEM + GP": _hybrid,
    "linear PEM + GP": partial(_linear_hybrid, model=attrgetter("siso"), label="linear PEM + GP"),
    "nonlinear PEM + output GP": _nonlinear_output,
    "GP alone": _gp,
    "LSTM": _lstm,
    "TCN": _tcn,
    "physics + MLP": partial(_on_physics, label="physics + MLP", space="MLP_SPACE"),
    "physics + LSTM": partial(_on_physics, label="physics + LSTM", space="LSTM_SPACE"),
}


def pairs(learners: Sequence[str]) -> dict[str, Callable[[Bench], Outcome]]:
    """Every model with each of `learners` (names, or files of the user's own), by the name of the
    method.

    What `METHODS` has already keeps its name there. Raises as `learner_of`.
    """
    out: dict[str, Callable[[Bench], Outcome]] = {}
    for learner in dict.fromkeys(learners):
        learner_of(learner)
        word = "GP" if learner == GP else learner
        siso, mimo, physics = (
            f"{b} PEM + {word}" for b in ("linear SISO", "linear MIMO", "nonlinear")
        )
        out[mimo] = partial(_linear_hybrid, model=attrgetter("mimo"), label=mimo, learner=learner)
        if learner != GP:
            out[siso] = partial(
                _linear_hybrid, model=attrgetter("siso"), label=siso, learner=learner
            )
            out[physics] = partial(_hybrid, learner=learner)
    return out
