"""Innovation form with a gain that does not follow the flight: the one-step predictor of a model
with process noise.

    x_hat(k+1) = F(x_hat(k), u_k) boxplus K e_k,   e_k = y_k - h(x_hat(k), u_k),   cov(e) = S

K and S follow from the noise levels (and parameters) by the Riccati equation at a reference point,
from the spread of the start until they have settled (`greybox.estimation.settling`); where channels
are missing the same state covariance gives the gain of those that are there. Errors of the start
that samples tell are integrated out so, the others are unknowns. Sensitivities include dK and dS:
they are the exact derivatives of the predictor. (Ljung 1999, System Identification, sec. 4.3 and
7.2; Jategaonkar 2015, Flight Vehicle System Identification, ch. 5: filter-error method.)
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, final

import numpy as np

from greybox.estimation.bending import bent
from greybox.estimation.gain import Linearisation, Riccati, linearisation_at
from greybox.estimation.predictor import Block, Predictor, Prepared_co
from greybox.estimation.predictors.simulation import start_of
from greybox.estimation.settling import READINGS, SOON, RecordGains, Settling
from greybox.estimation.solver import IndexArray
from greybox.symbolic import BoolArray, FloatArray

if TYPE_CHECKING:
    from greybox.estimation.problem import Problem

FORGOTTEN = 1e-100
"""Sensitivity that is zero for the next piece. Of its start a long record forgets everything;
numbers below 1e-308, which the decay would otherwise end in, take ten times as long."""


@dataclass(frozen=True, kw_only=True, eq=False)
class InnovationPrepared:
    """What the innovation form works out once: the step linearised symbolically, the reference
    (state (n_x,), command window (n_u, past + 1 + future)) that it is evaluated at, and the
    variances (n_d,) of the very weak pseudo-measurement of every error state."""

    linearisation: Linearisation
    reference: tuple[FloatArray, FloatArray]
    weak: FloatArray


@dataclass(frozen=True, kw_only=True)
class StationaryGain(Predictor[Prepared_co]):
    """Innovation form with a gain that does not follow the flight; members say where the gain comes
    from.

    Records of more than `piece` samples come in pieces, as the sensitivities of one hour do not fit
    into memory; the numbers are the same.
    """

    has_noise: ClassVar[bool] = True
    piece: int = field(default=20_000, compare=False)

    @abstractmethod
    def gains(self, problem: Problem, theta: FloatArray, slopes: bool) -> list[RecordGains]:
        """The filter of every record at `theta`, and with `slopes` its derivatives in local
        columns. Raises `FitError`."""

    def blocks(self, problem: Problem, theta: FloatArray, jacobian: bool) -> Iterable[Block]:
        """Innovations of every record, one after the other: what is done with may be forgotten."""
        filters = self.gains(problem, theta, jacobian)
        count = len(problem.records)
        if jacobian and any(r.n > self.piece for r in problem.records):
            return (
                block
                for i in range(count)
                for block in self._pieces(problem, theta, i, filters[i], jacobian)
            )
        return problem.map_records(
            lambda i: next(self._pieces(problem, theta, i, filters[i], jacobian))
        )

    def _pieces(
        self, problem: Problem, theta: FloatArray, i: int, filters: RecordGains, jacobian: bool
    ) -> Iterator[Block]:
        """Innovations of record i, in pieces where they come with slopes."""
        engine, record, pattern = problem.engine, problem.records[i], filters.pattern
        places = [problem.place(n) for n in noise_names(problem)]
        noise_columns = np.array([p for p in places if p is not None], dtype=np.intp)
        x, moved = problem.start_of(theta, i)
        initial = problem.initial_columns(i)
        gains, covariance, slope = filters.tables()
        columns = np.concatenate([problem.local_columns(record.flight), noise_columns, initial])
        s: FloatArray | None = None
        if jacobian:
            s = np.zeros((engine.nd, columns.size))
            # Derivative of the moved start in its own chart (identity to first order in the
            # small move).
            s[:, columns.size - initial.size :] = moved
        p = problem.parameters_of(theta, record.flight)
        length = self.piece if jacobian else record.n
        for begin in range(0, record.n, length):
            rows = slice(begin, min(begin + length, record.n))
            run = engine.run(
                x0=x,
                inputs=record.inputs[begin : rows.stop + engine.past + engine.future],
                outputs=record.outputs[rows],
                mask=record.mask[rows],
                pattern=pattern[rows],
                gains=gains,
                p=p,
                dt=record.dt,
                s0=s,
                want=frozenset({"innovations", "sensitivity"})
                if jacobian
                else frozenset({"innovations"}),
            )
            run.demand_finite(f"the prediction of flight {record.flight}", begin)
            assert run.innovations is not None
            x, s = run.end, run.end_sensitivity
            if s is not None:
                s = np.where(np.abs(s) < FORGOTTEN, 0.0, s)
            yield Block(
                record=record,
                e=run.innovations,
                mask=record.mask[rows],
                jacobian=run.sensitivity,
                columns=columns,
                covariance=covariance,
                covariance_slope=slope,
                pattern=pattern[rows],
            )


@final
@dataclass(frozen=True, kw_only=True)
class Innovation(StationaryGain[InnovationPrepared]):
    """Stationary gain from the noise levels, at a reference point."""

    name: str = "innovation"

    def prepare(self, problem: Problem) -> InnovationPrepared:
        """Linearise once, symbolically; choose the reference state and command."""
        d = problem.dynamics
        past, future = d.window
        u = np.array([problem.means.get(n, 0.0) for n in d.inputs.names])
        weak = np.max([r.x0_sigma for r in problem.records], axis=0) * 100.0
        x = d.reference(problem.means)
        elsewhere = d.reference({k: v + 1.0 for k, v in problem.means.items()})
        built = problem.engine.built
        return InnovationPrepared(
            linearisation=linearisation_at(d, built, x, elsewhere).select(problem.engine.columns),
            reference=(x, np.repeat(u[:, None], past + 1 + future, axis=1)),
            weak=weak**2,
        )

    def riccati(self, problem: Problem, theta: FloatArray, slopes: bool) -> Riccati:
        """Stationary solution with all channels at `theta`, see `settling`."""
        return self.settling(problem, theta, slopes).settled()[0]

    def gains(self, problem: Problem, theta: FloatArray, slopes: bool) -> list[RecordGains]:
        """The filter of every record at `theta`, from the spread of its start as far as that is no
        unknown."""
        settling = self.settling(problem, theta, slopes)
        spreads = problem.spreads or [None] * len(problem.records)
        return [
            settling.gains(r, spread) for r, spread in zip(problem.records, spreads, strict=True)
        ]

    @property
    def carries_starts(self) -> bool:
        """Its filter starts with the covariance of the start."""
        return True

    def told(self, problem: Problem) -> list[BoolArray]:
        """The initial errors that the linearisation at nominal parameters and noise levels lets the
        samples tell, and that are within it."""
        prepared, d = problem.prepared(self), problem.dynamics
        x, window = prepared.reference
        p = np.array([q.nominal for q in d.parameters])
        nominal = Settling(
            values=prepared.linearisation.values(x, window, p, problem.dt),
            q=d.noise_scale(problem.dt) ** 2,
            r=d.sensor_scale() ** 2,
            weak=prepared.weak,
        )
        told = [nominal.told(r) for r in problem.records]
        samples = max(READINGS, round(SOON / problem.dt))
        bends = [bent(problem.engine, r, p, d.sensor_scale(), samples) for r in problem.records]
        return [(t & ~b) | r.lasting for t, b, r in zip(told, bends, problem.records, strict=True)]

    def settling(self, problem: Problem, theta: FloatArray, slopes: bool) -> Settling:
        """The filter at `theta`; per-flight parameters at their base values. Slopes are in local
        columns."""
        prepared = problem.prepared(self)
        lin, weak = prepared.linearisation, prepared.weak
        x, window = prepared.reference
        p = problem.parameters_of(theta, None)
        process, sensor = problem.noise_levels(theta)
        q, r = process**2, sensor**2
        if not slopes:
            return Settling(values=lin.values(x, window, p, problem.dt), q=q, r=r, weak=weak)
        values, dvalues = lin(x, window, p, problem.dt)
        # A per-flight parameter does not move the common gain, nor does a bias.
        shared = np.array([(a, None) in problem.index for a in problem.engine.active], dtype=bool)
        felt = np.any([v.any(axis=(1, 2)) for v in dvalues], axis=0)
        moving = shared & felt
        free = np.array([problem.place(n) is not None for n in noise_names(problem)], dtype=bool)
        na, nw, level = int(moving.sum()), q.size, np.concatenate([q, r])
        dlevel = np.diag(2 * level)[free]  # d sigma^2 / d ln sigma
        dlevel = np.concatenate([np.zeros((na, level.size)), dlevel])
        return Settling(
            values=values,
            q=q,
            r=r,
            weak=weak,
            slopes=tuple(v[moving] for v in dvalues),
            dq=dlevel[:, :nw],
            dr=dlevel[:, nw:],
            columns=np.concatenate([moving, np.ones(free.sum(), dtype=bool)]),
        )


def noise_names(problem: Problem) -> list[str]:
    """Names of all noise levels, process first, in the order of the columns of every predictor."""
    names = [f"noise.process.{n}" for n in problem.dynamics.noises.names]
    return names + [f"noise.sensor.{n}" for n in problem.dynamics.innovations.names]


def filtered_states(
    problem: Problem, theta: FloatArray, i: int, filters: RecordGains, jacobian: bool
) -> tuple[FloatArray, FloatArray | None, IndexArray]:
    """(States (n, n_x) of the filter over record i, their slopes (n, n_d, n_s) if asked for, the
    unknowns of these (n_s,)). Raises `FitError` where they are not finite."""
    record = problem.records[i]
    x0, s0, columns = start_of(problem, theta, i)
    passed = problem.engine.run(
        x0=x0,
        gains=filters.tables()[0],
        pattern=filters.pattern,
        p=problem.parameters_of(theta, record.flight),
        s0=s0 if jacobian else None,
        want=frozenset({"states", "state_sensitivity"}),
        **record.samples,
    )
    passed.demand_finite(f"the prediction of flight {record.flight}")
    assert passed.states is not None
    return passed.states, passed.state_sensitivity, columns
