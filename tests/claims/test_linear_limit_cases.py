"""Linear prediction error estimates agree with what theory says where the answer is known by other
means."""

import numpy as np
import pytest
import scipy.optimize

from greybox.linear.fit import Options, Settings, fit_linear
from greybox.linear.pem import Nuisance, evaluate
from greybox.linear.prediction import k_step, kalman, simulate
from greybox.linear.records import Record
from greybox.linear.subspace import subspace
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices, steady_gain
from scenarios.plants.linear_systems import LinearTruth, random_system
from scenarios.plants.linear_systems import simulate as fly

A = np.array([[0.9, 0.2], [-0.15, 0.8]])
B = np.array([[0.3], [1.0]])
C = np.array([[1.0, 0.0]])
Q = np.diag([0.02, 0.05])
R = np.array([[0.1]])


def noisy_plant(count, seed=0):
    """x+ = A x + B u + w, y = C x + v with known covariances Q and R: the innovation form is not
    what generates it."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(count, 1))
    w = rng.normal(size=(count, 2)) @ np.linalg.cholesky(Q).T
    v = rng.normal(size=(count, 1)) @ np.linalg.cholesky(R).T
    x, y = np.zeros(2), np.zeros((count, 1))
    for i in range(count):
        y[i] = C @ x + v[i]
        x = A @ x + B @ u[i] + w[i]
    return Record(u=u, y=y)


def test_gain_equals_the_steady_state_kalman_gain_of_the_true_noise():
    fit = fit_linear([noisy_plant(8000)], 2)
    gain, lam, _ = steady_gain(A, C, Q, R)
    assert fit.model.noise[0, 0] == pytest.approx(lam[0, 0], rel=0.05)
    # in coordinates-free form: C A^i K, the noise model's impulse response
    truth = [(C @ np.linalg.matrix_power(A, i) @ gain)[0, 0] for i in range(8)]
    m = fit.model.matrices
    found = [(m.c @ np.linalg.matrix_power(m.a, i) @ m.k)[0, 0] for i in range(8)]
    np.testing.assert_allclose(found, truth, atol=0.04)


def test_output_error_equals_simulation_least_squares():
    rng = np.random.default_rng(1)
    truth = random_system(rng, 2, 1, 1, coloured=False)
    u, y = fly(rng, truth, 600)
    settings = Settings(stable=True, offsets=False, free_start=False, tolerance=1e-9)
    fit = fit_linear(
        [Record(u=u, y=y)], 2, center=False, options=Options(noise_model=False, settings=settings)
    )

    def residual(theta):
        a1, a2, b1, b2 = theta
        a = np.array([[-a1, 1.0], [-a2, 0.0]])
        x, out = np.zeros(2), np.empty(len(u))
        for i in range(len(u)):
            out[i] = y[i, 0] - x[0]
            x = a @ x + np.array([b1, b2]) * u[i, 0]
        return out

    poly = np.poly(np.linalg.eigvals(truth.a))
    b = truth.c @ truth.b
    start = [poly[1], poly[2], b[0, 0], (truth.c @ truth.a @ truth.b)[0, 0] + poly[1] * b[0, 0]]
    best = scipy.optimize.least_squares(residual, start, xtol=1e-12, ftol=1e-12)
    assert float(np.sum(fit.innovations[0] ** 2)) == pytest.approx(2 * best.cost, rel=1e-7)
    np.testing.assert_allclose(
        np.poly(np.linalg.eigvals(fit.model.matrices.a))[1:], best.x[:2], atol=1e-4
    )


def test_siso_equals_mimo_for_decoupled_data():
    rng = np.random.default_rng(2)
    parts = [random_system(rng, 2, 1, 1) for _ in range(2)]
    data = [fly(rng, t, 4000) for t in parts]
    both = Record(u=np.hstack([d[0] for d in data]), y=np.hstack([d[1] for d in data]))
    mimo = fit_linear([both], 4)
    f = np.array([0.02, 0.1, 0.3])
    wide = mimo.uncertainty.response(f, 1.0)
    for i, (u, y) in enumerate(data):
        siso = fit_linear([Record(u=u, y=y)], 2)
        gain, cov = siso.uncertainty.response(f, 1.0)
        spread = np.sqrt(
            np.trace(cov[:, 0, 0], axis1=1, axis2=2) + np.trace(wide[1][:, i, i], axis1=1, axis2=2)
        )
        assert (np.abs(gain[:, 0, 0] - wide[0][:, i, i]) < 3 * spread).all()
    cross = np.abs(wide[0][:, 0, 1]) / np.sqrt(np.trace(wide[1][:, 0, 1], axis1=1, axis2=2))
    assert (cross < 3.5).all()


def test_kalman_filter_from_rest_is_the_predictor_and_k_step_one_is_one_step():
    rng = np.random.default_rng(3)
    truth = random_system(rng, 3, 2, 2)
    u, y = fly(rng, truth, 200)
    record = Record(u=u, y=y)
    fit = fit_linear([record], 3)
    x0, c = fit.x0[0], fit.offsets[0] - fit.model.output_offset
    assert np.abs(c).max() < 1e-9
    filtered = kalman(fit.model, record, x0=x0)
    np.testing.assert_allclose(filtered.innovations, fit.innovations[0], atol=1e-8)
    one = k_step(fit.model, record, [1], x0=x0)[0]
    np.testing.assert_allclose(one.measured - one.predicted, fit.innovations[0][1:], atol=1e-8)
    # far ahead, prediction is simulation from the filtered state
    ahead = k_step(fit.model, record, [40], x0=x0)[0]
    tail = simulate(fit.model, u[41:81], x0=filtered.predicted[41])
    np.testing.assert_allclose(
        ahead.predicted[80 - 40], simulate(fit.model, u[41:81], x0=filtered.predicted[41])[39]
    )
    assert tail.shape == (40, 2)


def test_simulation_with_its_own_innovations_returns_the_record():
    rng = np.random.default_rng(4)
    truth = random_system(rng, 3, 2, 2)
    u, y = fly(rng, truth, 300)
    fit = fit_linear([Record(u=u, y=y)], 3)
    np.testing.assert_allclose(
        simulate(fit.model, u, x0=fit.x0[0], e=fit.innovations[0]), y, atol=1e-8
    )


def test_noise_free_data_give_the_system_back():
    rng = np.random.default_rng(5)
    truth = random_system(rng, 3, 2, 2)
    quiet = LinearTruth(truth.a, truth.b, truth.c, truth.k, 1e-20 * np.eye(2))
    u, y = fly(rng, quiet, 400)
    for method in ("n4sid", "moesp", "cva"):
        system = subspace([Record(u=u, y=y)], method, past=6, order=3, feedthrough=False).realise(3)
        np.testing.assert_allclose(
            system.poles(), np.sort_complex(np.linalg.eigvals(truth.a)), atol=1e-6
        )


def test_standard_errors_survive_a_change_of_coordinates():
    fit = fit_linear([noisy_plant(1500)], 2)
    known = fit.uncertainty
    other = known.transformed(np.array([[2.0, -1.0], [0.3, 50.0]]))
    np.testing.assert_allclose(
        other.poles().covariance, known.poles().covariance, rtol=1e-6, atol=1e-14
    )
    f = np.array([0.01, 0.2])
    np.testing.assert_allclose(
        other.response(f, 1.0)[1], known.response(f, 1.0)[1], rtol=1e-6, atol=1e-14
    )
    np.testing.assert_allclose(
        other.predictor_poles().covariance,
        known.predictor_poles().covariance,
        rtol=1e-6,
        atol=1e-14,
    )


def test_gradients_of_poles_zeros_and_response_are_right():
    """The delta method against moving the model along every direction of its covariance."""
    rng = np.random.default_rng(6)
    truth = random_system(rng, 3, 2, 2)
    u, y = fly(rng, truth, 1000)
    known = fit_linear([Record(u=u, y=y)], 3).uncertainty
    n, m, p = known.system.sizes
    f = np.array([0.1])

    def moved(column, h):
        s = h * known.factor[:, column]
        rows = s[: n * (n + m + p)].reshape(n, n + m + p)
        c, d = (
            s[n * (n + m + p) :][: p * n].reshape(p, n),
            s[n * (n + m + p) + p * n :].reshape(p, m),
        )
        a, b, c0, d0, k = known.system
        return Matrices(
            a + rows[:, :n], b + rows[:, n : n + m], c0 + c, d0 + d, k + rows[:, n + m :]
        )

    for name in ("poles", "zeros", "response"):

        def value(system, name=name):
            here = type(known)(system=system, factor=known.factor)
            out = (
                getattr(here, name)(f, 1.0)[0].ravel()
                if name == "response"
                else getattr(here, name)().value
            )
            return np.asarray(out)

        total = 0.0
        for j in range(known.factor.shape[1]):
            change = (value(moved(j, 1e-4)) - value(moved(j, -1e-4))) / 2e-4
            both = np.array([change.real, change.imag])
            total = total + np.einsum("ak,bk->kab", both, both)
        got = known.response(f, 1.0)[1] if name == "response" else getattr(known, name)().covariance
        np.testing.assert_allclose(got.reshape(-1, 2, 2), total, rtol=1e-3, atol=1e-9)


def test_criterion_is_the_gaussian_likelihood_at_its_own_covariance():
    record = noisy_plant(500)
    gain, _, _ = steady_gain(A, C, Q, R)
    here = evaluate(
        Matrices(A, B, C, np.zeros((1, 1)), gain),
        [Nuisance(x0=np.zeros(2), offset=np.zeros(1))],
        [record],
        R,
    )
    model = LinearModel.from_control(_control(), gain=gain, noise=here.noise)
    assert here.criterion == pytest.approx(-2 * kalman(model, record).log_likelihood, rel=1e-10)


def _control():
    import control

    return control.StateSpace(A, B, C, np.zeros((1, 1)), 1.0)
