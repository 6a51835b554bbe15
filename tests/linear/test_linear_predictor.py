import numpy as np
import pytest

from greybox.linear import predictor as pr
from greybox.linear.parametrisation import Free, similarity_directions
from greybox.linear.records import Record
from greybox.model.matrices import Matrices
from scenarios.plants.linear_systems import random_system


def case(seed=0, count=60, defective=False):
    rng = np.random.default_rng(seed)
    truth = random_system(rng, 4, 2, 2)
    system, lam = (
        Matrices(truth.a, truth.b, truth.c, rng.normal(size=(2, 2)) * 0.1, truth.k),
        truth.noise,
    )
    if defective:
        a = 0.5 * np.eye(4) + np.diag(np.ones(3), 1)
        system = Matrices(a, system.b, system.c, system.d, np.zeros((4, 2)))
    record = Record(u=rng.normal(size=(count, 2)), y=rng.normal(size=(count, 2)))
    return rng, system, lam, record, rng.normal(size=4), rng.normal(size=2) * 0.2


def differences(function, value, h=1e-6):
    return np.stack(
        [(function(value + h * e) - function(value - h * e)) / (2 * h) for e in np.eye(len(value))],
        axis=2,
    )


@pytest.mark.parametrize("defective", [False, True])
def test_sensitivities_equal_finite_differences(defective):
    _, system, lam, record, x0, offset = case(defective=defective)
    prediction = pr.predict(system, record, x0, offset, lam)
    j, jx, jc = pr.sensitivities(system, record, prediction)

    def predicted(vector, x0, offset):
        moved = pr.from_full_vector(vector, system.sizes)
        return -pr.predict(moved, record, x0, offset, lam).e

    vector = pr.full_vector(system)
    # moving a defective matrix by h gives nearly dependent modes, whose rounding a larger h
    # outweighs
    h, tolerance = (1e-3, 1e-3) if defective else (1e-6, 1e-6)
    expected = differences(lambda v: predicted(v, x0, offset), vector, h)
    np.testing.assert_allclose(j, expected, rtol=10 * tolerance, atol=tolerance)
    np.testing.assert_allclose(
        jx, differences(lambda v: predicted(vector, v, offset), x0), rtol=1e-6, atol=1e-7
    )
    np.testing.assert_allclose(
        jc, differences(lambda v: predicted(vector, x0, v), offset), rtol=1e-6, atol=1e-7
    )


def test_modal_and_recursive_sensitivities_agree():
    _, system, lam, record, x0, offset = case(1, 400)
    prediction = pr.predict(system, record, x0, offset, lam)
    for fast, slow in zip(
        pr.sensitivities(system, record, prediction), pr._recursive(system, record, prediction)
    ):
        np.testing.assert_allclose(fast, slow, rtol=1e-9, atol=1e-10)


def test_innovations_with_holes_are_those_of_a_kalman_filter_written_out():
    _, system, lam, record, x0, offset = case(2, 80)
    y = record.y.copy()
    y[20:24] = np.nan
    y[40, 1] = np.nan
    prediction = pr.predict(system, Record(u=record.u, y=y), x0, offset, lam)
    a, b, c, d, k = system
    x, p = x0, np.zeros((4, 4))
    q, s = k @ lam @ k.T, k @ lam
    for i in range(len(y)):
        v = np.flatnonzero(np.isfinite(y[i]))
        expected = y[i, v] - offset[v] - c[v] @ x - d[v] @ record.u[i]
        np.testing.assert_allclose(prediction.e[i, v], expected, atol=1e-9)
        gain = np.zeros((4, 2))
        if v.size:
            big = c[v] @ p @ c[v].T + lam[np.ix_(v, v)]
            cross = a @ p @ c[v].T + s[:, v]
            gain[:, v] = cross @ np.linalg.inv(big)
            p = a @ p @ a.T + q - gain[:, v] @ cross.T
        else:
            p = a @ p @ a.T + q
        x = a @ x + b @ record.u[i] + gain[:, v] @ expected


def test_similarity_directions_change_no_output():
    _, system, lam, record, _, _ = case(3)
    zero = np.zeros(2)
    base = pr.predict(system, record, np.zeros(4), zero, lam).e
    rng = np.random.default_rng(0)
    step = similarity_directions(system) @ rng.normal(size=16)
    h = 1e-5
    up = pr.predict(
        pr.from_full_vector(pr.full_vector(system) + h * step, system.sizes),
        record,
        np.zeros(4),
        zero,
        lam,
    )
    assert (
        np.abs(up.e - base).max() < 50 * h**2 * np.abs(step).max() ** 2 * np.abs(base).max() + 1e-9
    )


def test_free_directions_number_as_many_as_the_theory_says():
    _, system, _, _, _, _ = case(4)
    n, m, p = system.sizes
    free = Free(system=system)
    assert free.tangent().shape[1] == n * (m + 2 * p) + p * m == free.dimension
    both = np.hstack([free.tangent(), similarity_directions(system)])
    assert np.linalg.matrix_rank(both / np.linalg.norm(both, axis=0)) == free.dimension + n * n
    assert Free(system=system, noise_model=False, feedthrough=False).dimension == n * (m + p)
