import numpy as np
import pytest

from greybox.linear import pem
from greybox.linear.gram import Gram, separable
from greybox.linear.parametrisation import Free
from greybox.linear.predictor import Modes, from_full_vector, full_vector, predict
from greybox.linear.records import Record, prepare
from greybox.linear.subspace import subspace
from greybox.model.matrices import Matrices
from scenarios.plants.linear_systems import random_system, simulate


def case(order, fitted, count=300, inputs=2, outputs=2, seed=0):
    rng = np.random.default_rng(seed)
    u, y = simulate(rng, random_system(rng, order, inputs, outputs), count)
    records, _ = prepare([Record(u=u, y=y)])
    return rng, records, subspace(records, "ssarx", order=fitted).realise(fitted)


@pytest.mark.parametrize("fitted", [1, 2, 3, 5])
def test_products_of_sensitivities_are_those_of_the_jacobian(fitted):
    rng, (record,), system = case(3, fitted)
    p, modes = 2, Modes(system.predictor)
    assert separable(modes)
    prediction = predict(
        system, record, rng.normal(size=fitted), rng.normal(size=p), np.eye(p), modes
    )
    whitener = np.linalg.inv(np.linalg.cholesky(np.cov(prediction.e.T)))
    tangent = Free(system=system).tangent()
    parts = Gram(system, modes, tangent, whitener).parts(record, prediction)
    information, gradient = pem._by_jacobian(system, record, prediction, modes, whitener, tangent)
    np.testing.assert_allclose(
        parts.information, information, rtol=1e-8, atol=1e-9 * np.abs(information).max()
    )
    np.testing.assert_allclose(
        parts.gradient, gradient, rtol=1e-8, atol=1e-9 * np.abs(gradient).max()
    )


@pytest.mark.parametrize("fitted", [2, 3, 5])
def test_second_derivatives_are_those_of_finite_differences(fitted):
    rng, (record,), system = case(3, fitted, seed=1)
    p, modes = 2, Modes(system.predictor)
    x0, offset = rng.normal(size=fitted), rng.normal(size=p)
    prediction = predict(system, record, x0, offset, np.eye(p), modes)
    whitener = np.linalg.inv(np.linalg.cholesky(np.cov(prediction.e.T)))
    tangent = Free(system=system).tangent()
    parts = Gram(system, modes, tangent, whitener).parts(record, prediction)
    base, white = full_vector(system), prediction.e @ whitener.T

    def product(step):
        moved = from_full_vector(base + tangent @ step, system.sizes)
        return -float((predict(moved, record, x0, offset, np.eye(p)).e @ whitener.T * white).sum())

    h = 1e-4
    for _ in range(4):
        a, b = (rng.normal(size=tangent.shape[1]) * h for _ in range(2))
        numeric = (product(a + b) - product(a - b) - product(b - a) + product(-a - b)) / 4
        assert a @ parts.second @ b == pytest.approx(
            numeric, rel=1e-3, abs=1e-6 * h**2 * np.abs(parts.second).max()
        )


def test_hessian_is_that_of_the_criterion_at_a_wrong_order_over_two_records():
    rng, (one,), system = case(4, 2, seed=2)
    records = [Record(u=one.u[:140], y=one.y[:140]), Record(u=one.u[140:], y=one.y[140:])]
    settings = pem.Settings(free_start=False, offsets=False)
    point = Free(system=system)
    nuisances = pem.start_nuisances(system, records, settings)
    here = pem.evaluate(system, nuisances, records, np.eye(2))
    normal = pem.normal_equations(point, records, here, settings)
    assert (
        np.abs(normal.hessian - normal.information).max() > 1e-3 * np.abs(normal.information).max()
    )

    def criterion(step):
        return pem.evaluate(point.moved(step).system, nuisances, records, np.eye(2)).criterion

    h = 1e-4
    for _ in range(4):
        a = rng.normal(size=point.dimension) * h
        numeric = criterion(a) - 2 * here.criterion + criterion(-a)
        assert 2 * a @ normal.hessian @ a == pytest.approx(numeric, rel=1e-3)


def test_modes_that_join_are_left_to_the_slow_way_and_it_gives_the_same():
    _, records, system = case(3, 2, seed=3)
    f = np.array([[0.5, 0.0], [0.0, 0.5]])
    system = Matrices(f + system.k @ system.c, *system[1:])
    assert not separable(Modes(system.predictor))
    settings = pem.Settings()
    nuisances = pem.start_nuisances(system, records, settings)
    here = pem.evaluate(system, nuisances, records, np.eye(2))
    slow = pem.normal_equations(Free(system=system), records, here, settings)
    apart = system._replace(a=system.a + np.diag([0.0, 1e-3]))
    there = pem.evaluate(apart, nuisances, records, np.eye(2))
    fast = pem.normal_equations(Free(system=apart), records, there, settings)
    assert np.linalg.eigvalsh(slow.information)[-1] == pytest.approx(
        np.linalg.eigvalsh(fast.information)[-1], rel=0.05
    )
