"""Push levels: how strongly what is unexplained pushes a craft about, counted on flights.

The filter's noise levels are those of errors one step ahead, where it knows the present push. A
simulator flies for long and knows none. From instants of flights the drawn craft fly on without
pushes; what the real flight does beside them, 0.1, 0.5 and 1 s ahead, is what pushes have to
explain. The variance of each sensor is

    V = V(craft, start, sensor) + sum_g k_g^2 V_g

with V_g that of the pushes of one axis at the filter's level: of the difference between the same
craft with and without them. The factors k_g are the most probable ones, with a prior about 1; the
likelihood is that of `greybox.validation.calibration`, but for pushes that nobody knows at the
start. An instant counts as many numbers as there are axes, as horizons repeat each other, and so do
a motion and its derivative.
Flights differ: one is rougher about roll than another. The logarithm of each flight's own factor is
a sample from a normal distribution; that of a new one, as drawn with every craft, is then
Student-distributed (`greybox.validation.new_flight`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize

from greybox.data import Dataset, Flight
from greybox.errors import DataError
from greybox.model.identified import IdentifiedModel
from greybox.simulators.coverage import (
    HORIZONS,
    START,
    Seen,
    adapted_draws,
    ahead,
    module_of,
    starts,
)
from greybox.simulators.draws import Draws
from greybox.symbolic import FloatArray

FACTORS = (0.05, 20.0)
PRIOR = float(np.log(4.0))
"""Standard deviation of the logarithm of a factor about 0, before flights are asked. A choice: the
filter's level is right to a factor of 4 in two of three cases. It is weakly informative (Gelman
2006, Bayesian Analysis 1(3)): it decides only where flights do not tell."""
MOST = float(np.log(4.0))
"""Logarithm of the largest factor of a flight of its own."""
FEWEST = 3
"""Flights below which nothing is said about how they differ."""
CRAFT = 40
"""Draws that are flown for every axis."""
FELT_BY = {
    "force": {f"velocity {i}" for i in range(3)},
    **{f"torque.{a}": {f"rate {i}"} for i, a in enumerate("xyz")},
}
"""What flights differ in -> sensors and axes that show it first of all."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Flown:
    """Of one flight: mean square error beside craft without pushes, their variance, and what the
    pushes of each axis add to it; `count` instants. All (c,): sensors, axes, horizons."""

    labels: tuple[str, ...]
    square: FloatArray
    base: FloatArray
    parts: FloatArray
    count: int

    def variance(self, squares: FloatArray) -> FloatArray:
        return np.asarray(self.base + squares @ self.parts)

    def at(self, felt: set[str]) -> list[bool]:
        """Which of the numbers are of a sensor and axis in `felt`."""
        return [label in felt for label in self.labels]


def with_push_levels(
    model: IdentifiedModel, draws: Draws, flights: Dataset, *, seed: int = 0
) -> Draws:
    """The draws with `levels` as `flights`, those of the fit, show them. Raises `DataError` where
    no flight is long enough, or the model does not carry the whole motion."""
    axes = _axes(model)
    groups = tuple(dict.fromkeys(axes))
    flown = [f for flight in flights for f in [_flown(model, draws, flight, axes, seed)] if f]
    if not flown:
        raise DataError(
            "no flight is long enough to count pushes on",
            expected=f"more than {START + max(HORIZONS):g} s in one piece",
        )

    def cost(logarithms: FloatArray) -> float:
        squares = np.exp(2.0 * logarithms)
        total = 0.0
        for f in flown:
            v = f.variance(squares)
            total += f.count * len(groups) * float(np.mean(np.log(v) + f.square / v))
        return total + float(np.sum((logarithms / PRIOR) ** 2))

    best = scipy.optimize.minimize(
        cost,
        np.zeros(len(groups)),
        method="L-BFGS-B",
        bounds=[tuple(np.log(FACTORS))] * len(groups),
    )
    factors = dict(zip(groups, np.exp(best.x).tolist(), strict=True))
    spread = {k: _between(flown, np.exp(2.0 * best.x), felt) for k, felt in FELT_BY.items()}
    random, n = np.random.default_rng([seed, 4]), len(flown)
    own = {}
    for k, s in spread.items():
        size = s * np.sqrt(1.0 + 1.0 / n) * random.standard_t(max(n - 1, 1), len(draws))
        own[k] = np.exp(np.clip(size, -MOST, MOST))
    levels = draws.levels.copy()
    for j, axis in enumerate(axes):
        kind, which = axis.split(".")
        about = own["force"] if kind == "force" else own[f"torque.{which}"]
        levels[:, j] = model.process_noise[j] * factors[axis] * about
    return replace(draws, levels=levels, pushes=_said(factors, spread, len(flown)))


