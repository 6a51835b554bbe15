"""Experiments for a model of the user's own: input signals within ranges that tell most about its
parameters, with the standard errors that they are expected to give.

As `greybox.planning.plan`, without a vehicle that could fall: pieces are random steps, a multi-sine
and a chirp on each input and on all, run open loop from the model's reference state.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import scipy.signal
from threadpoolctl import threadpool_limits

from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import FitError, GreyboxError, ModelError, UnknownNameError
from greybox.files import Json
from greybox.model.dynamics import Dynamics, StateSpaceModel
from greybox.model.identified import IdentifiedModel, library_versions
from greybox.model.known import demand_known
from greybox.model.parameter import Parameter
from greybox.planning.information import Score, choose, efficiency, errors, information
from greybox.planning.options import LONGEST, demand_lengths, left_over, whole_pieces
from greybox.planning.planning_case import noise_levels, precision_of
from greybox.symbolic import FloatArray

SCHEMA = "greybox.own_plan/1"
HOLDS = (0.01, 0.03, 0.1, 0.25, 0.5)
"""Steps between the ends of a range, and between random levels, are held for these shares of a
piece."""
LONGEST_SAMPLES = 100 * LONGEST
"""The longest experiment: as many samples as the longest flight has at 100 Hz."""
SMALLER, TRIES = 0.7, 12
"""Factor, and how often, by which a piece that leaves a limit is made smaller."""
Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class OwnSubject:
    """What is planned for: as `greybox.planning.planning_case.PlanningCase`, for a model of any
    kind."""

    dynamics: Dynamics
    free: tuple[str, ...]
    values: Mapping[str, float]
    noise: Mapping[str, float]
    precision: FloatArray
    sample_time: float

    @property
    def wanted(self) -> tuple[str, ...]:
        """All that is estimated."""
        return self.free

    @property
    def declared(self) -> dict[str, Parameter]:
        """Declarations by name."""
        return {d.name: d for d in self.dynamics.parameters}


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnPlan:
    """Which inputs to play. `pieces` are names with the share of the range that each uses, in
    order; `log` the noise-free record; `errors` and `naive` parameter -> expected standard error
    (with what is known before, from the record alone) of the plan and of steps between the ends of
    the ranges of the same length."""

    subject: OwnSubject
    ranges: Mapping[str, Range]
    piece: float
    pieces: tuple[tuple[str, float], ...]
    log: Dataset
    errors: Mapping[str, tuple[float, float]]
    naive: Mapping[str, tuple[float, float]]
    efficiency: float
    warnings: tuple[str, ...]

    @property
    def blind(self) -> tuple[str, ...]:
        """Parameters of which the experiment says nothing."""
        return tuple(n for n, (std, _) in self.errors.items() if not np.isfinite(std))

    def to_dict(self) -> dict[str, Json]:
        """The content of plan.json (schema "greybox.own_plan/1")."""
        declared = self.subject.declared
        return {
            "schema": SCHEMA,
            "model": self.subject.dynamics.name,
            "sample_time": self.subject.sample_time,
            "seconds": self.piece * len(self.pieces),
            "ranges": {n: list(r) for n, r in self.ranges.items()},
            "pieces": [
                {"name": n, "start": k * self.piece, "seconds": self.piece, "amplitude": a}
                for k, (n, a) in enumerate(self.pieces)
            ],
            "parameters": {
                n: {
                    "value": self.subject.values[n],
                    "unit": declared[n].unit,
                    "std": std,
                    "std_record_alone": alone,
                    "std_naive": self.naive[n][0],
                }
                for n, (std, alone) in self.errors.items()
            },
            "efficiency": self.efficiency,
            "warnings": list(self.warnings),
            "versions": library_versions(),
        }

    def summary(self) -> str:
        """The plan as text."""
        lines = [f"{self.piece * len(self.pieces):g} s for {self.subject.dynamics.name}:"]
        lines += [
            f"  {k * self.piece:6.4g} s  {n}  ({100 * a:.0f} %)"
            for k, (n, a) in enumerate(self.pieces)
        ]
        width = max(len(n) for n in self.errors)
        lines.append(f"{'':{width}}  {'value':>12} {'std after':>10} {'naive':>10}")
        declared = self.subject.declared
        for n, (std, _) in self.errors.items():
            lines.append(
                f"{n:{width}}  {self.subject.values[n]:12.5g} {std:10.2g} {self.naive[n][0]:10.2g} "
                f"{declared[n].unit}"
            )
        lines.append(
            f"steps between the ends of the ranges would have to last {self.efficiency:.1f} times "
            "as long for the same confidence region"
        )
        return "\n".join([*lines, *(f"warning: {w}" for w in self.warnings)])


def plan_own(
    model: StateSpaceModel | IdentifiedModel,
    ranges: Mapping[str, Range],
    *,
    limits: Mapping[str, Range] | None = None,
    seconds: float = 60.0,
    piece: float = 5.0,
    free: Iterable[str] | None = None,
    values: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
    sample_time: float | None = None,
    seed: int = 0,
) -> OwnPlan:
    """Choose `seconds` of pieces of `piece` seconds of input signals that tell most about the
    parameters.

    `ranges` gives (lowest, highest) of every input, `limits` of outputs that must not leave theirs.
    A fitted model brings its values, noise levels, covariance and sample time; of a plain one
    `sample_time` [s] must be said. `free`: exactly these parameters are estimated. Raises
    `GreyboxError` (a missing range or sample time, nothing to estimate), `UnknownNameError`,
    `FitError` (nothing that keeps the limits).
    """
    subject = _subject(model, free, values, noise, sample_time)
    _demand_ranges(subject.dynamics, ranges, limits or {})
    _demand_samples(seconds, piece, subject.sample_time)
    count, n = whole_pieces(seconds, piece), round(piece / subject.sample_time)
    run = _Runner(subject, ranges, limits or {})
    with threadpool_limits(limits=1):
        candidates = _fitting(run, list(ranges), n, seed)
        told = {
            name: information(subject, run.record([s], a)) for name, (s, a) in candidates.items()
        }
        names = next(iter(told.values())).names
        chosen = choose(told, count, Score(subject, names))
        shapes = [candidates[c][0] * candidates[c][1] for c in chosen]
        whole = _one_after_the_other(run, shapes)
        log = run.record(shapes, whole)
        found = information(subject, log)
        ends = [
            np.where(np.arange(n)[:, None] < n // 2, 1.0, -1.0) * np.ones((1, len(ranges)))
        ] * count
        naive = information(subject, run.record(ends, run.fitting(ends) or 0.0))
    expected = errors(subject, found)
    warnings = [
        f"nothing will be known of {p}" for p, (std, _) in expected.items() if not np.isfinite(std)
    ]
    return OwnPlan(
        subject=subject,
        ranges=dict(ranges),
        piece=piece,
        pieces=tuple((c, candidates[c][1] * whole) for c in chosen),
        log=log,
        errors=expected,
        naive=errors(subject, naive),
        efficiency=efficiency(subject, found, naive),
        warnings=(*warnings, *left_over(seconds, piece)),
    )


def _one_after_the_other(run: _Runner, shapes: Sequence[FloatArray]) -> float:
    """The share of the chosen signals that keeps the limits together."""
    whole = run.fitting(list(shapes))
    if whole is None:
        raise FitError(
            "the pieces keep the limits one by one, but not one after the other",
            fix="ranges whose middle holds the outputs where they are, fewer --seconds, or "
            "wider --limit",
        )
    return whole


def _demand_samples(seconds: float, piece: float, step: float) -> None:
    shortest, longest = (20 * step, "20 samples"), LONGEST_SAMPLES * step
    demand_lengths("an experiment", seconds, piece, shortest=shortest, longest=longest)


def _fitting(
    run: _Runner, inputs: Sequence[str], n: int, seed: int
) -> dict[str, tuple[FloatArray, float]]:
    """Name -> (signal (n, n_u), the share of it that keeps the limits). Raises `FitError` for
    none."""
    found: dict[str, tuple[FloatArray, float]] = {}
    for name, shape in _shapes(list(inputs), n, seed):
        if (share := run.fitting([shape])) is not None:
            found[name] = (shape, share)
    if not found:
        raise FitError("no input signal keeps the limits", fix="wider --limit, or smaller --range")
    return found


def _subject(
    model: StateSpaceModel | IdentifiedModel,
    free: Iterable[str] | None,
    values: Mapping[str, float] | None,
    noise: Mapping[str, float] | None,
    sample_time: float | None,
) -> OwnSubject:
    fitted = model if isinstance(model, IdentifiedModel) else None
    demand_known(fitted)
    core = fitted.core if fitted is not None else model
    if not isinstance(core, StateSpaceModel):
        raise ModelError(
            "not a model of your own", got=type(core).__name__, fix="--vehicle plans for vehicles"
        )
    dt = sample_time or (fitted.sample_time if fitted is not None else None)
    if dt is None:
        raise GreyboxError(
            "no sample time",
            expected="the rate at which the experiment is logged",
            fix="--rate 100",
        )
    dynamics = fitted.dynamics if fitted is not None else core
    declared = {d.name: d for d in dynamics.parameters}
    for n in (*(free or ()), *(values or ())):
        if n not in declared:
            raise UnknownNameError("parameter", n, declared)
    names = tuple(
        n for n, d in declared.items() if (n in set(free) if free is not None else d.sigma > 0)
    )
    if not names:
        raise GreyboxError("nothing to estimate: every number is exact", fix="--free a,b")
    known = {} if fitted is None else {n: v for n, v in fitted.values.items() if n in declared}
    return OwnSubject(
        dynamics=dynamics,
        free=names,
        values={**{n: d.nominal for n, d in declared.items()}, **known, **(values or {})},
        noise=noise_levels(dynamics, fitted, noise),
        precision=precision_of(declared, names, fitted),
        sample_time=dt,
    )


def _demand_ranges(
    dynamics: Dynamics, ranges: Mapping[str, Range], limits: Mapping[str, Range]
) -> None:
    for what, given, known in (
        ("input", ranges, dynamics.inputs.names),
        ("output", limits, dynamics.outputs.names),
    ):
        for n, (low, high) in given.items():
            if n not in known:
                raise UnknownNameError(what, n, known)
            if not low < high:
                raise GreyboxError(
                    f"the range of {n} is empty", expected="LOW,HIGH", got=f"{low:g},{high:g}"
                )
    if missing := [n for n in dynamics.inputs.names if n not in ranges]:
        raise GreyboxError(
            f"no range of the input {missing[0]}",
            expected="one for every input",
            fix=f"--range {missing[0]}=-1,1",
        )


def _shapes(inputs: Sequence[str], n: int, seed: int) -> Iterator[tuple[str, FloatArray]]:
    """(name, signal (n, n_u) within -1 .. 1) of every candidate piece: each input alone, and all
    together."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / n
    for column, name in [*enumerate(inputs), *([(-1, "all inputs")] if len(inputs) > 1 else [])]:
        at = list(range(len(inputs))) if column < 0 else [column]
        signals: dict[str, FloatArray] = {}
        for share in HOLDS:
            hold = max(1, round(share * n))
            count = (-(-n // hold), len(at))
            ends = np.where(np.arange(count[0])[:, None] % 2, -1.0, 1.0) * rng.choice(
                [-1.0, 1.0], count[1]
            )
            for kind, levels in (("ends", ends), ("levels", rng.uniform(-1.0, 1.0, count))):
                signals[f"steps between {kind}, {hold} samples each, on {name}"] = np.repeat(
                    levels, hold, axis=0
                )[:n]
        phases = rng.uniform(0, 2 * np.pi, (8, len(at)))
        cycles = np.unique(np.round(np.geomspace(1, max(2, n / 10), 8)))
        waves = np.sum(
            [np.sin(2 * np.pi * c * t[:, None] + phases[i]) for i, c in enumerate(cycles)], axis=0
        )
        signals[f"multi-sine on {name}"] = waves / np.abs(waves).max()
        chirp = scipy.signal.chirp(t, 1.0, 1.0, n / 10, method="logarithmic")
        signals[f"chirp on {name}"] = chirp[:, None] * np.ones((1, len(at)))
        for label, signal in signals.items():
            out = np.zeros((n, len(inputs)))
            out[:, at] = signal
            yield label, out


class _Runner:
    """Runs input signals through the model without noise, and says whether outputs keep their
    limits."""

    def __init__(
        self, subject: OwnSubject, ranges: Mapping[str, Range], limits: Mapping[str, Range]
    ) -> None:
        d = subject.dynamics
        self.subject, self.limits = subject, {d.outputs[n]: r for n, r in limits.items()}
        low, high = np.array([ranges[n] for n in d.inputs.names]).T
        self.centre, self.half = (low + high) / 2, (high - low) / 2
        x, u = ca.SX.sym("x", len(d.states)), ca.SX.sym("u", len(d.inputs))
        p = ca.DM([subject.values[q.name] for q in d.parameters])
        quiet = ca.DM.zeros(len(d.noises))
        dt = subject.sample_time
        after, seen = d.step(0, x, u, p, quiet, dt), d.output(0, x, u, p, quiet, dt)
        self.step = ca.Function("step", [x, u], [after, ca.densify(seen)])
        self.start = np.asarray(d.reference(dict(zip(d.inputs.names, self.centre, strict=True))))

    def outputs(self, u: FloatArray) -> FloatArray:
        """Outputs (n, n_y) of commands u (n, n_u)."""
        return np.asarray(self.step.mapaccum(len(u))(self.start, u.T)[1].full().T)

    def commands(self, shapes: Sequence[FloatArray], share: float) -> FloatArray:
        """Commands (n, n_u) of signals within -1 .. 1, `share` of the range."""
        return self.centre + share * self.half * np.concatenate(list(shapes))

    def fitting(self, shapes: Sequence[FloatArray]) -> float | None:
        """The largest share of the range at which the outputs keep their limits; None where none
        does."""
        share = 1.0
        for _ in range(TRIES):
            y = self.outputs(self.commands(shapes, share))
            kept = all(
                low <= y[:, i].min() and y[:, i].max() <= high
                for i, (low, high) in self.limits.items()
            )
            if np.isfinite(y).all() and kept:
                return share
            share *= SMALLER
        return None

    def record(self, shapes: Sequence[FloatArray], share: float) -> Dataset:
        """The noise-free record, t [s], inputs and outputs."""
        u = self.commands(shapes, share)
        y, d = self.outputs(u), self.subject.dynamics
        columns = {n: u[:, i] for i, n in enumerate(d.inputs.names)} | {
            n: y[:, i] for i, n in enumerate(d.outputs.names)
        }
        return dataset_from_arrays(
            self.subject.sample_time * np.arange(len(u)), columns, name="experiment_1"
        )
