"""Effect: one physical equation that may be missing from the core model, its parameters, and what
it needs.

An effect lives in exactly one stage. How effects of one stage combine is fixed by the stage (see
`SLOTS`), never by the order in which they are listed, and every effect is the identity at its null
parameters: removal is exact and every smaller model is nested. A new effect is one small file plus
one line in the catalogue tuple.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, TypedDict, Unpack

import numpy.typing as npt

from greybox.model.clock import DELAYS
from greybox.model.flow import Flow, Remembered
from greybox.model.parameter import Parameter, Scope
from greybox.model.sensors import SENSORS
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr

Stage = Literal["command", "rotor", "thrust", "body", "wrench", "sensor"]

SLOTS: Mapping[str, frozenset[str]] = {
    "command": frozenset({"delay", "command"}),
    "rotor": frozenset({"steady_factor", "lag", "lag_asymmetry", "lag_speed", "lag_second"}),
    "thrust": frozenset({"thrust_factor", "torque_factor", "thrust_increment"}),
    "body": frozenset({"mass_factor", "inertia_increment", "center_of_mass"}),
    "wrench": frozenset({"force", "moment", "hub_force", "wind"}),
    "sensor": frozenset(s.name for s in SENSORS) | DELAYS,
}
"""What an effect of a stage may return. command: delays add [s], commands form the fixed chain;
rotor: factors multiply, at most one lag [s], longer by lag_asymmetry of itself for rotors that slow
down and shorter by as much for those that speed up, its inverse growing with speed in the share
lag_speed, of second order by lag_second; thrust: factors multiply T_i or Q_i, then increments [N]
add; body: factors multiply, increments add; wrench: forces [N] and moments [N m] add in body axes,
hub_force (3 x n) acts at the hubs, winds [m/s] in world axes add; sensor: the value replaces that
of the sensor of that name, in the order of `Effect.order`, delays of a clock (see
`greybox.model.clock`) [s] add."""

EARLY = frozenset({"delay", "lag", "lag_asymmetry", "lag_speed", "lag_second", "wind"}) | DELAYS
"""Slots that the model must know before it comes to their stage: states, window and airspeeds
depend on them."""


@dataclass(frozen=True, kw_only=True)
class ReferenceCase:
    """Numbers worked by hand: at these parameters and signals the effect must return `expected`
    (per slot).

    `working` shows the arithmetic, so that a reader can repeat it without running code.
    """

    parameters: Mapping[str, float]
    flow: Mapping[str, npt.ArrayLike]
    expected: Mapping[str, npt.ArrayLike]
    working: str


@dataclass(frozen=True, kw_only=True)
class Needs:
    """What must be there for the effect to be in a model and to be felt.

    All `columns` of the log, all facts of the `vehicle` file (dotted, as "actuator.rotor_radius"),
    one of `sensors` and one of `other_sensors`. Of `effects` one must be in the model for this one
    to be felt; a model without is allowed.
    """

    columns: tuple[str, ...] = ()
    vehicle: tuple[str, ...] = ()
    sensors: tuple[str, ...] = ()
    other_sensors: tuple[str, ...] = ()
    effects: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class EffectSource:
    """Where an effect was read: the file's name without its folder, the SHA-256 of its text, and
    the text."""

    file: str
    sha256: str
    text: str


class Effect(ABC):
    """Base of all effects: declarations as class attributes, the formula in `apply`.

    Effects of the catalogue also name their source and have a case worked by hand; an effect from a
    user's file may leave out `references`, `validity` and `case`.
    """

    name: ClassVar[str]
    stage: ClassVar[Stage]
    summary: ClassVar[str]
    formula: ClassVar[str]
    references: ClassVar[tuple[str, ...]] = ()
    validity: ClassVar[str] = ""
    tags: ClassVar[frozenset[str]] = frozenset()
    needs: ClassVar[Needs] = Needs()
    order: ClassVar[int] = 0
    early: ClassVar[frozenset[str]] = frozenset()
    """Those of `EARLY` that `apply` returns. They depend on the effect's parameters alone."""
    beyond: ClassVar[str] = ""
    """What flights say that want a parameter by {0} beyond the bound where the effect is nothing,
    {1} in whole rows, and what to do; empty where that is not known."""
    case: ClassVar[ReferenceCase]
    source: ClassVar[EffectSource | None] = None
    """The file that it was loaded from; None: of the catalogue, or of the caller's own code."""

    @abstractmethod
    def parameters(self, vehicle: Vehicle) -> tuple[Parameter, ...]:
        """Declarations, named without the effect's prefix."""

    @abstractmethod
    def apply(self, flow: Flow, p: Mapping[str, Expr]) -> Mapping[str, Expr]:
        """The formula: slots of the stage -> expressions. `p` holds the effect's own parameters by
        short name."""

    def memory(self, vehicle: Vehicle) -> tuple[Remembered, ...]:
        """States of its own, for an effect that remembers (stages thrust, wrench); `flow.memory`
        has them in this order."""
        return ()

    def remember(self, flow: Flow, p: Mapping[str, Expr]) -> Expr:
        """d memory / dt [unit / s], one value per state of `memory`, with all of `flow` known."""
        raise NotImplementedError(
            f"effect {self.name} has a memory and does not say how it changes"
        )

    def derived(self, p: Mapping[str, Expr], vehicle: Vehicle) -> Mapping[str, Expr]:
        """Further named numbers that follow from the parameters (reported with error bars, never
        fitted)."""
        return {}

    def missing(
        self,
        vehicle: Vehicle | None,
        sensors: Collection[str],
        columns: Collection[str] | None = None,
    ) -> tuple[str, ...]:
        """What the effect needs and is not there, in words; empty where it can be in a model.

        `vehicle` may be None (nothing is stated), `sensors` are the names of the model's sensors,
        `columns` those of the log (None: not
        asked).
        """
        needs = self.needs
        out = [f"column {c}" for c in needs.columns if columns is not None and c not in columns]
        out += [
            f"{fact} in the vehicle file" for fact in needs.vehicle if _fact(vehicle, fact) is None
        ]
        either = [
            group
            for group in (needs.sensors, needs.other_sensors)
            if group and not set(group) & set(sensors)
        ]
        return (*out, *(f"sensor {' or '.join(group)}" for group in either))

    def __repr__(self) -> str:
        return f"<effect {self.name}>"