def _axes(model: IdentifiedModel) -> tuple[str, ...]:
    """Of every process noise, the axis that it pushes: white noise and disturbance together."""
    return tuple(n.removeprefix("disturbance.") for n in model.dynamics.noises.names)


def _flown(
    model: IdentifiedModel, draws: Draws, flight: Flight, axes: tuple[str, ...], seed: int
) -> _Flown | None:
    found, adapted = starts(model, flight)
    if not found:
        return None
    few = min(CRAFT, len(draws))
    own = adapted_draws(draws, adapted, seed)
    values = (draws.values if own is None else own)[:few]
    module = module_of(model, draws)

    def flights(on: FloatArray) -> dict[str, list[Seen]]:
        """Pushed about by the noises that are `on` (n_w,); always with the same normals."""
        level = np.tile(np.where(on, model.process_noise, 0.0), (few, 1))
        out: dict[str, list[Seen]] = {}
        for start in found:
            for seen in ahead(model, module, values, level, start, seed):
                out.setdefault(f"{seen.group} {seen.seconds:g}", []).append(seen)
        return out

    calm = flights(np.zeros(len(axes)))
    base = _mean(calm, lambda off, _: off.var(axis=1))
    square = _mean(calm, lambda _, away: away**2)
    parts = []
    for axis in dict.fromkeys(axes):
        pushed = flights(np.array([a == axis for a in axes]))
        # what the push alone does: beside the same craft with the same errors, not a difference of
        # variances
        apart = {
            k: [replace(s, craft=s.craft - c.craft) for s, c in zip(v, calm[k], strict=True)]
            for k, v in pushed.items()
        }
        parts.append(_mean(apart, lambda off, _: off.var(axis=1)))
    there = np.isfinite(square)
    if not there.any():
        return None
    labels = [f"{k.split()[0]} {i}" for k, v in calm.items() for i in range(v[0].real.shape[1])]
    return _Flown(
        labels=tuple(n for n, t in zip(labels, there, strict=True) if t),
        square=square[there],
        base=base[there],
        parts=np.array(parts)[:, there],
        count=sum(len(s.rows) for s in found),
    )


def _mean(
    seen: Mapping[str, list[Seen]], of: Callable[[FloatArray, FloatArray], FloatArray]
) -> FloatArray:
    """Mean (c,) over instants of a number `of` distances from the middle; nan where none is
    seen."""
    means = []
    for pieces in seen.values():
        each = np.concatenate([of(*s.about_the_middle()) for s in pieces])
        count = np.isfinite(each).sum(axis=0)
        means.append(np.where(count, np.nansum(each, axis=0) / np.maximum(count, 1), np.nan))
    return np.concatenate(means)


def _between(flown: list[_Flown], squares: FloatArray, felt: set[str]) -> float:
    """Standard deviation between flights of the logarithm of their own factor, less what the number
    of instants alone makes."""
    told = [f for f in flown if any(f.at(felt))]
    if len(told) < FEWEST:
        return 0.0
    own = [0.5 * np.log(np.mean((f.square / f.variance(squares))[f.at(felt)])) for f in told]
    chance = float(np.mean([1.0 / (2.0 * f.count * len(felt)) for f in told]))
    return float(np.sqrt(max(np.var(own, ddof=1) - chance, 0.0)))


def _said(factors: Mapping[str, float], spread: Mapping[str, float], flights: int) -> str:
    """For people."""
    lines = [f"  pushes, counted on {flights} flights, over those of one step ahead:"]
    lines.append("    " + ", ".join(f"{n} {v:.1f}" for n, v in factors.items()))
    kinds = ", ".join(f"{k} by a factor of {np.exp(s):.2f}" for k, s in spread.items() if s)
    lines += [f"    flights differ in {kinds}"] if kinds else []
    return "\n".join(lines)
