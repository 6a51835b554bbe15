"""Claims about criteria: outliers move the Gaussian estimate and not the robust one; clean data
give the same levels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from greybox.data import Dataset, dataset_from_arrays
from greybox.errors import ModelError, UnknownNameError
from greybox.estimation.criteria import CRITERIA
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.criteria.least_squares import LeastSquares
from greybox.estimation.criteria.robust import Robust
from greybox.estimation.initialisation import equation_error
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.predictors.kalman import Kalman
from greybox.estimation.predictors.simulation import Simulation
from greybox.estimation.problem import make_problem
from greybox.estimation.solvers.levenberg_marquardt import LevenbergMarquardt
from greybox.symbolic import FloatArray
from tests import motor
from tests.differences import gradient_error

ROBUST = [Robust(), Robust(kind="pseudo-huber", shape=1.5)]


def estimate(data: Dataset, criterion: Any, predictor: Any) -> tuple[FloatArray, FloatArray]:
    problem = make_problem(motor.model(), data, predictor=predictor, criterion=criterion)
    theta, status = LevenbergMarquardt().solve(problem, equation_error(problem))
    assert status.converged
    hessian = problem.evaluate(theta).hessian
    assert hessian is not None
    return theta, np.sqrt(np.diag(np.linalg.inv(hessian)))


def with_outliers(data: Dataset, share: float = 0.02) -> Dataset:
    """Two per cent of the samples off by 50 to 150 standard deviations, to one side (a loose
    connector)."""
    s, rng = data.segments[0], np.random.default_rng(11)
    c = {k: np.array(v) for k, v in s.channels.items()}
    for name, size in (("current", 1.0), ("speed", 15.0)):
        bad = rng.random(s.n) < share
        c[name][bad] += size * rng.uniform(1, 3, bad.sum())
    return dataset_from_arrays(s.t, c)


@pytest.mark.parametrize("criterion", ROBUST, ids=lambda c: c.kind)
def test_gross_outliers_move_the_gaussian_estimate_but_not_the_robust_one(
    criterion: Robust,
) -> None:
    data = motor.record()
    clean, error = estimate(data, Gaussian(), Simulation())
    dirty = with_outliers(data)
    gaussian, _ = estimate(dirty, Gaussian(), Simulation())
    robust, _ = estimate(dirty, criterion, Simulation())
    moved = np.abs(gaussian - clean)[:6] / error[:6]
    stayed = np.abs(robust - clean)[:6] / error[:6]
    assert moved.max() > 10
    assert stayed.max() < moved.max() / 5
    if criterion.kind == "student-t":
        assert stayed.max() < 2


@pytest.mark.parametrize("criterion", ROBUST, ids=lambda c: c.kind)
def test_on_clean_data_noise_levels_are_those_of_the_gaussian_criterion(criterion: Robust) -> None:
    data = motor.record(torque_noise=0.002)
    gaussian, error = estimate(data, Gaussian(), Innovation())
    robust, _ = estimate(data, criterion, Innovation())
    assert np.abs(robust - gaussian)[6] < 4 * error[6]
    assert np.abs(robust - gaussian)[7] < 4 * error[7]


@pytest.mark.parametrize("criterion", ROBUST, ids=lambda c: c.kind)
def test_the_robust_loss_is_normalised_and_redescends_slower_than_a_square(
    criterion: Robust,
) -> None:
    z = np.random.default_rng(0).standard_normal(400_000)
    rho, weight = criterion.loss(z)
    assert float(np.mean(weight * z * z)) == pytest.approx(1.0, abs=0.01)
    h = 1e-6
    slope = (criterion.loss(z[:100] + h)[0] - criterion.loss(z[:100] - h)[0]) / (2 * h)
    np.testing.assert_allclose(slope, weight[:100] * z[:100], rtol=1e-6, atol=1e-8)
    assert criterion.loss(np.array([100.0]))[0][0] < 0.1 * 0.5 * 100.0**2
    assert (rho >= 0).all()


@pytest.mark.parametrize("name", CRITERIA)
@pytest.mark.parametrize("predictor", [Simulation(), Innovation()], ids=lambda p: p.name)
def test_gradients_are_those_of_the_cost(name: str, predictor: Any) -> None:
    data = with_outliers(motor.record(n=200, torque_noise=0.002))
    problem = make_problem(motor.model(), data, predictor=predictor, criterion=CRITERIA[name]())
    assert gradient_error(problem, equation_error(problem)) < 1e-6


def test_scores_add_up_to_the_gradient() -> None:
    data = motor.record(n=200, torque_noise=0.002)
    for predictor, criterion in (
        (Innovation(), Robust()),
        (Kalman(), Gaussian()),
        (Simulation(), LeastSquares()),
    ):
        problem = make_problem(motor.model(), data, predictor=predictor, criterion=criterion)
        value = problem.evaluate(problem.start, scores=16)
        prior = np.array(
            [(t - u.mean) / u.sigma**2 for t, u in zip(problem.start, problem.unknowns)]
        )
        assert value.scores is not None
        np.testing.assert_allclose(
            value.scores.sum(axis=0) + prior, value.gradient, rtol=1e-8, atol=1e-6
        )


def test_right_weights_give_the_estimates_and_errors_of_the_likelihood() -> None:
    data = motor.record()
    gaussian, error = estimate(data, Gaussian(), Simulation())
    squares, other = estimate(
        data, LeastSquares(sigma={"current": 0.02, "speed": 0.3}), Simulation()
    )
    assert (np.abs(squares - gaussian) / error).max() < 0.3
    np.testing.assert_allclose(other, error, rtol=0.1)


def test_the_cost_of_least_squares_is_half_the_sum_of_squares() -> None:
    data = motor.record(n=100)
    problem = make_problem(
        motor.model(), data, predictor=Simulation(), criterion=LeastSquares(sigma={"speed": 2.0})
    )
    (block,) = problem.predictor.blocks(problem, problem.start, False)
    expected = 0.5 * float(((block.e / np.array([0.05, 2.0])) ** 2).sum())
    assert problem.evaluate(problem.start).likelihood == pytest.approx(expected, rel=1e-12)


def test_weights_that_do_not_fit_are_named() -> None:
    data = motor.record(n=100)
    for sigma, error in (({"sped": 1.0}, UnknownNameError), ({"speed": 0.0}, ModelError)):
        problem = make_problem(
            motor.model(), data, predictor=Simulation(), criterion=LeastSquares(sigma=sigma)
        )
        with pytest.raises(error):
            problem.evaluate(problem.start)
    with pytest.raises(ModelError, match="shape"):
        Robust(shape=0.0)
