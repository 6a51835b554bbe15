"""One-step errors of a filter, collected over flights: metrics per channel, residual tests,
coverage of intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from greybox.errors import DataError
from greybox.estimation.filtering import Filtered
from greybox.model.dynamics import Dynamics
from greybox.symbolic import BoolArray, FloatArray
from greybox.validation.coverage import LEVELS, Coverage, interval_coverage
from greybox.validation.cross_correlation import CrossCorrelation, cross_correlation
from greybox.validation.metrics import ChannelMetrics, channel_metrics
from greybox.validation.whiteness import Whiteness, whiteness

QUATERNION = ("qw", "qx", "qy", "qz")


@dataclass(kw_only=True)
class OneStep:
    """Adds up what the filter predicted one sample ahead; `metrics`, `tests` and `coverage` give
    the results."""

    dynamics: Dynamics
    measured: list[FloatArray] = field(default_factory=list)
    predicted: list[FloatArray] = field(default_factory=list)
    innovations: list[FloatArray] = field(default_factory=list)
    normalised: list[FloatArray] = field(default_factory=list)
    inputs: list[FloatArray] = field(default_factory=list)
    flights: list[str] = field(default_factory=list)

    def add(self, flight: str, filtered: Filtered, rows: BoolArray) -> None:
        """The samples `rows` (N,) of one segment."""
        record = filtered.record
        if rows.sum() < 2:
            return
        measured, predicted = record.outputs[rows].copy(), filtered.outputs[rows].copy()
        names = self.dynamics.outputs.names
        if all(n in names for n in QUATERNION):
            at = [self.dynamics.outputs[n] for n in QUATERNION]
            # q and -q are the same attitude.
            opposite = np.sum(np.nan_to_num(measured[:, at]) * predicted[:, at], axis=1) < 0
            predicted[np.ix_(opposite, at)] *= -1.0
        e = np.where(record.mask != 0, filtered.innovations, np.nan)[rows]
        self.measured.append(measured)
        self.predicted.append(predicted)
        self.innovations.append(e)
        self.normalised.append(e / filtered.sigma[rows])
        self.inputs.append(record.segment.matrix(self.dynamics.inputs.names)[rows])
        self.flights.append(flight)

    def metrics(self) -> dict[str, ChannelMetrics]:
        """Per output channel, over all flights; a channel that was never measured is left out."""
        if not self.measured:
            return {}
        y, p = np.concatenate(self.measured), np.concatenate(self.predicted)
        signals = self.dynamics.outputs.signals
        return {
            s.name: channel_metrics(y[:, i], p[:, i], unit=s.unit)
            for i, s in enumerate(signals)
            if np.isfinite(y[:, i]).any()
        }

    def coverage(self) -> dict[str, Sequence[Coverage]]:
        """Per innovation component the share inside the predicted intervals; the bands are block
        bootstraps."""
        out: dict[str, Sequence[Coverage]] = {}
        for i, name in enumerate(self.dynamics.innovations.names):
            parts = [z[:, i] for z in self.normalised if np.isfinite(z[:, i]).any()]
            if parts:
                out[name] = [
                    interval_coverage(parts, 1.0, nominal=level, block=50) for level in LEVELS
                ]
        return out

    def tests(self) -> tuple[Whiteness | None, CrossCorrelation | None, list[str]]:
        """(whiteness, cross-correlation with the inputs, warnings why one of them is missing)."""
        said: list[str] = []
        names = self.dynamics.innovations.names
        keep = [
            i for i in range(len(names)) if any(np.isfinite(z[:, i]).any() for z in self.normalised)
        ]
        z = [v[:, keep] for v in self.normalised]
        white: Whiteness | None = None
        cross: CrossCorrelation | None = None
        try:
            white = whiteness(z, names=[names[i] for i in keep])
        except DataError as error:
            said.append(f"no whiteness test: {error}")
        try:
            cross = cross_correlation(
                z,
                self.inputs,
                names=[names[i] for i in keep],
                input_names=self.dynamics.inputs.names,
            )
        except DataError as error:
            said.append(f"no test of the innovations against the inputs: {error}")
        return white, cross, said
