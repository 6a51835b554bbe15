"""Colour: which sensors' noise is not white, as causes that the search may add.

A cause of this kind is never named: it is part of the noise that names are held against.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from greybox.discovery.cause import Cause, Causes, sensor_cause
from greybox.discovery.evidence import Fitted
from greybox.discovery.rules import RULES
from greybox.estimation.fit import Fit
from greybox.model.layer import physics_of
from greybox.model.noise import Coloured, LowPass, SensorPart, sensor_parts
from greybox.model.noise.low_pass import FILTERED
from greybox.validation.whiteness import ChannelWhiteness, whiteness

LAGS = 25
"""Lags of the autocorrelation that are looked at."""
CLEARLY = 0.01
"""Level at which a channel counts as not white, over all channels: colour is only proposed by it."""


def innovations_of(at: Fitted) -> dict[str, ChannelWhiteness]:
    """Innovation component -> test of its whiteness, of those that can be tested."""
    names = at.problem.dynamics.innovations.names
    records = []
    for block in at.problem.predictor.blocks(at.problem, at.theta, False):
        e = np.where(block.mask != 0, block.e, np.nan)
        if len(e) > 4 * LAGS:
            records.append(e)
    live = [j for j in range(len(names)) if any(np.isfinite(e[:, j]).any() for e in records)]
    if not records or not live:
        return {}
    test = whiteness([e[:, live] for e in records], names=[names[j] for j in live], max_lag=LAGS)
    return {c.name: c for c in test.channels}


def sensor_proposals(at: Fitted, causes: Causes) -> tuple[list[Cause], float]:
    """(colour of every sensor whose innovations are clearly not white, and a low-pass of those that
    firmware filters; log likelihood that they promise together: what the channels' own past tells).
    What is not felt goes again; none where all are white."""
    physics = physics_of(at.problem.dynamics)
    assert physics is not None
    tested = innovations_of(at)
    parts: list[SensorPart] = []
    gain = 0.0
    for sensor in physics.sensors:
        own = [s.name for s in sensor.innovation_signals(physics.vehicle)]
        told = [tested[n] for n in own if n in tested]
        clear = [c.predictable for c in told if c.test.p_value < CLEARLY / len(tested)]
        if max(clear, default=0.0) > RULES.colour:
            gain -= sum(0.5 * c.n * np.log1p(-c.predictable) for c in told)
            parts.append(Coloured(sensor=sensor.name))
            if sensor.name in FILTERED:
                parts.append(LowPass(sensor=sensor.name))
    return [sensor_cause(p, causes.model) for p in parts if p.name not in at.structure], gain


def sensor_table(found: Fit) -> list[dict[str, Any]]:
    """One entry per channel and kind of noise, as in discovery.json: {channel, kind, parameters}.

    `parameters`: `sigma` of the white part; what `SensorPart.described` says of the others.
    """
    noise = {n: v for n, (v, _, _) in found.noise.items()}
    values, dt = found.model.values, found.model.sample_time
    physics = found.model.physics
    out: list[dict[str, Any]] = []
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
