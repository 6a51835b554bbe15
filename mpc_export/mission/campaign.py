"""Many flights of several controllers with the same seeds: one JSON line a flight, resumed, on one
or two cores.

OUT/flights.jsonl   a row per flight; a second run goes on where the first stopped, and flies anew what has changed
OUT/tuning.jsonl    flights on training seeds, by which the tube's and the constant back-off are chosen
OUT/traces/         what the animation shows, of the first flights
"""

from __future__ import annotations

import functools
import io
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from greybox.files import (
    OutputError,
    append_json_line,
    checksum,
    file_sha256,
    read_json,
    read_json_lines,
    write_atomic,
    write_json,
)
from greybox.progress import FIRST, in_words
from greybox.report.mpc_documents import FlightRow, FlightTrace, Rehearsal
from greybox.residual.files import load_model
from greybox.symbolic import FloatArray
from mpc_export.mission.flight import (
    Cascade,
    Mission,
    Plant,
    controller,
    fitting,
    flown_with,
    fly,
    load_course,
    mission,
    tightened,
)
from mpc_export.tube.controller import TubeController
from mpc_export.tube.risk import kappa, kappa_rehearsed

OBSTACLES = "mpc_export.mission:OBSTACLE_COURSE"
NEAR = 2e-3
"""A limit that a plan comes closer to than this is touched [m]."""
WATCHED = 3
"""So many flights are kept for the animation."""
FORM = "tightening of commands keeps a share of what is asked"
"""Of the controllers: flights of another form do not count with those of this one."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One controller: kind "tube" flies the model of a file, tightened by `kappa` standard
    deviations or `moved` [m]."""

    name: str
    text: str
    kind: str = "tube"
    model: str = ""
    kappa: float = 0.0
    moved: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """Where and against what: plant "model" or `module:attribute`; `model` is the file whose sample
    time and vehicle count.

    course: `module:attribute` too. disturbances: a file of resampled disturbances (an array) beside
    the model as the plant.
    """

    out: Path
    plant: str
    model: str
    pace: float
    course: str = OBSTACLES
    disturbances: str = ""

    def mission(self) -> Mission:
        """Course and problem."""
        return mission(load_model(self.model), load_course(self.course), self.pace)

    def open_plant(self) -> Plant:
        """The plant, checked against the model. Raises `PlantError`."""
        model = load_model(self.model)
        plant = flown_with(
            self.plant, model, read_segments(self.disturbances) if self.disturbances else None
        )
        fitting(plant, model, self.mission().course.start)
        return plant

    def key(self, entry: Entry) -> str:
        """What a row must have been flown with to count."""
        parts = [entry.kind, entry.kappa, entry.moved, self.plant, _set_up(self), FORM]
        parts += [file_sha256(f) for f in (entry.model, self.model, self.disturbances) if f]
        return checksum(parts)[:16]


def write_segments(path: Path, segments: Sequence[FloatArray]) -> None:
    """Resampled disturbances as one array, segments parted by a row of NaN: the same bytes for the
    same numbers."""
    parted = [v for s in segments for v in (s, np.full((1, s.shape[1]), np.nan))]
    stream = io.BytesIO()
    np.save(stream, np.concatenate(parted), allow_pickle=False)
    write_atomic(path, stream.getvalue())


def read_segments(path: str) -> list[FloatArray]:
    """What `write_segments` wrote."""
    found = np.load(path, allow_pickle=False)
    ends = np.flatnonzero(np.isnan(found).all(axis=1))
    return [
        np.asarray(found[i + 1 : j], dtype=float)
        for i, j in zip([-1, *ends[:-1]], ends, strict=True)
    ]


@functools.lru_cache(maxsize=8)
def _set_up(campaign: Campaign) -> str:
    """Course, weights, limits and times of a campaign as text."""
    return repr(campaign.mission())


