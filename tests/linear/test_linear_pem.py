import numpy as np
import pytest
import scipy.linalg
import scipy.signal

from greybox.errors import FitError
from greybox.linear import pem
from greybox.linear.fit import Options, Settings, fit_linear
from greybox.linear.parametrisation import Free
from greybox.linear.records import Record, prepare
from greybox.linear.subspace import METHODS, subspace
from greybox.linear.validation import validate_linear
from greybox.model.linear import LinearModel
from greybox.model.matrices import Matrices, spectral_radius
from scenarios.plants.linear_systems import random_system, simulate


def data(seed=0, n=3, m=2, p=2, count=1200, **kwargs):
    rng = np.random.default_rng(seed)
    truth = random_system(rng, n, m, p)
    system = Matrices(truth.a, truth.b, truth.c, np.zeros((p, m)), truth.k)
    return rng, system, truth.noise, recorded(rng, truth, count, **kwargs)


def recorded(rng, truth, count, name="record", **kwargs):
    u, y = simulate(rng, truth, count, **kwargs)
    return Record(u=u, y=y, name=name)


def test_gradient_is_that_of_the_criterion():
    _, _, _, record = data(1)
    records, _ = prepare([record])
    point = Free(system=subspace(records, "cva", order=3).realise(3))
    settings = pem.Settings(free_start=False, offsets=False)
    nuisances = pem.start_nuisances(point.system, records, settings)
    here = pem.evaluate(point.system, nuisances, records, np.eye(2))
    gradient = pem.normal_equations(point, records, here, settings).gradient
    for i in range(0, point.dimension, 3):
        step = np.zeros(point.dimension)
        step[i] = 1e-6
        up = pem.evaluate(point.moved(step).system, nuisances, records, np.eye(2)).criterion
        down = pem.evaluate(point.moved(-step).system, nuisances, records, np.eye(2)).criterion
        assert (up - down) / 2e-6 == pytest.approx(-2 * gradient[i], rel=1e-4, abs=1e-2)


def test_all_starts_reach_the_same_optimum():
    _, _, _, record = data(2, count=2000)
    values = []
    for method in METHODS:
        fit = fit_linear(
            [record], 3, options=Options(methods=(method,), settings=Settings(tolerance=1e-4))
        )
        assert fit.converged
        values.append(fit.criterion)
    assert np.ptp(values) < 1e-3


def test_likelihood_at_the_optimum_is_above_that_of_the_truth():
    _, system, lam, record = data(3, count=2000)
    fit = fit_linear([record], 3, center=False, options=Options(settings=Settings(offsets=False)))
    truth = pem.evaluate(
        system, [pem.Nuisance(x0=np.zeros(3), offset=np.zeros(2))], [record], lam
    ).criterion
    gain = truth - fit.criterion
    d = fit.parameters + 3
    assert 0.2 * d < gain < 3 * d  # -2 log likelihood falls by chi-square with d degrees of freedom


def test_records_of_different_length_with_their_own_start_and_offset():
    rng = np.random.default_rng(4)
    truth = random_system(rng, 3, 2, 2)
    records = []
    for i, count in enumerate((300, 700, 1100)):
        r = recorded(rng, truth, count, name=f"r{i}")
        records.append(Record(u=r.u, y=r.y + np.array([i, -2.0 * i]), name=r.name))
    fit = fit_linear(records, 3)
    np.testing.assert_allclose(np.array(fit.offsets), [[0, 0], [1, -2], [2, -4]], atol=0.35)
    np.testing.assert_allclose(
        fit.model.matrices.poles(), np.sort_complex(np.linalg.eigvals(truth.a)), atol=0.05
    )


