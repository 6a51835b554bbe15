"""What a log holds, what of it greybox can use, what is missing, and which logging settings would
provide it."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from greybox.data.airframe import Airframe
from greybox.data.channel import GROUPS, channel, group_names
from greybox.data.document import InspectDocument, StreamRow
from greybox.data.fitness import unfit, unscaled, untold
from greybox.data.logs import mapping_for
from greybox.data.logs.canonical import to_channels
from greybox.data.logs.table import Table
from greybox.data.raw import RawLog, is_numeric
from greybox.data.readers import LogFormat, LogMapping, Recording, format_of, read_recording
from greybox.data.readers.assemble import (
    assemble,
    choose,
    describe,
    in_channels,
    stream_of_table,
    usable,
)
from greybox.data.readers.mapping import TABLE
from greybox.data.readers.recording import Source, Stream
from greybox.data.resampling import STRETCH
from greybox.errors import GreyboxError
from greybox.shown import Cell, Shown
from greybox.takes import MAPPING, PATH, VEHICLE, takes

SCHEMA = "greybox.inspect/1"

WANTED_RATE = {
    "command": 90.0,
    "rate": 90.0,
    "specific_force": 90.0,
    "rotor_speed": 50.0,
    "attitude": 20.0,
    "position": 10.0,
    "velocity": 10.0,
    "battery": 1.0,
}
"""Samples per second below which a group tells less than it could [Hz]: motors answer in 20 to
80 ms, in which commands and IMU should be logged several times; the IMU bridges the pose."""

PURPOSE = {
    "command": "without it, or rotor speeds in its place, no model of forces or torques can be "
    "fitted",
    "rotor_speed": "separates motor lag from everything else, and gives coefficients of true rotor "
    "speed",
    "battery": "battery_sag; thrust otherwise drifts over a flight",
    "attitude": "tells gravity from thrust; long horizons",
    "rate": "the whole rotational model",
    "specific_force": "thrust, drag and every force; without it they come from the pose alone",
    "position": "ground_effect; long horizons",
    "velocity": "drag and all aerodynamic effects, and horizons of velocity",
    "setpoint": "an instrument for closed-loop data (optional)",
}
"""What a channel group is for."""


@dataclass(frozen=True, kw_only=True)
class ChannelGroup:
    """A group that greybox can use: its channels, where they come from, how often, and whether that
    is enough."""

    group: str
    channels: tuple[str, ...]
    origin: str
    rate: float
    share: float
    enough: bool


@dataclass(frozen=True, kw_only=True)
class MissingGroup:
    """A group that is missing or logged too slowly, what it is for, and the setting that provides
    it."""

    group: str
    channels: tuple[str, ...]
    reason: str
    purpose: str
    advice: str


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Inspection(Shown):
    """What `inspect_log` found. `raw` is the log in canonical channels, None where `problem` says
    why it cannot be."""

    format: LogFormat
    recording: Recording
    groups: tuple[ChannelGroup, ...]
    missing: tuple[MissingGroup, ...]
    others: tuple[str, ...]
    notes: tuple[str, ...]
    raw: RawLog | None
    problem: str

    @property
    def unfit(self) -> tuple[str, ...]:
        """Why no model can be fitted to the log; empty where one can."""
        if self.raw is None:
            return (self.problem,)
        return tuple(unfit(self.raw, {g.group: g.rate for g in self.groups}))

    @property
    def untold(self) -> tuple[str, ...]:
        """What a log that can be fitted does not say of its commands, or is too slow to tell."""
        if self.unfit or self.raw is None:
            return ()
        return (*unscaled(self.raw), *untold({g.group: g.rate for g in self.groups}))

    @property
    def verdict(self) -> str:
        """One line: what the log is good for."""
        if self.unfit:
            return f"NOT USABLE: {'; '.join(self.unfit)}"
        return "; ".join(["usable for a fit", *self.untold])

    def _shown_text(self) -> str:
        """The verdict, then what is there and what is missing."""
        lines = [self.verdict, f"{self.recording.source}: {self.format.title}"]
        lines += [
            f"  {g.group}: {g.rate:.0f} Hz{'' if g.enough else ', slow'}" for g in self.groups
        ]
        return "\n".join([*lines, *(f"  missing: {m.group} ({m.reason})" for m in self.missing)])

    def _shown_rows(self) -> list[dict[str, Cell]]:
        """One row per channel group: there and how often, or missing and what would provide it."""
        rows: list[dict[str, Cell]] = [
            {
                "group": g.group,
                "channels": ", ".join(g.channels),
                "rate [Hz]": g.rate,
                "known": g.share,
                "enough": g.enough,
                "advice": "",
            }
            for g in self.groups
        ]
        seen = {g.group for g in self.groups}
        return rows + [
            {
                "group": m.group,
                "channels": ", ".join(m.channels),
                "enough": False,
                "advice": m.advice,
            }
            for m in self.missing
            if m.group not in seen
        ]

    def to_dict(self) -> InspectDocument:
        """Plain values (schema "greybox.inspect/1")."""
        return {
            "schema": SCHEMA,
            "log": self.recording.source,
            "sha256": self.recording.sha256,
            "format": self.format.name,
            "title": self.format.title,
            "verdict": self.verdict,
            "info": dict(self.recording.info),
            "streams": [stream_facts(s) for s in self.recording.streams.values()],
            "dropouts": [{"start": a, "length": b} for a, b in self.recording.dropouts],
            "rows": 0 if self.raw is None else self.raw.n,
            "duration": 0.0
            if self.raw is None
            else float(np.nanmax(self.raw.t) - np.nanmin(self.raw.t)),
            "channels": [
                {
                    "group": g.group,
                    "channels": [{"name": c, "unit": channel(c).unit} for c in g.channels],
                    "from": g.origin,
                    "rate": g.rate,
                    "known": g.share,
                    "enough": g.enough,
                }
                for g in self.groups
            ],
            "other_sources": list(self.others),
            "missing": [
                {
                    "group": m.group,
                    "channels": list(m.channels),
                    "reason": m.reason,
                    "purpose": m.purpose,
                    "advice": m.advice,
                }
                for m in self.missing
            ],
            "advice": self.format.advice.get("", ""),
            "rotors": [{"position": list(p), "spin": s} for p, s in self.recording.rotors],
            "notes": list(self.notes),
            "problem": self.problem or None,
        }


@takes(path=PATH, vehicle=VEHICLE, mapping=MAPPING)
def inspect_log(
    path: str | os.PathLike[str],
    vehicle: Airframe | None = None,
    *,
    mapping: str | os.PathLike[str] | LogMapping | None = None,
) -> Inspection:
    """Look into a log of any format. `vehicle` says what the columns of a table are and how many
    rotors there are.

    Raises `DataError` where the file cannot be read at all; a log that can be read and not be used
    says so in `problem`.
    """
    where = os.fspath(path)
    said = mapping_for(vehicle, mapping)
    form = format_of(path)
    own_names = form.table is not None and not said
    problem, raw, table = "", None, None
    if form.table is not None:
        table = form.table(path)
        recording = (
            stream_of_table(table, said, where=where)
            if mapping is not None
            else _recording_of(table, said, where)
        )
    else:
        recording = read_recording(path, said)
    try:
        if table is None:
            table = assemble(recording, said)
        elif said:
            table = in_channels(table, said)
        raw = to_channels(table, vehicle, where=where)
    except GreyboxError as error:
        problem = str(error)
    chosen = {} if own_names or (problem and mapping is None) else choose(recording, said)
    origins = {g: describe(s, recording.streams[s.stream]) for g, s in chosen.items()}
    groups = tuple(_groups(raw, origins, recording)) if raw is not None else ()
    others = [
        f"{s.group}: {describe(s, recording.streams[s.stream])}"
        for s in recording.sources
        if not own_names and usable(recording, s) and not any(_same(s, c) for c in chosen.values())
    ]
    return Inspection(
        format=form,
        recording=recording,
        groups=groups,
        missing=tuple(_missing(groups, form)),
        others=tuple(others),
        notes=tuple(
            n
            for n in (raw.notes if raw is not None else recording.notes)
            if n not in origins.values()
        ),
        raw=raw,
        problem=problem,
    )


def _same(one: Source, other: Source) -> bool:
    return (one.group, one.stream, one.fields) == (other.group, other.stream, other.fields)


def _recording_of(table: Table, said: LogMapping, where: str) -> Recording:
    """A table as a recording, also where no column is known to be its time."""
    try:
        return stream_of_table(table, said, where=where)
    except GreyboxError:
        empty: npt.NDArray[np.float64] = np.full(table.rows.size, np.nan)
        numbers = {k: v for k, v in table.columns.items() if is_numeric(v)}
        text = tuple(k for k in table.columns if k not in numbers)
        stream = Stream(
            name=TABLE,
            t=empty,
            fields=numbers,
            clock="no column is known to be the time",
            unread=text,
        )
        return Recording(
            format="table", source=table.source, sha256=table.sha256, streams={TABLE: stream}
        )


def _groups(raw: RawLog, origins: dict[str, str], recording: Recording) -> list[ChannelGroup]:
    steps = np.diff(raw.t)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    rate = 1.0 / float(np.median(steps)) if steps.size else 0.0
    out = []
    for group in GROUPS:
        names = tuple(n for n in group_names(group, 99) if n in raw.channels)
        if not names:
            continue
        share = float(np.mean([np.isfinite(raw.channels[n]).mean() for n in names]))
        short = f"{names[0]}..{names[-1]}" if len(names) > 3 else ", ".join(names)
        origin = origins.get(group) or f"{short}: columns {', '.join(names)}"
        own = rate * share if share < 0.95 else rate
        stream = next(
            (
                s
                for s in recording.streams.values()
                if origin.partition(": ")[2].startswith(s.name + " [")
            ),
            None,
        )
        if stream is not None and group in origins:
            own = stream.rate
        out.append(
            ChannelGroup(
                group=group,
                channels=names,
                origin=origin,
                rate=own,
                share=share,
                enough=own >= WANTED_RATE.get(group, 0.0),
            )
        )
    return out


def _missing(groups: tuple[ChannelGroup, ...], form: LogFormat) -> list[MissingGroup]:
    there = {g.group: g for g in groups}
    out = []
    for group in GROUPS:
        found = there.get(group)
        if found is not None and found.enough:
            continue
        reason = f"only {found.rate:.3g} Hz" if found is not None else "not in the log"
        if found is not None:
            reason += f" (best from {WANTED_RATE[group]:g} Hz)"
        advice = form.advice.get(group, "")
        out.append(
            MissingGroup(
                group=group,
                channels=group_names(group),
                reason=reason,
                purpose=PURPOSE[group],
                advice=advice,
            )
        )
    return out


def stream_facts(stream: Stream) -> StreamRow:
    """Samples, rate [Hz], span [s], jitter, gaps and fields of a stream."""
    t = stream.t[np.isfinite(stream.t)]
    steps = np.diff(t)
    middle = float(np.median(steps)) if steps.size else 0.0
    forward = steps[steps > 0]
    gaps = forward[forward > STRETCH * middle] if middle > 0 else forward[:0]
    low, high = np.percentile(forward, [1, 99]) if forward.size else (0.0, 0.0)
    return {
        "name": stream.name,
        "kind": stream.kind,
        "samples": stream.n,
        "rate": stream.rate,
        "start": float(t[0]) if t.size else None,
        "end": float(t[-1]) if t.size else None,
        "jitter": float(high - low) / middle if middle > 0 else None,
        "gaps": int(gaps.size),
        "longest_gap": float(gaps.max()) if gaps.size else 0.0,
        "backward_steps": int((steps <= 0).sum()),
        "clock": stream.clock,
        "fields": list(stream.fields),
        "unread": list(stream.unread),
    }
