"""Beliefs: how sure a vehicle file is of each of its numbers, and what is believed of a number that
does not say.

People who weigh and measure a craft rarely write standard deviations. In a file of schema
"greybox.vehicle/2" a number without one is believed within the default of its quantity; the table
below belongs to that schema and never changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Why = Literal["stated", "default", "exact"]
"""Where a sigma comes from: the file gives it, the file is silent, or the number is exact (sigma
0)."""


@dataclass(frozen=True, kw_only=True)
class DefaultSigma:
    """What is believed of a number that states no sigma: `share` of its own size (`center_of_mass`:
    of the arm)."""

    share: float
    reason: str


DEFAULT_SIGMAS: Mapping[str, DefaultSigma] = {
    "mass": DefaultSigma(
        share=0.01, reason="weighed: a kitchen scale, and what a strap or another battery weighs"
    ),
    "arm": DefaultSigma(
        share=0.02, reason="measured with a ruler: 1 to 2 mm of the arms of small craft"
    ),
    "inertia": DefaultSigma(
        share=0.30,
        reason="guessed from mass and arm: J / (m L^2) of published craft lies within 30 % "
        "(Foerster 2015: 0.28, 0.49; Foehn et al. 2022: 0.21, 0.18, 0.37)",
    ),
    "thrust": DefaultSigma(
        share=0.20,
        reason="data sheet or hover command: battery, propeller and frame change it by 10 to 20 %",
    ),
    "torque": DefaultSigma(
        share=0.30,
        reason="nearly always thrust times a guessed length: that length is 0.15 to 0.35 rotor "
        "radii (Leishman 2006, ch. 2)",
    ),
    "center_of_mass": DefaultSigma(
        share=0.03, reason="of the arm: how well a craft balances on two fingers"
    ),
    "effects": DefaultSigma(
        share=0.50, reason="of another craft or from the literature: the right order of magnitude"
    ),
}
"""Defaults per quantity. A coefficient or effect parameter that is zero has no size to take a share
of: it stays exact."""

UNITS = {
    "mass": "kg",
    "arm": "m",
    "inertia": "kg m^2",
    "thrust": "N",
    "torque": "N m",
    "center_of_mass": "m",
}


def default_sigma(name: str, value: float, arm: float) -> float:
    """Standard deviation of the quantity `name` ("mass", "inertia.xx", "motor_lag.tau") where none
    is stated.

    `arm` [m] is the longest arm. 0 (exact) for a coefficient or an effect's parameter that is zero.
    """
    group = group_of(name)
    return DEFAULT_SIGMAS[group].share * (arm if group == "center_of_mass" else abs(value))


def group_of(name: str) -> str:
    """The row of `DEFAULT_SIGMAS` that a name belongs to; everything that is no core quantity is an
    effect's."""
    head = name.partition(".")[0]
    return head if head in DEFAULT_SIGMAS else "effects"


@dataclass(frozen=True, kw_only=True)
class Belief:
    """One number of a vehicle file: its name, value, standard deviation (0 = exact), and where that
    comes from."""

    quantity: str
    value: float
    sigma: float
    why: Why

    @property
    def unit(self) -> str:
        """SI unit; empty for effects, whose declarations know it."""
        return UNITS.get(self.quantity.partition(".")[0], "")

    @property
    def group(self) -> str:
        """Group of the number, see `group_of`."""
        return group_of(self.quantity)

    def line(self) -> str:
        """One line for a person: `mass 0.0282 +- 0.00028 kg (default, 1 %)`."""
        unit = f" {self.unit}" if self.unit else ""
        if self.why == "exact":
            return f"{self.quantity} {self.value:.4g}{unit} (exact)"
        sure = f"{self.quantity} {self.value:.4g} +- {self.sigma:.2g}{unit} ({self.why}"
        if self.why == "stated":
            return f"{sure})"
        arm = " of the arm" * (self.group == "center_of_mass")
        return f"{sure}, {DEFAULT_SIGMAS[self.group].share:.0%}{arm})"


@dataclass(frozen=True, kw_only=True)
class Beliefs:
    """How sure a vehicle file is of each of its numbers, in the order of the model's parameters."""

    entries: tuple[Belief, ...]

    @property
    def assumed(self) -> tuple[Belief, ...]:
        """Those whose sigma is a default of its quantity."""
        return tuple(b for b in self.entries if b.why == "default")

    def lines(self) -> list[str]:
        """One line per number that a fit may move or that was believed by default; none says that
        all are exact."""
        return [b.line() for b in self.entries if b.why != "exact"]

    def sentence(self) -> str:
        """The defaults in one line; empty where every number says how sure it is (arms cannot)."""
        groups = list(dict.fromkeys(b.group for b in self.assumed))
        if groups in ([], ["arm"]):
            return ""
        said = ", ".join(
            f"{g.replace('_', ' ')} "
            f"{DEFAULT_SIGMAS[g].share:.0%}{' of the arm' if g == 'center_of_mass' else ''}"
            for g in groups
        )
        return f"believed by default, because the vehicle file gives no sigma: {said}"
