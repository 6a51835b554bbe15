"""Figures of the paper's experiment: prediction against truth with two-sigma bands, and sigma against manoeuvres."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenarios.studies.paper_data import OUTPUTS, TEST, PaperData
from scenarios.studies.paper_scores import intensity

UNITS = ("rad/s", "rad/s", "rad/s", "m/s$^2$", "m/s$^2$", "m/s$^2$")


def draw(
    folder: Path, data: PaperData, predictions: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]]
) -> list[Path]:
    """One figure per method (all outputs) and one of sigma over time; predictions: mean and variance (n_test, 6)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = data.rows(TEST)
    t, truth, seen = data.segment.t[rows], data.truth.y[rows], data.segment.matrix(OUTPUTS)[rows]
    written = []
    for name, (mean, variance) in predictions.items():
        figure, axes = pyplot.subplots(6, 1, figsize=(9, 11), sharex=True, constrained_layout=True)
        sigma = np.sqrt(variance)
        for i, axis in enumerate(axes):
            axis.fill_between(t, (mean - 2 * sigma)[:, i], (mean + 2 * sigma)[:, i], color="C0", alpha=0.25, lw=0)
            axis.plot(t, seen[:, i], ".", ms=1.5, color="0.6")
            axis.plot(t, truth[:, i], color="k", lw=0.8)
            axis.plot(t, mean[:, i], color="C0", lw=0.8)
            axis.set_ylabel(f"{OUTPUTS[i]} [{UNITS[i]}]")
        axes[0].set_title(f"{name}, seed {data.seed}: one step ahead, two sigma; black truth, dots measured")
        axes[-1].set_xlabel("t [s]")
        written.append(folder / f"prediction-{_file(name)}-seed{data.seed}.png")
        figure.savefig(written[-1], dpi=110)
        pyplot.close(figure)
    figure, axes = pyplot.subplots(
        len(predictions) + 1, 1, figsize=(9, 1.6 * (len(predictions) + 1)), sharex=True, constrained_layout=True
    )
    axes[0].plot(t, intensity(data)[rows], color="k", lw=0.9)
    axes[0].set_ylabel("intensity")
    axes[0].set_title(f"Predicted sigma over time against manoeuvre intensity, seed {data.seed}")
    for axis, (name, (_, variance)) in zip(axes[1:], predictions.items(), strict=True):
        for i, output in enumerate(OUTPUTS):
            axis.plot(t, np.sqrt(variance[:, i]), lw=0.8, label=output)
        axis.set_yscale("log")
        axis.set_ylabel(name, fontsize=7)
    axes[1].legend(ncol=6, fontsize=6, loc="upper right")
    axes[-1].set_xlabel("t [s]")
    written.append(folder / f"sigma-seed{data.seed}.png")
    figure.savefig(written[-1], dpi=110)
    pyplot.close(figure)
    return written


def _file(name: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in name.lower())
