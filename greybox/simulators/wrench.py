"""Wrench: force and moment of a craft's physics as one CasADi function, for generated code."""

from __future__ import annotations

import casadi as ca

from greybox.simulators.craft import Craft
from greybox.simulators.learned import learned_wrench

ARGUMENTS = ("attitude", "velocity", "position", "rate", "nu", "nu_rate")


def wrench_function(craft: Craft, *, learned: bool = False) -> ca.Function:
    """(attitude, velocity and position of the centre of mass in the world, rate, nu, nu_rate) ->
    force [N] and moment about the centre of mass [N m] in body axes, without gravity; with what
    was `learned` of these."""
    physics, n = craft.physics, craft.count
    q, v, x, rate, nu, change = (
        ca.SX.sym(a, k) for a, k in zip(ARGUMENTS, (4, 3, 3, 3, n, n), strict=True)
    )
    body = physics.body
    memory = ca.SX.zeros(len(body.staged.remembered))
    blocks = {"attitude": q, "velocity": v, "position": x, "rate": rate, "memory": memory}
    u = ca.SX.ones(len(physics.inputs)) * (craft.nominal_voltage or 1.0)
    values = {name: ca.SX(value) for name, value in craft.values.items()}
    force, alpha, _ = body.accelerations(blocks, nu, change, u, values, ca.SX.zeros(9))
    j = ca.DM(craft.inertia)
    moment = j @ alpha + ca.cross(rate, j @ rate)
    out = ca.densify(ca.vertcat(craft.mass * force, moment))
    push = learned_wrench(craft, blocks, nu) if learned else None
    out = out if push is None else out + push
    return ca.Function("wrench", [q, v, x, rate, nu, change], [out], {"cse": True})
