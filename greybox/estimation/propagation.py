"""Uncertainty of open-loop predictions: the covariance that travels along with every rollout.

Linearised along the predicted path, in the error state d of the model:

    S+ = A S A' + G Q G'                        filter error and process noise, white from step to step
    c+ = A c + G L(z),   b+ = A b + B           errors of the learned push and of parameters
    Sigma = S + c c' + b Cov(p) b'

An error of a parameter is the same at every step of one prediction, so it is carried as a consider
state (Schmidt 1966) and not as fresh noise per step, which would average it out; that of the
learned function as far as its features stay alike (`ErrorAlongPath`). What the model does not
explain and is correlated in time is a state of `Augmented`, with its own covariance in S. G is that
of the model's reference point: in the error state it hardly depends on the path.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.errors import FitError
from greybox.estimation.engine import Engine, engine_for
from greybox.estimation.error_along_path import HELD, ErrorAlongPath
from greybox.estimation.filtering import Filter, Filtered
from greybox.estimation.smoothing import transitions
from greybox.model.identified import IdentifiedModel
from greybox.model.known import as_flights_are
from greybox.model.layer import LearnedPush, learned_push_of
from greybox.symbolic import FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class Ahead:
    """Predictions h samples ahead of m origins: states (m, n_x), their error covariance (m, n_d,
    n_d), and that of the predicted innovation, sensor noise included, (m, n_e, n_e)."""

    h: int
    states: FloatArray
    covariance: FloatArray
    innovation_covariance: FloatArray


class Propagator:
    """Propagates mean and covariance of an identified model through a horizon.

    `extra` adds (or replaces) parameter standard deviations by name, such as those of an adaptation
    to the flight. `parameters=False` leaves the parameters' uncertainty out, `learned=False` that
    of a learned push, `weights=False` the part of it that is in its weights. `noise` (n_w) replaces
    the model's process-noise levels.
    """

    def __init__(
        self,
        runner: Filter,
        *,
        extra: Mapping[str, float] | None = None,
        parameters: bool = True,
        learned: bool = True,
        weights: bool = True,
        noise: FloatArray | None = None,
        use_compiler: bool = True,
    ) -> None:
        model = runner.model
        self.runner = runner
        names, self.spread = (
            _parameter_covariance(model, extra or {}) if parameters else ((), np.zeros((0, 0)))
        )
        self.engine: Engine = engine_for(model.dynamics, names, use_compiler=use_compiler)
        _, g, _, d = runner.linear
        self.push, self.through = g, d
        if noise is None:
            noise = model.noise_ahead
        self.noise = (g * noise**2) @ g.T
        self.seen = (d * noise**2) @ d.T + np.diag(model.sensor_noise**2)
        self.learned = learned_push_of(model.dynamics) if learned else None
        self.open_only = not weights

    def run(
        self, filtered: Filtered, origins: npt.NDArray[np.int_], horizon: int
    ) -> Iterator[Ahead]:
        """h = 1 .. horizon ahead of `origins` (m,), which have `horizon` samples after them.

        Raises `FitError` where a prediction stops being finite.
        """
        return (ahead for (ahead,) in run_together([self], filtered, origins, horizon))


def run_together(
    propagators: Sequence[Propagator],
    filtered: Filtered,
    origins: npt.NDArray[np.int_],
    horizon: int,
) -> Iterator[list[Ahead]]:
    """As `Propagator.run` for several propagators of one filter, which share the path: one list per
    h = 1 .. horizon.

    The first propagator has the parameters that any other has. Raises `FitError` for an origin with
    fewer samples after it than the horizon.
    """
    first = propagators[0]
    engine, record = first.engine, filtered.record
    rows = np.asarray(origins) + 1
    m, nd, na = len(rows), engine.nd, len(engine.active)
    if m and rows.max() + horizon > record.n:
        raise FitError("an origin has fewer samples after it than the horizon")
    states = np.ascontiguousarray(filtered.states[rows])
    white = [filtered.state_covariances(rows) for _ in propagators]
    learned = {k: _Learned.of(p, m) for k, p in _kinds(propagators).items()}
    held = max(1, round(HELD / record.dt))
    start = np.zeros((m, nd, na + nd))
    start[:, :, na:] = np.eye(nd)
    for h in range(1, horizon + 1):
        at = rows + h - 1
        found = transitions(engine, states, at, record.inputs, filtered.p, record.dt, start)
        assert found.end_sensitivity is not None
        assert found.sensitivity is not None
        # `found` describes the output at this sample and the state after it.
        c, direct = found.sensitivity[:, :, na:], found.sensitivity[:, :, :na]
        a, bias = found.end_sensitivity[:, :, na:], start[:, :, :na]
        out = []
        # Of a craft that cannot be, it may spread beyond all numbers: the verdict tells that.
        with np.errstate(over="ignore", invalid="ignore"):
            for error in learned.values() if (h - 1) % held == 0 else ():
                error.arrive(states, engine.command_windows(record.inputs, at))
            for i, p in enumerate(propagators):
                total, inner = white[i], c @ white[i] @ c.transpose(0, 2, 1) + p.seen
                if p.spread.size:
                    total = total + bias @ p.spread @ bias.transpose(0, 2, 1)
                    # `sensitivity` already holds ex S + ep for the parameter columns.
                    inner = inner + direct @ p.spread @ direct.transpose(0, 2, 1)
                if p.learned is not None:
                    error = learned[p.open_only]
                    carried = error.along.carried
                    now = c @ carried - error.along.seen(error.through)
                    total = total + carried @ carried.transpose(0, 2, 1)
                    inner = inner + now @ now.transpose(0, 2, 1)
                out.append(Ahead(h=h, states=states, covariance=total, innovation_covariance=inner))
                white[i] = a @ white[i] @ a.transpose(0, 2, 1) + p.noise
            for error in learned.values():
                error.along.step(a)
        yield out
        start[:, :, :na] = found.end_sensitivity[:, :, :na]
        states = found.ends


def _kinds(propagators: Sequence[Propagator]) -> dict[bool, Propagator]:
    """One of the propagators for each kind of errors of a learned push that any of them counts."""
    return {p.open_only: p for p in propagators if p.learned is not None}


@dataclass(frozen=True, kw_only=True, eq=False)
class _Learned:
    """Errors of a learned push `along` the path. `through` (n_e, n_out): how the push acts on a
    measurement."""

    push: LearnedPush
    through: FloatArray
    along: ErrorAlongPath

    @classmethod
    def of(cls, propagator: Propagator, predictions: int) -> _Learned:
        """At the origins of so many predictions."""
        push = propagator.learned
        assert push is not None
        rows = list(push.learned_rows)
        return cls(
            push=push,
            through=propagator.through[:, rows],
            along=ErrorAlongPath(
                propagator.push[:, rows], predictions, open_only=propagator.open_only
            ),
        )

    def arrive(self, states: FloatArray, windows: FloatArray) -> None:
        self.along.arrive(self.push.learned_errors(states, windows))


def _parameter_covariance(
    model: IdentifiedModel, extra: Mapping[str, float]
) -> tuple[tuple[str, ...], FloatArray]:
    """Names and covariance (k, k) of the parameters. Those that only show together have to move
    together: mass and thrust, or a thrust and the level of a flight, whose errors `extra` has."""
    declared = {d.name for d in model.dynamics.parameters}
    known, joint = as_flights_are(model)
    at = [i for i, n in enumerate(known) if n in declared and n not in extra]
    shared = [known[i] for i in at]
    own = [n for n, s in extra.items() if n in declared and np.isfinite(s) and s > 0]
    names = (*shared, *own)
    cov = np.zeros((len(names), len(names)))
    cov[: len(shared), : len(shared)] = np.nan_to_num(joint[np.ix_(at, at)])
    cov[range(len(shared), len(names)), range(len(shared), len(names))] = [
        extra[n] ** 2 for n in own
    ]
    return names, cov
