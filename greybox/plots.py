"""Plots for a notebook or a script: plain arrays in, matplotlib axes out.

Objects of the public interface have a `plot` method that calls one of these. Axes that are passed
are drawn into; otherwise a new figure of pyplot is made, which a notebook shows by itself.
matplotlib is imported when something is drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from greybox.errors import GreyboxError
from greybox.symbolic import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PANEL = (8.0, 1.7)
"""Width and height [inch] of one panel of several."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """One line: `x`, `y` (n,) and, where it has one, a band of half width `spread` (n,)."""

    label: str
    x: FloatArray
    y: FloatArray
    spread: FloatArray | None = None


def panels(
    rows: Mapping[str, Sequence[Curve]], *, x: str, ax: Sequence[Axes] | None = None
) -> list[Axes]:
    """One panel per entry of `rows` (label of its y axis -> curves), one above the other, with a
    common x axis labelled `x`. `ax`: as many axes. Raises `GreyboxError` where their number differs
    or there is nothing to draw."""
    if not rows:
        raise GreyboxError("there is nothing to plot", fix="choose channels that the data have")
    if ax is None:
        from matplotlib import pyplot as plt

        _, grid = plt.subplots(
            len(rows),
            1,
            sharex=True,
            squeeze=False,
            figsize=(PANEL[0], PANEL[1] * len(rows) + 0.6),
            layout="constrained",
        )
        axes = list(grid[:, 0])
    else:
        axes = list(np.atleast_1d(np.asarray(ax, dtype=object)))
    if len(axes) != len(rows):
        raise GreyboxError("axes to draw into", expected=str(len(rows)), got=str(len(axes)))
    for axis, (label, curves) in zip(axes, rows.items(), strict=True):
        for curve in curves:
            (line,) = axis.plot(curve.x, curve.y, label=curve.label, linewidth=1.0)
            if curve.spread is not None:
                low, high = curve.y - curve.spread, curve.y + curve.spread
                axis.fill_between(
                    curve.x, low, high, color=line.get_color(), alpha=0.2, linewidth=0
                )
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
        if sum(bool(c.label) for c in curves) > 1:
            axis.legend(fontsize="small", loc="best")
    axes[-1].set_xlabel(x)
    return axes


def bars(values: Mapping[str, float], *, x: str, threshold: float, ax: Axes | None = None) -> Axes:
    """One bar per name, and a dashed line at `threshold`. Raises `GreyboxError` without names."""
    if not values:
        raise GreyboxError("there is nothing to plot", fix="a search that judged a cause")
    if ax is None:
        from matplotlib import pyplot as plt

        size = (PANEL[0], 0.28 * len(values) + 1.0)
        _, ax = plt.subplots(figsize=size, layout="constrained")
    place = np.arange(len(values))[::-1]
    ax.barh(place, list(values.values()), height=0.6)
    ax.axvline(threshold, color="0.3", linestyle="--", linewidth=1.0)
    ax.set_yticks(place, labels=list(values))
    ax.set_xlabel(x)
    ax.grid(alpha=0.3)
    return ax


def deviations(
    names: Sequence[str], values: FloatArray, errors: FloatArray, *, x: str, ax: Axes | None = None
) -> Axes:
    """One row per name: `values` (n,) with bars of `errors` (n,), a line at zero. Raises
    `GreyboxError` where there is nothing to plot."""
    if not names:
        raise GreyboxError("there is nothing to plot", fix="a fit with free parameters")
    if ax is None:
        from matplotlib import pyplot as plt

        _, ax = plt.subplots(figsize=(PANEL[0], 0.28 * len(names) + 1.0), layout="constrained")
    place = np.arange(len(names))[::-1]
    ax.errorbar(values, place, xerr=np.nan_to_num(errors), fmt="o", markersize=4, capsize=3)
    ax.axvline(0.0, color="0.6", linewidth=0.8)
    ax.set_yticks(place, labels=list(names))
    ax.set_xlabel(x)
    ax.grid(alpha=0.3)
    return ax
