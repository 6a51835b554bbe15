"""Felt: which states and forces the sensors of a model feel at all (structural observability)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import casadi as ca

from greybox.frames import quat_derivative
from greybox.model.flow import Flow
from greybox.model.sensor_clocks import SensorClocks
from greybox.model.state_blocks import BLOCKS
from greybox.symbolic import Expr


class Moment(NamedTuple):
    """All that is to be known at one instant, with rotors at a steady speed."""

    force: Expr  # specific, body axes
    alpha: Expr  # angular acceleration
    flow: Flow
    changes: Mapping[str, Expr]  # rates of memories, a block or none
    readings: Expr


@dataclass(frozen=True, kw_only=True)
class Felt:
    """What the sensors on their `clocks` feel, in a model with these `parameters` and so many
    `inputs`."""

    clocks: SensorClocks
    parameters: tuple[str, ...]
    inputs: int

    def _at_rest(self, x: Mapping[str, Expr], w: Expr) -> Moment:
        body = self.clocks.body
        nu, u = ca.SX.sym("nu", body.rotors.count), ca.SX.sym("u", self.inputs)
        p = ca.SX.sym("p", len(self.parameters))
        values = {name: p[i] for i, name in enumerate(self.parameters)}
        force, alpha, flow = body.accelerations(x, nu, nu * 0, u, values, w)
        changes = body.staged.changes(flow, x, values)
        readings = self.clocks.shown(flow, force, x, values)
        return Moment(force, alpha, flow, changes, ca.vertcat(*readings.values()))

    def _symbols(self) -> dict[str, Expr]:
        """Symbols of all state blocks but the rotors'."""
        count = len(self.clocks.body.staged.remembered)
        own = {"memory": ca.SX.sym("memory", count)} if count else {}
        return {b: ca.SX.sym(b, block.size) for b, block in BLOCKS.items()} | own

    @cached_property
    def blocks(self) -> tuple[str, ...]:
        """State blocks of the rigid body that some sensor feels, directly or through other
        states."""
        try:
            return _blocks(self)
        except TypeError:  # an effect of one's own that cannot be hashed
            return _blocks.__wrapped__(self)

    @cached_property
    def force(self) -> bool:
        """Whether a sensor feels forces at once, and not only through the velocity."""
        push = ca.SX.sym("force", 3)
        now = self._at_rest(self._symbols(), ca.vertcat(push, ca.DM.zeros(3)))
        return any(ca.which_depends(now.readings, push, 1, False))

    @cached_property
    def place(self) -> bool:
        """Whether forces or moments depend on the position (as near the ground), where that is
        felt."""
        if not self.clocks.body.staged.effects or "position" not in self.blocks:
            return False
        x = self._symbols()
        now = self._at_rest(x, ca.DM.zeros(6))
        felt = ca.vertcat(now.force, now.alpha, *now.changes.values())
        return any(ca.which_depends(felt, x["position"], 1, False))


@lru_cache(maxsize=256)
def _blocks(felt: Felt) -> tuple[str, ...]:
    """Known for every model that is made again, as with other values or for a further flight."""
    x = felt._symbols()
    now = felt._at_rest(x, ca.SX.sym("w", 6))
    # Gravity enters the velocity equation in body axes through the attitude.
    turn = now.flow.rotation
    rates = dict(now.changes) | {
        "position": x["velocity"],
        "velocity": turn.T @ (turn @ now.force + ca.vertcat(0, 0, -1)) + now.flow.velocity * 0,
        "attitude": quat_derivative(x["attitude"], x["rate"]),
        "rate": now.alpha,
    }
    found: set[str] = set()
    frontier = [now.readings]
    while frontier:
        expression = frontier.pop()
        for b, symbol in x.items():
            if b not in found and ca.which_depends(expression, symbol, 1, True).count(True):
                found.add(b)
                frontier.append(rates[b])
    return tuple(b for b in BLOCKS if b in found)
