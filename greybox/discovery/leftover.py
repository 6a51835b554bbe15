"""Leftover: is what remains structured, what does it depend on, and can it be written down?

Force and torque are promoted to Gauss-Markov states (Kristensen, Madsen and Jorgensen 2004); a group whose states improve
BIC clearly is deficient, and an axis whose likelihood falls clearly when its state is taken away. What the terms of a
small library (greybox.discovery.terms) on all deficient axes would have done to the innovations (responses) is held
against these; terms that are stable and help on flights that were left out (selection) are the law, next to what the
rotors' own coefficients can do, which the fit bent. The share of the smoothed discrepancy that they explain on flights that
were left out (stretches, of a single flight) says whether there is a law. What is deficient but follows no signal of the
model is said to be that.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from greybox.data import Dataset
from greybox.discovery.regimes import Regime, regimes
from greybox.discovery.responses import Library, library
from greybox.discovery.selection import left_out, select, solve
from greybox.discovery.terms import Memory, wanted_features
from greybox.errors import FitError
from greybox.estimation.fit import Fit, fit, noise_of
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.estimation.status import Code
from greybox.residual.discrepancy import GROUPS, discrepancy
from greybox.statistics.evidence import CLEAR

SHARE = 0.25
"""Share of the smoothed discrepancy that terms must explain on left-out stretches to be called a law."""
TERMS = 6
"""Terms of an axis, at most."""
OWN: dict[str, tuple[str, tuple[str, ...]]] = {
    "force.z": ("rotors.thrust", ("thrust.", "mass")), "torque.x": ("rotors.roll", ("thrust.", "inertia.xx")),
    "torque.y": ("rotors.pitch", ("thrust.", "inertia.yy")), "torque.z": ("rotors.yaw", ("torque.", "inertia.zz")),
}  # fmt: skip
"""Axis -> (the term that a wrong coefficient of the rotors, mass or inertia leaves, how the names of these begin)."""
TOLERANCE = 1e-2
"""Log likelihood at which the fit of the disturbance states stops: levels that run to zero never quite get there."""
ENOUGH = 12
"""Iterations that show how much is left."""
STRONG = 60.0
"""Gain above which an axis counts as deficient although no law was found."""
SILENT = 12.0
"""By how much the logarithm of a level falls when its state is taken away."""
NO_LAW: dict[str, Any] = {"share": 0.0, "terms": {}, "depends_on": ()}
LOUDER = (0.0, 0.7, 1.4, 2.1, 2.8, 3.5)
"""By how much the logarithm of the white noise is tried to rise in its place."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Leftover:
    """One axis: `channel` (force.x, ...), RMS of its smoothed discrepancy [unit], `share` of its variance that `terms`
    (text -> coefficient, SI) explain out of sample, and the signals that they look at; `codes` are the terms as lines of
    an effect file, `memories` how those with a memory follow it, and its RMS. `gain`: how much BIC loses without this axis'
    state; `lasts`: correlation time of the state [s]."""

    channel: str
    unit: str
    rms: float
    share: float
    terms: dict[str, float]
    depends_on: tuple[str, ...]
    codes: tuple[str, ...] = ()
    memories: tuple[tuple[Memory, float] | None, ...] = ()
    gain: float = 0.0
    lasts: float | None = None

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
            "lasts_s": self.lasts,
        }  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Promoted:
    """The model with disturbance states, and by how much they improve BIC. `known` is false where that model has no finite
    prediction along the flights (a velocity that nothing holds): then no law of what is left was sought."""

    fit: Fit
    gain: float
    axes: tuple[Leftover, ...]
    regimes: tuple[Regime, ...] = ()
    known: bool = True

    @property
    def deficiency(self) -> float | None:
        """`gain`, None where there is no likelihood with disturbance states at all."""
        return self.gain if self.known or self.axes else None

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


def promote(found: Fit, data: Dataset, *, seed: int = 0, iterations: int = 60, memory: bool = True) -> Promoted:
    """Disturbance states on top of `found` (physics held, levels and time constants fitted), and laws for their axes.

    A dozen `iterations` are enough to show where a model that misses much is deficient; its gain is then a lower bound.
    Without `memory` laws are of what is, not of what was, and are sought in a third of the time.
    """
    result, gain = disturbed(found, data, iterations)
    if result.status.code is Code.INVALID_START:
        return Promoted(fit=result, gain=0.0, axes=(), known=False)
    names = wanted_features(result.model.dynamics)
    gains = axis_gains(result, gain)
    try:
        seen = discrepancy(result.model, data, names)
    except FitError:
        return Promoted(fit=result, gain=gain, axes=_sizes(result, gains), known=False)
    wanted = [c.name for c in seen.outputs if gains[c.name] > CLEAR] if gain > CLEAR else []
    laws: dict[str, dict[str, Any]] = {}
    if wanted:
        offered = library(found.model, result.model, data, names, wanted, memory=memory)
        laws = laws_of(offered, result.n_samples, seed, found.parameters)
    axes = tuple(
        Leftover(
            channel=c.name, unit=c.unit, rms=float(np.sqrt(np.mean((seen.y[:, j] - seen.y[:, j].mean()) ** 2))),
            gain=gains[c.name], lasts=_lasts(result, c.name), **laws.get(c.name, NO_LAW),
        )
        for j, c in enumerate(seen.outputs)
    )  # fmt: skip
    return Promoted(fit=result, gain=gain, axes=axes, regimes=regimes(seen, names))


