"""FilterPredictor: a physical model under its stationary filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from greybox.baselines.base_predictor import BasePredictor
from greybox.baselines.predictor_run import Run
from greybox.data import Flight, Segment
from greybox.data.segment import START_SECONDS
from greybox.estimation.filtering import Filter
from greybox.model.identified import IdentifiedModel
from greybox.residual.features import default_features
from greybox.symbolic import Expr, FloatArray
from greybox.validation.adapt import adapt_to_flight


@dataclass(frozen=True, kw_only=True, eq=False)
class FilterPredictor(BasePredictor):
    """With `adapt`, start and per-flight parameters are fitted on every segment but those of
    training flights."""

    model: IdentifiedModel
    kind = "physics"

    @cached_property
    def filter(self) -> Filter:
        """The stationary filter of the model."""
        return Filter(self.model)

    @cached_property
    def gain(self) -> tuple[FloatArray, FloatArray]:
        """Those of the filter once it has settled."""
        k, s, _, _ = self.filter.riccati.gain(np.ones(len(self.dynamics.innovations)))
        return k, s

    @property
    def parameters(self) -> int:
        """Shared parameters and their values per flight."""
        own = sum(len(v) for v in self.model.per_flight.values())
        return len(self.model.covariance_names) + own

    @property
    def commands(self) -> tuple[str, ...]:
        """The model's inputs."""
        return tuple(self.dynamics.inputs.names)

    @property
    def run_in(self) -> float:
        """Nothing: the filter starts from what is measured, with its spread."""
        return 0.0

    @property
    def offsets(self) -> tuple[str, ...]:
        """None: sensors that are off are parameters of the model."""
        return ()

    @property
    def reference(self) -> tuple[FloatArray, Mapping[str, float]]:
        """That of the model."""
        names = self.dynamics.inputs.names
        return self.model.reference_state, dict(zip(names, self.model.reference_inputs.tolist()))

    @property
    def n_p(self) -> int:
        """All parameters: they may differ from flight to flight."""
        return len(self.dynamics.parameters)

    def numbers(self, p: Expr) -> Expr:
        """The argument itself."""
        return p

    def default_features(
        self, angles: Sequence[str], commands: Sequence[str], earlier: Sequence[str]
    ) -> tuple[str, ...]:
        """Its predicted motion and rotors, which tell more than commands do; attitude is predicted
        too."""
        inputs, states = self.dynamics.inputs.names, self.dynamics.states.names
        own = [n for n in default_features(self.dynamics) if n not in inputs]
        attitude = ("phi", "theta") if "rate" in {n.split(".")[0] for n in states} else ()
        rotors = any(n.startswith("nu") for n in own) and not earlier
        return (*attitude, *own, *(() if rotors else commands), *earlier)

    def _run(self, segment: Segment) -> Run:
        model = self.model
        p, x0, sigma, blind = None, None, None, max(3, round(START_SECONDS / segment.dt))
        if self.adapt is not None and segment.flight not in model.trained_on:
            flight = Flight(name=segment.flight, segments=(segment,))
            found = adapt_to_flight(model, flight, self.adapt, riccati=self.filter.riccati)
            p, x0, sigma = model.parameter_vector(found.values), found.x0, found.x0_sigma
            blind = round(self.adapt / segment.dt)
        filtered = self.filter.run(segment, p=p, x0=x0, x0_sigma=sigma)
        at = [self.dynamics.outputs[n] for n in self.outputs]
        return Run(
            states=filtered.states[: segment.n],
            mean=filtered.outputs[:, at],
            known=np.arange(segment.n) >= blind,
            inputs=filtered.record.inputs,
            p=filtered.p,
            shift=np.zeros(len(at)),
        )
