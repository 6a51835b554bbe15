"""Leftover: is what remains structured, what does it depend on, and can it be written down?

Force and torque are promoted to Gauss-Markov states (Kristensen, Madsen and Jorgensen 2004); a group whose states improve
BIC clearly is deficient. The smoothed discrepancy of each of its axes is regressed on a small library of polynomial terms
of the model's signals: forward selection on random halves of the flight's stretches, terms that are chosen most of the time
stay (stability selection, Meinshausen and Buhlmann 2010, JRSS B 72(4)), and the share that they explain on stretches that
were left out says whether there is a law. What is deficient but follows no signal of the model is said to be that.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from greybox.data import Dataset
from greybox.estimation.fit import Fit, fit, noise_of
from greybox.residual.discrepancy import GROUPS, discrepancy
from greybox.residual.features import available, default_features
from greybox.symbolic import FloatArray

SHARE = 0.25
"""Share of the smoothed discrepancy that terms must explain on left-out stretches to be called a law."""
STABLE = 0.7
"""Share of the halves in which a term must be chosen."""
TERMS, HALVES, STRETCHES = 3, 30, 10
CLEAR = 10.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Leftover:
    """One axis: `channel` (force.x, ...), RMS of its smoothed discrepancy [unit], `share` of its variance that `terms`
    (text -> coefficient, SI) explain out of sample, and the signals that they look at."""

    channel: str
    unit: str
    rms: float
    share: float
    terms: dict[str, float]
    depends_on: tuple[str, ...]

    @property
    def lawful(self) -> bool:
        """Whether a law was found."""
        return bool(self.terms) and self.share >= SHARE

    def to_dict(self) -> dict[str, Any]:
        """As in discovery.json."""
        law = " + ".join(f"{c:.4g} {t}" for t, c in self.terms.items())
        return {
            "channel": self.channel, "depends_on": list(self.depends_on), "share": self.share, "rms": self.rms,
            "unit": self.unit, "proposal": f"{self.channel} = {law}" if law else None,
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Promoted:
    """The model with disturbance states, and by how much they improve BIC."""

    fit: Fit
    gain: float
    axes: tuple[Leftover, ...]

    @property
    def deficient(self) -> bool:
        """Whether the states are clearly needed."""
        return self.gain > CLEAR


def promote(found: Fit, data: Dataset, *, seed: int = 0) -> Promoted:
    """Disturbance states on top of `found` (physics held, levels and time constants fitted), and laws for their axes."""
    groups = tuple(g for g in GROUPS if any(n.startswith(g + ".") for n in found.model.dynamics.noises.names))
    result = fit(
        found.model.dynamics, data, disturbance=groups, free=[f"disturbance.{g}.T" for g in groups],
        values=dict(found.model.values), noise=noise_of(found.model), initialisation="nominal",
    )  # fmt: skip
    model = result.model
    wanted = default_features(model.dynamics)
    extra = [n for n in available(model.dynamics) if n == "height" or n.startswith("gravity.") or n in ("psi", "vbat")]
    names = tuple(dict.fromkeys((*wanted, *extra)))
    seen = discrepancy(model, data, names)
    axes = tuple(
        _law(channel.name, channel.unit, seen.z, seen.y[:, j], names, seen.flights, seed)
        for j, channel in enumerate(seen.outputs)
    )
    # Physics is held here and was free there: its parameters count once, on both sides.
    gain = 2 * (result.loglik - found.loglik) - _states(result) * float(np.log(max(result.n_samples, 1)))
    return Promoted(fit=result, gain=gain, axes=axes)


def _states(result: Fit) -> int:
    return sum(n.startswith("disturbance") for n in result.model.dynamics.noises.names) + len(result.parameters)


def _library(z: FloatArray, names: Sequence[str]) -> tuple[FloatArray, list[str], list[tuple[str, ...]]]:
    """Columns of signals, products of two, v|v|, sin and cos of the heading; their texts and the signals they use."""
    columns: list[FloatArray] = []
    texts: list[str] = []
    uses: list[tuple[str, ...]] = []
    at = {n: i for i, n in enumerate(names)}
    plain = [n for n in names if n != "psi"]
    for n in plain:
        columns += [z[:, at[n]], z[:, at[n]] * np.abs(z[:, at[n]])]
        texts += [n, f"{n} |{n}|"]
        uses += [(n,), (n,)]
    for a, b in itertools.combinations(plain, 2):
        columns.append(z[:, at[a]] * z[:, at[b]])
        texts.append(f"{a} {b}")
        uses.append((a, b))
    if "psi" in at:
        columns += [np.sin(z[:, at["psi"]]), np.cos(z[:, at["psi"]])]
        texts += ["sin(psi)", "cos(psi)"]
        uses += [("psi",), ("psi",)]
    if "height" in at:
        columns.append(1.0 / np.maximum(np.abs(z[:, at["height"]]), 0.05) ** 2)
        texts.append("1/height^2")
        uses.append(("height",))
    return np.column_stack(columns), texts, uses


def _law(
    channel: str, unit: str, z: FloatArray, y: FloatArray, names: Sequence[str], flights: Sequence[str], seed: int
) -> Leftover:
    library, texts, uses = _library(z, names)
    y = y - y.mean()
    rms = float(np.sqrt(np.mean(y * y)))
    none = Leftover(channel=channel, unit=unit, rms=rms, share=0.0, terms={}, depends_on=())
    spread = library.std(axis=0)
    keep = spread > 1e-9 * np.maximum(np.abs(library).max(axis=0), 1e-12)
    library, texts = library[:, keep], [t for t, k in zip(texts, keep, strict=True) if k]
    uses = [u for u, k in zip(uses, keep, strict=True) if k]
    x = (library - library.mean(axis=0)) / spread[keep]
    stretch = _stretches(flights)
    labels = np.unique(stretch)
    if rms == 0 or labels.size < 4:
        return none
    rng = np.random.default_rng(seed)
    counts = np.zeros(x.shape[1])
    for _ in range(HALVES):
        half = np.isin(stretch, rng.choice(labels, labels.size // 2, replace=False))
        counts[_forward(x[half], y[half])] += 1
    stable = np.flatnonzero(counts >= STABLE * HALVES)[:TERMS]
    if not stable.size:
        return none
    left, error = 0.0, 0.0
    for s in labels:
        out = stretch == s
        c = np.linalg.lstsq(x[~out][:, stable], y[~out], rcond=None)[0]
        error += float(((y[out] - x[out][:, stable] @ c) ** 2).sum())
        left += float((y[out] ** 2).sum())
    c = np.linalg.lstsq(x[:, stable], y, rcond=None)[0]
    terms = {texts[i]: float(v / spread[keep][i]) for i, v in zip(stable, c, strict=True)}
    looks = tuple(dict.fromkeys(n for i in stable for n in uses[i]))
    return Leftover(channel=channel, unit=unit, rms=rms, share=1 - error / left, terms=terms, depends_on=looks)


def _stretches(flights: Sequence[str]) -> Any:
    """Number of the stretch of every row: each flight in equal parts along its time, about `STRETCHES` in all."""
    names = np.asarray(flights)
    out, base = np.zeros(len(names), dtype=int), 0
    each = max(2, -(-STRETCHES // max(len(set(flights)), 1)))
    for n in dict.fromkeys(flights):
        rows = np.flatnonzero(names == n)
        out[rows] = base + np.arange(rows.size) * each // max(rows.size, 1)
        base += each
    return out


def _forward(x: FloatArray, y: FloatArray) -> list[int]:
    """Up to `TERMS` columns, each the one that leaves least, while BIC falls.

    Orthogonal least squares (Chen, Billings and Luo 1989, International Journal of Control 50(5)): a column counts by
    what it adds to those chosen before, so that v |v| is found next to v.
    """
    chosen: list[int] = []
    n = len(y)
    residual, best = y, n * np.log(np.mean(y * y) + 1e-300)
    size = (x * x).sum(axis=0)
    rest = x
    for _ in range(TERMS):
        left = (rest * rest).sum(axis=0)
        free = left > 1e-6 * size
        gains = np.where(free, (rest.T @ residual) ** 2 / np.where(free, left, 1.0), -1.0)
        gains[chosen] = -1
        j = int(gains.argmax())
        trial = [*chosen, j]
        c = np.linalg.lstsq(x[:, trial], y, rcond=None)[0]
        error = y - x[:, trial] @ c
        value = n * np.log(np.mean(error * error) + 1e-300) + len(trial) * np.log(n)
        if value >= best:
            break
        chosen, residual, best = trial, error, value
        basis = np.linalg.qr(x[:, trial])[0]
        rest = x - basis @ (basis.T @ x)
    return chosen
