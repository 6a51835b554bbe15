"""Do the drawn craft fly, and do they move enough? One row per seed and the worst of its five
flights.

python -m scenarios.foreign.survey --seeds 1 60 [--simulator rotorpy]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from greybox.plants.flight_log import Log
from scenarios.foreign.draw import SIMULATORS, Draw, draw, flights_of
from scenarios.foreign.flights import CENTER

FARTHEST = 3.5
"""Distance from the middle of the flights that counts as lost [m]; references stay within 2.2 m."""
LOWEST = 0.2
STEEPEST = 60.0
FASTEST = 15.0
"""Rates [rad/s] beyond which a flight counts as tumbling."""
LIVELY_TILT, LIVELY_RATE = 15.0, 0.6
"""A training flight that really moves tilts by so many degrees for a twentieth of its time, and
turns at so many rad/s (RMS of roll and pitch rate)."""


@dataclass(frozen=True, kw_only=True)
class Survey:
    """Figures of one draw: the worst of five flights, tilt and rates of the calmest training
    flight."""

    farthest: float
    lowest: float
    steepest: float
    fastest: float
    tilt: float
    rate: float
    yaw_rate: float
    saturated: float

    @property
    def flies(self) -> bool:
        """Whether no flight was lost."""
        inside = self.farthest < FARTHEST and self.lowest > LOWEST
        return inside and self.steepest < STEEPEST and self.fastest < FASTEST

    @property
    def moves(self) -> bool:
        """Whether every training flight is lively."""
        return self.tilt > LIVELY_TILT and self.rate > LIVELY_RATE


def tilt(log: Log) -> np.ndarray:
    """Angle between body z and the vertical [deg], (N,)."""
    return np.degrees(
        np.arccos(np.clip(1.0 - 2.0 * (log["true.qx"] ** 2 + log["true.qy"] ** 2), -1.0, 1.0))
    )


def survey(logs: dict[str, Log]) -> Survey:
    """Figures of the flights of one draw."""
    flown = list(logs.values())
    train = [log for name, log in logs.items() if name.startswith("train")]

    def place(log: Log) -> np.ndarray:
        return np.stack([log[f"true.{c}"] for c in "xyz"], axis=-1)

    def rates(log: Log, axes: str) -> np.ndarray:
        return np.stack([log[f"true.{c}"] for c in axes], axis=-1)

    def at_limit(log: Log) -> float:
        commands = np.stack([log[f"u{i}"] for i in range(1, 5)], axis=-1)
        return float(np.mean((commands <= 0.0) | (commands >= 1.0)))

    return Survey(
        farthest=max(float(np.max(np.linalg.norm(place(log) - CENTER, axis=1))) for log in flown),
        lowest=min(float(log["true.z"].min()) for log in flown),
        steepest=max(float(tilt(log).max()) for log in flown),
        fastest=max(float(np.abs(rates(log, "pqr")).max()) for log in flown),
        tilt=min(float(np.percentile(tilt(log), 95)) for log in train),
        rate=min(float(np.sqrt(np.mean(rates(log, "pq") ** 2))) for log in train),
        yaw_rate=min(float(np.sqrt(np.mean(rates(log, "r") ** 2))) for log in train),
        saturated=max(at_limit(log) for log in flown),
    )


def row(drawn: Draw, found: Survey) -> str:
    """One line of the table."""
    grams, lag = 1000.0 * drawn.craft.airframe.mass, 1000.0 * drawn.craft.lag
    air = "gusts" if drawn.gusts else "still"
    sensors = "ideal" if drawn.realism is None else "real"
    verdict = "ok" if found.flies and found.moves else "calm" if found.flies else "LOST"
    return (
        f"{drawn.seed:5d} {drawn.simulator:12} {grams:5.0f} {lag:4.0f} {air:5} {sensors:5} "
        f"{found.farthest:5.2f} {found.lowest:5.2f} {found.steepest:4.0f} {found.fastest:5.1f} "
        f"{found.tilt:6.0f} {found.rate:5.2f} {found.yaw_rate:5.2f} "
        f"{100.0 * found.saturated:6.1f}  {verdict}"
    )


HEAD = (
    " seed simulator     mass  lag air   sense   far   low tilt  rate tilt95  rate   yaw  at 0,1\n"
    "                       g   ms                 m     m  deg rad/s    deg rad/s rad/s       %"
)


def table(seeds: Iterable[int], simulator: str | None = None) -> list[Survey]:
    """Print the table and return its figures."""
    print(HEAD)
    found = []
    for seed in seeds:
        drawn = draw(seed, simulator)
        found.append(survey(flights_of(drawn)))
        print(row(drawn, found[-1]), flush=True)
    lost, calm = sum(not s.flies for s in found), sum(s.flies and not s.moves for s in found)
    print(f"{len(found)} craft: {lost} lost, {calm} too calm")
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code 1 when a craft is lost or too calm."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 60), metavar=("FIRST", "LAST"))
    parser.add_argument("--simulator", choices=SIMULATORS)
    arguments = parser.parse_args(argv)
    first, last = arguments.seeds
    found = table(range(first, last + 1), arguments.simulator)
    return 0 if all(s.flies and s.moves for s in found) else 1


if __name__ == "__main__":
    raise SystemExit(main())
