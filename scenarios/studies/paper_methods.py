"""The methods of the paper's experiment: each takes the same record and predicts every sample from
what lies before it.

`METHODS` maps names to functions of a `Bench`, which holds the record and the fits that several
methods share. What has choices is tuned on 20-25 s with the same number of candidates
(`Bench.budget`); nothing looks at 25-30 s. `LEAKS` are no methods: they see measurements of the
instant that they predict, and show what that alone achieves.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from greybox.baselines.filter_predictor import FilterPredictor
from greybox.baselines.linear_predictor import LinearPredictor
from greybox.data.segment import Segment
from greybox.estimation.filtering import Filter, Filtered
from greybox.estimation.fit import Fit, fit
from greybox.linear.fit import fit_linear
from greybox.linear.prediction import k_step
from greybox.linear.records import Record
from greybox.model.linear import LinearModel
from greybox.model.model import build_model
from greybox.model.vehicle import Vehicle, read_vehicle
from greybox.plants.vehicle_file import write_vehicle
from greybox.residual.posterior import GPPosterior
from greybox.symbolic import Layout, Signal
from scenarios.studies.paper_data import (
    COMMANDS,
    DT,
    EULER,
    OUTPUTS,
    POSITION,
    TEST,
    TRAIN,
    VALIDATION,
    PaperData,
    plant,
)

Array = NDArray[np.float64]

HORIZON = 50
ORIGINS = np.arange(round(TEST[0] / DT), round(TEST[1] / DT) - HORIZON, 10)
"""Free runs of half a second start at these samples of the test part, ten a second."""
EFFECTS = (
    "motor_lag",
    "thrust_curve",
    "battery_sag",
    "rotor_drag",
    "accelerometer_bias",
    "gyro_bias",
)
"""What a practitioner puts into the model; blade flapping, ground effect, inertia products and
sensor scales are missed."""
PAIRS = {"p": "roll", "ay": "roll", "q": "pitch", "ax": "pitch", "r": "yaw", "az": "collective"}
"""Output -> its input in the decoupled linear model."""
MIXES = {
    "roll": (0.0, 1.0, 0.0, -1.0),
    "pitch": (-1.0, 0.0, 1.0, 0.0),
    "yaw": (1.0, -1.0, 1.0, -1.0),
    "collective": (1.0, 1.0, 1.0, 1.0),
}
BLACK_BOX_INPUTS = ((*COMMANDS, "vbat", *EULER), (*COMMANDS, "vbat", *EULER, *POSITION))
"""Half of the candidates of LSTM and GP see the position too; all of it one sample old at least."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """Predictions of the whole record, mean and variance (n, 6) of what would be measured, NaN
    where none is possible.

    parameters: how many numbers were trained, `named` of them with a physical meaning and a unit;
    seconds of CPU: training, all candidates; microseconds of CPU per predicted sample. ahead (m,
    HORIZON, 6): free run with the recorded commands from every one of `ORIGINS`.
    """

    mean: Array
    variance: Array
    parameters: int
    seconds: float
    microseconds: float
    named: int = 0
    ahead: Array | None = None
    notes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True, eq=False)
class Bench:
    """One record and what several methods share. budget: candidates that a method with choices may
    try; train: the part [s] to train on."""

    data: PaperData
    budget: int = 4
    train: tuple[float, float] = TRAIN
    say: Callable[[str], None] = lambda _text: None

    @cached_property
    def measured(self) -> Array:
        """The outputs as measured, (n, 6)."""
        return self.data.segment.matrix(OUTPUTS)

    @cached_property
    def vehicle(self) -> Vehicle:
        """What ruler and data sheet say: inertia and torque 10 % too much, thrust 10 % too
        little."""
        with tempfile.TemporaryDirectory() as folder:
            path = write_vehicle(
                Path(folder) / "vehicle.toml",
                plant(),
                sigma={"inertia": 0.2, "thrust.c2": 0.2, "torque.c2": 0.3},
                errors={"inertia": 1.1, "thrust.c2": 0.9, "torque.c2": 1.1},
            )
            return read_vehicle(path)

    @cached_property
    def physics(self) -> Fit:
        """The nonlinear model, fitted to the training part in innovation form."""
        train = self.data.part(self.train)
        return fit(build_model(self.vehicle, train.channels, EFFECTS), train)

    @cached_property
    def filtered(self) -> Filtered:
        """The whole record under the fitted filter."""
        return Filter(self.physics.model).run(self.data.segment)

    @cached_property
    def decoupled(self) -> tuple[Outcome, list[LinearModel]]:
        """Six linear models with one input and one output each."""
        parts, models = [], []
        for name in OUTPUTS:
            axis = PAIRS[name]
            part, model = _linear(self, np.array([MIXES[axis]]).T, (axis,), (name,), largest=6)
            parts.append(part)
            models.append(model)
        outcome = Outcome(
            mean=np.concatenate([p.mean for p in parts], axis=1),
            variance=np.concatenate([p.variance for p in parts], axis=1),
            parameters=sum(p.parameters for p in parts),
            seconds=sum(p.seconds for p in parts),
            microseconds=sum(p.microseconds for p in parts),
            ahead=np.concatenate([p.ahead for p in parts if p.ahead is not None], axis=2),
            notes={"orders": [p.notes["order"] for p in parts]},
        )
        return outcome, models

    @cached_property
    def nonlinear(self) -> Outcome:
        """One-step predictions of the filter of the nonlinear model."""
        began = time.process_time()
        found = self.physics
        seconds = time.process_time() - began
        began = time.process_time()
        run, d = self.filtered, found.model.dynamics
        spent = time.process_time() - began
        return Outcome(
            mean=run.outputs[:, [d.outputs[n] for n in OUTPUTS]],
            variance=run.sigma[:, [d.innovations[n] for n in OUTPUTS]] ** 2,
            parameters=found.n_parameters,
            seconds=seconds,
            microseconds=1e6 * spent / self.data.segment.n,
            named=len(found.parameters),
            ahead=_ahead(FilterPredictor(model=found.model, outputs=OUTPUTS), self.data.segment),
            notes={
                "converged": found.converged,
                "values": {n: e.value for n, e in found.parameters.items()},
                "std": {n: e.std for n, e in found.parameters.items()},
                "warnings": list(found.warnings),
            },
        )


def _ahead(predictor: Any, segment: Segment) -> Array:
    """Free runs (m, HORIZON, n_y) from `ORIGINS` of anything that has `free_run`."""
    return np.asarray(predictor.free_run(segment, ORIGINS, HORIZON)[0])


def _linear(
    bench: Bench, mix: Array, inputs: Sequence[str], outputs: Sequence[str], *, largest: int
) -> tuple[Outcome, LinearModel]:
    """A linear model in innovation form of `outputs` from mixed commands, the newest of them one
    sample old."""
    segment = bench.data.segment
    channels = {
        name: tuple((float(w), c) for w, c in zip(column, COMMANDS, strict=True) if w)
        for name, column in zip(inputs, mix.T, strict=True)
        if name not in COMMANDS
    }
    record = Record(u=segment.matrix(COMMANDS) @ mix, y=segment.matrix(outputs), name="record")
    rows = bench.data.rows(bench.train)
    train = Record(u=record.u[rows], y=record.y[rows], name="train")
    began = time.process_time()
    # One sample of delay keeps the command that the controller computed from y(t) out of the
    # prediction of y(t).
    found = fit_linear(
        [train],
        "auto",
        dt=DT,
        inputs=inputs,
        outputs=outputs,
        delays=(1,) * len(inputs),
        largest=largest,
    )
    seconds = time.process_time() - began
    mean = np.full((segment.n, len(outputs)), np.nan)
    began = time.process_time()
    mean[2:] = k_step(found.model, record, [1])[0].predicted
    spent = time.process_time() - began
    outcome = Outcome(
        mean=mean,
        variance=np.broadcast_to(np.diag(found.model.noise), mean.shape).copy(),
        parameters=found.parameters,
        seconds=seconds,
        microseconds=1e6 * spent / segment.n,
        ahead=_ahead(
            LinearPredictor(model=found.model, outputs=tuple(outputs), channels=channels), segment
        ),
        notes={"order": found.order, "status": found.status.value},
    )
    return outcome, found.model


def linear_siso(bench: Bench) -> Outcome:
    """PEM, decoupled linear models: the paper's."""
    return bench.decoupled[0]