def test_missing_samples_leave_the_estimate_where_it_was():
    rng, _, _, record = data(5, count=800)
    whole = fit_linear([record], 3)
    y = record.y.copy()
    y[rng.random(y.shape) < 0.03] = np.nan
    y[400:412] = np.nan
    holes = fit_linear([Record(u=record.u, y=y)], 3)
    assert any("bridged" in w for w in holes.warnings)
    std = np.sqrt(whole.uncertainty.poles().covariance[:, 0, 0])
    assert (
        np.abs(whole.model.matrices.poles().real - holes.model.matrices.poles().real)
        < 2.5 * std + 0.002
    ).all()


def test_persistence_holds_the_last_value_where_a_channel_is_slower():
    _, _, _, record = data(6, count=800)
    fit = fit_linear([record], 3)

    def rows(y):
        test = Record(u=record.u, y=y)
        return validate_linear(fit, [record], [test], [0, 1], [0, 1], horizons=(1, 2)).rows

    slow = record.y.copy()
    slow[::2, 1] = np.nan
    for whole, holes in zip(rows(record.y), rows(slow), strict=True):
        np.testing.assert_allclose(holes.persistence[0], whole.persistence[0])
        assert 0.8 < holes.persistence[1] / whole.persistence[1] < 2.0


def test_a_fit_converges_where_only_one_of_two_records_has_a_hole():
    rng = np.random.default_rng(11)
    truth = random_system(rng, 2, 1, 1)
    first, second = recorded(rng, truth, 500), recorded(rng, truth, 500)
    whole = fit_linear([first, second], 2)
    y = second.y.copy()
    y[250:252] = np.nan
    fit = fit_linear([first, Record(u=second.u, y=y)], 2)
    assert fit.converged
    std = np.sqrt(whole.uncertainty.poles().covariance[:, 0, 0])
    assert (np.abs(fit.model.matrices.poles().real - whole.model.matrices.poles().real) < std).all()


def test_predictor_is_stable_and_a_is_where_asked():
    rng = np.random.default_rng(6)
    u = rng.normal(size=(400, 1))
    y = np.cumsum(
        u + 0.3 * rng.normal(size=u.shape), axis=0
    )  # a random walk: the pole sits on the unit circle
    free = fit_linear([Record(u=u, y=y)], 2)
    held = fit_linear([Record(u=u, y=y)], 2, options=Options(settings=Settings(stable=True)))
    assert spectral_radius(free.model.matrices.predictor) < 1.0
    assert spectral_radius(held.model.matrices.predictor) < 1.0
    assert spectral_radius(held.model.matrices.a) < 1.0


def test_estimate_does_not_depend_on_units():
    _, _, _, record = data(7)
    base = fit_linear([record], 3)
    other = fit_linear([Record(u=record.u * 1e3 + 5, y=record.y * 1e-4 - 2)], 3)
    np.testing.assert_allclose(base.model.matrices.poles(), other.model.matrices.poles(), atol=1e-5)
    np.testing.assert_allclose(
        base.model.matrices.gain(1.0) * 1e-7, other.model.matrices.gain(1.0), rtol=1e-4
    )
    jump = 2 * record.y.size * np.log(1e-4)
    assert other.criterion == pytest.approx(base.criterion + jump, rel=1e-9, abs=1e-2)


def test_a_fit_that_ran_out_of_iterations_says_so():
    _, _, _, record = data(8)
    fit = fit_linear([record], 3, options=Options(settings=Settings(max_iterations=1)))
    assert not fit.converged
    assert any("not converged" in w for w in fit.warnings)
    assert fit.model.unsettled == fit.status.value
    assert "not converged" in str(fit.model)
    assert LinearModel.from_dict(fit.model.to_dict()).unsettled == fit.status.value


def test_too_many_states_fit_no_undamped_line():
    rng = np.random.default_rng(0)
    u, e = rng.normal(size=(400, 1)), rng.normal(size=(400, 1))
    line = np.cos(1.3 * np.arange(400))[
        :, None
    ]  # a line in the noise of these records, and of no others
    fit = fit_linear([Record(u=u, y=np.roll(u, 1, axis=0) + e + 0.3 * line)], 4)
    assert spectral_radius(fit.model.matrices.predictor) < 1.0 - pem.FORGET / 400


