"""EffectiveLag: how long after a command its effect shows, in one number.

A lag, a delay and a filter in a row have, for slow motion, the sum of their times as delay (the
slope of the phase at frequency zero). Flights tell this sum better than its parts: the parts are
correlated, and what is published of a craft as its motor lag is often the sum.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from greybox.symbolic import FloatArray

PARTS = {
    "motor_lag.tau": "motor lag",
    "command_delay.d": "command delay",
    "sensor_delay.d": "delay of the IMU",
    "low_pass.gyro.T": "filter of the gyro",
    "delay.gyro.d": "delay of the gyro",
}
"""Parameters [s] that stand in a row between a command and what the gyro shows of it."""
OF_SENSORS = ("sensor_delay.d", "low_pass.gyro.T", "delay.gyro.d")


@dataclass(frozen=True, kw_only=True)
class EffectiveLag:
    """`value` and its standard error `std` [s] (0 where all of it is held, None where it is not
    known); `parts` [s] by parameter. `measured`: what acts are rotor speeds, which a log may have
    late (a negative delay)."""

    value: float
    std: float | None
    parts: Mapping[str, float]
    measured: bool = False

    @property
    def line(self) -> str:
        """The sum and its parts in words."""
        shows = any(n in self.parts for n in OF_SENSORS)
        each = " + ".join(f"{PARTS[n]} {1e3 * v:.1f}" for n, v in self.parts.items())
        error = f" +- {1e3 * self.std:.2g}" if self.std else ""
        if self.measured and self.value < 0:
            return f"rotor speeds are logged {-1e3 * self.value:.1f}{error} ms late"
        return (
            f"{'rotor speeds' if self.measured else 'commands'} "
            f"{'show in the gyro' if shows else 'act'} after "
            f"{1e3 * self.value:.1f}{error} ms: {each}"
        )

    def to_dict(self) -> dict[str, float | dict[str, float] | None]:
        """As in model.json and fit.json."""
        return {"value": self.value, "std": self.std, "parts": dict(self.parts)}


def effective_lag(
    values: Mapping[str, float],
    names: tuple[str, ...],
    covariance: FloatArray,
    *,
    measured: bool = False,
) -> EffectiveLag | None:
    """The sum of those of `PARTS` among `values`, its error from the `covariance` (n, n) of the
    estimates `names`; None where there are fewer than two parts, as one of them says it itself,
    unless rotor speeds were `measured`."""
    parts = {n: float(values[n]) for n in PARTS if n in values}
    if len(parts) < (1 if measured else 2):
        return None
    own = np.array([n in parts for n in names], dtype=bool)
    variance = float(covariance[np.ix_(own, own)].sum())
    std = float(np.sqrt(max(variance, 0.0))) if np.isfinite(variance) else None
    return EffectiveLag(value=sum(parts.values()), std=std, parts=parts, measured=measured)
