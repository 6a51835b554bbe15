"""The figures of reports: small panels that read alike, on a phone and on a desk, in light and in
dark.

Every function returns a matplotlib Figure of one column's width without touching pyplot. Colours
are the stand-ins of `greybox.report.svg`; keys (legends) are part of the page, not of the figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from greybox.errors import DataError
from greybox.report.decimate import min_max
from greybox.report.svg import GRID, GROUND, INK, MUTED, SERIES
from greybox.report.words import number

_SHORT = FuncFormatter(lambda v, _: number(float(v), 6))
WIDTH = 4.1
"""Width of a panel [in]."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.74, 0.14, 0.30, 0.46


@dataclass(frozen=True, kw_only=True)
class Line:
    """A curve of a time series: values (N,) (NaN = missing) and its look."""

    values: npt.ArrayLike
    colour: str = INK
    style: str = "-"
    width: float = 1.0


def _axes(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Axes at a place given in inches, styled."""
    w, h = figure.get_size_inches()
    axes = figure.add_axes((left / w, bottom / h, width / w, height / h))
    axes.set_facecolor("none")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(MUTED)
        axes.spines[side].set_linewidth(0.7)
    axes.tick_params(colors=MUTED, labelcolor=MUTED, labelsize=8.5, width=0.7, length=3)
    axes.tick_params(which="minor", color=MUTED)
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    return axes


def _label(axes: Axes, *, x: str = "", y: str = "", title: str = "") -> None:
    axes.set_xlabel(_plain(x), fontsize=8.5, color=MUTED, labelpad=2)
    axes.set_ylabel(_plain(y), fontsize=8.5, color=MUTED)
    # At a fixed place, so that long numbers never push it off the figure.
    axes.yaxis.set_label_coords((0.14 - _LEFT) / (WIDTH - _LEFT - _RIGHT), 0.5)
    axes.set_title(_plain(title), fontsize=9.5, color=INK, loc="left", pad=5, y=1.0)


def _plain(text: str) -> str:
    """Text that matplotlib must not read as a formula."""
    return text.replace("$", r"\$")


def _figure(height: float, width: float = WIDTH) -> Figure:
    figure = Figure(figsize=(width, height), dpi=72)
    figure.patch.set_visible(False)
    return figure


def _panel(height: float = 2.5) -> tuple[Figure, Axes]:
    figure = _figure(height)
    return figure, _axes(figure, _LEFT, _BOTTOM, WIDTH - _LEFT - _RIGHT, height - _TOP - _BOTTOM)


def time_series(
    t: npt.ArrayLike, rows: Mapping[str, Sequence[Line]], *, title: str = "", buckets: int = 300
) -> Figure:
    """Rows of curves over a common time axis `t` (N,) [s]; the key of `rows` is the label of its
    vertical axis.

    Long records are thinned out to `buckets` cells; peaks are kept. Raises `DataError` for no row
    or unequal lengths.
    """
    if not rows:
        raise DataError("a time series figure needs at least one row")
    each, space = 1.05, 0.14
    figure = _figure(_TOP + _BOTTOM + len(rows) * each + (len(rows) - 1) * space)
    last = len(rows) - 1
    times = np.asarray(t, dtype=np.float64)
    for i, (name, lines) in enumerate(rows.items()):
        axes = _axes(
            figure, _LEFT, _BOTTOM + (last - i) * (each + space), WIDTH - _LEFT - _RIGHT, each
        )
        for line in lines:
            x, y = min_max(times, line.values, buckets=buckets)
            axes.plot(x, y, color=line.colour, linestyle=line.style, linewidth=line.width)
        axes.set_xlim(
            float(times[0]), float(times[-1]) if times[-1] > times[0] else float(times[0]) + 1.0
        )
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.yaxis.set_major_formatter(_SHORT)
        if i < last:
            axes.tick_params(labelbottom=False)
        _label(axes, x="time [s]" if i == last else "", y=name, title=title if i == 0 else "")
    return figure


def error_growth(
    seconds: npt.ArrayLike,
    curves: Mapping[str, tuple[Sequence[float | None], str, str]],
    *,
    unit: str,
    title: str,
    measure: str = "mean error",
) -> Figure:
    """Error (by `measure`) against the horizon, both axes logarithmic.

    `curves`: label -> (values (H,), colour, line style) at `seconds` (H,). Values that are not
    positive are left out.
    """
    figure, axes = _panel()
    x = np.asarray(seconds, dtype=np.float64)
    for values, colour, style in curves.values():
        y = np.array(
            [
                np.nan if v is None else float(v)
                for v in np.atleast_1d(np.asarray(values, dtype=object))
            ]
        )
        good = np.isfinite(y) & (y > 0)
        if good.any():
            marker = "o" if good.sum() < 5 else None
            axes.plot(
                x[: len(y)][good],
                y[good],
                color=colour,
                linestyle=style,
                linewidth=1.6,
                marker=marker,
                markersize=3,
            )
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
        axis.set_major_formatter(_SHORT)
        axis.set_minor_formatter(NullFormatter())
        axis.set_minor_locator(LogLocator(subs=()))
    low, high = axes.get_ylim()
    if high / low > 100:
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0,), numticks=8))
    _label(axes, x="seconds ahead", title=f"{title}: {measure} [{unit}]")
    return figure


def correlogram(
    lags: npt.ArrayLike,
    r: npt.ArrayLike,
    band: npt.ArrayLike,
    *,
    title: str,
    unit: str = "lag [samples]",
) -> Figure:
    """Correlations `r` (L,) at `lags` (L,) as stems; those outside +-`band` ((L,) or a number)
    stand out."""
    figure, axes = _panel(1.9)
    x, y = np.asarray(lags, dtype=np.float64), np.asarray(r, dtype=np.float64)
    width = np.broadcast_to(np.asarray(band, dtype=np.float64), y.shape)
    axes.fill_between(x, -width, width, color=SERIES[3], alpha=0.22, linewidth=0)
    out = np.abs(y) > width
    for chosen, colour in ((~out, SERIES[0]), (out, SERIES[1])):
        axes.vlines(x[chosen], 0.0, y[chosen], color=colour, linewidth=1.4)
    axes.axhline(0.0, color=MUTED, linewidth=0.7)
    if x.min() < 0 < x.max():
        axes.axvline(0.0, color=MUTED, linewidth=0.7, linestyle=":")
    top = max(
        1.3 * float(np.nanmax(np.abs(y))),
        2.0 * float(np.nanmax(np.where(np.isfinite(width), width, 0.0))),
        1e-3,
    )
    axes.set_ylim(-top, top)
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_formatter(_SHORT)
    _label(axes, x=unit, y="correlation", title=title)
    return figure


def autocorrelations(
    lags: npt.ArrayLike, curves: Mapping[str, npt.ArrayLike], band: npt.ArrayLike, *, title: str
) -> Figure:
    """Correlations (L,) of a few channels with themselves at `lags` (L,), in the order of `SERIES`,
    over +-`band` ((L,) or a number)."""
    figure, axes = _panel(1.9)
    x = np.asarray(lags, dtype=np.float64)
    width = np.broadcast_to(np.asarray(band, dtype=np.float64), x.shape)
    axes.fill_between(x, -width, width, color=SERIES[3], alpha=0.22, linewidth=0)
    every = [np.asarray(r, dtype=np.float64) for r in curves.values()]
    for y, colour in zip(every, SERIES, strict=False):
        axes.plot(x, y, color=colour, linewidth=1.2)
    axes.axhline(0.0, color=MUTED, linewidth=0.7)
    sizes = np.concatenate([1.3 * np.abs(y) for y in every] + [2.0 * width, [1e-3]])
    sizes = sizes[np.isfinite(sizes)]
    axes.set_ylim(-float(sizes.max()), float(sizes.max()))
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_formatter(_SHORT)
    _label(axes, x="lag [samples]", y="correlation", title=title)
    return figure


def cumulated(
    shares: Mapping[str, npt.ArrayLike], band: float, *, sample_time: float, title: str
) -> Figure:
    """Cumulated periodograms of a few channels, in the order of `SERIES`: shares (F,) of the
    variance below the frequencies up to half the sample rate, between the lines `band` above and
    below that of white noise."""
    figure, axes = _panel(1.9)
    white = np.linspace(0.0, 1.0, 100)
    for off in (-band, band):
        line = np.clip(white + off, 0.0, 1.0)
        axes.plot(0.5 / sample_time * white, line, color=MUTED, linestyle="--", linewidth=0.8)
    for share, colour in zip(shares.values(), SERIES, strict=False):
        y = np.asarray(share, dtype=np.float64)
        x = np.linspace(0.0, 0.5 / sample_time, len(y))
        axes.plot(x, y, color=colour, linewidth=1.4)
    axes.set_xlim(0.0, 0.5 / sample_time)
    axes.set_ylim(0.0, 1.0)
    axes.yaxis.set_major_locator(MaxNLocator(4))
    axes.yaxis.set_major_formatter(_SHORT)
    _label(axes, x="frequency [Hz]", y="share", title=title)
    return figure


def dot_plot(
    names: Sequence[str],
    values: npt.ArrayLike,
    stds: npt.ArrayLike,
    *,
    title: str,
    unit: str,
    mark: float | None = None,
) -> Figure:
    """One row per name: `values` (K,) as dots with bars of 1.96 `stds` (K,), NaN = no bar; `mark`
    is a dashed line."""
    centre, spread = np.asarray(values, dtype=np.float64), np.asarray(stds, dtype=np.float64)
    height = 0.19 * len(names) + 0.9
    longest = max((len(n) for n in names), default=1)
    left = min(0.25 + 0.062 * min(longest, 26), 1.9)
    figure = _figure(height)
    axes = _axes(figure, left, _BOTTOM, WIDTH - left - 0.28, height - _TOP - _BOTTOM)
    rows = np.arange(len(names))[::-1]
    axes.hlines(
        rows, centre - 1.96 * spread, centre + 1.96 * spread, color=SERIES[0], linewidth=1.6
    )
    axes.plot(
        centre,
        rows,
        "o",
        color=SERIES[0],
        markersize=4,
        markeredgecolor=GROUND,
        markeredgewidth=0.6,
    )
    if mark is not None:
        axes.axvline(mark, color=MUTED, linewidth=1.0, linestyle="--")
    short = [n if len(n) <= 26 else n[:12] + "\N{HORIZONTAL ELLIPSIS}" + n[-13:] for n in names]
    axes.set_yticks(rows, [_plain(s) for s in short])
    axes.set_ylim(-0.7, len(names) - 0.3)
    axes.xaxis.set_major_locator(MaxNLocator(4))
    axes.xaxis.set_major_formatter(_SHORT)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("" if unit == "-" else _plain(unit), fontsize=8.5, color=MUTED, labelpad=2)
    # The title starts at the left edge: next to long names there is no room above the axes alone.
    figure.text(
        0.06 / WIDTH, 1 - 0.17 / height, _plain(title), fontsize=9.5, color=INK, va="center"
    )
    return figure


def heat_map(names: Sequence[str], matrix: npt.ArrayLike) -> Figure:
    """Correlation matrix (K, K) of parameters: blue positive, orange negative, the deeper the
    stronger. Raises `DataError` for another shape."""
    r = np.asarray(matrix, dtype=np.float64)
    k = len(names)
    if r.shape != (k, k):
        raise DataError("correlation matrix", expected=f"({k}, {k})", got=str(r.shape))
    cell = 0.27 if k <= 24 else max(6.5 / k, 0.08)
    longest = max((len(n) for n in names), default=1)
    left, top = 0.3 + 0.062 * longest, 0.2 + 0.062 * longest * 0.8
    figure = _figure(top + cell * k + 0.1, left + cell * k + 0.6)
    axes = _axes(figure, left, 0.1, cell * k, cell * k)
    axes.grid(visible=False)
    for i in range(k):
        for j in range(k):
            if i != j and np.isfinite(r[i, j]) and abs(r[i, j]) >= 0.03:
                colour = SERIES[0] if r[i, j] > 0 else SERIES[1]
                axes.add_patch(
                    Rectangle(
                        (j, k - 1 - i),
                        1,
                        1,
                        facecolor=colour,
                        alpha=min(1.0, abs(r[i, j])),
                        linewidth=0,
                    )
                )
                if k <= 24 and abs(r[i, j]) >= 0.3:
                    text = f"{abs(r[i, j]):.2f}".lstrip("0") if abs(r[i, j]) < 0.995 else "1"
                    colour = GROUND if abs(r[i, j]) > 0.6 else INK
                    axes.text(
                        j + 0.5,
                        k - 0.5 - i,
                        text,
                        fontsize=7,
                        color=colour,
                        ha="center",
                        va="center",
                    )
        axes.add_patch(Rectangle((i, k - 1 - i), 1, 1, facecolor=GRID, linewidth=0))
    axes.set_xlim(0, k)
    axes.set_ylim(0, k)
    for line in range(1, k):
        axes.axhline(line, color=GRID, linewidth=0.4)
        axes.axvline(line, color=GRID, linewidth=0.4)
    axes.set_yticks(np.arange(k) + 0.5, [_plain(n) for n in names[::-1]])
    axes.set_xticks(
        np.arange(k) + 0.5,
        [_plain(n) for n in names],
        rotation=50,
        ha="left",
        rotation_mode="anchor",
    )
    axes.tick_params(
        length=0, labelcolor=INK, top=False, labeltop=True, labelbottom=False, bottom=False
    )
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)
    return figure


def rise(
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    *,
    limit: float,
    marks: Sequence[float],
    label: str,
    unit: str,
    title: str,
) -> Figure:
    """A curve y (N,) over x (N,) with its points, a level `limit`, and upright `marks`; the part
    far above is cut off."""
    figure, axes = _panel()
    at, values = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    axes.plot(at, values, color=SERIES[0], marker="o", markersize=3, linewidth=1.2)
    axes.axhline(limit, color=MUTED, linestyle="--", linewidth=0.9)
    for mark in marks:
        axes.axvline(mark, color=SERIES[1], linestyle=":", linewidth=1.1)
    axes.set_ylim(0.0, max(2.5 * limit, min(float(values.max()), 4 * limit)))
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(_SHORT)
    _label(axes, x=f"{title} [{unit}]", y=label, title=title)
    return figure
