"""Where excitation enters a closed loop: at the mixer's inputs and at the setpoints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from greybox.excitation.multisine import Multisine
from greybox.excitation.signal import Array, Signal

MIXER = ("thrust", "roll", "pitch", "yaw")
"""Mixer inputs: specific thrust [m/s^2] and angular acceleration about body x, y, z [rad/s^2]."""
SETPOINT = ("x", "y", "z", "yaw")
"""Setpoints: world position [m] and yaw [rad]."""


@dataclass(frozen=True, kw_only=True)
class Excitation:
    """Signals by channel; channels that are not named stay at rest.

    mixer: any of "thrust" [m/s^2], "roll", "pitch", "yaw" [rad/s^2]; setpoint: any of "x", "y", "z"
    [m], "yaw" [rad].
    """

    mixer: Mapping[str, Signal] = field(default_factory=dict)
    setpoint: Mapping[str, Signal] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for given, known, what in (
            (self.mixer, MIXER, "mixer"),
            (self.setpoint, SETPOINT, "setpoint"),
        ):
            unknown = sorted(set(given) - set(known))
            if unknown:
                raise ValueError(
                    f"no {what} channel {', '.join(unknown)}; there are {', '.join(known)}"
                )

    def sample(self, time: Array, rng: np.random.Generator) -> tuple[Array, Array]:
        """Signals at the times (N,): mixer (N, 4) in the order of MIXER, setpoint (N, 4) in the
        order of SETPOINT."""
        seeds = rng.integers(0, 2**63, size=len(MIXER) + len(SETPOINT))
        tables = []
        for channels, names, own in (
            (self.mixer, MIXER, seeds[:4]),
            (self.setpoint, SETPOINT, seeds[4:]),
        ):
            table = np.zeros((time.size, len(names)))
            for k, name in enumerate(names):
                if name in channels:
                    table[:, k] = channels[name](time, np.random.default_rng(own[k]))
            tables.append(table)
        return tables[0], tables[1]


def rich_excitation(level: float = 1.0) -> Excitation:
    """Orthogonal multisines on all four mixer inputs, strong enough to identify a small quadrotor
    in half a minute."""

    def sines(rms: float, low: float, high: float, offset: int) -> Multisine:
        return Multisine(rms=level * rms, low=low, high=high, count=32, offset=offset, stride=4)

    return Excitation(
        mixer={
            "thrust": sines(0.9, 0.3, 6.0, 0),
            "roll": sines(12.0, 0.8, 10.0, 1),
            "pitch": sines(12.0, 0.8, 10.0, 2),
            "yaw": sines(4.0, 0.4, 5.0, 3),
        }
    )
