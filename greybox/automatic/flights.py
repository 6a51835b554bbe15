"""Which flights take part: one sample rate for all, and none that is of another craft.

A flight that a data fault blocks is left out where others are sound. So is one whose thrust at the
same command is another craft's: in level flight the mean thrust carries the weight, whatever the
model, so that the share of the commanded thrust that does so is known before any fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from greybox.automatic.facts import response_rate
from greybox.data import Dataset, Flight
from greybox.data.checks import CheckReport
from greybox.data.drive import drive
from greybox.model.faults import demand_sound
from greybox.model.vehicle import Vehicle

ANOTHER = 1.4
"""Factor of the median thrust at the same command from which a flight counts as another craft's:
more than a full battery against an empty one (1.3) and a payload that a small craft carries."""
LEAST_RATE, MOST_RATE = 100.0, 250.0
"""Rates [Hz] between which a fit is made: rotors answer within 20 to 80 ms, and nothing of a body
this size moves faster than 25 Hz."""
WORTH = 2.5
"""Times the rate that is needed from which averaging down is worth it. A mean over two rows shares
a sixth of its noise's variance with the next one, which then looks coloured, and looks a quarter of
a step ahead, which looks like a delay of the commands; over four rows a fourteenth."""


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """A flight that does not take part, and why."""

    flight: str
    reason: str

    def line(self) -> str:
        """For a terminal."""
        return f"{self.flight} is left out: {self.reason}"


def needed_rate(data: Dataset) -> float | None:
    """Rate [Hz] to bring the flights to; None: they have one already, and it is no more than
    needed."""
    own = np.array([1.0 / f.dt for f in data])
    needed = float(np.clip(max(response_rate(f) for f in data), LEAST_RATE, MOST_RATE))
    needed = next(r for r in (100.0, 125.0, 200.0, 250.0) if r >= needed - 1e-9)
    if float(own.min()) > WORTH * needed:
        return needed
    if np.ptp(own) > 1e-6 * own.min():
        return float(round(float(own.min())))
    return None


def sound_flights(
    data: Dataset, vehicle: Vehicle, report: CheckReport
) -> tuple[Dataset, tuple[LeftOut, ...]]:
    """The flights that take part, and those that do not. Raises `BadDataError` where none is
    left."""
    out: dict[str, str] = {}
    for finding in report.blocking:
        out.setdefault(finding.flight, f"data fault in {finding.where}: {finding.message}")
    if len(out) == len(data):
        demand_sound(report, "a fit")
    ratios = {f.name: thrust_share(f, vehicle) for f in data if f.name not in out}
    known = {n: r for n, r in ratios.items() if np.isfinite(r) and r > 0}
    if len(known) >= 3:
        middle = float(np.median(list(known.values())))
        for name, ratio in known.items():
            factor = max(ratio / middle, middle / ratio)
            if factor > ANOTHER:
                out[name] = (
                    f"at the same command its thrust over weight is {ratio / middle:.2f} times "
                    "that of the other flights, as of another craft"
                )
    kept = [n for n in data.names if n not in out]
    return data.select(kept), tuple(LeftOut(flight=n, reason=r) for n, r in out.items())


def thrust_share(flight: Flight, vehicle: Vehicle) -> float:
    """Mean specific force along the thrust axis over that which commands and vehicle file promise.

    Without an accelerometer the weight stands for it. Rotor speeds stand for commands that the log
    lacks; NaN where it lacks both.
    """
    c0, c1, c2 = (float(c.value) for c in vehicle.actuator.thrust)
    promised, felt = [], []
    for s in flight.segments:
        u = drive(s.channels, vehicle)
        if u is None:
            return float("nan")
        thrust = (c0 + c1 * u + c2 * u * u).sum(axis=1) / float(vehicle.mass.value)
        az = s.channels.get("az", np.full(s.n, vehicle.gravity))
        good = np.isfinite(thrust) & np.isfinite(az)
        promised.append(thrust[good])
        felt.append(az[good])
    total = np.concatenate(promised)
    if not total.size or abs(float(total.mean())) < 1e-9:
        return float("nan")
    return float(np.concatenate(felt).mean() / total.mean())
