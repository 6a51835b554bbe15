"""Cause: one thing that a model may miss, and how large it typically is.

An effect of the catalogue or of the user's file, a law, and a part of the sensors' noise are the
same to the search: each has parameters with a value at which it is absent and a prior about it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, Self

from greybox.discovery.rules import RULES
from greybox.estimation.prior import Prior
from greybox.model.absence import absence, moved_numbers, not_offered
from greybox.model.dynamics import Dynamics
from greybox.model.effect import Effect
from greybox.model.effects import CATALOGUE
from greybox.model.known import NOTHING, Known
from greybox.model.model import PhysicsModel, build_model
from greybox.model.noise import Augmented, Disturbance, Gust, SensorPart
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.residual.laws.effect_file import Law, proposal_text, proposed

Kind = Literal["effect", "sensor noise"]
LEVELS = ("thrust_level", "rotor_speed_scale")
BASE = ("gyro_bias", "accelerometer_bias", *LEVELS)
"""From the start: no sensor is without a bias, no file knows the air and the battery (`LEVELS`)."""
GROUPS = ("force", "torque")
"""Groups of the process noise that carry the unnamed discrepancy."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Cause:
    """One candidate. `parameters` are full names, `prior` maps each to the value at which the cause
    is absent and the standard deviation about it. `needs`: causes without one of which it is not
    felt (a wind without a drag). An effect's `early` slots change states or command window."""

    name: str
    kind: Kind
    parameters: tuple[str, ...]
    prior: Mapping[str, tuple[float, float]]
    needs: tuple[str, ...] = ()
    early: bool = False
    effect: Effect | None = None
    part: SensorPart | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Causes(ABC):
    """All causes that are `offered`, on one `model` that holds what is not offered. `core` are the
    free parameters that are of no cause, `unjudged` maps what cannot be offered to the reason.
    `known` (value, standard deviation) and `untold`: of a model that was identified before, see
    `greybox.model.known`. `flat`: no parameter has a prior."""

    model: Dynamics
    offered: Mapping[str, Cause]
    core: tuple[str, ...]
    unjudged: Mapping[str, str]
    per_flight: tuple[str, ...] = ()
    known: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    untold: tuple[Mapping[str, float], ...] = ()
    flat: bool = False

    @abstractmethod
    def built(self, structure: Iterable[str]) -> Augmented:
        """The model of a structure: core, effects, what has no name, sensor noise."""

    @abstractmethod
    def with_cause(self, *more: Cause) -> Self:
        """These and further causes. Raises `ModelError` where the model cannot have one."""

    @abstractmethod
    def of_laws(self, laws: Sequence[Law], taken: Collection[str]) -> list[Cause]:
        """Laws of what has no name as causes proposal_<axis>, with coefficients c_1, c_2, ..."""

    @abstractmethod
    def law_file(self, law: Law, number: int, taken: Collection[str]) -> str:
        """The text of the file proposal_<number>.py."""

    def canonical(self) -> Causes:
        """The same as it goes over the wire."""
        return self

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects among the causes."""
        return tuple(n for n, c in self.offered.items() if c.kind == "effect")

    @property
    def base(self) -> frozenset[str]:
        """Causes that are in the structure from the start."""
        return frozenset(n for n in BASE if n in self.offered)

    @property
    def omega_known(self) -> bool:
        """Whether rotor speeds are known, where rotors are."""
        return True

    def prior_of(self, name: str) -> tuple[float, float] | None:
        """(value at which its cause is absent, sigma) of a parameter; None without a cause."""
        owner = self.offered.get(name.split(".")[0])
        return None if owner is None else owner.prior.get(name)

    def prior(self, d: Parameter, chosen: Iterable[Cause] = ()) -> Prior | None:
        """That of a parameter where it is not its declaration's: an effect is known by its order;
        what was stated may be another craft's; with a `chosen` load inertia is as the file says."""
        if d.name in self.known:
            mean, sigma = self.known[d.name]
            new = any(c.effect is not None and c.effect.stage == "body" for c in chosen)
            turns = new and d.name.startswith("inertia.")
            return Prior(mean, max(sigma, d.sigma) if turns else sigma)
        if (own := self.prior_of(d.name)) is not None:
            return Prior(*own, long_tails=d.name.split(".")[0] in self.effects)
        if d.name.split(".")[0] in ("disturbance", "coloured", "low_pass", "line"):
            return Prior(d.nominal, RULES.typical * d.scale)
        if 0.0 < d.sigma < math.inf:
            return Prior(d.nominal, d.sigma, long_tails=True, normal_core=True)
        return None


