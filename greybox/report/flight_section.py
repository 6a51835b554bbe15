"""The section that lays predictions over measured flights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure

from greybox.frames import numeric
from greybox.report import figures
from greybox.report.html import Key, Report
from greybox.report.replay import Replay, replay
from greybox.report.svg import INK, SERIES
from greybox.report.words import number
from greybox.symbolic import FloatArray

PANELS = {
    "position": ("x", "y", "z"),
    "velocity": ("vx", "vy", "vz"),
    "attitude": ("roll", "pitch", "yaw"),
    "rate": ("p", "q", "r"),
    "specific force": ("ax", "ay", "az"),
}
"""Channels that share a panel, by name."""


@dataclass(frozen=True, kw_only=True)
class ChannelSeries:
    """One channel of a flight, arrays (N,), NaN = missing: measured, predicted one step and some
    seconds ahead.

    `ahead[k]` is the prediction of sample k that was made `FlightSeries.ahead_seconds` earlier.
    None = not computed.
    """

    measured: FloatArray
    unit: str = ""
    one_step: FloatArray | None = None
    ahead: FloatArray | None = None


@dataclass(frozen=True, kw_only=True)
class FlightSeries:
    """The time series of one flight: `t` (N,) [s] and its channels by name; `role` is "train" or
    "test"; `replay` where position and attitude are known."""

    t: FloatArray
    channels: Mapping[str, ChannelSeries]
    ahead_seconds: float = 0.5
    role: str = ""
    replay: Replay | None = None


MOST_REPLAYS = 2
"""Flights of a page that can be replayed: each weighs some 250 kB."""
QUATERNION = ("qw", "qx", "qy", "qz")


def _with_angles(flight: FlightSeries) -> FlightSeries:
    """Roll, pitch and yaw [deg] in place of a quaternion; without jumps from 180 to -180
    degrees."""
    if not set(QUATERNION) <= set(flight.channels):
        return flight
    parts = [flight.channels[n] for n in QUATERNION]
    measured = _angles([p.measured for p in parts])
    for column in measured.T:
        seen = np.isfinite(column)
        column[seen] = np.unwrap(column[seen], period=360.0)
    one_step = _beside(measured, [p.one_step for p in parts])
    ahead = _beside(measured, [p.ahead for p in parts])
    angles = {
        name: ChannelSeries(
            measured=measured[:, i],
            unit="deg",
            one_step=None if one_step is None else one_step[:, i],
            ahead=None if ahead is None else ahead[:, i],
        )
        for i, name in enumerate(PANELS["attitude"])
    }
    rest = {n: c for n, c in flight.channels.items() if n not in QUATERNION}
    return replace(flight, channels={**rest, **angles})


def _beside(measured: FloatArray, quaternion: Sequence[FloatArray | None]) -> FloatArray | None:
    """Angles (N, 3) [deg] of predictions, on the turn on which they are nearest to the measured
    ones."""
    parts = [q for q in quaternion if q is not None]
    if len(parts) < len(QUATERNION):
        return None
    apart: FloatArray = _angles(parts) - measured
    return measured + apart - 360.0 * np.round(apart / 360.0)


def _angles(quaternion: Sequence[FloatArray]) -> FloatArray:
    """(N, 3) roll, pitch, yaw [deg] of the columns of a quaternion; NaN where a part of it is
    missing."""
    q = np.column_stack([np.asarray(c, dtype=np.float64) for c in quaternion])
    angles: FloatArray = np.degrees(numeric("euler", q))
    angles[~np.isfinite(q).all(axis=1)] = np.nan
    return angles


def _panels(names: Sequence[str]) -> dict[str, list[str]]:
    """Channel names by panel; channels that no panel knows come in threes under their own names."""
    found = {title: [n for n in members if n in names] for title, members in PANELS.items()}
    known = {n for members in PANELS.values() for n in members}
    rest = [n for n in names if n not in known]
    for i in range(0, len(rest), 3):
        found[", ".join(rest[i : i + 3])] = rest[i : i + 3]
    return {title: members for title, members in found.items() if members}


def _lines(series: ChannelSeries, part: slice) -> list[figures.Line]:
    lines = [figures.Line(values=series.measured[part], colour=INK, width=1.0)]
    if series.ahead is not None:
        lines.append(figures.Line(values=series.ahead[part], colour=SERIES[1], width=1.1))
    if series.one_step is not None:
        lines.append(
            figures.Line(values=series.one_step[part], colour=SERIES[0], width=0.9, style="--")
        )
    return lines


def _liveliest(flight: FlightSeries, seconds: float) -> slice:
    """The stretch of that length in which the channels move most, each in units of its own
    spread."""
    step = float(np.median(np.diff(flight.t)))
    n, width = len(flight.t), max(2, round(seconds / step))
    if width >= n:
        return slice(0, n)
    activity = np.zeros(n)
    for series in flight.channels.values():
        value = np.asarray(series.measured, dtype=np.float64)
        seen = np.isfinite(value)
        if seen.sum() < 2 or np.std(value[seen]) == 0.0:
            continue
        moved = np.abs(np.diff(value, prepend=value[:1])) / np.std(value[seen])
        activity += np.where(np.isfinite(moved), np.minimum(moved, 1.0), 0.0)
    total = np.concatenate([[0.0], np.cumsum(activity)])
    start = int(np.argmax(total[width:] - total[:-width]))
    return slice(start, start + width)


def _figures(flight: FlightSeries, window: slice, buckets: int) -> Iterator[tuple[str, Figure]]:
    """(title, curves over the window) of every panel."""
    for title, members in _panels(list(flight.channels)).items():
        rows = {
            f"{m} [{flight.channels[m].unit}]": _lines(flight.channels[m], window) for m in members
        }
        yield title, figures.time_series(flight.t[window], rows, title=title, buckets=buckets)


def flight_section(
    report: Report,
    flights: Mapping[str, FlightSeries],
    *,
    max_flights: int = 6,
    zoom_seconds: float = 4.0,
) -> None:
    """Each flight folds open: its liveliest seconds in full resolution, then the whole flight,
    thinned out.

    At most `max_flights` are drawn, test flights first; the rest is named. Nothing where there is
    no flight.
    """
    if not flights:
        return
    flights = {name: _with_angles(flight) for name, flight in flights.items()}
    report.section("Predictions over measured flights")
    order = sorted(flights, key=lambda name: flights[name].role == "train")
    shown, left = order[:max_flights], order[max_flights:]
    ahead = flights[shown[0]].ahead_seconds
    key = [
        Key(text="measured", colour="ink"),
        Key(text="one step ahead", colour="c1", stroke="dash"),
        Key(text=f"open loop, {number(ahead)} s ahead", colour="c2"),
    ]
    report.paragraph(
        f"Orange at each instant is what the model said {number(ahead)} s before, from the "
        "commands alone; blue dashed "
        "is the filter's prediction for the next sample. Select a flight to open it."
    )
    lines = sum(3 * len(flights[name].channels) for name in shown)
    # About 1.4 MB of curves in all: each cell of a curve costs some 24 characters in each of two
    # windows.
    buckets = int(np.clip(0.7e6 / (24 * max(lines, 1)), 60, 300))
    for i, name in enumerate(shown):
        flight = flights[name]
        role = f" ({flight.role})" if flight.role else ""
        with report.details(f"{name}{role}", open=i == 0):
            if flight.replay is not None and i < MOST_REPLAYS:
                replay(report, name, flight.replay)
            part = _liveliest(flight, zoom_seconds)
            for what, window in (
                ("the liveliest seconds", part),
                ("the whole flight", slice(0, len(flight.t))),
            ):
                panels = [
                    (
                        figure,
                        f"{title} of flight {name} against time, {what}: measured and predicted",
                    )
                    for title, figure in _figures(flight, window, buckets)
                ]
                report.figures(panels, caption=f"{name}, {what}.", key=key)
                if window.stop - window.start == len(flight.t):
                    break
    if left:
        report.paragraph(f"Not drawn, to keep this page light: {', '.join(left)}.")
