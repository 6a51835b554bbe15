"""Scores of the paper's experiment: per output against measurement and truth, their means, and the
table of all seeds.

A mean over rad/s and m/s^2 says nothing: the means here are over outputs in units of their variance
on the training part. The plain mean over the six outputs is computed too, as `mse_mixed`, because
it is what the paper prints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy.signal
import scipy.stats
from numpy.typing import NDArray

from greybox.statistics.whiteness import autocorrelation, is_coloured
from greybox.validation.metrics import mse, r_squared
from greybox.validation.predictive import score
from scenarios.studies.paper_data import DT, OUTPUTS, TEST, TRAIN, PaperData
from scenarios.studies.paper_methods import HORIZON, ORIGINS, Outcome

Array = NDArray[np.float64]

PAPER = {
    "PEM linear SISO": (3.87e-3, 0.995),
    "LSTM": (2.25e-3, 0.997),
    "GP": (1.76e-3, 0.998),
    "hybrid linear SISO": (2.70e-9, 0.999),
}
"""(MSE, R^2) of Ghoul et al. 2026, their table of results, under our names."""
FLOOR = "noise floor"


def intensity(data: PaperData) -> Array:
    """How hard the vehicle manoeuvres, (n,): root mean square over outputs and 0.2 s of the true
    deviation in sigmas."""
    y, train = data.truth.y, data.rows(TRAIN)
    square = np.mean(((y - y[train].mean(axis=0)) / y[train].std(axis=0)) ** 2, axis=1)
    width = round(0.2 / DT)
    return np.asarray(np.sqrt(np.convolve(square, np.ones(width) / width, "same")))


def spectral_error(y: Array, predicted: Array) -> float:
    """Root mean square over 0.4-20 Hz of the ratio of the two power spectra [dB] (Welch, 1.28 s);
    at most 120 dB count."""
    spectra = []
    for values in (y, predicted):
        frequency, power = scipy.signal.welch(values, fs=1.0 / DT, nperseg=min(128, len(values)))
        spectra.append(power[(frequency >= 0.4) & (frequency <= 20.0)])
    true, told = (np.maximum(power, 1e-12 * spectra[0].max()) for power in spectra)
    return float(np.sqrt(np.mean((10.0 * np.log10(told / true)) ** 2)))


def scores(data: PaperData, outcome: Outcome) -> dict[str, Any]:
    """Everything that the table needs of one method on the test part; plain values."""
    rows, train = data.rows(TEST), data.rows(TRAIN)
    y, truth = data.segment.matrix(OUTPUTS)[rows], data.truth.y[rows]
    mean, variance = outcome.mean[rows], outcome.variance[rows]
    scale = data.segment.matrix(OUTPUTS)[train].var(axis=0)
    channels: dict[str, Any] = {}
    for i, name in enumerate(OUTPUTS):
        one = score(y[:, i], mean[:, i], variance[:, i])
        channels[name] = {
            **one.to_dict(),
            "r2": r_squared(y[:, i], mean[:, i]),
            "mse_truth": mse(truth[:, i], mean[:, i]),
            "spectral_db": spectral_error(truth[:, i], mean[:, i]),
            "floor": float(data.truth.floor[i]),
            "floor_truth": float(data.truth.process[i]),
        }

    def pooled(key: str, by: Array) -> float:
        return float(np.mean([channels[n][key] for n in OUTPUTS] / by))

    ones, root = np.ones(len(OUTPUTS)), np.sqrt(scale)
    sigma = np.sqrt(np.mean(variance / scale, axis=1))
    moved = intensity(data)[rows]
    follows = (
        scipy.stats.spearmanr(sigma, moved).statistic
        if np.ptp(sigma) > 1e-9 * sigma.max()
        else None
    )
    return {
        "channels": channels,
        **_hardness(data, (mean - truth) ** 2 / scale),
        **_ahead(data, outcome, scale),
        **_left(y - mean),
        "mse": pooled("mse", scale),
        "mse_truth": pooled("mse_truth", scale),
        "mse_mixed": pooled("mse", ones),
        "mse_mixed_truth": pooled("mse_truth", ones),
        "r2": pooled("r2", ones),
        "spectral_db": pooled("spectral_db", ones),
        # nlpd of the standardised channel: a density scales with the unit.
        "nlpd": float(np.mean([channels[n]["nlpd"] for n in OUTPUTS] - np.log(root))),
        "crps": pooled("crps", root),
        **{f"coverage{level}": pooled(f"coverage{level}", ones) for level in (50, 68, 95)},
        "sigma_follows_intensity": None if follows is None else float(follows),
        "parameters": outcome.parameters,
        "named": outcome.named,
        "seconds": outcome.seconds,
        "microseconds": outcome.microseconds,
        "notes": dict(outcome.notes),
    }


def _hardness(data: PaperData, error: Array) -> dict[str, float]:
    """Error to the truth in the quarter of the test part that manoeuvres hardest, and in the
    calmest."""
    moved = intensity(data)[data.rows(TEST)]
    low, high = np.quantile(moved, (0.25, 0.75))
    return {
        "mse_truth_hard": float(error[moved >= high].mean()),
        "mse_truth_calm": float(error[moved <= low].mean()),
    }


def _ahead(data: PaperData, outcome: Outcome, scale: Array) -> dict[str, float | None]:
    """Error to the truth of the free runs, a tenth and half a second ahead; None where there are
    none."""
    out: dict[str, float | None] = {}
    for h in (10, HORIZON):
        told = outcome.ahead
        missed = None if told is None else (told[:, h - 1] - data.truth.y[ORIGINS + h]) ** 2 / scale
        out[f"free_{h * DT:g}"] = None if missed is None else float(np.mean(missed))
    return out


def _left(errors: Array) -> dict[str, float]:
    """Correlation in time of the one-step errors: the largest over 20 lags, mean over outputs, and
    the outputs that are coloured (Ljung-Box, 1 %)."""
    columns = [errors[:, [i]] for i in range(errors.shape[1])]
    largest = [float(np.abs(autocorrelation([c], 20).r).max()) for c in columns]
    return {
        "correlation": float(np.mean(largest)),
        "coloured": float(sum(is_coloured([c]) for c in columns)),
    }


def floor(data: PaperData) -> dict[str, Any]:
    """The row of the noise floor: what a predictor scores that knows plant and state exactly."""
    rows, scale = data.rows(TEST), data.segment.matrix(OUTPUTS)[data.rows(TRAIN)].var(axis=0)
    y = data.segment.matrix(OUTPUTS)[rows]
    f, process = data.truth.floor, data.truth.process
    return {
        "mse": float(np.mean(f / scale)),
        "mse_truth": float(np.mean(process / scale)),
        "mse_mixed": float(np.mean(f)),
        "mse_mixed_truth": float(np.mean(process)),
        "r2": float(np.mean(1.0 - f / y.var(axis=0))),
        "nlpd": float(np.mean(0.5 * np.log(2.0 * np.pi * np.e * f / scale)))
        if np.all(f > 0)
        else None,
        **{f"coverage{level}": level / 100 for level in (50, 68, 95)},
    }


COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("mse_mixed", "MSE mixed", ".2e"),
    ("r2", "R2", ".4f"),
    ("mse", "MSE std", ".2e"),
    ("mse_truth", "to truth", ".2e"),
    ("free_0.1", "free .1 s", ".2e"),
    ("free_0.5", "free .5 s", ".2e"),
    ("correlation", "max corr", ".2f"),
    ("coloured", "coloured", ".1f"),
)
MORE: tuple[tuple[str, str, str], ...] = (
    ("spectral_db", "spec dB", ".2f"),
    ("nlpd", "NLPD", ".3f"),
    ("crps", "CRPS", ".4f"),
    ("coverage50", "c50", ".3f"),
    ("coverage68", "c68", ".3f"),
    ("coverage95", "c95", ".3f"),
    ("sigma_follows_intensity", "sigma~", ".2f"),
    ("seconds", "train s", ".0f"),
    ("microseconds", "us/pred", ".0f"),
    ("parameters", "numbers", ".0f"),
)


def table(results: Sequence[Mapping[str, Any]], names: Sequence[str]) -> str:
    """Mean over seeds of every column, the spread of the two errors, and the paper's numbers; one
    line per method.

    free: error to the truth of a free run so far ahead. max corr, coloured: the largest correlation
    of one-step errors over 20 lags, and how many of the six outputs are coloured (Ljung-Box, 1 %).
    """
    lines: list[str] = []
    for columns in (COLUMNS, MORE):
        told = columns is COLUMNS
        head = f"{'paper MSE':>10s}{'paper R2':>9s}" if told else ""
        lines += ["", f"{'method':24s}{head}" + "".join(f"{title:>11s}" for _, title, _ in columns)]
        for name in (*names, FLOOR):
            rows = [r["methods"][name] for r in results if name in r["methods"]]
            if not rows:
                continue
            paper = f"{PAPER[name][0]:10.2e}{PAPER[name][1]:9.3f}" if name in PAPER else " " * 19
            line = f"{name:24s}{paper if told else ''}"
            for key, _, form in columns:
                mean = _mean(rows, key)
                line += f"{format(mean, form):>11s}" if np.isfinite(mean) else " " * 11
            lines.append(line.rstrip())
    lines.append("")
    lines.append(
        f"{'over seeds':24s}{'MSE std: mean +- spread':>30s}{'to truth: mean +- spread':>30s}{'seeds':>7s}"
    )
    for name in names:
        rows = [r["methods"][name] for r in results if name in r["methods"]]
        if rows:
            line = f"{name:24s}"
            for key in ("mse", "mse_truth"):
                found = np.array([r[key] for r in rows])
                line += f"{f'{found.mean():.3e} +- {found.std():.1e}':>30s}"
            lines.append(f"{line}{len(rows):7d}")
    return "\n".join(lines[1:])


BASE = "PEM linear MIMO"
"""What knows no nonlinear effect."""


def qualities(
    results: Sequence[Mapping[str, Any]], short: Sequence[Mapping[str, Any]], names: Sequence[str]
) -> str:
    """The paper's qualitative columns as what was measured, mean over seeds; one line per method.

    named: parameters with a physical meaning, of all numbers trained. in 95 %, sigma~: how many
    errors lie inside, and the rank correlation of sigma with the manoeuvre. hard: error to the
    truth in the hardest quarter over that of the MIMO linear model; calm: the same in the calmest.
    data: error to the truth after a quarter of the data over that after all. train s, Hz: seconds
    of CPU with tuning, predictions a second.
    """
    head = ("in 95 %", "sigma~", "hard", "calm", "data", "train s", "Hz")
    lines = [f"{'method':24s}{'named':>12s}" + "".join(f"{h:>9s}" for h in head)]

    def over(name: str, key: str) -> float:
        both = [r["methods"] for r in results if {name, BASE} <= set(r["methods"])]
        return float(np.mean([m[name][key] / m[BASE][key] for m in both])) if both else float("nan")

    for name in names:
        rows = [r["methods"][name] for r in results if name in r["methods"]]
        if not rows:
            continue
        whole = {
            r["seed"]: r["methods"][name]["mse_truth"] for r in results if name in r["methods"]
        }
        less = [
            s["methods"][name]["mse_truth"] / whole[s["seed"]] for s in short if s["seed"] in whole
        ]

        share = f"{_mean(rows, 'named'):.0f}/{_mean(rows, 'parameters'):.0f}"
        lines.append(
            f"{name:24s}{share:>12s}{_mean(rows, 'coverage95'):9.3f}"
            f"{_mean(rows, 'sigma_follows_intensity'):9.2f}"
            f"{over(name, 'mse_truth_hard'):9.2f}{over(name, 'mse_truth_calm'):9.2f}"
            f"{float(np.mean(less)) if less else float('nan'):9.2f}{_mean(rows, 'seconds'):9.1f}"
            f"{1e6 / _mean(rows, 'microseconds'):9.0f}"
        )
    return "\n".join(lines)


def _mean(rows: Sequence[Mapping[str, Any]], key: str) -> float:
    found = [row[key] for row in rows if row.get(key) is not None]
    return float(np.mean(found)) if found else float("nan")


def verdict(
    results: Sequence[Mapping[str, Any]], hybrids: Sequence[str], others: Sequence[str]
) -> str:
    """In how many seeds the best hybrid wins, and its error to the truth over that of the best
    other, per seed."""
    wins, halves, ratios = 0, 0, []
    for r in results:
        own = {n: r["methods"][n] for n in hybrids if n in r["methods"]}
        rest = {n: r["methods"][n] for n in others if n in r["methods"]}
        if not own or not rest:
            continue
        best = min(own, key=lambda n: own[n]["mse"])
        wins += own[best]["mse"] < min(v["mse"] for v in rest.values())
        ratio = own[best]["mse_truth"] / min(v["mse_truth"] for v in rest.values())
        halves += ratio <= 0.5
        ratios.append(ratio)
    if not ratios:
        return "no seed has both a hybrid and another method"
    return (
        f"best hybrid has the lowest test MSE in {wins} of {len(ratios)} seeds; its error to the "
        f"truth is at most half of the best other's in {halves} (ratio: median "
        f"{np.median(ratios):.2f}, {min(ratios):.2f} .. {max(ratios):.2f})"
    )
