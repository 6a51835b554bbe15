"""Gust: a disturbance whose axes need not turn with the craft, d+ = R(-s omega dt) exp(-dt/T) d +
w.

Moving air pushes along axes of the world; what a model has wrong of the craft turns with it. Seen
from the body, a push that stands still in the world turns by -omega dt in every sample. The share
s of that is estimated: 1 for air, 0 for the craft.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca

from greybox.model.dynamics import Dynamics
from greybox.model.noise.disturbance import Disturbance
from greybox.model.parameter import Parameter
from greybox.symbolic import Expr


@dataclass(frozen=True, kw_only=True)
class Gust(Disturbance):
    """A disturbance of three axes whose `reading` is the body's rate [rad/s]; its states and
    numbers are called as those of any disturbance."""

    kind = "gust"
    quantities = ("T", "world")

    def parameters(self, core: Dynamics) -> tuple[Parameter, ...]:
        """T [s], and world [-], the share of the craft's turning that the push does not follow."""
        return (
            *super().parameters(core),
            Parameter(
                name=f"{self.name}.world",
                unit="-",
                nominal=0.5,
                lower=0.0,
                upper=1.0,
                scale=0.5,
                meaning=f"share of the craft's turning that the {self.group} disturbance stays "
                "behind",
            ),
        )

    def rate(self, c: Expr, values: Mapping[str, Expr], reading: Expr) -> Expr:
        """-d/T - s omega x d."""
        return super().rate(c, values, reading) - values["world"] * ca.cross(reading, c)

    def step(self, c: Expr, w: Expr, values: Mapping[str, Expr], reading: Expr, dt: Expr) -> Expr:
        """What is kept of it, turned (Cayley's form of a rotation keeps lengths), and what is
        new."""
        half = -0.5 * dt * values["world"] * reading
        kept = super().step(c, 0, values, reading, dt)
        turned = 2 / (1 + ca.dot(half, half)) * ca.cross(half, kept + ca.cross(half, kept))
        return kept + turned + w
