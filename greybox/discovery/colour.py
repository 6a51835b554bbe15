"""Colour: which sensors' noise is not white, as causes that the search may add.

A cause of this kind is never named: it is part of the noise that names are held against.
"""

from __future__ import annotations

import numpy as np

from greybox.discovery.cause import Cause, Causes, sensor_cause
from greybox.discovery.evidence import Fitted
from greybox.discovery.rules import RULES
from greybox.model.layer import physics_of
from greybox.model.noise import Coloured, LowPass, SensorPart
from greybox.model.noise.low_pass import FILTERED
from greybox.validation.whiteness import whiteness_of_blocks

LAGS = 25
"""Lags of the autocorrelation that are looked at."""
CLEARLY = 0.01
"""Level, over all channels, at which one counts as not white: colour is only proposed by it."""


def sensor_proposals(at: Fitted, causes: Causes) -> tuple[list[Cause], float]:
    """(colour of every sensor whose innovations are clearly not white, and a low-pass of those that
    firmware filters; log likelihood that they promise together: what the channels' own past tells).
    What is not felt goes again; none where all are white."""
    physics = physics_of(at.problem.dynamics)
    if physics is None:  # nothing is known of the sensors of a model of the user's own
        return [], 0.0
    names = at.problem.dynamics.innovations.names
    tested = whiteness_of_blocks(
        at.problem.predictor.blocks(at.problem, at.theta, False), names, max_lag=LAGS
    )
    parts: list[SensorPart] = []
    gain = 0.0
    for sensor in physics.sensors:
        own = [s.name for s in sensor.innovation_signals(physics.vehicle)]
        told = [tested[n] for n in own if n in tested]
        clear = [c.predictable for c in told if c.test.p_value < CLEARLY / len(tested)]
        if max(clear, default=0.0) > RULES.colour:
            more: list[SensorPart] = [Coloured(sensor=sensor.name)]
            # Where the clocks of gyro and attitude wander nothing tells how late a filter is.
            if sensor.name in FILTERED and not physics.kinematic_noise:
                more.append(LowPass(sensor=sensor.name))
            if new := [p for p in more if p.name not in at.structure]:
                parts += new
                gain -= sum(0.5 * c.n * np.log1p(-c.predictable) for c in told)
    return [sensor_cause(p, causes.model) for p in parts], gain
