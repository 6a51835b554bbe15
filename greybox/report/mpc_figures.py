"""Figures of the report of `greybox mpc`: paths past the limits, margins, solution times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from greybox.report.figures import (
    _BOTTOM,
    _LEFT,
    _RIGHT,
    _SHORT,
    _TOP,
    WIDTH,
    _axes,
    _figure,
    _label,
    _panel,
)
from greybox.report.mpc_documents import PlaneRow
from greybox.report.svg import INK, MUTED, SERIES
from greybox.report.words import number

COLOURS = {"ink": INK, "muted": MUTED, **{f"c{i + 1}": c for i, c in enumerate(SERIES)}}
STROKES = {"line": "-", "dash": (0, (5, 2)), "dots": (0, (1, 1.5))}
NEAR, BEYOND = 8.0, 30.0
"""Distances to limits are drawn between these, on this side and beyond [cm]."""


def margins(
    rows: Sequence[Sequence[float | None]], cell: float, duration: float, *, title: str, colour: str
) -> Figure:
    """Distance to the nearest limit of many flights: rows of [m] per cell [s] (None: no limit
    near): least and median."""
    n = max((len(r) for r in rows), default=1)
    values = np.full((len(rows), n), np.nan)
    for i, row in enumerate(rows):
        values[i, : len(row)] = [np.nan if v is None else 100 * v for v in row]
    values[values > 5 * NEAR] = np.nan
    figure, axes = _panel(1.9)
    seen = np.isfinite(values).any(axis=0)
    least, middle = np.full(n, np.nan), np.full(n, np.nan)
    if seen.any():
        least[seen], middle[seen] = (
            np.nanmin(values[:, seen], axis=0),
            np.nanmedian(values[:, seen], axis=0),
        )
    times = cell * (np.arange(n) + 0.5)
    floor = min(-3.0, 1.15 * float(np.nanmin(least)) if seen.any() else -3.0)
    axes.axhspan(max(floor, -BEYOND), 0, color=SERIES[1], alpha=0.16, linewidth=0)
    axes.fill_between(times, least, middle, color=COLOURS[colour], alpha=0.25, linewidth=0)
    axes.plot(times, middle, color=COLOURS[colour], linewidth=1.0, linestyle="--")
    axes.plot(times, least, color=COLOURS[colour], linewidth=1.5)
    axes.axhline(0.0, color=INK, linewidth=0.8)
    axes.set_xlim(0, duration)
    axes.set_ylim(max(floor, -BEYOND), NEAR)
    _label(axes, x="time [s]", y="distance [cm]", title=title)
    return figure


def solve_times(times: Mapping[str, tuple[npt.ArrayLike, str, str]], deadline: float) -> Figure:
    """Solution times [ms] by controller -> (values, colour, stroke) as shares per logarithmic cell,
    with the deadline."""
    figure, axes = _panel(2.3)
    everything = np.concatenate(
        [np.asarray(v[0], dtype=float) for v in times.values()] or [np.ones(1)]
    )
    low, high = (
        max(0.05, 0.8 * float(everything.min())),
        max(1.3 * deadline, 1.1 * float(everything.max())),
    )
    edges = np.geomspace(low, high, 50)
    for values, colour, stroke in times.values():
        v = np.asarray(values, dtype=float)
        count = 100 * np.histogram(v, edges)[0] / max(1, v.size)
        axes.stairs(count, edges, color=COLOURS[colour], linestyle=STROKES[stroke], linewidth=1.4)
    axes.axvline(deadline, color=INK, linewidth=1.0, linestyle="--")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(_SHORT)
    axes.set_xticks([t for t in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if low < t < high])
    axes.minorticks_off()
    _label(
        axes,
        x="one plan [ms]",
        y="share [%]",
        title=f"Solution times, deadline {number(deadline, 3)} ms",
    )
    return figure


def paths(
    runs: Sequence[tuple[npt.ArrayLike, str, str]],
    wanted: npt.ArrayLike,
    plane: PlaneRow,
    *,
    title: str,
) -> Figure:
    """Paths (n, 3) with (colour, stroke) past one plane: along it to the right, across it upward
    (the limit at 0 cm)."""
    normal, path = np.array(plane["normal"]), np.asarray(wanted, dtype=float)
    there = np.ones(len(path), dtype=bool)
    for axis, (low, high) in plane["where"].items():
        there &= (path[:, "xyz".index(axis)] >= low) & (path[:, "xyz".index(axis)] <= high)
    figure = _figure(2.3)
    axes = _axes(figure, _LEFT, _BOTTOM, WIDTH - _LEFT - _RIGHT, 2.3 - _TOP - _BOTTOM)
    near = path[there] if there.any() else path
    spread = np.ptp(near, axis=0) * (1 - np.abs(normal))
    along = int(spread.argmax())
    tangent = np.eye(3)[along]
    close = near[(plane["offset"] - near @ normal) < 0.3] if there.any() else near
    close = close if len(close) > 1 else near
    left, right = float((close @ tangent).min()) - 0.1, float((close @ tangent).max()) + 0.1
    ends = plane["where"].get("xyz"[along])
    if ends:
        left, right = max(left, ends[0] - 0.15), min(right, ends[1] + 0.15)
    axes.add_patch(
        Rectangle((left, 0), right - left, 8, facecolor=SERIES[1], alpha=0.16, linewidth=0)
    )
    axes.axhline(0.0, color=INK, linewidth=1.0)
    for points, colour, stroke in runs:
        p = np.asarray(points, dtype=float)
        inside = np.ones(len(p), dtype=bool)
        for axis, (low, high) in plane["where"].items():
            inside &= (p[:, "xyz".index(axis)] >= low - 0.1) & (
                p[:, "xyz".index(axis)] <= high + 0.1
            )
        across = np.where(inside, 100 * (p @ normal - plane["offset"]), np.nan)
        axes.plot(
            p @ tangent, across, color=COLOURS[colour], linestyle=STROKES[stroke], linewidth=1.1
        )
    axes.set_xlim(left, right)
    axes.set_ylim(-12, 4)
    _label(axes, x=f"{'xyz'[along]} [m]", y="across the limit [cm]", title=title)
    return figure


def sureness(
    place: npt.ArrayLike, spread: npt.ArrayLike, outside: npt.ArrayLike, *, title: str
) -> Figure:
    """Places (n, 2) [m] from above, the line the wider the larger `spread` (n,), in another colour
    where " "`outside` (n,) > 0."""
    p, s, far = (
        np.asarray(place, dtype=float),
        np.asarray(spread, dtype=float),
        np.asarray(outside, dtype=float),
    )
    height = 2.9
    figure = _figure(height)
    axes = _axes(figure, _LEFT, _BOTTOM, WIDTH - _LEFT - _RIGHT, height - _TOP - _BOTTOM)
    width = 1.0 + 9.0 * (s / max(float(s.max()), 1e-12)) ** 2
    for k in range(len(p) - 1):
        colour = SERIES[1] if far[k] > 0 else SERIES[0]
        axes.plot(
            p[k : k + 2, 0],
            p[k : k + 2, 1],
            color=colour,
            linewidth=width[k],
            alpha=0.55,
            solid_capstyle="butt",
        )
    axes.set_aspect("equal", adjustable="datalim")
    _label(axes, x="x [m]", y="y [m]", title=title)
    return figure
