"""The noise of a fit's sensors as a table, as discovery.json holds it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypedDict

from greybox.estimation.fit import Fit
from greybox.model.layer import physics_of
from greybox.model.noise import sensor_parts


class SensorRow(TypedDict):
    """One channel and kind of noise: what it is made of, by name."""

    channel: str
    kind: str
    parameters: Mapping[str, float | None]


def sensor_table(found: Fit) -> list[SensorRow]:
    """One entry per channel and kind of noise, as in discovery.json: {channel, kind, parameters}.

    `parameters`: `sigma` of the white part; what `SensorPart.described` says of the others.
    """
    noise = {n: v for n, (v, _, _) in found.noise.items()}
    values, dt = found.model.values, found.model.sample_time
    physics = physics_of(found.model.dynamics)
    out: list[SensorRow] = []
    if physics is None:
        names = found.model.dynamics.innovations.names
        sigma = {c: {"sigma": noise.get(f"noise.sensor.{c}")} for c in names}
        return [{"channel": c, "kind": "white", "parameters": s} for c, s in sigma.items()]
    for sensor in physics.sensors:
        channels = [s.name for s in sensor.innovation_signals(physics.vehicle)]
        out += [
            {"channel": c, "kind": "white", "parameters": {"sigma": noise.get(f"noise.sensor.{c}")}}
            for c in channels
        ]
        for part in sensor_parts(found.model.dynamics):
            if part.sensor != sensor.name:
                continue
            for c in channels:
                level = noise.get(f"noise.process.{part.name}.c.{c.split('.')[-1]}", 0.0)
                said = part.described(level, values, dt)
                out.append({"channel": c, "kind": part.kind, "parameters": said})
    return out
