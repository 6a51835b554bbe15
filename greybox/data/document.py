"""What `greybox inspect` says of a log (greybox.inspect/1): what the log holds, and what it allows."""

from __future__ import annotations

from typing import TypedDict


class StreamRow(TypedDict):
    """A stream of a log, as `stream_facts` tells it."""

    name: str
    kind: str
    samples: int
    rate: float
    start: float | None
    end: float | None
    jitter: float | None
    gaps: int
    longest_gap: float
    backward_steps: int
    clock: str
    fields: list[str]
    unread: list[str]


class Dropout(TypedDict):
    """What the logger itself reports as lost [s]."""

    start: float
    length: float


class ChannelRow(TypedDict):
    """A canonical channel."""

    name: str
    unit: str


GroupRow = TypedDict(
    "GroupRow",
    {
        "group": str,
        "channels": list[ChannelRow],
        "from": str,
        "rate": float,
        "known": float,
        "enough": bool,
    },
)
"""A group of channels that the log has, and from where; `known` is the share of its rows."""


class MissingRow(TypedDict):
    """A group that is not there, what for, and how to log it."""

    group: str
    channels: list[str]
    reason: str
    purpose: str
    advice: str


class RotorRow(TypedDict):
    """A rotor that the log states: place [m] and sense of rotation."""

    position: list[float]
    spin: int


class InspectDocument(TypedDict):
    """What a log holds (greybox.inspect/1)."""

    schema: str
    log: str
    sha256: str
    format: str
    title: str
    verdict: str
    info: dict[str, str]
    streams: list[StreamRow]
    dropouts: list[Dropout]
    rows: int
    duration: float
    channels: list[GroupRow]
    other_sources: list[str]
    missing: list[MissingRow]
    advice: str
    rotors: list[RotorRow]
    notes: list[str]
    problem: str | None


class Uses(TypedDict):
    """What the log can be used for, as `uses` finds it."""

    fit: bool
    sensors: list[str]
    rotation: bool
    translation: bool
    speed_input: bool
    predictor: str
    open_loop_horizons: list[str]


class Allowed(TypedDict):
    """Effects that the log allows, and what the others lack."""

    possible: list[str]
    lacking: dict[str, list[str]]


class GuessRow(TypedDict):
    """Columns that look like a group of channels."""

    group: str
    fields: list[str]
    unit: str
    frame: str
    limits: tuple[float, float] | None
    why: str


class Findings(InspectDocument):
    """What `greybox inspect` says."""

    effects: Allowed
    uses: Uses
    looks_like: list[GuessRow]
    next: list[str]
