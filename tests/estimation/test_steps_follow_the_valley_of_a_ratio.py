"""Where flights show a ratio alone the prior decides along a curved valley, and the solver follows
it; noise levels whose Hessian is wrong do not hold it back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from greybox.estimation.solver import Value
from greybox.estimation.solvers import levenberg_marquardt
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt, newton_decrement
from greybox.estimation.unknown import Unknown
from greybox.model.effects.payload_mass import PayloadMass
from greybox.symbolic import FloatArray

ERROR = 3e-5
"""Standard error of the logarithm of thrust over mass."""


def unknown(name: str, mean: float, sigma: float, origin: float, lower: float) -> Unknown:
    return Unknown(
        name=name,
        kind="noise" if name == "level" else "parameter",
        flight=None,
        start=mean,
        lower=lower,
        upper=np.inf,
        mean=mean,
        sigma=sigma,
        scale=sigma,
        unit="",
        origin=origin,
    )


UNKNOWNS = (
    unknown("mass", 1.0, 0.03, 0.0, 0.05),
    unknown("share", 0.0, 0.3, -1.0, -0.5),
    unknown("thrust", 0.6, 0.1, 0.0, 0.01),
    unknown("level", 0.0, 3.0, np.nan, -10.0),
)


@dataclass(frozen=True)
class Ratio:
    """thrust / (mass (1 + share)) = 1 is known to `ERROR`; the true curvature of the noise level is
    `wrong` times that of its Hessian."""

    unknowns: tuple[Unknown, ...] = UNKNOWNS
    wrong: float = 20.0

    @property
    def n(self) -> int:
        return len(self.unknowns)

    @property
    def lower(self) -> FloatArray:
        return np.array([u.lower for u in self.unknowns])

    @property
    def upper(self) -> FloatArray:
        return np.array([u.upper for u in self.unknowns])

    @property
    def scale(self) -> FloatArray:
        return np.array([u.scale for u in self.unknowns])

    def evaluate(self, theta: FloatArray, order: int = 1, scores: int | None = None) -> Value:
        mass, share, thrust, level = theta.tolist()
        mean = np.array([u.mean for u in self.unknowns])
        precision = np.array([u.sigma**-2.0 for u in self.unknowns])
        off = (thrust / (mass * (1 + share)) - 1) / ERROR
        slope = np.array([-1 / mass, -1 / (1 + share), 1 / thrust, 0.0]) * (off + 1 / ERROR)
        steep = 0.5 * self.wrong * level**2
        cost = 0.5 * off**2 + steep + 0.5 * float((precision * (theta - mean) ** 2).sum())
        gradient = off * slope + precision * (theta - mean)
        gradient[3] += self.wrong * level
        hessian = np.outer(slope, slope) + np.diag(precision)
        hessian[3, 3] += 1.0
        return Value(cost=cost, likelihood=cost, gradient=gradient, hessian=hessian)


def test_a_search_follows_the_valley_while_a_level_overshoots() -> None:
    problem = Ratio()
    start = np.array([1.0, 0.0, 1.0, 0.3])
    found, status = LevenbergMarquardt(tolerance=1e-6).solve(problem, start)
    assert status.converged
    mass, share, thrust, _ = found.tolist()
    assert thrust / (mass * (1 + share)) == pytest.approx(1, abs=ERROR)
    # Along the valley thrust = mass (1 + share) the prior alone decides.
    rows = np.linspace(0.5, 1.0, 1001)
    masses = np.linspace(0.9, 1.0, 501)[:, None]
    prior = (
        ((masses - 1) / 0.03) ** 2 + ((rows / masses - 1) / 0.3) ** 2 + ((rows - 0.6) / 0.1) ** 2
    )
    assert thrust == pytest.approx(rows[int(prior.argmin()) % rows.size], abs=2e-3)


def test_without_the_logarithm_of_factors_it_takes_twice_as_long() -> None:
    blind = Ratio(unknowns=tuple(replace(u, origin=np.nan) for u in UNKNOWNS))
    start = np.array([1.0, 0.0, 1.0, 0.3])
    _, creeping = LevenbergMarquardt(tolerance=1e-6).solve(blind, start)
    _, straight = LevenbergMarquardt(tolerance=1e-6).solve(Ratio(), start)
    assert straight.converged
    assert creeping.iterations > 2 * straight.iterations


def test_a_load_is_a_factor_of_the_mass() -> None:
    (share,) = PayloadMass().parameters(None)
    assert share.origin == -1.0


def test_a_factor_that_is_pushed_to_its_bound_lands_on_it() -> None:
    """Half the mass as a load stood a rounding beside its bound, and had a name."""
    weak = tuple(replace(u, mean=0.1, sigma=0.01) if u.name == "thrust" else u for u in UNKNOWNS)
    for start in (-0.3, 0.0, 0.7):
        found, status = LevenbergMarquardt().solve(
            Ratio(unknowns=weak), np.array([1.0, start, 1.0, 0.3])
        )
        assert status.converged
        assert found[1] == Ratio(unknowns=weak).lower[1]


@dataclass(frozen=True)
class ThrustMap(Ratio):
    """The thrust c1 u + c2 u^2 over the mass is known to `ERROR` at two commands."""

    unknowns: tuple[Unknown, ...] = (
        unknown("mass", 1.0, 0.03, 0.0, 0.05),
        unknown("thrust.c1", -0.2, 0.1, np.nan, -20.0),
        unknown("thrust.c2", 3.0, 1.0, np.nan, -20.0),
    )

    def evaluate(self, theta: FloatArray, order: int = 1, scores: int | None = None) -> Value:
        u = np.array([0.5, 0.8])
        rows = np.column_stack([u, u**2]) / ERROR
        mass, parts = theta[0], theta[1:]
        off = rows @ (parts / mass - [-0.3, 4.0])
        slope = np.column_stack([-rows @ parts / mass**2, rows / mass])
        return self._valued(theta, off, slope)

    def _valued(self, theta: FloatArray, off: FloatArray, slope: FloatArray) -> Value:
        mean = np.array([v.mean for v in self.unknowns])
        precision = np.array([v.sigma**-2.0 for v in self.unknowns])
        cost = 0.5 * float(off @ off + (precision * (theta - mean) ** 2).sum())
        gradient = slope.T @ off + precision * (theta - mean)
        hessian = slope.T @ slope + np.diag(precision)
        return Value(cost=cost, likelihood=cost, gradient=gradient, hessian=hessian)


@dataclass(frozen=True)
class Drags(ThrustMap):
    """The sum of two drags is known to `ERROR`, and each cannot be negative."""

    unknowns: tuple[Unknown, ...] = (
        unknown("rotor_drag", 1.0, 0.5, 0.0, 0.0),
        unknown("blade_flapping", 1.0, 0.1, 0.0, 0.0),
    )

    def evaluate(self, theta: FloatArray, order: int = 1, scores: int | None = None) -> Value:
        off = np.array([theta.sum() - 3.0]) / ERROR
        return self._valued(theta, off, np.ones((1, 2)) / ERROR)


@pytest.mark.parametrize(
    ("problem", "start"),
    [(ThrustMap(), 2.7 * np.array([1.0, -0.3, 4.0])), (Drags(), np.array([0.3, 2.7]))],
)
def test_the_valley_of_a_sum_is_straight(
    problem: ThrustMap, start: FloatArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thrust map with a negative part crept along for a hundred steps, and a fit that would have
    foretold three times better was given up as not converged."""
    found, status = LevenbergMarquardt().solve(problem, start)
    assert status.converged
    assert status.iterations < 15
    value = problem.evaluate(found)
    assert value.gradient is not None
    assert value.hessian is not None
    assert newton_decrement(value.gradient, value.hessian, np.zeros(found.size, dtype=bool)) < 1e-6
    monkeypatch.setattr(levenberg_marquardt, "straight", levenberg_marquardt.moved_by)
    _, creeping = LevenbergMarquardt().solve(problem, start)
    assert creeping.iterations > 2 * status.iterations