@dataclass(frozen=True, kw_only=True, eq=False)
class VehicleCauses(Causes):
    """Those of a vehicle: `model` holds every effect of them and those of the vehicle file."""

    model: PhysicsModel

    @property
    def omega_known(self) -> bool:
        """Whether the vehicle file knows the rotors' speed."""
        return self.model.omega_known

    @cached_property
    def groups(self) -> tuple[str, ...]:
        """Groups of the process noise with an unnamed discrepancy."""
        names = {n.split(".")[0] for n in self.model.noises.names}
        return tuple(g for g in GROUPS if g in names)

    def built(self, structure: Iterable[str]) -> Augmented:
        """The model of a structure: core, effects, unnamed force and torque, sensor noise."""
        chosen = {n: self.offered[n] for n in structure}
        gone = [n for n in self.effects if n not in chosen]
        parts = [c.part for c in chosen.values() if c.part is not None]
        core = self.model.without_effect(*gone) if gone else self.model
        states = [(Gust if g == "force" else Disturbance)(group=g) for g in self.groups]
        return Augmented(core=core, parts=(*parts, *states))

    def canonical(self) -> Causes:
        """The same with the catalogue's own effects, which share one build over the wire."""
        own = {type(e): e for e in CATALOGUE}
        effects = tuple(own.get(type(e), e) for e in self.model.effects)
        same = effects == self.model.effects
        return self if same else replace(self, model=replace(self.model, effects=effects))

    def with_cause(self, *more: Cause) -> Self:
        """These and further causes. Raises `ModelError` where the model cannot have one."""
        effects = [c.effect for c in more if c.effect is not None]
        model = self.model.with_effect(*effects) if effects else self.model
        return replace(self, model=model, offered={**self.offered, **{c.name: c for c in more}})

    def of_laws(self, laws: Sequence[Law], taken: Collection[str]) -> list[Cause]:
        """Each an effect, read back from its file."""
        return [cause_of(e, self.model.vehicle) for e in proposed(laws, taken)]

    def law_file(self, law: Law, number: int, taken: Collection[str]) -> str:
        """An effect file."""
        return proposal_text(law, number, taken)


def cause_of(effect: Effect, vehicle: Vehicle) -> Cause:
    """An effect as a cause."""
    prior = absence(effect, vehicle)
    return Cause(
        name=effect.name,
        kind="effect",
        parameters=tuple(prior),
        prior=prior,
        needs=effect.needs.effects,
        early=bool(effect.early) or bool(effect.memory(vehicle)),
        effect=effect,
    )


def sensor_cause(part: SensorPart, model: Dynamics) -> Cause:
    """A part of the sensors' noise as a cause; its name is that of the part."""
    prior = {d.name: (d.nominal, RULES.typical * d.scale) for d in part.parameters(model)}
    return Cause(
        name=part.name,
        kind="sensor noise",
        parameters=tuple(prior),
        prior=prior,
        early=True,
        part=part,
    )


def offer(
    vehicle: Vehicle,
    columns: Iterable[str],
    *,
    own: Iterable[Effect] = (),
    sample_time: float = 0.01,
    noncausal: Iterable[str] = (),
    kinematic_noise: bool = False,
    fixed: Iterable[str] = (),
    per_flight: Iterable[str] = (),
    known: Known = NOTHING,
) -> VehicleCauses:
    """The effects of the catalogue and of the user's `own` that the vehicle file and the `columns`
    of the log allow, and the biases of the sensors; those in the file, or in the model that was
    `known`, not again. Raises `ModelError` for a log without sensors.
    """
    columns, noncausal = tuple(columns), tuple(noncausal)

    def build(effects: Iterable[Effect]) -> PhysicsModel:
        return build_model(
            vehicle,
            columns,
            (*known.effects, *effects),
            input=known.input,
            sample_time=sample_time,
            noncausal=noncausal,
            kinematic_noise=kinematic_noise,
        )

    bare = build(())
    there = {e.name for e in bare.effects}
    chosen: list[Effect] = []
    unjudged: dict[str, str] = {}
    for effect in (e for e in (*CATALOGUE, *own) if e.name not in there):
        if (why := not_offered(effect, bare, columns)) is None:
            chosen.append(effect)
        else:
            unjudged[effect.name] = why
    model = build(chosen)
    causes = {e.name: cause_of(e, vehicle) for e in chosen}
    every = {p for c in causes.values() for p in c.parameters}
    levels = [d.name for d in model.parameters if d.name.split(".")[0] in LEVELS]
    # Were these free in every model, their effect could never be needed.
    held = {*fixed, *known.held, *(n for e in chosen for n in moved_numbers(e, vehicle, "default"))}
    core = tuple(
        d.name
        for d in model.parameters
        if d.sigma > 0 and d.name not in every and d.name not in held
    )
    return VehicleCauses(
        model=model,
        offered=causes,
        core=core,
        unjudged=unjudged,
        per_flight=(*per_flight, *(levels if "vbat" not in columns else [])),
        known=known.prior,
        untold=known.untold,
    )
