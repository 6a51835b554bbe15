"""Figures of the paper's experiment: prediction against truth with two-sigma bands, sigma against
manoeuvres, and histograms of the errors in the sigma that each method states."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenarios.studies.paper_data import OUTPUTS, TEST, PaperData
from scenarios.studies.paper_scores import intensity

UNITS = ("rad/s", "rad/s", "rad/s", "m/s$^2$", "m/s$^2$", "m/s$^2$")


def draw(
    folder: Path,
    data: PaperData,
    predictions: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> list[Path]:
    """One figure per method (all outputs), one of sigma over time and one of histograms;
    predictions: mean and variance (n_test, 6)."""
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
            axis.fill_between(
                t, (mean - 2 * sigma)[:, i], (mean + 2 * sigma)[:, i], color="C0", alpha=0.25, lw=0
            )
            axis.plot(t, seen[:, i], ".", ms=1.5, color="0.6")
            axis.plot(t, truth[:, i], color="k", lw=0.8)
            axis.plot(t, mean[:, i], color="C0", lw=0.8)
            axis.set_ylabel(f"{OUTPUTS[i]} [{UNITS[i]}]")
        axes[0].set_title(
            f"{name}, seed {data.seed}: one step ahead, two sigma; black truth, dots measured"
        )
        axes[-1].set_xlabel("t [s]")
        written.append(folder / f"prediction-{_file(name)}-seed{data.seed}.png")
        figure.savefig(written[-1], dpi=110)
        pyplot.close(figure)
    figure, axes = pyplot.subplots(
        len(predictions) + 1,
        1,
        figsize=(9, 1.6 * (len(predictions) + 1)),
        sharex=True,
        constrained_layout=True,
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
    written.append(_histograms(folder, data, predictions))
    return written


def _histograms(
    folder: Path,
    data: PaperData,
    predictions: Mapping[str, tuple[NDArray[np.float64], NDArray[np.float64]]],
) -> Path:
    """Errors over their stated sigma, one panel per output; the curve is what honest Gaussian
    errors follow."""
    from matplotlib import pyplot

    seen, edges = data.segment.matrix(OUTPUTS)[data.rows(TEST)], np.linspace(-5.0, 5.0, 41)
    figure, axes = pyplot.subplots(
        2, 3, figsize=(9, 5), sharex=True, sharey=True, constrained_layout=True
    )
    fine = np.linspace(-5.0, 5.0, 201)
    for i, axis in enumerate(axes.flat):
        for name, (mean, variance) in predictions.items():
            error = np.clip((seen - mean)[:, i] / np.sqrt(variance[:, i]), edges[0], edges[-1])
            axis.hist(error, edges, density=True, histtype="step", lw=0.9, label=name)
        axis.plot(fine, np.exp(-0.5 * fine**2) / np.sqrt(2 * np.pi), color="k", lw=0.8)
        axis.set_title(OUTPUTS[i], fontsize=8)
    axes[0, 0].legend(fontsize=6)
    for axis in axes[-1]:
        axis.set_xlabel("error / stated sigma")
    path = folder / f"histograms-seed{data.seed}.png"
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
    return path


def _file(name: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in name.lower())
