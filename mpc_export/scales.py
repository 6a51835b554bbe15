"""Limits of the commands and typical sizes of x, u and y of an exported model."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from greybox.model.layer import physics_of
from greybox.symbolic import FloatArray
from mpc_export.model_parts import ModelParts

SCALES = {"position": 1.0, "velocity": 1.0, "attitude": 1.0, "rate": 1.0, "rotor": 1.0}


def command_limits(parts: ModelParts) -> tuple[FloatArray, FloatArray]:
    """(lower, upper) of the commands: the range in the vehicle file, of rotor speeds 0 ..
    speed_max, else what was seen in training."""
    domain = parts.model.domain
    physics = physics_of(parts.sampled.dynamics)
    rows = []
    for name in parts.sampled.inputs.names:
        if physics is not None:
            actuator = physics.vehicle.actuator
            ends = (actuator.u_min, actuator.u_max)
            if name.startswith("omega"):
                ends = (0.0, math.inf if actuator.speed_max is None else actuator.speed_max)
            rows.append(ends)
        else:
            rows.append(domain.get(name, (-math.inf, math.inf)))
    values = np.array(rows, dtype=float).reshape(-1, 2)
    return values[:, 0], values[:, 1]


def typical_sizes(parts: ModelParts) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Typical sizes of x, u and y: dimensionless = value / scale. Of outputs half the range seen in
    training."""
    s, domain = parts.sampled, parts.model.domain

    def half(name: str, default: float) -> float:
        low, high = domain.get(name, (0.0, 0.0))
        size = max(abs(low), abs(high)) if math.isfinite(low) and math.isfinite(high) else 0.0
        return size if size > 0 else default

    rates = dict(zip(("rate.x", "rate.y", "rate.z"), "pqr"))
    speeds = dict(zip(("velocity.x", "velocity.y", "velocity.z"), ("vx", "vy", "vz")))
    pushes = {
        f"disturbance.{n}": v for n, v in zip(s.dynamics.noises.names, s.dynamics.noise_scale(0.01))
    }
    physics = physics_of(s.dynamics)
    remembered: Mapping[str, float] = {} if physics is None else physics.memory_sizes
    lower, upper = command_limits(parts)
    width = np.where(np.isfinite(upper - lower), np.maximum(np.abs(lower), np.abs(upper)), 1.0)
    commands = dict(zip(s.inputs.names, np.where(width > 0, width, 1.0).tolist()))
    x = []
    for name in s.states.names:
        head = name.split(".")[0]
        if head == "history":
            x.append(commands.get(name.split(".")[1], 1.0))
        elif name in pushes:
            x.append(float(pushes[name]) or 1.0)
        else:
            x.append(
                half((rates | speeds).get(name, name), remembered.get(name, SCALES.get(head, 1.0)))
            )
    y = [half(n, 1.0) for n in s.dynamics.outputs.names]
    return np.array(x), np.array(list(commands.values())), np.array(y)