def linear_mimo(bench: Bench) -> Outcome:
    """PEM, one linear model with four inputs and six outputs."""
    return _linear(bench, np.eye(4), COMMANDS, OUTPUTS, largest=8)[0]


def nonlinear(bench: Bench) -> Outcome:
    """PEM, the physics model with the effects of `EFFECTS`."""
    return bench.nonlinear


def lstm(bench: Bench) -> Outcome:
    """LSTM alone."""
    from scenarios.studies.paper_search import search_lstm

    began = time.process_time()
    found = [
        search_lstm(
            bench.data.part(bench.train),
            bench.data.part(VALIDATION),
            outputs=OUTPUTS,
            inputs=inputs,
            budget=max(1, bench.budget // 2),
            seed=bench.data.seed,
            progress=bench.say,
        )
        for inputs in BLACK_BOX_INPUTS
    ]
    spent = time.process_time() - began
    return _black_box(bench, found, [f.report["validation"] for f in found], spent)


def gp_narx(bench: Bench) -> Outcome:
    """GP alone, on past samples."""
    from scenarios.studies.paper_search import search_narx

    began = time.process_time()
    found = [
        search_narx(
            bench.data.part(bench.train),
            bench.data.part(VALIDATION),
            outputs=OUTPUTS,
            inputs=inputs,
            budget=max(1, bench.budget // 2),
            seed=bench.data.seed,
            progress=bench.say,
        )
        for inputs in BLACK_BOX_INPUTS
    ]
    spent = time.process_time() - began
    return _black_box(
        bench,
        found,
        [min(float(c["validation"]) for c in f.report["search"]) for f in found],
        spent,
    )


def _black_box(
    bench: Bench, found: Sequence[Any], errors: Sequence[float], seconds: float
) -> Outcome:
    best = found[int(np.argmin(errors))]
    ahead = _ahead(best, bench.data.segment)
    began = time.process_time()
    mean, variance = best.one_step(bench.data.segment)
    spent = time.process_time() - began
    return Outcome(
        mean=mean,
        variance=variance,
        parameters=best.parameters,
        seconds=seconds,
        microseconds=1e6 * spent / bench.data.segment.n,
        ahead=ahead,
        notes={
            "settings": best.report["settings"],
            "inputs": list(best.lags.inputs),
            "search": [c for f in found for c in f.report["search"]],
        },
    )


# ---------------------------------------------------------------------------------------- hybrids


def _hybrid(
    bench: Bench,
    base: Outcome,
    model: Any,
    choices: Mapping[str, tuple[str, ...]],
    channels: Mapping[str, Sequence[tuple[float, str]]] | None = None,
) -> Outcome:
    """model + GP on r(t) = y(t) - y(t|t-1), trained on 0-20 s; features, kernel and size chosen on
    20-25 s."""
    from greybox.baselines.output_residual import OutputHybrid, fit_output_residual

    validation, segment = bench.data.rows(VALIDATION), bench.data.segment
    scale = bench.measured[bench.data.rows(bench.train)].var(axis=0)
    candidates = list(itertools.product(choices, ("se", "matern52"), (100, 200)))
    picked = np.random.default_rng(bench.data.seed).permutation(len(candidates))[: bench.budget]
    began = time.process_time()
    best: OutputHybrid | None = None
    lowest, tried = float("inf"), []
    for index in picked:
        which, kernel, points = candidates[index]
        found = fit_output_residual(
            model,
            bench.data.part(bench.train),
            outputs=OUTPUTS,
            channels={n: tuple(t) for n, t in (channels or {}).items()},
            features=choices[which],
            kernel=kernel,
            points=points,
            seed=bench.data.seed,
        )
        error = float(
            np.mean((bench.measured - found.one_step(segment)[0])[validation] ** 2 / scale)
        )
        tried.append({"features": which, "kernel": kernel, "points": points, "validation": error})
        bench.say(f"residual GP: {tried[-1]}")
        if error < lowest:
            best, lowest = found, error
    assert best is not None
    seconds = time.process_time() - began
    began = time.process_time()
    mean, variance = best.one_step(segment)
    spent = time.process_time() - began
    return Outcome(
        mean=mean,
        variance=variance,
        parameters=base.parameters + best.parameters - best.base.parameters,
        seconds=base.seconds + seconds,
        microseconds=1e6 * spent / segment.n,
        named=base.named,
        ahead=_ahead(best, segment),
        notes={
            "search": tried,
            "active": list(best.posterior.active),
            "noise_inflation": list(best.posterior.noise_inflation)
            if isinstance(best.posterior, GPPosterior)
            else [],
            "validation_without_gp": float(
                np.mean((bench.measured - base.mean)[validation] ** 2 / scale)
            ),
        },
    )


LATE_COMMANDS = tuple(f"{name}[t-1]" for name in COMMANDS)


def hybrid_siso(bench: Bench) -> Outcome:
    """The paper's hybrid without its leak: decoupled linear PEM + GP on what was known before t."""
    base, models = bench.decoupled
    paper = ("phi[t-1]", "theta[t-1]", "psi[t-1]", "p", "q", "r", *LATE_COMMANDS)
    channels = {
        axis: [(weight, name) for weight, name in zip(mix, COMMANDS) if weight]
        for axis, mix in MIXES.items()
    }
    wide = (*paper, "ax", "ay", "az", "z[t-1]", "vbat[t-1]")
    return _hybrid(bench, base, models, {"paper": paper, "wide": wide}, channels)


def hybrid_nonlinear(bench: Bench) -> Outcome:
    """Nonlinear PEM + GP on its predicted state x(t|t-1)."""
    velocity, rotors = (
        tuple(f"body_velocity.{a}" for a in "xyz"),
        tuple(f"nu{i}" for i in range(1, 5)),
    )
    paper = ("phi", "theta", "psi", "p", "q", "r", *LATE_COMMANDS)
    state = ("phi", "theta", "p", "q", "r", *velocity, "height", *rotors, "vbat[t-1]")
    return _hybrid(bench, bench.nonlinear, bench.physics.model, {"paper": paper, "state": state})


def training_claim(bench: Bench) -> dict[str, float]:
    """Is a Gaussian process quicker to train on the residual? Seconds of CPU of the same process
    (inputs of the sample before, rows, support points, start) on the outputs themselves and on what
    the nonlinear PEM leaves of them."""
    import gpytorch  # noqa: F401 (its import is not training)

    from greybox.residual.train import train_gp

    rows = bench.data.rows(bench.train)
    names = (*EULER, *OUTPUTS, *COMMANDS, "vbat")
    seen = bench.data.segment.matrix(names)[rows][:-1]
    found = {}
    for label, target in (
        ("output", bench.measured),
        ("residual", bench.measured - bench.nonlinear.mean),
    ):
        began = time.process_time()
        train_gp(
            seen,
            target[rows][1:],
            inputs=Layout([Signal(name=f"{n}[t-1]", unit="1") for n in names]),
            outputs=Layout(
                [Signal(name=n, unit="rad/s" if n in "pqr" else "m/s^2") for n in OUTPUTS]
            ),
            points=100,
            seed=bench.data.seed,
            hold_out=0.0,
            noise_inflation=1.0,
        )
        found[label] = time.process_time() - began
    return found


# ------------------------------------------------------------------------------------------ leaks


def _peeking(bench: Bench, base: Outcome, names: Sequence[str]) -> Outcome:
    """base + GP on its error, from columns measured at the predicted instant: everything that a
    method must not do."""
    from greybox.residual.train import train_gp

    seen, train = bench.data.segment.matrix(names), bench.data.rows(bench.train)
    began = time.process_time()
    gp = train_gp(
        seen[train],
        (bench.measured - base.mean)[train],
        inputs=Layout([Signal(name=n, unit="1") for n in names]),
        outputs=Layout([Signal(name=n, unit="rad/s" if n in "pqr" else "m/s^2") for n in OUTPUTS]),
        points=200,
        seed=bench.data.seed,
        hold_out=0.0,
        noise_inflation=1.0,
    ).posterior
    seconds = time.process_time() - began
    began = time.process_time()
    added, variance = gp.evaluate(seen, noise=True)
    spent = time.process_time() - began
    return Outcome(
        mean=base.mean + added,
        variance=variance,
        parameters=base.parameters
        + gp.support.size
        + gp.weights.size
        + len(OUTPUTS) * (len(names) + 2),
        seconds=base.seconds + seconds,
        microseconds=base.microseconds + 1e6 * spent / len(seen),
    )


PAPER_INPUTS = (*EULER, "p", "q", "r", *COMMANDS)
"""[phi, theta, psi, p, q, r, u1..u4] of the instant itself, as the paper writes it."""


def leak_literal(bench: Bench) -> Outcome:
    """The paper's form as written."""
    return _peeking(bench, bench.decoupled[0], PAPER_INPUTS)


def leak_alone(bench: Bench) -> Outcome:
    """The same inputs without any model: what the leak achieves by itself."""
    return _peeking(bench, _nothing(bench), PAPER_INPUTS)


def leak_all(bench: Bench) -> Outcome:
    """All six outputs of the instant among the inputs: the answer is in the question."""
    return _peeking(bench, _nothing(bench), (*EULER, *OUTPUTS, *COMMANDS))


def _nothing(bench: Bench) -> Outcome:
    """A model that predicts the mean of the training part."""
    y, rows = bench.measured, bench.data.rows(bench.train)
    mean, variance = (
        np.broadcast_to(v, y.shape) for v in (y[rows].mean(axis=0), y[rows].var(axis=0))
    )
    return Outcome(
        mean=mean, variance=variance, parameters=len(OUTPUTS), seconds=0.0, microseconds=0.0
    )


METHODS: Mapping[str, Callable[[Bench], Outcome]] = {
    "PEM linear SISO": linear_siso,
    "PEM linear MIMO": linear_mimo,
    "PEM nonlinear": nonlinear,
    "LSTM": lstm,
    "GP": gp_narx,
    "hybrid linear SISO": hybrid_siso,
    "hybrid nonlinear": hybrid_nonlinear,
}
LEAKS: Mapping[str, Callable[[Bench], Outcome]] = {
    "paper's leaking form": leak_literal,
    "its leak alone": leak_alone,
    "y(t) among the inputs": leak_all,
}
