"""Slopes of what begins within a flight and stays are differences of the predictor, and the place
where it is likeliest is told for all samples at once."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from greybox.data import dataset_from_arrays
from greybox.estimation.fit import fit
from greybox.estimation.lasting_pushes import Lasting, LastingPushes
from greybox.estimation.problem import make_problem
from greybox.estimation.result import Fit
from greybox.model.dynamics import StateSpaceModel
from greybox.model.noise import with_disturbance
from greybox.model.parameter import Parameter
from greybox.statistics.rivals import Parabola, likeliest
from greybox.symbolic import FloatArray, Layout, Signal

DT, N, BEGIN, PUSH = 0.05, 300, 180, 0.8


def oscillator() -> StateSpaceModel:
    """Damped, with a gain of its input and a steady force b; its position is measured."""
    return StateSpaceModel(
        name="oscillator",
        states=Layout([Signal(name="pos", unit="m"), Signal(name="vel", unit="m/s")]),
        inputs=Layout([Signal(name="u", unit="N")]),
        outputs=Layout([Signal(name="y", unit="m")]),
        parameters=(
            Parameter(name="gain", unit="-", nominal=1.0, null=1.0, sigma=0.5, scale=1.0),
            Parameter(name="b", unit="N", nominal=0.0, null=0.0, sigma=1.0, scale=1.0),
        ),
        dynamics=lambda t, x, u, p: [x[1], p["gain"] * u + p["b"] - 4 * x[0] - 0.4 * x[1]],
        measurement=lambda t, x, u, p: [x[0]],
        noise_states=("vel",),
    )


@functools.cache
def fitted(push: float = PUSH) -> Fit:
    """A flight with a `push` from `BEGIN` on."""
    rng, x = np.random.default_rng(0), np.zeros(2)
    u, y = np.repeat(rng.standard_normal(N // 5), 5), np.zeros(N)
    for k in range(N):
        y[k] = x[0] + 0.01 * rng.standard_normal()
        for _ in range(10):
            force = u[k] + push * (k >= BEGIN) - 4 * x[0] - 0.4 * x[1]
            x = x + DT / 10 * np.array([x[1], force])
    data = dataset_from_arrays(DT * np.arange(N), {"u": u, "y": y}, name="run")
    return fit(with_disturbance(oscillator(), ("vel",), time=1.0), data)


def lasting(*names: str, share: FloatArray | None = None) -> Lasting:
    step = 1.0 * (np.arange(N) >= BEGIN)
    sigma = np.full(len(names), 1.0)
    return Lasting(record=0, names=names, sigma=sigma, share=step if share is None else share)


def test_slopes_are_differences_of_the_predictor() -> None:
    found = fitted()
    problem, theta, h = found.problem, found.theta, 1e-5
    for share in (1.0 * (np.arange(N) >= BEGIN), np.linspace(0.0, 1.0, N)):
        asked = lasting("disturbance.vel", "b", share=share)
        of_fit = LastingPushes(problem=problem, theta=theta)
        wide, at = of_fit.with_pushes({"a": of_fit.felt(asked)})
        (block,) = wide.predictor.blocks(wide, at, True)
        assert block.jacobian is not None
        slope = block.jacobian[:, 0, -2:]
        assert slope[:, 0] == pytest.approx(slope[:, 1], abs=1e-9)
        segment = problem.records[0].segment
        u = segment.channels["u"] if "u" in segment.channels else segment.extra["u"]
        gain = found["gain"].value
        moved = dataset_from_arrays(
            segment.t,
            {"u": u + h * share / gain, "y": problem.records[0].outputs[:, 0]},
            name="run",
        )
        other = make_problem(problem.dynamics, moved)
        assert [v.name for v in other.unknowns] == [v.name for v in problem.unknowns]
        e = LastingPushes(problem=other, theta=theta).blocks[0].e - of_fit.blocks[0].e
        assert slope[:, 0] == pytest.approx(e[:, 0] / h, abs=1e-4 * np.abs(slope).max())


def odds_of(found: Fit, asked: Lasting) -> float:
    """Log odds of what lasts, by the parabola about the fit."""
    of_fit = LastingPushes(problem=found.problem, theta=found.theta)
    wide, at = of_fit.with_pushes({"a": of_fit.felt(asked)})
    value, n = wide.evaluate(at), found.problem.n
    assert value.data_hessian is not None and value.gradient is not None
    prior = np.array([u.sigma for u in wide.unknowns]) ** -2.0
    places = {"a": range(n, wide.n)}
    about = Parabola.about(value.data_hessian, value.gradient, prior, range(n), places)
    form = likeliest(about, {"a": 0.0})
    return 0.0 if form is None else form.log_odds


def test_the_place_is_told_for_all_samples_at_once() -> None:
    found = fitted()
    asked = lasting("disturbance.vel")
    odds = LastingPushes(problem=found.problem, theta=found.theta).log_odds_from(asked)
    assert odds.shape == (N,) and abs(int(np.argmax(odds)) - BEGIN) <= 1
    assert odds[BEGIN] == pytest.approx(odds_of(found, asked), rel=0.02, abs=0.2)
    assert odds[BEGIN] > np.log(N) > odds[: BEGIN - 30].max()


def test_a_flight_without_one_has_no_place() -> None:
    found = fitted(push=0.0)
    of_fit = LastingPushes(problem=found.problem, theta=found.theta)
    odds = of_fit.log_odds_from(lasting("disturbance.vel"))
    assert odds.max() < np.log(N)
