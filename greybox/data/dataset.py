"""Flight and Dataset: named flights made of segments, splits that do not leak, and a hash that pins
the content."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NotRequired, TypedDict

import numpy as np
import numpy.typing as npt

from greybox.data.channel import channel, is_canonical
from greybox.data.fingerprint import LogFile, fingerprint
from greybox.data.raw import RawLog, Removed
from greybox.data.segment import Segment
from greybox.errors import DataError, UnknownNameError
from greybox.plots import Curve, panels
from greybox.shown import Cell, Shown
from greybox.takes import FLIGHTS, NAMES, Several, is_a, takes

if TYPE_CHECKING:
    from matplotlib.axes import Axes


A_FLIGHT = Several(
    words="a list of Flights",
    fits=is_a("Flight"),
    fix="Flight(name=..., segments=[...]) of each log",
)


class FlightFacts(TypedDict):
    """A flight as fit.json and validate.json tell it; `seconds` without its gaps, `sha256` of the
    log where it is told."""

    name: str
    samples: int
    seconds: float
    notes: list[str]
    sha256: NotRequired[str]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Flight(Shown):
    """One flight (one log): its segments in order of time, which bear its name, and where they came
    from.

    `source` is the file name, `sha256` the checksum of its bytes ("" for data from memory), `notes`
    say what conditioning did, `removed` which samples were taken as missing because no craft can
    have made them. `noncausal` are channels whose values were smoothed with later samples,
    `recipes` say how channels were made of what the log holds (data/readers/recipes.py),
    `fingerprint` some of the samples of its file (data/fingerprint.py; none: `known_by` takes its
    own). Raises `DataError`
    where there is no segment or the sample times differ.
    """

    name: str
    segments: tuple[Segment, ...]
    source: str = ""
    sha256: str = ""
    notes: tuple[str, ...] = ()
    noncausal: frozenset[str] = frozenset()
    recipes: Mapping[str, str] = field(default_factory=dict)
    removed: tuple[Removed, ...] = ()
    fingerprint: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if not self.segments:
            raise DataError("no usable samples", where=f"flight {self.name}")
        if len({s.dt for s in self.segments}) > 1:
            raise DataError(
                f"segments with different sample times {sorted({s.dt for s in self.segments})}",
                where=f"flight {self.name}",
                fix="resample to one rate",
            )
        for before, after in zip(self.segments[:-1], self.segments[1:], strict=True):
            if after.t[0] <= before.t[-1]:
                raise DataError("segments overlap in time", where=f"flight {self.name}")
        if any(s.flight != self.name for s in self.segments):
            own = tuple(replace(s, flight=self.name) for s in self.segments)
            object.__setattr__(self, "segments", own)

    @cached_property
    def known_by(self) -> frozenset[str]:
        """Its fingerprint; of samples that come from no file their own."""
        if self.fingerprint:
            return self.fingerprint
        names = self.channels
        return fingerprint(
            {n: np.concatenate([s.channels[n] for s in self.segments]) for n in names}
        )

    def facts(self) -> FlightFacts:
        """What a result says of it."""
        return {
            "name": self.name,
            "samples": self.n,
            "seconds": self.duration,
            "notes": list(self.notes),
        }

    def as_log(self) -> RawLog:
        """The flight as the log that it might have been read from; its gaps are gaps of the
        clock."""
        t = np.concatenate([s.t for s in self.segments])
        first, *rest = self.segments
        others = [n for n in first.extra if all(n in s.extra for s in rest)]
        return RawLog(
            t=t,
            channels={
                n: np.concatenate([s.channels[n] for s in self.segments]) for n in self.channels
            },
            extra={n: np.concatenate([s.extra[n] for s in self.segments]) for n in others},
            rows=np.arange(1, t.size + 1, dtype=np.int64),
            flight=self.name,
            source=self.source,
            sha256=self.sha256,
            noncausal=self.noncausal,
            recipes=self.recipes,
            notes=self.notes,
            removed=self.removed,
            fingerprint=self.known_by,
        )

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.segments[0].dt

    @property
    def n(self) -> int:
        """Number of samples in all segments."""
        return sum(s.n for s in self.segments)

    @property
    def duration(self) -> float:
        """Time covered by samples [s]."""
        return sum(s.duration for s in self.segments)

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels that every segment has."""
        return tuple(
            n for n in self.segments[0].names if all(n in s.channels for s in self.segments)
        )

    def between(self, t0: float, t1: float) -> Flight | None:
        """The samples with t0 <= t < t1; None where fewer than two in a row are left."""
        kept = []
        for segment in self.segments:
            inside = int(((segment.t >= t0) & (segment.t < t1)).sum())
            if inside >= 2:
                kept.append(segment.between(t0, t1))
        return replace(self, segments=tuple(kept)) if kept else None

    def _shown_text(self) -> str:
        """What it is, its channels, and what conditioning did."""
        what = (
            f"Flight {self.name}: {len(self.segments)} segment(s), {self.n} samples of "
            f"{self.dt:g} s"
        )
        return "\n".join([what, f"  {', '.join(self.channels)}", *(f"  {n}" for n in self.notes)])

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per segment."""
        return [
            {
                "start [s]": float(s.t[0]),
                "seconds": s.duration,
                "samples": s.n,
                "channels": len(s.channels),
            }
            for s in self.segments
        ]

    def plot(
        self, channels: Sequence[str] | None = None, ax: Sequence[Axes] | None = None
    ) -> list[Axes]:
        """Channels over time, one panel per unit; matplotlib axes. Raises `UnknownNameError`."""
        return Dataset(flights=(self,)).plot(channels, ax=ax)


def demand_names_once(names: Sequence[str]) -> None:
    """Raise `DataError` for two flights of one name."""
    double = sorted({n for n in names if names.count(n) > 1})
    if double:
        raise DataError(
            f"flight names given twice: {', '.join(double)}",
            fix="give each log once; of two files with one name rename one",
        )


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Dataset(Shown):
    """Several flights. Immutable; flight names are unique (`DataError` otherwise)."""

    flights: tuple[Flight, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "flights", A_FLIGHT.taken("flights", self.flights))
        demand_names_once([f.name for f in self.flights])

    def __len__(self) -> int:
        return len(self.flights)

    def __iter__(self) -> Iterator[Flight]:
        return iter(self.flights)

    def __getitem__(self, name: str) -> Flight:
        for flight in self.flights:
            if flight.name == name:
                return flight
        raise UnknownNameError("flight", name, self.names)

    @takes(other=FLIGHTS)
    def __add__(self, other: Dataset | Flight) -> Dataset:
        more = (other,) if isinstance(other, Flight) else other.flights
        return Dataset(flights=self.flights + more)

    def __radd__(self, other: object) -> Dataset:
        """That `sum` begins with 0."""
        return self if other == 0 else NotImplemented

    @staticmethod
    def of(data: Dataset | Flight) -> Dataset:
        """One flight as a data set. Raises `DataError` for what is neither, and where there is no
        flight."""
        if isinstance(data, Flight):
            return Dataset(flights=(data,))
        if not isinstance(data, Dataset):
            raise DataError(
                "flights come as a Dataset",
                got=type(data).__name__,
                fix="greybox.read_logs(paths, vehicle)",
            )
        if not data.flights:
            raise DataError("no flights", fix="check the paths that were read")
        return data

    @property
    def files(self) -> tuple[LogFile, ...]:
        """What tells every flight from others."""
        return tuple(LogFile(f.name, f.sha256, f.known_by) for f in self.flights)

    @property
    def names(self) -> tuple[str, ...]:
        """Flight names."""
        return tuple(f.name for f in self.flights)

    @property
    def segments(self) -> tuple[Segment, ...]:
        """All segments of all flights, in order."""
        return tuple(s for f in self.flights for s in f.segments)

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels that every flight has, in the order of the first flight."""
        if not self.flights:
            return ()
        return tuple(
            n for n in self.flights[0].channels if all(n in f.channels for f in self.flights)
        )

    @property
    def any_channels(self) -> tuple[str, ...]:
        """Channels that at least one flight has."""
        return tuple(dict.fromkeys(n for f in self.flights for n in f.channels))

    @property
    def noncausal(self) -> frozenset[str]:
        """Channels that at least one flight marks as smoothed with later samples."""
        return frozenset().union(*(f.noncausal for f in self.flights))

    @property
    def notes(self) -> Mapping[str, tuple[str, ...]]:
        """Per flight what conditioning did."""
        return {f.name: f.notes for f in self.flights}

    @property
    def removed(self) -> tuple[Removed, ...]:
        """Samples of all flights that were taken as missing because no craft can have made them."""
        return tuple(r for f in self.flights for r in f.removed)

    @property
    def hash(self) -> str:
        """SHA-256 of names, times and channel values (not of file paths, notes or extra
        columns)."""
        digest = hashlib.sha256()
        for flight in self.flights:
            digest.update(f"flight {flight.name} {','.join(sorted(flight.noncausal))}\n".encode())
            for segment in flight.segments:
                digest.update(f"segment {segment.n}\n".encode() + _bytes(segment.t))
                for name in sorted(segment.channels):
                    digest.update(f"channel {name}\n".encode() + _bytes(segment.channels[name]))
        return digest.hexdigest()

    @property
    def recipes(self) -> dict[str, str]:
        """How channels were made of what the logs hold; of flights that differ all that there
        are."""
        said: dict[str, list[str]] = {}
        for flight in self.flights:
            for name in flight.channels:
                said.setdefault(name, []).append(flight.recipes.get(name, name))
        told = {n: " or ".join(dict.fromkeys(texts)) for n, texts in said.items()}
        return {n: text for n, text in told.items() if text != n}

    @takes(names=NAMES)
    def select(self, names: Iterable[str]) -> Dataset:
        """The named flights, in the order given. Raises `UnknownNameError`."""
        return Dataset(flights=tuple(self[n] for n in names))

    @takes(test=NAMES)
    def split_by_flight(self, test: Iterable[str]) -> tuple[Dataset, Dataset]:
        """(train, test): the flights named in `test` go to the second. Raises
        `UnknownNameError`."""
        held_out = self.select(test)
        rest = tuple(f for f in self.flights if f.name not in held_out.names)
        return Dataset(flights=rest), held_out

    def split_by_time(
        self, fraction: float = 0.5, *, at: float | None = None
    ) -> tuple[Dataset, Dataset]:
        """(first, second): every flight is cut once, at `fraction` of its time span or at the log
        time `at` [s].

        A flight with no samples on one side is missing there. Raises `DataError` for a fraction
        outside (0, 1).
        """
        if at is None and not 0.0 < fraction < 1.0:
            raise DataError(f"fraction {fraction:g}", expected="between 0 and 1")
        parts: tuple[list[Flight], list[Flight]] = ([], [])
        for flight in self.flights:
            start, stop = float(flight.segments[0].t[0]), float(flight.segments[-1].t[-1])
            cut = start + fraction * (stop - start) if at is None else at
            for side, part in zip(
                parts,
                (flight.between(-float("inf"), cut), flight.between(cut, float("inf"))),
                strict=True,
            ):
                if part is not None:
                    side.append(part)
        return Dataset(flights=tuple(parts[0])), Dataset(flights=tuple(parts[1]))

    def _shown_text(self) -> str:
        """One line for all flights, one for each."""
        count = len(self.flights)
        lines = [
            f"Dataset: {count} flight{'s' * (count != 1)}, {sum(f.n for f in self.flights)} samples"
        ]
        lines += [
            f"  {f.name}: {f.duration:.4g} s at {1.0 / f.dt:.4g} Hz, {', '.join(f.channels)}"
            for f in self.flights
        ]
        return "\n".join(lines)

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per flight."""
        return [
            {
                "flight": f.name,
                "seconds": f.duration,
                "rate [Hz]": 1.0 / f.dt,
                "samples": f.n,
                "segments": len(f.segments),
                "channels": ", ".join(f.channels),
            }
            for f in self.flights
        ]

    def plot(
        self,
        channels: Sequence[str] | None = None,
        *,
        flight: str | None = None,
        ax: Sequence[Axes] | None = None,
    ) -> list[Axes]:
        """Channels over time, one panel per unit, of one flight (the first one); matplotlib axes.

        Raises `UnknownNameError` for a flight or channel that is not there.
        """
        shown = self[self.names[0] if flight is None else flight]
        rows: dict[str, list[Curve]] = {}
        for name in shown.channels if channels is None else channels:
            # Segments are drawn apart: a row of NaN between them.
            parts = [
                np.vstack([np.column_stack([s.t, s.column(name)]), [np.nan, np.nan]])
                for s in shown.segments
            ]
            xy = np.vstack(parts)
            rows.setdefault(_panel(name), []).append(Curve(label=name, x=xy[:, 0], y=xy[:, 1]))
        return panels(rows, x="t [s]", ax=ax)


def _panel(name: str) -> str:
    """Label of the panel that a channel is drawn in: its group and unit."""
    if not is_canonical(name):
        return name
    declared = channel(name)
    return f"{declared.group.replace('_', ' ')} [{declared.unit}]"


def _bytes(values: npt.NDArray) -> bytes:
    return values.astype("<f8").tobytes()
