"""Without a position an accelerometer feels a white force as its own noise: where the flights do not
tell the two apart, errors are those of the split that tells less, and the split is named."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from greybox.estimation.noise_split import wider_split
from greybox.estimation.problem import Problem
from greybox.estimation.solver import Value
from greybox.estimation.unknown import SearchSpace, Unknown
from greybox.symbolic import FloatArray

MASS, SUM, ROWS, WIDE = 0.5, 0.4, 1200, 2.0
"""Of the craft [kg]; white noise of the reading [m/s^2], sensor and force together; samples; sigma
of a level's prior."""
BIAS = "accelerometer_bias.b_z"


def unknown(name: str, sigma: float) -> Unknown:
    return Unknown(
        name=name,
        kind="noise" if name.startswith("noise.") else "parameter",
        flight=None,
        start=0.0,
        lower=-12.0,
        upper=8.0,
        mean=np.log(SUM) if name.startswith("noise.") else 0.0,
        sigma=sigma,
        scale=1.0,
        unit="m/s^2",
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Reading(SearchSpace):
    """One axis of an accelerometer with a bias that only the sensor's noise blurs. The sum of the
    two variances is told, and by `told` that the sensor has none of it."""

    told: float
    dt: float = 0.01

    @property
    def dynamics(self) -> Any:
        return SimpleNamespace(
            innovations=SimpleNamespace(names=("az",)), noises=SimpleNamespace(names=("force.z",))
        )

    def place(self, name: str) -> int | None:
        return {u.name: i for i, u in enumerate(self.unknowns)}.get(name)

    def prepared(self, predictor: object) -> Any:
        through = np.array([[1 / MASS]])
        values = (np.zeros((1, 1)),) * 3 + (through,)
        return SimpleNamespace(
            reference=(np.zeros(1), np.zeros((1, 1))),
            linearisation=SimpleNamespace(values=lambda *_: values),
        )

    def parameters_of(self, theta: FloatArray, flight: str | None) -> FloatArray:
        return theta[2:]

    def noise_levels(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        return np.exp(theta[1:2]), np.exp(theta[:1])

    def evaluate(self, theta: FloatArray, order: int = 1) -> Value:
        r, q = np.exp(2 * theta[0]), np.exp(2 * theta[1]) / MASS**2
        share = np.array([r, q]) / (r + q)
        off = 0.5 * np.log((r + q) / SUM**2)
        cost = ROWS * off**2 + self.told * r / SUM**2
        hessian = np.zeros((3, 3))
        hessian[:2, :2] = 2 * ROWS * np.outer(share, share) + np.diag([WIDE**-2.0] * 2)
        hessian[2, 2] = ROWS / r
        gradient = np.append(2 * ROWS * off * share, 0.0)
        return Value(cost=cost, likelihood=cost, gradient=gradient, hessian=hessian)


def asked(told: float, sensor: float) -> tuple[float, float, tuple[str, ...]]:
    """(error of the bias with the noise of the sensor at `sensor`, that with other splits, what is
    said)."""
    names = ("noise.sensor.az", "noise.process.force.z", BIAS)
    space = Reading(unknowns=tuple(unknown(n, WIDE) for n in names), told=told)
    theta = np.array([np.log(sensor), np.log(MASS * np.sqrt(SUM**2 - sensor**2)), 0.0])
    value = space.evaluate(theta)
    assert value.hessian is not None
    fisher = np.linalg.inv(value.hessian)
    nothing = np.zeros(3, dtype=bool)
    wider, said = wider_split(cast(Problem, space), theta, value, fisher, nothing)
    assert (wider[:2] == 1).all()
    alone = float(np.sqrt(fisher[2, 2]))
    return alone, alone * float(wider[2]), said


def test_the_error_is_that_of_the_split_that_tells_less():
    least = SUM / np.sqrt(ROWS)
    alone, held, said = asked(told=0.0, sensor=0.04)
    assert alone < 0.2 * least
    assert held == pytest.approx(least, rel=0.01)
    assert len(said) == 1
    assert said[0].startswith("noise.sensor.az and noise.process.force.z are one number")
    assert f"errors of {BIAS} are" in said[0]


def test_as_much_is_put_on_the_sensor_as_chance_allows():
    _, held, _ = asked(told=2.3, sensor=0.04)
    assert held == pytest.approx(SUM * np.sqrt((1 - 0.5**2) / ROWS), rel=0.01)


@pytest.mark.parametrize(("told", "sensor"), [(100.0, 0.04), (0.0, 0.39)])
def test_a_split_that_is_told_and_one_that_widens_nothing_are_not_spoken_of(told, sensor):
    alone, held, said = asked(told=told, sensor=sensor)
    assert held == alone
    assert not said
