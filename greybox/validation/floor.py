"""Floor: dead reckoning with the measured IMU from the pose at every origin, the best that a model
which sees commands alone can come near."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from greybox.data import Segment
from greybox.estimation.filtering import Filtered
from greybox.symbolic import FloatArray, IntArray
from greybox.validation.baselines import ImuBias, dead_reckoning, imu_record
from greybox.validation.open_loop import GroupReader


def reckoned_from(
    segment: Segment,
    filtered: Filtered,
    reader: GroupReader,
    references: Mapping[str, FloatArray],
    origins: IntArray,
    *,
    past: int,
    steps: int,
    bias: ImuBias,
    gravity: float,
) -> dict[str, FloatArray]:
    """Group -> predictions (m, steps, dimension) from the measured pose at the origins (m,) and the
    filter's velocity there, all known causally. A pose that no sample of that row measures is the
    filter's, too: a pose is often slower than the IMU.

    `references` hold the measured rotation; `past` is the number of commands before the first
    sample in the record.
    """
    commands = filtered.record.inputs[origins + past]
    own = reader.values(filtered.outputs[origins], filtered.states[origins], filtered.p, commands)

    def start(group: str) -> FloatArray | None:
        if group not in references:
            return own.get(group)
        value = references[group][origins].copy()
        lost = ~np.isfinite(value).all(axis=1)
        if group in own:
            value[lost] = own[group][lost]
        return value

    attitude = start("rotation")
    assert attitude is not None
    return dead_reckoning(
        imu_record(segment),
        origins,
        attitude=attitude,
        velocity=own.get("velocity"),
        position=start("position"),
        steps=steps,
        bias=bias,
        gravity=gravity,
    )
