"""Figures of the discovery report: where the discrepancy is, how strong the evidence for every
candidate is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from greybox.report.figures import _SHORT, _TOP, WIDTH, _axes, _figure, _plain
from greybox.report.svg import INK, MUTED, SERIES
from greybox.report.words import number


def paired_bars(
    names: Sequence[str], before: npt.ArrayLike, after: npt.ArrayLike, *, unit: str, title: str
) -> Figure:
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
                    number(float(v), 2),
                    (v, y + shift),
                    xytext=(3, 0),
                    textcoords="offset points",
                    fontsize=7.5,
                    color=MUTED,
                    va="center",
                )
    top = float(np.nanmax(np.concatenate([old, new]), initial=0.0))
    axes.set_xlim(0, 1.05 * top if top > 0 else 1.0)
    axes.set_yticks(rows, [_plain(n) for n in names])
    axes.grid(visible=False, axis="y")
    axes.xaxis.set_major_formatter(_SHORT)
    axes.locator_params(axis="x", nbins=4)
    axes.set_xlabel(_plain(f"RMS [{unit}]"), fontsize=8.5, color=MUTED, labelpad=2)
    axes.set_title(_plain(title), fontsize=9.5, color=INK, loc="left", pad=5, y=1.0)
    return figure


def evidence(
    names: Sequence[str], strength: npt.ArrayLike, looks: Sequence[str], *, title: str
) -> Figure:
    """Predicted gain in log evidence (K,) of every candidate as bars on a logarithmic axis, in the
    colours `looks` (c1, c3, muted)."""
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
    axes.xaxis.set_major_formatter(_SHORT)
    axes.set_yticks(rows, [_plain(n) for n in names])
    axes.tick_params(axis="y", labelsize=7.5)
    axes.set_ylim(-0.7, len(names) - 0.3)
    axes.grid(visible=False, axis="y")
    axes.set_xlabel("gain in log evidence", fontsize=8.5, color=MUTED, labelpad=2)
    figure.text(
        0.06 / WIDTH, 1 - 0.17 / height, _plain(title), fontsize=9.5, color=INK, va="center"
    )
    return figure
