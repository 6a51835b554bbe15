"""How long a chain will still take: typical times of its stages, corrected by those that ended."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from greybox.commands.chain.record import StageRecord
from greybox.commands.chain.request import Stage
from greybox.files import read_json

TRUST = 20.0
"""Seconds of work for which the typical times are believed before this machine's own count as
much."""


def flight_seconds(folder: Path, record: StageRecord | None) -> float | None:
    """Seconds of all logs as inspect found them in its `folder`; None where it did not run."""
    if record is None or not record.writes:
        return None
    return sum(float(read_json(folder / f)["duration"]) for f in record.writes)


def typical(stage: Stage, flown: float) -> float:
    """Seconds that a stage takes with `flown` seconds of flight."""
    return stage.start + stage.each * flown


def seconds_left(
    stages: Iterable[Stage],
    open_stages: Iterable[str],
    done: Mapping[str, StageRecord],
    flown: float,
) -> float:
    """Seconds that the stages of the names `open_stages` will take."""
    by_name = {s.name: s for s in stages}
    ended = [r for r in done.values() if not r.skipped]
    measured = TRUST + sum(r.seconds for r in ended)
    expected = TRUST + sum(typical(by_name[r.name], flown) for r in ended)
    return measured / expected * sum(typical(by_name[n], flown) for n in open_stages)
