"""LinearPredictor: a linear state-space model, with the gain and covariance that it brings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.decoupled import Terms, free_entries
from greybox.baselines.predictor_run import Run
from greybox.data import Segment
from greybox.errors import DataError
from greybox.estimation.record import hold_missing
from greybox.linear.prediction import adapt
from greybox.linear.predictor import predict
from greybox.linear.records import Record, delayed
from greybox.linear.validation import RUN_IN
from greybox.model.linear import LinearModel
from greybox.symbolic import Expr, FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearPredictor(BasePredictor):
    """`channels`: input of the model -> (weight, log column) of the sum that it is; by its own name
    where absent. With `adapt`, start and output offset are fitted on every segment."""

    model: LinearModel
    channels: Mapping[str, Terms] = field(default_factory=dict)
    kind = "linear"

    @property
    def gain(self) -> tuple[FloatArray, FloatArray]:
        """K and S of the model."""
        return self.model.matrices[4], self.model.noise

    @property
    def parameters(self) -> int:
        """Entries of a minimal form."""
        return free_entries(self.model)

    @property
    def commands(self) -> tuple[str, ...]:
        """Log columns that its inputs are made of."""
        return tuple(dict.fromkeys(c for n in self.model.inputs.names for _, c in self.terms(n)))

    @property
    def run_in(self) -> float:
        """It starts from zero where nothing is adapted."""
        return RUN_IN if self.adapt is None else 0.0

    @property
    def offsets(self) -> tuple[str, ...]:
        """All, where it is adapted."""
        return () if self.adapt is None else self.outputs

    @property
    def reference(self) -> tuple[FloatArray, Mapping[str, float]]:
        """Zero."""
        return np.zeros(self.model.order), {}

    @property
    def n_p(self) -> int:
        """One that is not used: the many entries of the matrices are constants of the functions."""
        return 1

    def numbers(self, p: Expr) -> Expr:
        """Entries of the matrices."""
        return ca.DM([q.nominal for q in self.model.parameters])

    def terms(self, name: str) -> Terms:
        """Those of `channels`, or the column of its name."""
        return self.channels.get(name, super().terms(name))

    def to_dict(self) -> dict[str, object]:
        """With the channels."""
        channels = {n: [list(t) for t in terms] for n, terms in self.channels.items()}
        return super().to_dict() | {"channels": channels}

    def default_features(
        self, angles: Sequence[str], commands: Sequence[str], earlier: Sequence[str]
    ) -> tuple[str, ...]:
        """Its predicted outputs: its states have no meaning."""
        return (*self.outputs, *angles, *commands, *earlier)

    def _record(self, segment: Segment) -> Record:
        """Inputs and outputs of the model, from the log."""
        model = self.model
        parts = [[w * segment.column(c) for w, c in self.terms(n)] for n in model.inputs.names]
        u = (
            np.column_stack([np.sum(p, axis=0) for p in parts])
            if parts
            else np.zeros((segment.n, 0))
        )
        u, _ = hold_missing(u)
        if not np.isfinite(u).all():
            raise DataError("an input column has no values", where=f"flight {segment.flight}")
        return Record(u=u, y=segment.matrix(model.outputs.names), name=segment.flight)

    def _run(self, segment: Segment) -> Run:
        model, record = self.model, self._record(segment)
        x0, offset, blind = np.zeros(model.order), model.output_offset, 0
        cut = max(model.delays, default=0)
        if self.adapt is not None:
            # The record begins where its delayed commands are known, and ends with the seconds to
            # adapt on.
            found = adapt(model, record, self.adapt - cut * model.dt)
            x0, offset, blind = found.x0, found.offset, found.samples
        moved = delayed(record, model.delays)
        moved = Record(u=moved.u - model.input_offset, y=moved.y - offset, name=record.name)
        x = predict(model.matrices, moved, x0, np.zeros(len(offset)), model.noise).x
        _, _, c, d, _ = model.matrices
        states, mean = (
            np.full((segment.n, model.order), np.nan),
            np.full((segment.n, len(offset)), np.nan),
        )
        states[cut:], mean[cut:] = x, x @ c.T + moved.u @ d.T + offset
        at = [model.outputs[n] for n in self.outputs]
        return Run(
            states=states,
            mean=mean[:, at],
            known=np.arange(segment.n) >= max(cut + 1, blind + cut),
            inputs=np.vstack([np.repeat(record.u[:1], cut, axis=0), record.u]),
            p=np.zeros(1),
            shift=(offset - model.output_offset)[at],
        )
