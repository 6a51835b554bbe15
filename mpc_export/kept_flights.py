"""Flights of a campaign kept row by row: what was flown counts when the same command runs again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, NotRequired, Protocol, TypedDict, TypeVar

from greybox.files import append_json_line, read_json, read_json_lines, write_json
from greybox.progress import TimeLeft

Shown = TypeVar("Shown")


class Row(TypedDict, Generic[Shown]):
    """What every flight says, and with `watch` a trace."""

    controller: str
    seed: int
    key: str
    trace: NotRequired[Shown]


R = TypeVar("R", bound=Row[Any])
Made = TypeVar("Made", covariant=True)


class Campaign(Protocol[Made]):
    """What flies: `out` is its folder."""

    out: Path

    def key(self, name: str) -> str:
        """What a row of a controller must have been flown with to count."""

    def fly(self, name: str, seed: int, *, watch: bool = False) -> Made:
        """One flight: controller, seed, key, and with `watch` a trace."""


def kept(
    campaign: Campaign[R], names: Sequence[str], seeds: Sequence[int], log: str = "flights.jsonl"
) -> list[R]:
    """Rows of an earlier run that still count."""
    path = campaign.out / log
    keys = {n: campaign.key(n) for n in names}
    rows: list[R] = read_json_lines(path.read_text(encoding="utf-8")) if path.exists() else []
    good = {
        (r["controller"], r["seed"]): r
        for r in rows
        if keys.get(str(r.get("controller"))) == r.get("key")
    }
    return [good[n, s] for s in seeds for n in names if (n, s) in good]


def trace_file(campaign: Campaign[object], name: str, seed: int) -> Path:
    """Where the animation's part of a flight is kept."""
    return campaign.out / "traces" / f"{name}_{seed}_{campaign.key(name)}.json"


def flights(
    campaign: Campaign[R],
    names: Sequence[str],
    seeds: Sequence[int],
    *,
    say: Callable[[str], None],
    log: str = "flights.jsonl",
    watched: Sequence[int] = (),
) -> list[R]:
    """Rows of all controllers and seeds, seed by seed; each is on the disk before the next flight
    begins."""
    rows = {(r["controller"], r["seed"]): r for r in kept(campaign, names, seeds, log)}
    todo = [
        (n, s)
        for s in seeds
        for n in names
        if (n, s) not in rows or (s in watched and not trace_file(campaign, n, s).exists())
    ]
    total = len(names) * len(seeds)
    done = before = total - len(todo)
    left = TimeLeft()
    for row in _flown(campaign, todo, watched):
        plain: Row[Any] = row
        trace = plain.pop("trace", None)
        name, seed = row["controller"], row["seed"]
        if trace is not None:
            write_json(trace_file(campaign, name, seed), trace)
        append_json_line(campaign.out / log, row)
        rows[name, seed] = row
        done += 1
        if done % 10 == 0 or done == total:
            say(f"{done} of {total} flights{left.after((done - before) / len(todo))}")
    return [rows[n, s] for s in seeds for n in names]


def _flown(
    campaign: Campaign[R], todo: Sequence[tuple[str, int]], watched: Sequence[int]
) -> Iterator[R]:
    for name, seed in todo:
        yield campaign.fly(name, seed, watch=seed in watched)


def read_traces(
    campaign: Campaign[Row[Shown]], names: Sequence[str], seeds: Sequence[int]
) -> dict[int, dict[str, Shown]]:
    """{seed: {controller: trace}} of the watched flights that were flown."""
    return {
        s: {
            n: read_json(trace_file(campaign, n, s))
            for n in names
            if trace_file(campaign, n, s).exists()
        }
        for s in seeds
    }
