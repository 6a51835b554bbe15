"""Figures of a linear identification: orders, poles with ellipses, Bode with bands, spectra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from greybox.linear.order import OrderRow
from greybox.linear.uncertainty import ComplexEstimate
from greybox.report.figures import (
    _BOTTOM,
    _LEFT,
    _RIGHT,
    _TOP,
    MUTED,
    SERIES,
    WIDTH,
    _axes,
    _figure,
    _label,
    _panel,
)


def singular_values(values: npt.ArrayLike, order: int) -> Figure:
    """Singular values of the subspace start on a logarithmic axis; those that the chosen order
    keeps are filled."""
    figure, axes = _panel(2.2)
    s = np.asarray(values, dtype=np.float64)[:20]
    n = np.arange(1, len(s) + 1)
    axes.semilogy(n[:order], s[:order], "o", color=SERIES[0], markersize=5)
    axes.semilogy(n[order:], s[order:], "o", color=MUTED, markersize=5, markerfacecolor="none")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _label(axes, x="state", title="singular values of the subspace start")
    return figure


def criteria(table: Sequence[OrderRow], order: int) -> Figure:
    """AIC, AICc and BIC against the order, each minus its smallest value plus one, logarithmic."""
    figure, axes = _panel(2.2)
    n = [r.order for r in table]
    for values, colour in (
        ([r.aic for r in table], SERIES[1]),
        ([r.aicc for r in table], SERIES[2]),
        ([r.bic for r in table], SERIES[0]),
    ):
        v = np.array(values, dtype=float)
        axes.semilogy(
            n, v - np.nanmin(v) + 1.0, marker="o", color=colour, markersize=4, linewidth=1.2
        )
    axes.axvline(order, color=MUTED, linestyle=":", linewidth=1.0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _label(axes, x="order", title="criterion above its smallest value, plus 1")
    return figure


def pole_map(poles: ComplexEstimate, zeros: ComplexEstimate) -> Figure:
    """Poles (crosses) and zeros (circles) with 95 % ellipses in the complex plane, and the unit
    circle."""
    figure = _figure(_TOP + _BOTTOM + 3.6)
    axes = _axes(figure, _LEFT, _BOTTOM, 3.8, 3.6)
    angle = np.linspace(0, 2 * np.pi, 181)
    axes.plot(np.cos(angle), np.sin(angle), color=MUTED, linewidth=0.8)
    for estimate, colour, marker in ((poles, SERIES[0], "x"), (zeros, SERIES[1], "o")):
        for i, value in enumerate(estimate.value):
            if abs(value) > 1.6:
                continue
            edge = estimate.ellipse(i)
            axes.plot(edge.real, edge.imag, color=colour, linewidth=0.9)
            axes.plot(
                [value.real],
                [value.imag],
                marker,
                color=colour,
                markersize=5,
                markerfacecolor="none",
            )
    axes.set_xlim(-1.3, 1.3)
    axes.set_ylim(-1.3, 1.3)
    axes.set_aspect("equal")
    _label(axes, x="real", y="imaginary", title="poles and zeros, 95 % ellipses")
    return figure


def bode(
    frequency: npt.ArrayLike,
    data: Mapping[str, npt.NDArray[np.float64]],
    i: int,
    j: int,
    *,
    title: str,
) -> Figure:
    """Magnitude and phase [deg] of channel (output i, input j) over `frequency` [Hz] with 95 %
    bands."""
    f = np.asarray(frequency, dtype=np.float64)
    each, space = 1.25, 0.2
    figure = _figure(_TOP + _BOTTOM + 2 * each + space)
    upper = _axes(figure, _LEFT, _BOTTOM + each + space, WIDTH - _LEFT - _RIGHT, each)
    lower = _axes(figure, _LEFT, _BOTTOM, WIDTH - _LEFT - _RIGHT, each)
    size, spread = (
        data["magnitude"][:, i, j],
        np.minimum(1.96 * data["log_magnitude_std"][:, i, j], 5.0),
    )
    upper.loglog(f, size, color=SERIES[0], linewidth=1.4)
    upper.fill_between(
        f, size * np.exp(-spread), size * np.exp(spread), color=SERIES[0], alpha=0.2, linewidth=0
    )
    phase = np.degrees(data["phase"][:, i, j])
    band = np.minimum(np.degrees(1.96 * data["phase_std"][:, i, j]), 180.0)
    lower.semilogx(f, phase, color=SERIES[0], linewidth=1.4)
    lower.fill_between(f, phase - band, phase + band, color=SERIES[0], alpha=0.2, linewidth=0)
    upper.tick_params(labelbottom=False)
    lower.yaxis.set_major_locator(MaxNLocator(4))
    for axes in (upper, lower):
        axes.set_xlim(float(f[0]), float(f[-1]))
    _label(upper, y="gain", title=title)
    _label(lower, x="frequency [Hz]", y="phase [deg]")
    return figure


def spectra(
    frequency: npt.ArrayLike,
    output: npt.ArrayLike,
    error: npt.ArrayLike,
    *,
    low: float,
    high: float,
    title: str,
) -> Figure:
    """Spectra of output and innovation of one channel between `low` and `high` Hz."""
    figure, axes = _panel(2.2)
    f = np.asarray(frequency)
    band = (f >= low) & (f <= high)
    axes.loglog(f[band], np.asarray(output)[band], color=MUTED, linewidth=1.3)
    axes.loglog(f[band], np.asarray(error)[band], color=SERIES[0], linewidth=1.3)
    _label(axes, x="frequency [Hz]", title=title)
    return figure
