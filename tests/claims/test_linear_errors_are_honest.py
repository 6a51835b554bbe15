"""Errors of linear fits hold under coloured innovations, for zeros with D free, and for weak
poles."""

import numpy as np
import pytest
from scipy.signal import lfilter

from greybox.errors import DataError
from greybox.linear.fit import Options, Settings, fit_linear
from greybox.linear.pole_profile import pole_profile
from greybox.linear.records import Record
from greybox.linear.robust import correlation_window
from scenarios.plants.linear_systems import random_system, simulate


def coloured(seed, count=3000):
    """Second-order plant, disturbance of pole 0.9 at the output: output error is consistent, but
    not white."""
    rng = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -0.8], rng.standard_normal((count, 1)), axis=0)
    v = lfilter([1.0], [1.0, -0.9], rng.standard_normal(count + 200))[200:]
    return Record(u=u, y=lfilter([0.0, 0.5, 0.3], [1.0, -1.2, 0.5], u[:, 0]) + 0.5 * v)


def quantities(known):
    """Real part of a pole and the real response at two frequencies, and their standard errors."""
    poles, (gain, cov) = known.poles(), known.response(np.array([0.01, 0.1]), 1.0)
    value = np.array([poles.value[-1].real, *gain[:, 0, 0].real])
    return value, np.sqrt([poles.covariance[-1, 0, 0], *cov[:, 0, 0, 0, 0]])


def spread(runs, count=3000):
    options = Options(noise_model=False, settings=Settings(stable=True))
    values, fisher, robust = [], [], []
    for seed in range(runs):
        fit = fit_linear([coloured(seed, count)], 2, options=options)
        assert fit.coloured
        assert fit.errors == "robust"
        value, error = quantities(fit.fisher)
        values.append(value)
        fisher.append(error)
        robust.append(quantities(fit.robust)[1])
    return np.array(values), np.array(fisher), np.array(robust)


@pytest.mark.parametrize("runs", [16, pytest.param(200, marks=pytest.mark.slow)])
def test_robust_errors_are_the_scatter_where_fisher_errors_are_too_small(runs):
    values, fisher, robust = spread(runs)
    scatter = values.std(axis=0, ddof=1)
    slack = 3.0 / np.sqrt(2 * runs)
    # at 0.01 cycles per sample the disturbance is far above its mean spectrum, which is all that
    # Fisher knows of it
    assert scatter[1] > 1.5 * np.median(fisher[:, 1])
    ratio = scatter / np.median(robust, axis=0)
    assert (ratio < 1.15 + slack).all(), ratio
    assert (ratio > 0.85 - slack).all(), ratio


def test_white_innovations_keep_the_fisher_errors():
    rng = np.random.default_rng(3)
    u, y = simulate(rng, random_system(rng, 2, 1, 1), 1500)
    fit = fit_linear([Record(u=u, y=y)], 2)
    assert fit.errors == "fisher"
    assert fit.robust is None
    assert fit.uncertainty is fit.fisher


def test_the_window_follows_the_correlation():
    rng = np.random.default_rng(0)
    white = rng.standard_normal((4000, 1))
    slow = lfilter([1.0], [1.0, -0.95], white, axis=0)
    assert correlation_window([white]) <= 60
    assert correlation_window([slow]) > 60


def test_zeros_with_free_feedthrough_scatter_as_their_errors_say():
    zeros, errors, half = [], [], (1.0, -0.5, 0.3)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        u = rng.standard_normal((800, 1))
        y = lfilter(half, [1.0, -1.1, 0.6], u, axis=0)
        y = y + 0.2 * lfilter([1.0], [1.0, -0.5], rng.standard_normal(u.shape), axis=0)
        known = fit_linear(
            [Record(u=u, y=y)], 2, options=Options(feedthrough=True)
        ).uncertainty.zeros()
        upper = int(np.argmax(known.value.imag))
        zeros.append(known.value[upper])
        errors.append(known.covariance[upper])
    found, true = np.array(zeros), np.roots(half)[0]
    scatter = np.cov(found.real, found.imag)
    mean = np.mean(errors, axis=0)
    assert abs(found.mean() - true) < 4 * np.sqrt(np.trace(scatter) / len(found))
    np.testing.assert_allclose(np.sqrt(np.diag(scatter)), np.sqrt(np.diag(mean)), rtol=0.35)
    assert abs(scatter[0, 1] - mean[0, 1]) < 0.5 * np.sqrt(mean[0, 0] * mean[1, 1])


