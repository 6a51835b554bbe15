"""Felt: which states and forces the sensors of a model feel at all (structural observability)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple, TypeVar

import casadi as ca

from greybox.frames import quat_derivative
from greybox.model.flow import Flow
from greybox.model.sensor_clocks import SensorClocks
from greybox.model.state_blocks import BLOCKS
from greybox.symbolic import Expr

Found = TypeVar("Found")


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
        return _known(_blocks, self)

    @cached_property
    def force(self) -> bool:
        """Whether a sensor feels forces at once, and not only through the velocity."""
        return _known(_force, self)

    @cached_property
    def place(self) -> bool:
        """Whether forces or moments depend on the position (as near the ground), where that is
        felt."""
        return _known(_place, self)


def _known(ask: Callable[[Felt], Found], felt: Felt) -> Found:
    """What is known of every model that is made again, as with other values or for a further
    flight."""
    try:
        return _asked(ask, felt)  # type: ignore[return-value]
    except TypeError:  # an effect of one's own that cannot be hashed
        return ask(felt)


@lru_cache(maxsize=512)
def _asked(ask: Callable[[Felt], object], felt: Felt) -> object:
    return ask(felt)


def _blocks(felt: Felt) -> tuple[str, ...]:
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


def _force(felt: Felt) -> bool:
    push = ca.SX.sym("force", 3)
    now = felt._at_rest(felt._symbols(), ca.vertcat(push, ca.DM.zeros(3)))
    return any(ca.which_depends(now.readings, push, 1, False))


def _place(felt: Felt) -> bool:
    if not felt.clocks.body.staged.effects or "position" not in felt.blocks:
        return False
    x = felt._symbols()
    now = felt._at_rest(x, ca.DM.zeros(6))
    moved = ca.vertcat(now.force, now.alpha, *now.changes.values())
    return any(ca.which_depends(moved, x["position"], 1, False))