class Hangar:
    """Plant and controllers of a campaign, each made when it is first flown."""

    def __init__(self, campaign: Campaign) -> None:
        self.task = campaign.mission()
        self.plant = campaign.open_plant()
        self.campaign = campaign
        self._pilots: dict[str, TubeController | Cascade] = {}

    def pilot(self, entry: Entry) -> TubeController | Cascade:
        """The controller of an entry; those of one model are one, tightened anew. Raises what
        `TubeController` raises."""
        cascade = entry.kind == "cascade"
        if entry.model not in self._pilots:
            self._pilots[entry.model] = (
                Cascade(load_model(self.campaign.model).physics.vehicle, self.task)
                if cascade
                else controller(load_model(entry.model), self.task)
            )
        made = self._pilots[entry.model]
        if isinstance(made, Cascade):
            return made
        return tightened(made, self.task, kappa=entry.kappa, moved=entry.moved)

    def fly(
        self, entry: Entry, seed: int, *, near: float | None = None, watch: bool = False
    ) -> FlightRow:
        """One flight as a row, with its controller and key."""
        row = fly(self.pilot(entry), self.plant, self.task, seed, near=near, watch=watch)
        return {"controller": entry.name, "key": self.campaign.key(entry), **row}


_hangar: Hangar | None = None


def _begin(campaign: Campaign) -> None:
    """A worker's start; the parent alone answers Ctrl-C."""
    global _hangar
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _hangar = Hangar(campaign)


def _flown(
    entry: Entry, seed: int, near: float | None, watch: bool, hangar: Hangar | None = None
) -> tuple[FlightRow, float]:
    """A flight, and the seconds that it took once its controller was there: a controller is
    compiled once, and says nothing of the flights to come."""
    flown = hangar or _hangar
    assert flown is not None
    flown.pilot(entry)
    began = time.monotonic()
    return flown.fly(entry, seed, near=near, watch=watch), time.monotonic() - began


def _left(took: Sequence[float], count: int, jobs: int) -> str:
    """ ", about ... left" for `count` flights, `jobs` at a time, by the seconds of those before;
    "" where that is soon."""
    seconds = float(np.mean(took)) * count / max(1, jobs)
    return f", {in_words(seconds)}" if count and seconds >= FIRST else ""


def flights(
    hangar: Hangar,
    entries: Sequence[Entry],
    seeds: Sequence[int],
    *,
    jobs: int = 1,
    log: str = "flights.jsonl",
    near: float | None = None,
    watched: Sequence[int] = (),
    later: int = 0,
    say: Callable[[str], None] = print,
) -> list[FlightRow]:
    """Rows of all entries and seeds, those of an earlier run among them; every row is on the disk
    before the next flight.

    later: flights that the command flies after these; the time that is left is that of all.
    watched: seeds whose traces are kept in OUT/traces. Flights go seed by seed, so that controllers
    can be compared however early the run is stopped.
    """
    campaign = hangar.campaign
    path = campaign.out / log
    make_folder(campaign.out)
    rows = {(r["controller"], r["seed"]): r for r in kept(campaign, entries, seeds, log=log)}

    by_name = {e.name: e for e in entries}

    def there(entry: Entry, seed: int) -> bool:
        return (entry.name, seed) in rows and (
            seed not in watched or trace_path(campaign, entry, seed).exists()
        )

    todo = [(e, s) for s in seeds for e in entries if not there(e, s)]
    done = len(entries) * len(seeds) - len(todo)
    total = len(entries) * len(seeds)
    if done and todo:
        say(f"{done} of {total} flights are there already")

    took: list[float] = []
    for row, seconds in _run(hangar, todo, jobs, near, watched):
        trace = row.pop("trace", None)
        if trace is not None:
            write_json(trace_path(campaign, by_name[row["controller"]], row["seed"]), trace)
        rows[row["controller"], row["seed"]] = row
        append_json_line(path, row)
        done += 1
        took.append(seconds)
        rest = _left(took, len(todo) + later - len(took), jobs)
        say(f"{done} of {total}: {row['controller']}, flight {row['seed']}: {told(row)}{rest}")
    return kept(campaign, entries, seeds, log=log)


def kept(
    campaign: Campaign,
    entries: Sequence[Entry],
    seeds: Sequence[int],
    *,
    log: str = "flights.jsonl",
) -> list[FlightRow]:
    """Rows on the disk that these entries flew with these seeds and settings, by entry and seed."""
    order = {e.name: i for i, e in enumerate(entries)}
    keys = {e.name: campaign.key(e) for e in entries}
    wanted = set(seeds)
    found = {
        (order[r["controller"]], r["seed"]): r
        for r in _rows(campaign.out / log)
        if r["controller"] in keys and r.get("key") == keys[r["controller"]] and r["seed"] in wanted
    }
    return [found[k] for k in sorted(found)]


