"""Known: what an identified model says before new flights are looked at."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Self

import numpy as np
from scipy.special import stdtrit

from greybox.errors import ModelError
from greybox.model.absence import TYPICAL
from greybox.model.effect import Effect
from greybox.model.identified import IdentifiedModel
from greybox.model.layer import learned_part, learned_push_of, physics_of
from greybox.model.verdict import demand_finished
from greybox.symbolic import FloatArray

LEAST = 1e-6
"""Share of a variance that is left at least where another number is given."""
SCALE = "mass"
"""Flights show forces and moments per mass: with mass, inertia, forces and moments larger by one
factor a craft flies the same."""


@dataclass(frozen=True, kw_only=True)
class Known:
    """What an identified model says: its effects, (value, sigma) of every number as what is `held`
    (the mass, and what it held itself) is given, `untold` (see there), and what drives it."""

    effects: tuple[Effect, ...] = ()
    prior: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    held: Mapping[str, float] = field(default_factory=dict)
    untold: tuple[Mapping[str, float], ...] = ()
    input: Literal["command", "speed"] | None = None


NOTHING = Known()
"""Of a craft that nobody has identified."""


def demand_known(model: IdentifiedModel | None) -> None:
    """Raises `ModelError` for a model whose numbers are no beginning: of a command that ended
    before the model was judged, or with a learned part. The numbers of such a one are those beside
    what was learned; whoever went on from them would call them the physics'."""
    demand_finished(model)
    if model is not None and learned_push_of(model.dynamics) is not None:
        raise learned_part(ModelError, model.source or model.name)


def since(model: IdentifiedModel) -> Known:
    """An identified model as what is known before new flights."""
    physics = physics_of(model.dynamics)
    errors = {**model.standard_errors, **{n: s for n, (s, _) in model.considered.items()}}
    scale = () if physics is None else (SCALE,)
    names = [n for n in (*scale, *model.considered) if errors.get(n, 0.0) > 0.0]
    held = {n: float(model.values[n]) for n in names}
    return Known(
        effects=() if physics is None else tuple(physics.effects),
        prior=known_numbers(model, held),
        held=held,
        untold=untold(model, held),
        input=None if physics is None else physics.input,
    )


def known_numbers(
    model: IdentifiedModel, given: Mapping[str, float] | None = None
) -> dict[str, tuple[float, float]]:
    """Parameter -> its number with its error; of those that differ from flight to flight with the
    error of one more flight. With numbers that are `given`: of the others, were these so (a
    Gaussian posterior).

    A new flight's own numbers are believed to be about the means of earlier ones, within what is
    usual at the least. The others are known as these means are given: a thrust of which flights
    tell only the product with their own level would else take up what the product denies.

    The numbers are taken for independent by whoever gets them. Five that share one unknown scale
    would then measure it five times. So each variance is multiplied by the sum of its absolute
    correlations: the diagonal matrix of these is at least the covariance (Gershgorin), and no
    direction is known better than it was.
    """
    means = {n: m for n, (m, _) in model.flight_spread.items()}
    names, values, covariance = _Joint.of(model).were(means | dict(given or {}))
    variances = np.diag(covariance) * _shared(covariance)
    variances += np.array([model.form_errors.get(n, 0.0) ** 2 for n in names])
    prior = {
        n: (float(v), float(np.sqrt(s)))
        for n, v, s in zip(names, values, variances, strict=True)
        if s > 0
    }
    # What hardly varied between flights of a day is no reason to believe that it never does.
    usual = {d.name: TYPICAL * d.scale for d in model.dynamics.parameters}
    spread = {
        n: (float(m), max(float(s) * _of_one_more(model, n), usual[n]))
        for n, (m, s) in model.flight_spread.items()
    }
    return prior | spread


def untold(model: IdentifiedModel, held: Collection[str]) -> tuple[Mapping[str, float], ...]:
    """How numbers move together, by one standard error at a time, where `known_numbers` are as what
    is `held` and the means of flights are given: new flights tell nothing of that."""
    joint = _Joint.of(model)
    given = [i for i, n in enumerate(joint.names) if n in held or n in model.flight_spread]
    if not given:
        return ()
    size, axes = np.linalg.eigh(joint.covariance[np.ix_(given, given)])
    moves = joint.gain(given).T @ axes * np.sqrt(np.maximum(size, 0.0))
    return tuple(
        {n: float(m) for n, m in zip(joint.names, column, strict=True) if m} for column in moves.T
    )


def as_flights_are(model: IdentifiedModel) -> tuple[tuple[str, ...], FloatArray]:
    """Names and covariance (k, k) of shared parameters and of those that were held and are not
    exact, as the means of what flights have of their own are given."""
    means = {n: m for n, (m, _) in model.flight_spread.items()}
    names, _, covariance = _Joint.of(model).were(means)
    at = [i for i, n in enumerate(names) if n not in means]
    return tuple(names[i] for i in at), covariance[np.ix_(at, at)]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Joint:
    """Names, values (n,) and covariance (n, n) of what was estimated, of what was held and not
    exact, and of the means over flights, as far as the model says how these vary with others."""

    names: Sequence[str]
    values: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, model: IdentifiedModel) -> Self:
        known, joint = model.joint_covariance
        own = list(model.flight_spread) if model.flight_covariance.size else []
        names, first = [*known, *own], len(known)
        covariance = np.zeros((len(names), len(names)))
        covariance[:first, :first] = joint
        if own:
            n = len(model.covariance_names)
            moved = [[s**2 * by.get(o, 0.0) for o in own] for s, by in model.considered.values()]
            held = np.reshape(moved, (first - n, len(own)))
            beside = np.vstack([model.flight_covariance[:n], held])
            covariance[:first, first:], covariance[first:, :first] = beside, beside.T
            covariance[first:, first:] = model.flight_covariance[n:]
        values = np.array([float(model.values[name]) for name in names])
        return cls(names=names, values=values, covariance=covariance)

    def gain(self, given: Sequence[int]) -> FloatArray:
        """How far all move (k, n) per unit of those at the places `given` (k,)."""
        square = self.covariance[np.ix_(given, given)]
        return np.asarray(np.linalg.lstsq(square, self.covariance[given], rcond=None)[0])

    def were(self, given: Mapping[str, float]) -> tuple[Sequence[str], FloatArray, FloatArray]:
        """Names, values and covariance, were those that are `given` so."""
        at = [i for i, n in enumerate(self.names) if n in given]
        if not at:
            return self.names, self.values, self.covariance
        gain = self.gain(at)
        off = np.array([given[self.names[i]] for i in at]) - self.values[at]
        covariance = self.covariance - gain.T @ self.covariance[at]
        least = LEAST * np.diag(self.covariance)
        np.fill_diagonal(covariance, np.maximum(np.diag(covariance), least))
        return self.names, self.values + gain.T @ off, covariance


def _shared(covariance: FloatArray) -> FloatArray:
    """Sum of the absolute correlations of each number with all, itself included."""
    error = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size = np.outer(error, error)
    known = np.divide(np.abs(covariance), size, out=np.zeros_like(size), where=size > 0)
    return np.minimum(known, 1.0).sum(axis=1)


def _of_one_more(model: IdentifiedModel, name: str) -> float:
    """Factor on the spread of what flights had, so that 95 % of next ones are within 1.96 of it
    (Student's prediction interval): two flights hardly tell how far a third may be."""
    n = sum(name in own for own in model.per_flight.values())
    return float(stdtrit(n - 1, 0.975) / 1.96 * np.sqrt(1 + 1 / n)) if n > 1 else 1.0
