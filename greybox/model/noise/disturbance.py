"""Disturbance: a slowly varying push on a group of the process noise, d+ = exp(-dt/T) d + w.

It enters where the white noise of its channel enters; T -> infinity is a random walk. The predictor
then carries the disturbance as a state (Kristensen, Madsen and Jorgensen 2004, Computers & Chemical
Engineering 28, sec. 4).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from greybox.errors import UnknownNameError
from greybox.model.dynamics import Dynamics
from greybox.model.noise import gauss_markov
from greybox.model.noise.part import NoisePart, Place
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr, FloatArray, Signal

DRIVING = 0.1
"""Start value of the level of its driving noise, as a share of the white noise of its channel."""


@dataclass(frozen=True, kw_only=True)
class Disturbance(NoisePart):
    """One state per process noise of `group`, the part of a noise name before the dot ("force",
    "torque"); `time` [s] is the start value of the correlation time T."""

    kind = "disturbance"
    quantities: ClassVar[tuple[str, ...]] = ("T",)
    lasting = True
    group: str
    time: float = 1.0

    @property
    def name(self) -> str:
        """disturbance.group, the prefix of its states and of its parameter."""
        return f"disturbance.{self.group}"

    def place(self, core: Dynamics) -> Place:
        """The process noises of the group. Raises `UnknownNameError` for a group that `core` does
        not have."""
        names = core.noises.names
        rows = tuple(i for i, n in enumerate(names) if n.split(".")[0] == self.group)
        if not rows:
            raise UnknownNameError(
                "disturbance group", self.group, {n.split(".")[0] for n in names}
            )
        return Place(signals=tuple(core.noises.signals[i] for i in rows), rows=rows)

    def signals(self, place: Place) -> tuple[Signal, ...]:
        """disturbance.<noise>, in the unit of the noise."""
        return tuple(
            Signal(name=f"disturbance.{s.name}", unit=s.unit, meaning=f"disturbance, {s.meaning}")
            for s in place.signals
        )

    def parameters(self, core: Dynamics) -> tuple[Parameter, ...]:
        """T [s], one for the group (bounds 0.02 .. 100 s)."""
        return (
            Parameter(
                name=f"{self.name}.T",
                unit="s",
                nominal=self.time,
                lower=0.02,
                upper=100.0,
                scale=self.time,
                meaning=f"correlation time of the {self.group} disturbance",
            ),
        )

    def typical(self, core: Dynamics, place: Place, dt: float) -> FloatArray:
        """The white noise of its channels."""
        return core.noise_scale(dt)[list(place.rows)]

    def rate(self, c: Expr, values: Mapping[str, Expr], reading: Expr) -> Expr:
        """-d/T."""
        return -c / values["T"]

    def step(self, c: Expr, w: Expr, values: Mapping[str, Expr], reading: Expr, dt: Expr) -> Expr:
        """exp(-dt/T) d + w; it is held over the step."""
        return gauss_markov.kept(values["T"], dt) * c + w

    def driving(self, level: FloatArray, dt: float) -> FloatArray:
        """A tenth of its channel's level."""
        return DRIVING * level

    def rescaled(self, values: Mapping[str, float], own: float, dt: float) -> float:
        """Its stationary variance stays."""
        return gauss_markov.rescaled(float(values[f"{self.name}.T"]), own, dt)