def _rows(path: Path) -> list[FlightRow]:
    return read_json_lines(path.read_text(encoding="utf-8")) if path.exists() else []


def make_folder(path: Path) -> None:
    """The folder of the results. Raises `OutputError`."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot write: {error.strerror or error}", where=str(path), fix="choose another --out"
        ) from None


def _run(
    hangar: Hangar,
    todo: Sequence[tuple[Entry, int]],
    jobs: int,
    near: float | None,
    watched: Sequence[int],
) -> Iterator[tuple[FlightRow, float]]:
    if jobs <= 1 or len(todo) < 2:
        for entry, seed in todo:
            yield _flown(entry, seed, near, seed in watched, hangar)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        jobs, mp_context=context, initializer=_begin, initargs=(hangar.campaign,)
    ) as pool:
        waiting = list(reversed(todo))
        running: set[Future[tuple[FlightRow, float]]] = set()
        try:
            while waiting or running:
                while waiting and len(running) < jobs:
                    entry, seed = waiting.pop()
                    running.add(pool.submit(_flown, entry, seed, near, seed in watched))
                ready, running = wait(running, return_when=FIRST_COMPLETED)
                for future in ready:
                    yield future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def told(row: FlightRow) -> str:
    """A flight in a few words."""
    if row["crashed"]:
        return f"crashed after {row['seconds']:.1f} s"
    worst = min((m for m in row["margins"].values() if m is not None), default=float("inf"))
    return (
        f"{1e3 * abs(worst):.0f} mm {'beyond a limit' if worst < 0 else 'from the nearest limit'}"
    )


def trace_path(campaign: Campaign, entry: Entry, seed: int) -> Path:
    """Where the trace of a flight with these settings is kept."""
    return campaign.out / "traces" / f"{entry.name}-{seed}-{campaign.key(entry)}.json"


def read_traces(
    campaign: Campaign, entries: Sequence[Entry], seeds: Sequence[int]
) -> dict[int, dict[str, FlightTrace]]:
    """{seed: {controller: trace}} of what is there."""
    found: dict[int, dict[str, FlightTrace]] = {}
    for seed in seeds:
        for entry in entries:
            path = trace_path(campaign, entry, seed)
            if path.exists():
                found.setdefault(seed, {})[entry.name] = read_json(path)
    return found


def tuned(rows: Sequence[FlightRow], level: float) -> dict[str, float]:
    """What flights without tightening on training seeds ask for.

    `pairs` of limits touched in a flight, `boole`, the standard deviations that Boole's inequality
    over them asks for, and `moved` [m], the constant that would have left at most `level` of these
    flights beyond a limit.
    """
    pairs = float(np.mean([r["pairs"] for r in rows]))
    depth = sorted(
        (max([c["depth"] for c in r["crossings"]], default=0.0) for r in rows), reverse=True
    )
    allowed = min(int(level * len(depth) + 1e-9), len(depth) - 1)
    return {
        "pairs": pairs,
        "boole": kappa(level, max(pairs, 1.0)),
        "moved": round(float(depth[allowed]), 5),
    }


def rehearsed(
    hangar: Hangar,
    plain: Entry,
    level: float,
    *,
    tried: Sequence[float],
    count: int,
    jobs: int,
    later: int,
    say: Callable[[str], None],
) -> tuple[float, list[Rehearsal]]:
    """(standard deviations for `level`, what was rehearsed): `count` flights against the model
    itself at each of `tried`, before `later` flights of another kind.

    Raises `ModelError` where they go beyond a limit too often for any of them
    (mpc_export/tube/risk.py).
    """
    stage = Hangar(replace(hangar.campaign, plant="rehearsal", disturbances=""))
    entries = [replace(plain, name=f"{value:g}", kappa=value) for value in tried]
    rows = flights(
        stage,
        entries,
        range(count),
        jobs=jobs,
        log="rehearsal.jsonl",
        later=later,
        say=lambda text: say(f"rehearsal: {text}"),
    )
    beyond = [
        sum(bool(r["crashed"] or r["crossings"]) for r in rows if r["controller"] == e.name)
        for e in entries
    ]
    found: list[Rehearsal] = [
        {"kappa": k, "flights": count, "crossed": n} for k, n in zip(tried, beyond, strict=True)
    ]
    return kappa_rehearsed(level, tried, beyond, [count] * len(beyond)), found