def weak(seed, residue=0.02):
    """A strong mode at 0.8 and a weak one at -0.3."""
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((1500, 1))
    y = lfilter([0.0, 1.0], [1.0, -0.8], u, axis=0) + residue * lfilter(
        [0.0, 1.0], [1.0, 0.3], u, axis=0
    )
    return Record(u=u, y=y + 0.1 * rng.standard_normal(u.shape))


def test_a_weak_mode_is_marked_and_a_strong_one_is_not():
    fit = fit_linear([weak(0)], 2)
    poles, sure = fit.uncertainty.poles().value, fit.uncertainty.well_determined()
    strong = int(np.argmin(np.abs(poles - 0.8)))
    assert sure[strong]
    assert not sure[1 - strong]
    strength = fit.uncertainty.pole_strengths()
    assert strength[strong] > 50 * strength[1 - strong]
    assert "weak or crowded" in fit.summary()


def test_profile_agrees_with_the_standard_error_of_a_strong_pole():
    rng = np.random.default_rng(1)
    u, y = simulate(rng, random_system(rng, 3, 1, 1), 2000)
    record = Record(u=u, y=y)
    fit = fit_linear([record], 3)
    profile, poles = pole_profile(fit, [record]), fit.uncertainty.poles()
    for i in np.flatnonzero(fit.uncertainty.well_determined() & (poles.value.imag >= 0)):
        for j, what in enumerate(("real", "imag") if poles.value[i].imag > 0 else ("real",)):
            found = profile.interval(int(i), what)
            half = 1.96 * np.sqrt(poles.covariance[i, j, j])
            assert found.upper - found.estimate == pytest.approx(half, rel=0.2)
            assert found.estimate - found.lower == pytest.approx(half, rel=0.2)
            assert profile.ratio(int(i), what, found.upper) == pytest.approx(3.84, abs=0.4)


def test_profile_of_coloured_innovations_agrees_with_the_robust_error():
    record = coloured(0)
    options = Options(noise_model=False, settings=Settings(stable=True))
    fit = fit_linear([record], 2, options=options)
    profile = pole_profile(fit, [record])
    for j, what in enumerate(("real", "imag")):
        found = profile.interval(1, what)
        robust, fisher = (
            1.96 * np.sqrt(v.poles().covariance[1, j, j]) for v in (fit.robust, fit.fisher)
        )
        assert found.upper - found.estimate == pytest.approx(max(robust, fisher), rel=0.2)
        assert found.estimate - found.lower == pytest.approx(max(robust, fisher), rel=0.2)


def test_profile_of_a_weak_pole_is_wider_than_its_standard_error_on_one_side():
    fit = fit_linear([weak(2, 0.03)], 2)
    profile, poles = pole_profile(fit, [weak(2, 0.03)]), fit.uncertainty.poles()
    i = int(np.argmax(np.abs(poles.value - 0.8)))
    found = profile.interval(i, "real")
    half = 1.96 * np.sqrt(poles.covariance[i, 0, 0])
    assert max(found.upper - found.estimate, found.estimate - found.lower) > 1.15 * half


def test_profile_refuses_what_is_not_there():
    fit = fit_linear([weak(0)], 2)
    profile = pole_profile(fit, [weak(0)])
    with pytest.raises(DataError, match="pole 5"):
        profile.interval(5, "real")
    with pytest.raises(DataError, match="angle of a real pole"):
        profile.interval(int(np.argmin(np.abs(fit.uncertainty.poles().value - 0.8))), "angle")
    with pytest.raises(DataError, match="records"):
        pole_profile(fit, [weak(0), weak(1)])
