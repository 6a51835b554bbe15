"""Leftover: is what remains structured, what does it depend on, and can it be written down?

Force and torque are promoted to Gauss-Markov states (Kristensen, Madsen and Jorgensen 2004); a group whose states improve
BIC clearly is deficient, and an axis whose likelihood falls clearly when its state is taken away. The smoothed
discrepancy of each axis is regressed on a small library (greybox.discovery.terms): forward selection on random halves of
the flights' stretches, terms that are chosen most of the time stay (stability selection, Meinshausen and Buhlmann 2010,
JRSS B 72(4)), and the share that they explain on flights that were left out (stretches, of a single flight) says whether
there is a law. What is deficient but follows no signal of the model is said to be that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from greybox.data import Dataset
from greybox.discovery.regimes import Regime, regimes
from greybox.discovery.terms import Term, terms, wanted_features
from greybox.estimation.fit import Fit, fit, noise_of
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.residual.discrepancy import GROUPS, discrepancy
from greybox.symbolic import FloatArray

SHARE = 0.25
"""Share of the smoothed discrepancy that terms must explain on left-out stretches to be called a law."""
STABLE = 0.7
"""Share of the halves in which a term must be chosen."""
TERMS, HALVES, STRETCHES = 3, 30, 10
CLEAR = 10.0
TOLERANCE = 1e-2
"""Log likelihood at which the fit of the disturbance states stops: levels that run to zero never quite get there."""
STRONG = 60.0
"""Gain above which an axis counts as deficient although no law was found."""
SILENT = 12.0
"""By how much the logarithm of a level falls when its state is taken away."""
LOUDER = (0.0, 0.7, 1.4, 2.1, 2.8, 3.5)
"""By how much the logarithm of the white noise is tried to rise in its place."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Leftover:
    """One axis: `channel` (force.x, ...), RMS of its smoothed discrepancy [unit], `share` of its variance that `terms`
    (text -> coefficient, SI) explain out of sample, and the signals that they look at; `codes` are the terms as lines of
    an effect file. `gain`: how much BIC loses without this axis' state."""

    channel: str
    unit: str
    rms: float
    share: float
    terms: dict[str, float]
    depends_on: tuple[str, ...]
    codes: tuple[str, ...] = ()
    gain: float = 0.0

    @property
    def lawful(self) -> bool:
        """Whether a law was found."""
        return bool(self.terms) and self.share >= SHARE

    def to_dict(self) -> dict[str, Any]:
        """As in discovery.json."""
        law = " + ".join(f"{c:.4g} {t}" for t, c in self.terms.items())
        return {
            "channel": self.channel, "depends_on": list(self.depends_on), "share": self.share, "rms": self.rms,
            "unit": self.unit, "proposal": f"{self.channel} = {law}" if law else None, "gain": self.gain,
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Promoted:
    """The model with disturbance states, and by how much they improve BIC."""

    fit: Fit
    gain: float
    axes: tuple[Leftover, ...]
    regimes: tuple[Regime, ...] = ()

    @property
    def deficient(self) -> bool:
        """Whether the states are clearly needed."""
        return self.gain > CLEAR

    @property
    def unnamed(self) -> tuple[Leftover, ...]:
        """Axes that are clearly deficient: with a law, or far above what chance and small mismatches leave."""
        if not self.deficient:
            return ()
        return tuple(a for a in self.axes if a.gain > CLEAR and (a.lawful or a.gain > STRONG))

    @property
    def laws(self) -> tuple[Leftover, ...]:
        """Unnamed axes with a law."""
        return tuple(a for a in self.unnamed if a.lawful)


def promote(found: Fit, data: Dataset, *, seed: int = 0, iterations: int = 60) -> Promoted:
    """Disturbance states on top of `found` (physics held, levels and time constants fitted), and laws for their axes.

    A dozen `iterations` are enough to show where a model that misses much is deficient; its gain is then a lower bound.
    """
    groups = tuple(g for g in GROUPS if any(n.startswith(g + ".") for n in found.model.dynamics.noises.names))
    result = fit(
        found.model.dynamics, data, disturbance=groups, free=[f"disturbance.{g}.T" for g in groups],
        values=dict(found.model.values), noise=noise_of(found.model), initialisation="nominal",
        solver=LevenbergMarquardt(tolerance=TOLERANCE, max_iterations=iterations),
    )  # fmt: skip
    names = wanted_features(result.model.dynamics)
    seen = discrepancy(result.model, data, names)
    # Physics is held here and was free there: its parameters count once, on both sides.
    gain = 2 * (result.loglik - found.loglik) - _states(result) * float(np.log(max(result.n_samples, 1)))
    gains = axis_gains(result, gain)
    vehicle = found.model.physics.vehicle
    axes = tuple(
        _law(
            channel.name, channel.unit, terms(channel.name, names, seen.z, vehicle), seen.y[:, j], seen.flights, seed,
            gains[channel.name],
        )
        for j, channel in enumerate(seen.outputs)
    )  # fmt: skip
    return Promoted(fit=result, gain=gain, axes=axes, regimes=regimes(seen, names))


def axis_gains(result: Fit, total: float) -> dict[str, float]:
    """Axis -> how much BIC loses when its disturbance state is taken away and its white noise takes over what it can.

    All else stays as it is, which overstates the loss; it is never more than the `total` of all states.
    """
    problem, theta = result.problem, result.theta
    price = float(np.log(max(result.n_samples, 1)))
    place = {u.name: i for i, u in enumerate(problem.unknowns)}
    out: dict[str, float] = {}
    for name, i in place.items():
        axis = name.removeprefix("noise.process.disturbance.")
        if axis == name:
            continue
        white = place[f"noise.process.{axis}"]
        best = np.inf
        for louder in LOUDER:
            still = theta.copy()
            still[i] = max(problem.lower[i], theta[i] - SILENT)
            still[white] = min(max(theta[white], theta[i]) + louder, problem.upper[white])
            value = problem.evaluate(still, 0)
            best = min(best, value.likelihood if value.valid else np.inf)
        out[axis] = min(2 * (best + result.loglik) - price, max(total, 0.0)) if np.isfinite(best) else 0.0
    return out


def _states(result: Fit) -> int:
    return sum(n.startswith("disturbance") for n in result.model.dynamics.noises.names) + len(result.parameters)


def _law(
    channel: str, unit: str, library: Sequence[Term], y: FloatArray, flights: Sequence[str], seed: int, gain: float = 0.0
) -> Leftover:  # fmt: skip
    y = y - y.mean()
    rms = float(np.sqrt(np.mean(y * y)))
    none = Leftover(channel=channel, unit=unit, rms=rms, share=0.0, terms={}, depends_on=(), gain=gain)
    raw = np.column_stack([t.values for t in library])
    spread = raw.std(axis=0)
    keep = np.flatnonzero(spread > 1e-9 * np.maximum(np.abs(raw).max(axis=0), 1e-12))
    x = (raw[:, keep] - raw[:, keep].mean(axis=0)) / spread[keep]
    stretch = _stretches(flights)
    labels = np.unique(stretch)
    if rms == 0 or labels.size < 4 or not keep.size:
        return none
    rng = np.random.default_rng(seed)
    counts = np.zeros(x.shape[1])
    for _ in range(HALVES):
        half = np.isin(stretch, rng.choice(labels, labels.size // 2, replace=False))
        counts[_forward(x[half], y[half])] += 1
    stable = np.flatnonzero(counts >= STABLE * HALVES)
    stable = stable[np.argsort(-counts[stable], kind="stable")][:TERMS]
    if not stable.size:
        return none
    c = np.linalg.lstsq(x[:, stable], y, rcond=None)[0]
    used = [library[keep[i]] for i in stable]
    return Leftover(
        channel=channel, unit=unit, rms=rms, share=_share(x[:, stable], y, stretch, flights), gain=gain,
        terms={t.text: float(v / spread[keep[i]]) for t, i, v in zip(used, stable, c, strict=True)},
        depends_on=tuple(dict.fromkeys(n for t in used for n in t.uses)), codes=tuple(t.code for t in used),
    )  # fmt: skip


def _share(x: FloatArray, y: FloatArray, stretch: Any, flights: Sequence[str]) -> float:
    """Share of the variance of y explained on flights that were left out (on stretches, where there is one flight).

    Neighbouring stretches of a flight share slow signals; other flights do not.
    """
    names = np.asarray(flights)
    label = names if len(set(flights)) > 1 else stretch
    left, error = 0.0, 0.0
    for s in np.unique(label):
        out = label == s
        c = np.linalg.lstsq(x[~out], y[~out], rcond=None)[0]
        error += float(((y[out] - x[out] @ c) ** 2).sum())
        left += float((y[out] ** 2).sum())
    return 1 - error / left


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
