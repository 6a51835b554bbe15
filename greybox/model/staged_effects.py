"""StagedEffects: the effects of a model, stage by stage, with their own parameters and what they
and sensors remember."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca

from greybox.errors import ModelError
from greybox.model.effect import Effect
from greybox.model.flow import Flow, Remembered
from greybox.model.sensor import Sensor
from greybox.model.vehicle import Vehicle
from greybox.symbolic import Expr


@dataclass(frozen=True, kw_only=True)
class StagedEffects:
    """`effects` in the order of their stages, on `vehicle`, with the `sensors` of the model.

    `values` everywhere below are all parameters of the model by full name, as expressions.
    """

    vehicle: Vehicle
    effects: tuple[Effect, ...]
    sensors: tuple[Sensor, ...]

    def has(self, slot: str | None) -> bool:
        """Whether an effect returns this early slot."""
        return any(slot in e.early for e in self.effects)

    def of(self, stage: str) -> Iterable[Effect]:
        """The effects of a stage."""
        return (e for e in self.effects if e.stage == stage)

    def own(self, effect: Effect, values: Mapping[str, Expr]) -> dict[str, Expr]:
        """An effect's parameters by short name."""
        return {d.name: values[f"{effect.name}.{d.name}"] for d in effect.parameters(self.vehicle)}

    def early(self, slot: str | None, values: Mapping[str, Expr]) -> Expr:
        """Sum over the effects of a slot that depends on parameters alone (`EARLY`)."""
        total: Expr = 0.0
        idle = Flow(vehicle=self.vehicle, vbat=1.0, command=ca.DM.zeros(len(self.vehicle.rotors)))
        for e in self.effects:
            if slot in e.early:
                total = total + e.apply(idle, self.own(e, values))[slot]
        return total

    @cached_property
    def needs_vbat(self) -> bool:
        """Whether an effect asks for the battery voltage, which is then the last input."""
        return any("vbat" in e.needs.columns for e in self.effects)

    def voltage(self, u: Expr) -> Expr:
        """Battery voltage [V] among the inputs, None where no effect asks for it."""
        return u[len(self.vehicle.rotors)] if self.needs_vbat else None

    # ---------------------------------------------------------------- what is remembered

    @property
    def owners(self) -> tuple[Effect | Sensor, ...]:
        """All that may remember, in the order of the state vector."""
        out: list[Effect | Sensor] = [*self.effects, *self.sensors]
        return tuple(out)

    @cached_property
    def memory(self) -> dict[str, tuple[Remembered, ...]]:
        """Effect or sensor -> its own states, in the order of the state vector."""
        return {e.name: own for e in self.owners if (own := e.memory(self.vehicle))}

    @cached_property
    def remembered(self) -> tuple[tuple[str, Remembered], ...]:
        """(effect or sensor, state), in the order of the state vector."""
        return tuple((name, r) for name, own in self.memory.items() for r in own)

    @cached_property
    def drifting(self) -> tuple[int, ...]:
        """Places among `remembered` of the states that noise pushes."""
        return tuple(i for i, (_, r) in enumerate(self.remembered) if r.drift > 0)

    def with_memory(self, owner: Effect | Sensor, flow: Flow, x: Mapping[str, Expr]) -> Flow:
        """The flow as one that remembers sees it: with its own part of the states."""
        at = 0
        for name, own in self.memory.items():
            if name == owner.name:
                return replace(flow, memory=x["memory"][at : at + len(own)])
            at += len(own)
        return flow

    def changes(
        self, flow: Flow, x: Mapping[str, Expr], values: Mapping[str, Expr], drift: Expr = None
    ) -> dict[str, Expr]:
        """d memory / dt of all that remember, as a block, pushed by the noise `drift`; none where
        nothing is remembered. Raises `ModelError` for an effect or sensor that gives another number
        of them than it declares."""
        parts = []
        for owner in self.owners:
            if owner.name not in self.memory:
                continue
            seen = self.with_memory(owner, flow, x)
            change = (
                owner.remember(seen, self.own(owner, values))
                if isinstance(owner, Effect)
                else owner.remember(seen)
            )
            part = ca.vertcat(*change) if isinstance(change, list | tuple) else ca.vertcat(change)
            expected = len(self.memory[owner.name])
            if part.shape != (expected, 1):
                kind = "effect" if isinstance(owner, Effect) else "sensor"
                got = "x".join(str(n) for n in part.shape)
                raise ModelError(
                    f"{kind} {owner.name}: remember() gives {got} values",
                    expected=f"a column of {expected}",
                )
            parts.append(part)
        if not parts:
            return {}
        rates = ca.vertcat(*parts)
        if self.drifting and drift is not None:
            spread = ca.DM.zeros(len(self.remembered), len(self.drifting))
            for j, i in enumerate(self.drifting):
                spread[i, j] = 1.0
            rates = rates + spread @ drift
        return {"memory": rates}
