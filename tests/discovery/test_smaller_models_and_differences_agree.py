"""A fit on the model of its own effects is the fit on the whole catalogue, and differences are exact sensitivities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.discovery.candidates import candidates
from greybox.discovery.differences import widened
from greybox.discovery.imu_filter import FILTER
from greybox.discovery.nested import Nest
from greybox.discovery.sensor_noise import with_parts
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.fit import noise_of
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import Problem, make_problem
from greybox.model.noise import LowPass
from greybox.symbolic import FloatArray
from tests.discovery import small_world


@pytest.fixture(scope="module")
def nest() -> Nest:
    return small_world.damped()


@pytest.fixture(scope="module")
def both(nest: Nest) -> tuple[Problem, FloatArray, Problem, FloatArray]:
    """(widened problem and point, problem of the whole model with exact sensitivities and the same point)."""
    at = nest.refit(("gyro_bias",))
    null = {n: v for n, v in nest.candidates.null.items() if not n.startswith("gyro_bias")}
    wide, theta = widened(at.fit.problem, at.fit.theta, nest.candidates.model, nest.data, null)
    free = [u.name for u in wide.unknowns if u.kind == "parameter"]
    whole = make_problem(
        nest.candidates.model, nest.data, predictor=Innovation(), criterion=Gaussian(), free=free,
        values=nest.candidates.null, noise=noise_of(at.fit.model),
    )  # fmt: skip
    known = {(u.name, u.flight): t for u, t in zip(wide.unknowns, theta, strict=True)}
    return wide, theta, whole, np.array([known[u.name, u.flight] for u in whole.unknowns])


def test_likelihoods_compare_to_the_last_digit(both: tuple[Problem, FloatArray, Problem, FloatArray]):
    wide, theta, whole, same = both
    assert wide.evaluate(theta).likelihood == pytest.approx(whole.evaluate(same, 0).likelihood, abs=1e-6)


def test_differences_are_the_exact_sensitivities(both: tuple[Problem, FloatArray, Problem, FloatArray]):
    wide, theta, whole, same = both
    places = {(u.name, u.flight): i for i, u in enumerate(whole.unknowns)}
    order = [places[u.name, u.flight] for u in wide.unknowns]
    a, b = wide.evaluate(theta, scores=50), whole.evaluate(same, scores=50)
    assert a.gradient is not None and b.gradient is not None
    assert a.hessian is not None and b.hessian is not None
    assert a.scores is not None and b.scores is not None
    spread = np.sqrt(np.diag(b.hessian))[order]
    assert np.abs(a.gradient - b.gradient[order]).max() < 1e-3 * np.abs(b.gradient).max()
    assert np.abs((a.hessian - b.hessian[np.ix_(order, order)]) / np.outer(spread, spread)).max() < 1e-4
    assert np.abs((a.scores - b.scores[:, order]) / spread).max() < 1e-4 * np.abs(b.scores[:, order] / spread).max()


def test_a_limit_that_no_command_reaches_is_moved_until_it_is_felt():
    data = small_world.flown()
    offered = candidates(small_world.vehicle(), data.channels, sample_time=0.01)
    some = tuple(n for n in offered.names if n != "command_saturation")
    model = offered.model.without_effect(*some)
    nest = Nest(
        candidates=replace(
            offered, model=model, parameters={"command_saturation": offered.parameters["command_saturation"]}
        ),
        data=data,
    )
    at = nest.refit(())
    null = dict.fromkeys(offered.parameters["command_saturation"], 0.0)
    wide, theta = widened(at.fit.problem, at.fit.theta, model, data, null)
    value = wide.evaluate(theta)
    assert value.hessian is not None
    upper = [u.name for u in wide.unknowns].index("command_saturation.a_hi")
    assert value.hessian[upper, upper] > 0


def test_a_fit_with_a_filter_starts_one_without(nest: Nest):
    """A group found with a filter of the IMU, which went later, is separated by fits without."""
    parts = tuple(LowPass(sensor=s, time=FILTER) for s in ("gyro", "accelerometer"))
    filtered = with_parts(nest, parts).refit((), start=nest.refit(()))
    assert "low_pass.gyro.T" in filtered.fit.parameters
    again = nest.refit(("rotational_damping",), start=filtered)
    assert again.fit.converged
    assert again.bic == pytest.approx(nest.refit(("rotational_damping",)).bic, abs=0.1)


def test_what_a_lag_of_no_length_shows_later_is_looked_for_in_time():
    """A rotor with a lag shows its speed at the sample, one without that of the step that begins: the accelerometer of a
    model with a lag, even of no length, is a sample behind, and a late IMU would not be seen in it."""
    data = small_world.flown()
    offered = candidates(small_world.vehicle(), data.channels, sample_time=0.01)
    assert offered.lags == {"motor_lag"}
    nest = Nest(candidates=offered, data=data)
    at = nest.refit(())
    null = {p: offered.null[p] for n in ("motor_lag", "sensor_delay") for p in offered.parameters[n]}
    whole, own = offered.only(("motor_lag", "sensor_delay")), offered.only(("sensor_delay",))
    exact, theta = widened(at.fit.problem, at.fit.theta, own, data, {"sensor_delay.d": 0.0})
    apart, same = widened(at.fit.problem, at.fit.theta, own, data, null, apart=whole)
    blurred, _ = widened(at.fit.problem, at.fit.theta, whole, data, null)
    assert [u.name for u in apart.unknowns[-2:]] == [u.name for u in blurred.unknowns[-2:]]
    found = {u.name: i for i, u in enumerate(apart.unknowns)}
    a, b, c = exact.evaluate(theta), apart.evaluate(same), blurred.evaluate(same)
    assert a.hessian is not None and b.hessian is not None and c.hessian is not None
    delay, lag = found["sensor_delay.d"], found["motor_lag.tau"]
    assert b.hessian[delay, delay] == pytest.approx(a.hessian[-1, -1], rel=1e-9)
    assert b.hessian[lag, lag] == pytest.approx(c.hessian[lag, lag], rel=1e-9)
    # Most of what tells of a late IMU is the accelerometer's.
    az = list(at.fit.model.dynamics.innovations.names).index("az")
    for wide, felt in ((apart, True), (blurred, False)):
        (block, *_) = wide.predictor.blocks(wide, same, True)
        assert block.jacobian is not None
        assert (np.abs(block.jacobian[100:, az, list(block.columns).index(delay)]).max() > 1.0) == felt
