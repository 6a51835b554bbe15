"""Figures of the discovery report: where the discrepancy is, how strong the evidence for every candidate is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from greybox.report.figures import _SHORT, _TOP, WIDTH, _axes, _figure, _label, _plain
from greybox.report.svg import INK, MUTED, SERIES
from greybox.report.words import number

DECIBEL = 15.0
"""Density [dB above white] that is drawn at full depth."""


def paired_bars(names: Sequence[str], before: npt.ArrayLike, after: npt.ArrayLike, *, unit: str, title: str) -> Figure:
    """Two bars per name: `before` (K,) above `after` (K,) [unit]; NaN = no bar."""
    old, new = np.asarray(before, dtype=np.float64), np.asarray(after, dtype=np.float64)
    height = 0.36 * len(names) + 0.9
    figure = _figure(height)
    left = 0.86
    axes = _axes(figure, left, 0.42, WIDTH - left - 0.7, height - _TOP - 0.42)
    rows = np.arange(len(names))[::-1]
    for values, shift, colour in ((old, 0.18, SERIES[3]), (new, -0.18, SERIES[0])):
        axes.barh(rows + shift, np.nan_to_num(values), height=0.32, color=colour, linewidth=0)
        for y, v in zip(rows, values, strict=True):
            if np.isfinite(v):
                axes.annotate(
                    number(float(v), 2), (v, y + shift), xytext=(3, 0), textcoords="offset points", fontsize=7.5,
                    color=MUTED, va="center",
                )  # fmt: skip
    top = float(np.nanmax(np.concatenate([old, new]), initial=0.0))
    axes.set_xlim(0, 1.05 * top if top > 0 else 1.0)
    axes.set_yticks(rows, [_plain(n) for n in names])
    axes.grid(visible=False, axis="y")
    axes.xaxis.set_major_formatter(_SHORT)
    axes.locator_params(axis="x", nbins=4)
    axes.set_xlabel(_plain(f"RMS [{unit}]"), fontsize=8.5, color=MUTED, labelpad=2)
    axes.set_title(_plain(title), fontsize=9.5, color=INK, loc="left", pad=5)
    return figure


def evidence(
    names: Sequence[str], strength: npt.ArrayLike, looks: Sequence[str], limit: float | None, *, title: str
) -> Figure:
    """Evidence -log10 p (K,) of every candidate as bars on a logarithmic axis, in the colours `looks` (c1, c3, muted);
    `limit` is the line that they had to pass."""
    values = np.maximum(np.asarray(strength, dtype=np.float64), 0.11)
    height = 0.2 * len(names) + 0.95
    figure = _figure(height)
    left = 1.72
    axes = _axes(figure, left, 0.46, WIDTH - left - 0.2, height - _TOP - 0.46)
    rows = np.arange(len(names))[::-1]
    colours = [{"c1": SERIES[0], "c3": SERIES[2]}.get(look, MUTED) for look in looks]
    axes.barh(rows, values - 0.1, left=0.1, height=0.62, color=colours, linewidth=0)
    axes.set_xscale("log")
    axes.set_xlim(0.1, max(100.0, 1.5 * float(values.max(initial=1.0))))
    if limit is not None:
        axes.axvline(limit, color=SERIES[1], linewidth=1.3, linestyle="--")
    axes.xaxis.set_major_formatter(_SHORT)
    axes.set_yticks(rows, [_plain(n) for n in names])
    axes.tick_params(axis="y", labelsize=7.5)
    axes.set_ylim(-0.7, len(names) - 0.3)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("evidence: zeros of the p value", fontsize=8.5, color=MUTED, labelpad=2)
    figure.text(0.06 / WIDTH, 1 - 0.17 / height, _plain(title), fontsize=9.5, color=INK, va="center")
    return figure


def band_map(channels: Sequence[str], frequency: npt.ArrayLike, density: npt.ArrayLike, *, title: str) -> Figure:
    """Density (n, B) of one-step errors relative to white, a cell per channel and band around `frequency` (B) [Hz]: the
    deeper, the more; cells at or below white are empty."""
    f = np.asarray(frequency, dtype=np.float64)
    values = np.asarray(density, dtype=np.float64)
    cell = 0.2
    height = cell * len(channels) + 0.95
    figure = _figure(height)
    left = 0.95
    axes = _axes(figure, left, 0.46, WIDTH - left - 0.2, height - _TOP - 0.46)
    axes.grid(visible=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.clip(10 * np.log10(values) / DECIBEL, 0.0, 1.0)
    for i, row in enumerate(depth):
        for j, d in enumerate(row):
            if np.isfinite(d) and d > 0.02:
                axes.add_patch(
                    Rectangle((j, len(channels) - 1 - i), 1, 1, facecolor=SERIES[1], alpha=float(d), linewidth=0)
                )
    axes.set_xlim(0, len(f))
    axes.set_ylim(0, len(channels))
    shown = range(0, len(f), max(1, len(f) // 5))
    axes.set_xticks([j + 0.5 for j in shown], [number(float(f[j]), 2) for j in shown])
    axes.set_yticks(np.arange(len(channels)) + 0.5, [_plain(c) for c in channels[::-1]])
    axes.tick_params(axis="y", labelsize=7.5)
    _label(axes, x="frequency [Hz]", title=title)
    return figure


def regime_map(axes_names: Sequence[str], edges: npt.ArrayLike, ratio: npt.ArrayLike, *, title: str) -> Figure:
    """RMS of the discrepancy (n, B) in B ranges of a signal over its RMS everywhere: full depth at twice, empty at or below
    once; `edges` (B + 1)."""
    bounds, values = np.asarray(edges, dtype=np.float64), np.asarray(ratio, dtype=np.float64)
    height = 0.2 * len(axes_names) + 0.95
    figure = _figure(height)
    left = 0.95
    axes = _axes(figure, left, 0.46, WIDTH - left - 0.2, height - _TOP - 0.46)
    axes.grid(visible=False)
    for i, row in enumerate(values):
        for j, v in enumerate(row):
            if np.isfinite(v) and v > 1.02:
                place = (j, len(axes_names) - 1 - i)
                axes.add_patch(Rectangle(place, 1, 1, facecolor=SERIES[1], alpha=min(float(v) - 1, 1.0), linewidth=0))
    axes.set_xlim(0, values.shape[1])
    axes.set_ylim(0, len(axes_names))
    axes.set_xticks(np.arange(len(bounds)), [number(float(b), 2) for b in bounds])
    axes.set_yticks(np.arange(len(axes_names)) + 0.5, [_plain(n) for n in axes_names[::-1]])
    axes.tick_params(axis="y", labelsize=7.5)
    _label(axes, x="quarters of the signal's values", title=title)
    return figure