def _fact(vehicle: Vehicle | None, dotted: str) -> object:
    """A fact of the vehicle by its dotted name, None where it is not stated."""
    fact: object = vehicle
    for part in dotted.split("."):
        fact = getattr(fact, part, None)
    return fact


class Declaration(TypedDict, total=False):
    """What else `Parameter` takes, alike for all axes."""

    lower: float
    upper: float
    sigma: float
    possible: float
    scope: Scope


def delay_parameters(meaning: str, lower: float, upper: float) -> tuple[Parameter, ...]:
    """A delay d [s] from `lower` to `upper`; none is its null."""
    return (
        Parameter(
            name="d",
            unit="s",
            nominal=0.0,
            lower=lower,
            upper=upper,
            null=0.0,
            scale=0.01,
            meaning=meaning,
        ),
    )


def vector_parameters(
    prefix: str,
    axes: Iterable[str],
    *,
    unit: str,
    scale: float,
    meaning: str,
    **declaration: Unpack[Declaration],
) -> tuple[Parameter, ...]:
    """One parameter per name among `axes` ("xyz"), named prefix + axis, all declared alike with null
    and nominal 0."""
    return tuple(
        Parameter(
            name=f"{prefix}{a}",
            unit=unit,
            nominal=0.0,
            null=0.0,
            scale=scale,
            meaning=f"{meaning}, {a}",
            **declaration,
        )
        for a in axes
    )