def disturbed(found: Fit, data: Dataset, iterations: int) -> tuple[Fit, float]:
    """(`found` with disturbance states, its physics held; by how much they improve BIC)."""
    groups = tuple(g for g in GROUPS if any(n.startswith(g + ".") for n in found.model.dynamics.noises.names))
    result = fit(
        found.model.dynamics, data, disturbance=groups, free=[f"disturbance.{g}.T" for g in groups],
        values=dict(found.model.values), noise=noise_of(found.model), initialisation="nominal",
        solver=LevenbergMarquardt(tolerance=TOLERANCE, max_iterations=iterations),
    )  # fmt: skip
    if result.status.code is Code.INVALID_START:
        return result, 0.0
    # Physics is held here and was free there: its parameters count once, on both sides.
    return result, 2 * (result.loglik - found.loglik) - _states(result) * float(np.log(max(result.n_samples, 1)))


def _sizes(result: Fit, gains: Mapping[str, float]) -> tuple[Leftover, ...]:
    """Axes without a law, their RMS that of the fitted process (stationary level of its state)."""
    model = result.model
    driving = dict(zip(model.dynamics.noises.names, model.process_noise.tolist(), strict=True))
    out = []
    for axis, gain in gains.items():
        memory = _lasts(result, axis)
        level = driving[f"disturbance.{axis}"] / np.sqrt(-np.expm1(-2 * model.sample_time / memory))
        unit = model.dynamics.noises.signals[model.dynamics.noises[axis]].unit
        out.append(Leftover(channel=axis, unit=unit, rms=float(level), gain=gain, lasts=memory, **NO_LAW))
    return tuple(out)


def _lasts(result: Fit, axis: str) -> float:
    """Correlation time [s] of the disturbance state of an axis; force and torque have one each."""
    return float(result.model.values[f"disturbance.{axis.split('.')[0]}.T"])


def _bent(axis: str, free: Iterable[str]) -> bool:
    """Whether the fit could bend what multiplies the rotors on this axis."""
    return any(n.startswith(OWN[axis][1]) for n in free)


def laws_of(offered: Library, samples: int, seed: int, free: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Axis -> `share`, `terms`, `depends_on` and `codes` of its law, for axes that have one; `free` are the names of the
    parameters that the fit had."""
    labels = [axis for axis, _ in offered.columns]
    own = [i for i, (axis, t) in enumerate(offered.columns) if axis in OWN and OWN[axis][0] == t.text and _bent(axis, free)]
    # The last columns are a constant push on every axis.
    always = [*own, *range(len(labels), offered.innovations.xy.shape[1])]
    groups = [*labels, *["constant"] * (len(always) - len(own))]
    kept = _merged(offered, select(offered.innovations, always, groups, most=TERMS, samples=samples, seed=seed))
    total = offered.innovations.xx.sum(0), offered.innovations.xy.sum(0)
    c = dict(zip([*always, *kept], solve(*total, [*always, *kept]).tolist(), strict=True)) if kept else {}
    out: dict[str, dict[str, Any]] = {}
    for axis, normal in offered.smoothed.items():
        mine = [i for i in kept if labels[i] == axis]
        if not mine:
            continue
        used = [offered.columns[i][1] for i in mine]
        constant = len(labels)
        base = [constant, *(i for i in own if labels[i] == axis)]
        more = left_out(normal, [*base, *mine]) - left_out(normal, base)
        out[axis] = {
            "share": more / max(float(normal.yy.sum()) - left_out(normal, [constant]), 1e-300),
            "terms": {t.text: c[i] for t, i in zip(used, mine, strict=True)}, "codes": tuple(t.code for t in used),
            "memories": tuple((t.memory, float(np.sqrt(np.mean(t.values**2)))) if t.memory else None for t in used),
            "depends_on": tuple(dict.fromkeys(n for t in used for n in t.uses)),
        }  # fmt: skip
    return out


def _merged(offered: Library, kept: Sequence[int]) -> list[int]:
    """Of memories of one kind that follow one signal on one axis the first: two of the grid stand for one that lies between,
    and a refit, whose times are free, would find that twice."""
    seen, out = set[tuple[str, str, str]](), list[int]()
    for i in kept:
        axis, term = offered.columns[i]
        if term.memory is not None:
            key = (axis, term.code, term.memory.kind)
            if key in seen:
                continue
            seen.add(key)
        out.append(i)
    return out


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
