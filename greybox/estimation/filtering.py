"""Run an identified model over data: predicted states, innovations with covariance, and open-loop
rollouts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.data import Segment
from greybox.errors import FitError
from greybox.estimation.ahead import run_ahead
from greybox.estimation.engine import Engine, engine_for
from greybox.estimation.gain import Riccati, linearisation_anywhere
from greybox.estimation.record import Record, make_record
from greybox.estimation.settling import RecordGains, Settling
from greybox.model.identified import IdentifiedModel
from greybox.symbolic import FloatArray
from greybox.takes import COUNT, MODEL, SEGMENT, takes


@dataclass(frozen=True, kw_only=True, eq=False)
class Filtered:
    """One segment under the filter. Arrays have the n samples first.

    states (n, n_x): x_hat(k | k-1), from measurements up to k-1; innovations (n, n_e), zero where
    missing; outputs (n, n_y): y_hat(k | k-1); covariance (n_row, n_e, n_e) of the innovations per
    row of `gains`.
    """

    record: Record
    gains: RecordGains
    states: FloatArray
    innovations: FloatArray
    outputs: FloatArray
    covariance: FloatArray
    p: FloatArray

    @property
    def state_covariance(self) -> FloatArray:
        """Covariance (n_d, n_d) of the predicted state once the filter has settled."""
        return self.gains.solutions[0].P

    def state_covariances(self, rows: npt.NDArray[np.int_]) -> FloatArray:
        """Covariance of the predicted state at some samples (m,), (m, n_d, n_d)."""
        return self.gains.covariances[self.gains.pattern[rows]]

    @property
    def sigma(self) -> FloatArray:
        """One standard deviation of every innovation, (n, n_e)."""
        spread = np.sqrt(np.array([np.diag(s) for s in self.covariance]))
        return spread[self.gains.pattern]


def at_reference(model: IdentifiedModel) -> tuple[FloatArray, ...]:
    """(A, G, C, D) of the model at its reference point, as in greybox.estimation.gain."""
    return linearisation_anywhere(model.dynamics).values(
        model.reference_state, _reference_window(model), model.parameter_vector(), model.sample_time
    )


def _reference_window(model: IdentifiedModel) -> FloatArray:
    """Reference commands for every row that a step looks at, (n_u, past + 1 + future)."""
    return np.repeat(model.reference_inputs[:, None], sum(model.dynamics.window) + 1, axis=1)


class Filter:
    """The identified filter: gains from the model's noise levels, linearised at its reference point
    (`linear`: A, G, C, D there). `settling` follows them from the spread of a start, `riccati` is
    where they end with all channels there."""

    @takes(model=MODEL)
    def __init__(self, model: IdentifiedModel, *, use_compiler: bool = True) -> None:
        self.model = model
        self.engine: Engine = engine_for(model.dynamics, (), use_compiler=use_compiler)
        self.linear = at_reference(model)
        self.settling = Settling(
            values=self.linear,
            q=model.process_noise**2,
            r=model.sensor_noise**2,
            weak=model.weak**2,
        )
        self.riccati: Riccati = self.settling.settled()[0]

    @takes(segment=SEGMENT)
    def run(
        self,
        segment: Segment,
        p: FloatArray | None = None,
        x0: FloatArray | None = None,
        x0_sigma: FloatArray | None = None,
    ) -> Filtered:
        """Filter one segment with the parameter vector p (the flight's own values by default) from
        its measured start.

        With x0 (n_x,) from there, with errors of `x0_sigma` (n_d,); without the latter as if it had
        always run. Raises `FitError` where the prediction stops being finite, `DataError` for
        missing input columns.
        """
        record = make_record(self.engine, segment)
        vector = (
            self.model.flight_vector(segment.flight) if p is None else np.asarray(p, dtype=float)
        )
        found = self.settling.gains(record, record.spread if x0 is None else x0_sigma)
        gains, covariance, _ = found.tables()
        run = self.engine.run(
            x0=record.x0 if x0 is None else x0,
            pattern=found.pattern,
            gains=gains,
            p=vector,
            want=frozenset({"innovations", "states", "outputs"}),
            **record.samples,
        )
        run.demand_finite(f"the prediction of flight {segment.flight}")
        if run.states is None or run.innovations is None or run.outputs is None:
            raise FitError("the engine returned no arrays")
        return Filtered(
            record=record,
            states=run.states,
            innovations=run.innovations,
            outputs=run.outputs,
            gains=found,
            covariance=covariance,
            p=vector,
        )

    @takes(horizon=COUNT)
    def rollout(
        self,
        filtered: Filtered,
        origins: npt.NDArray[np.int_],
        horizon: int,
        starts: FloatArray | None = None,
    ) -> FloatArray:
        """Open-loop outputs (m, horizon, n_y) at k+1 .. k+horizon from every origin k, with the
        recorded commands.

        The state at k+1 is x_hat(k+1 | k): measurements up to and including k. Every origin must
        have `horizon` samples after it, else `FitError` is raised. `starts` (m, n_x) replaces those
        states (at row k+1).
        """
        rows = np.asarray(origins) + 1
        if rows.size and rows.max() + horizon > filtered.record.n:
            raise FitError("an origin has fewer samples after it than the horizon")
        return run_ahead(
            self.engine,
            starts=filtered.states[rows] if starts is None else starts,
            rows=rows,
            steps=horizon,
            inputs=filtered.record.inputs,
            p=filtered.p,
            dt=filtered.record.dt,
        ).outputs