def test_a_flat_fit_is_not_called_converged():
    assert not pem.Status.FLAT.converged
    assert "not converged" in pem.Status.FLAT.value
    assert [s for s in pem.Status if s.converged] == [pem.Status.CONVERGED]


def roll_under_feedback(seed, n=1500, dt=0.01):
    """Angle and rate of a craft with a motor lag of 50 ms that a state feedback flies: two poles near
    1, which the data tell badly apart."""
    rate = np.array([[0.0, 1, 0], [0, -0.5, 60], [0, 0, -20]])
    whole = scipy.linalg.expm(
        dt * np.block([[rate, np.array([[0], [0], [20]])], [np.zeros((1, 4))]])
    )
    a, b = whole[:3, :3], whole[:3, 3:]
    cost = scipy.linalg.solve_discrete_are(a, b, np.diag([30, 1, 0.1]), [[50.0]])
    gain = np.linalg.solve(50.0 + b.T @ cost @ b, b.T @ cost @ a)
    rng, x, goal, inputs, outputs = np.random.default_rng(seed), np.zeros((3, 1)), 0.0, [], []
    for k in range(n):
        goal = rng.choice([-0.4, 0, 0.4]) if k % 37 == 0 else goal
        y = x[:2] + np.array([[0.005], [0.02]]) * rng.normal(size=(2, 1))
        u = -gain @ np.vstack([y[0] - goal, y[1], x[2]]) + 0.05 * rng.normal()
        inputs.append(u[:, 0])
        outputs.append(y[:, 0])
        x = a @ x + b @ u + np.array([[0], [0.02], [0.001]]) * rng.normal(size=(3, 1))
    return Record(u=np.array(inputs), y=np.array(outputs))


def test_steps_that_still_lead_to_the_maximum_are_not_flat():
    """Where a full step promises no more than three steps may gain on a plateau, the next few end
    the descent: at the true order it was called not converged, with the advice to lower it."""
    fit = fit_linear([roll_under_feedback(1), roll_under_feedback(2)], 3, dt=0.01)
    assert fit.converged and fit.order == 3
    assert not fit.warnings
    assert "exact_order" in pem.Status.FLAT.value, "the order was chosen by evidence"


def test_an_unstable_predictor_is_refused_as_a_start():
    _, _, _, record = data(9)
    bad = Matrices(
        2 * np.eye(3), np.ones((3, 2)), np.ones((2, 3)), np.zeros((2, 2)), np.zeros((3, 2))
    )
    with pytest.raises(FitError, match="unstable predictor"):
        pem.minimise(Free(system=bad), [record])


def test_input_delay_is_found_per_channel():
    rng = np.random.default_rng(10)
    truth = random_system(rng, 3, 2, 2, snr=20)
    record = recorded(rng, truth, 2000)
    shifted = np.column_stack([np.roll(record.u[:, 0], -4), np.roll(record.u[:, 1], -1)])
    # u'[k] = u[k + d]: the output sees u' with d samples of extra delay
    fit = fit_linear([Record(u=shifted[:-5], y=record.y[:-5])], 3, delays="auto")
    assert fit.model.delays == (4, 1)
    np.testing.assert_allclose(
        fit.model.matrices.poles(), np.sort_complex(np.linalg.eigvals(truth.a)), atol=0.05
    )


def test_rows_lost_in_every_record_and_at_the_edges_are_bridged():
    rng = np.random.default_rng(12)
    truth = random_system(rng, 2, 1, 1)
    whole = [recorded(rng, truth, 400, name=f"r{i}") for i in range(2)]
    spoiled = []
    for r in whole:
        y = r.y.copy()
        y[:3] = y[-2:] = y[100:110] = np.nan
        spoiled.append(Record(u=r.u, y=y, name=r.name))
    full, holes = fit_linear(whole, 2), fit_linear(spoiled, 2)
    assert any("30 samples with missing outputs" in w for w in holes.warnings)
    assert all(
        np.isnan(e[100:110]).all() and np.isfinite(e[3:100]).all() for e in holes.innovations
    )
    gain, cov = full.uncertainty.response(np.array([0.0, 0.1, 0.3]), 1.0)
    other, _ = holes.uncertainty.response(np.array([0.0, 0.1, 0.3]), 1.0)
    assert (np.abs(gain - other) < 2 * np.sqrt(np.trace(cov, axis1=3, axis2=4))).all()


@pytest.mark.parametrize("radius", [1.02, 1.5, 30.0])
def test_a_start_whose_model_explodes_is_polished_without_overflow(radius):
    """A may be far outside the unit circle as long as the predictor is not; 1.5^2000 would overflow
    a simulation."""
    rng = np.random.default_rng(13)
    record = recorded(rng, random_system(rng, 2, 1, 1), 2000)
    records, _ = prepare([record])
    a, c = np.diag([radius, 0.5]), np.ones((1, 2))
    k = np.array([[radius - 0.6], [0.0]])
    start = Matrices(a, np.ones((2, 1)), c, np.zeros((1, 1)), k)
    assert spectral_radius(start.predictor) < 1
    solution = pem.minimise(Free(system=start, feedthrough=False), records)
    assert np.isfinite(solution.evaluation.criterion)
    assert spectral_radius(solution.system.predictor) < 1
    assert (
        solution.evaluation.criterion
        <= pem.minimise(
            Free(system=start, feedthrough=False), records, pem.Settings(max_iterations=0)
        ).evaluation.criterion
    )


def test_a_start_that_does_what_an_offset_does_leaves_digits_to_the_matrices():
    """Beside an integrator start and offset differ by rounding alone, and information of the
    matrices became negative."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.choice([-1.0, 1.0], 120), 25) + 0.1
    y = scipy.signal.lfilter([0, 1e-3], [1, -1.9608, 0.9608], u)
    y = y + 0.01 * rng.standard_normal(len(u))
    records, _ = prepare([Record(u=u[:, None], y=y[:, None])])
    a, k = np.array([[1.0 + 1e-7, 0.02], [0.0, 0.9608]]), np.array([[0.12], [0.16]])
    system = Matrices(a, np.array([[0.0], [0.05]]), np.eye(1, 2), np.zeros((1, 1)), k)
    nuisances = pem.start_nuisances(system, records, Settings())
    here = pem.evaluate(system, nuisances, records, np.eye(1))
    normal = pem.normal_equations(Free(system=system), records, here, Settings())
    assert np.linalg.eigvalsh(normal.information)[0] > 0
    assert np.abs(nuisances[0].offset).max() < 100


def test_normal_equations_without_information_are_no_place_to_go_on_from():
    lost = pem.Normal(-1e10 * np.eye(2), np.ones(2), 1e12 * np.eye(2), [])
    assert not pem._finite(lost)
    assert pem._finite(pem.Normal(np.eye(2), np.ones(2), np.eye(2), []))


def test_an_integrator_stands_still_at_no_input_and_not_at_the_mean_of_its_inputs():
    """The mean of the inputs as operating point put a ramp into the model, which a pole beside one
    and a huge start had to undo."""
    records = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.choice([-1.0, 1.0], 40), 25) + 0.3
        y = scipy.signal.lfilter([0, 0.02], [1, -1], u) + 0.01 * rng.standard_normal(len(u))
        records.append(Record(u=u[:, None], y=y[:, None] + 5.0, name=f"r{seed}"))
    fit = fit_linear(records[:1], 1, dt=0.02)
    assert fit.model.input_offset[0] == 0.0
    assert abs(fit.uncertainty.poles().value[0].real - 1.0) < 1e-4
    truth = 0.01**2
    assert fit.model.noise[0, 0] < 1.1 * truth
    drift = fit.model.matrices.b[0, 0] * fit.model.matrices.c[0, 0]
    assert abs(drift - 0.02) < 2e-4
