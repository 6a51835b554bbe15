"""A fit on the model of its own effects is the fit on the whole catalogue, and differences are
exact sensitivities."""

from __future__ import annotations

import numpy as np
import pytest

from greybox.discovery.cause import offer
from greybox.discovery.evidence import Flights
from greybox.estimation.differences import with_candidate_sensitivities
from greybox.estimation.problem import Problem, make_problem
from greybox.symbolic import FloatArray
from tests.discovery import small_world

Both = tuple[Problem, FloatArray, Problem, FloatArray]


@pytest.fixture(scope="module")
def both() -> Both:
    """(widened problem and point, problem of the whole model with exact sensitivities and the same
    point)."""
    flights = small_world.damped()
    causes = flights.causes
    at = flights.fit({"gyro_bias"})
    absent = [n for n in causes.effects if n != "gyro_bias"]
    null = {p: m for n in absent for p, (m, _) in causes.offered[n].prior.items()}
    every = causes.built(causes.effects)
    wide, theta = with_candidate_sensitivities(at.problem, at.theta, every, flights.data, null)
    free = [u.name for u in wide.unknowns if u.kind == "parameter"]
    d, (process, sensor) = at.problem.dynamics, at.problem.noise_levels(at.theta)
    noise = dict(zip((f"noise.process.{n}" for n in d.noises.names), process.tolist(), strict=True))
    noise |= dict(
        zip((f"noise.sensor.{n}" for n in d.innovations.names), sensor.tolist(), strict=True)
    )
    whole = make_problem(every, flights.data, free=free, values=null, noise=noise)
    known = {(u.name, u.flight): t for u, t in zip(wide.unknowns, theta, strict=True)}
    return wide, theta, whole, np.array([known[u.name, u.flight] for u in whole.unknowns])


def test_likelihoods_compare_to_the_last_digit(both: Both):
    wide, theta, whole, same = both
    assert wide.evaluate(theta).likelihood == pytest.approx(
        whole.evaluate(same, 0).likelihood, abs=1e-6
    )


def test_differences_are_the_exact_sensitivities(both: Both):
    wide, theta, whole, same = both
    places = {(u.name, u.flight): i for i, u in enumerate(whole.unknowns)}
    order = [places[u.name, u.flight] for u in wide.unknowns]
    a, b = wide.evaluate(theta), whole.evaluate(same)
    assert a.data_hessian is not None and b.data_hessian is not None
    exact = b.data_hessian[np.ix_(order, order)]
    spread = np.sqrt(np.maximum(np.diag(exact), 1e-300))
    assert np.abs((a.data_hessian - exact) / np.outer(spread, spread)).max() < 1e-3


def test_a_limit_that_no_command_reaches_is_moved_until_it_is_felt():
    data = small_world.flown()
    causes = offer(small_world.vehicle(), data.channels, sample_time=0.01)
    at = Flights(causes=causes, data=data).fit(())
    null = {p: m for p, (m, _) in causes.offered["command_saturation"].prior.items()}
    wide, theta = with_candidate_sensitivities(
        at.problem, at.theta, causes.built({"command_saturation"}), data, null
    )
    value = wide.evaluate(theta)
    assert value.hessian is not None
    upper = [u.name for u in wide.unknowns].index("command_saturation.a_hi")
    assert value.hessian[upper, upper] > 0


def test_what_a_lag_of_no_length_shows_later_is_looked_for_in_time():
    """A rotor with a lag shows its speed at the sample, one without that of the step that begins:
    the accelerometer of a model with a lag, even of no length, is a sample behind, and a late IMU
    would not be seen in it."""
    data = small_world.flown()
    causes = offer(small_world.vehicle(), data.channels, sample_time=0.01)
    at = Flights(causes=causes, data=data).fit(())
    null = {p: 0.0 for n in ("motor_lag", "sensor_delay") for p in causes.offered[n].parameters}
    whole, own = causes.built({"motor_lag", "sensor_delay"}), causes.built({"sensor_delay"})
    exact, theta = with_candidate_sensitivities(
        at.problem, at.theta, own, data, {"sensor_delay.d": 0.0}
    )
    apart, same = with_candidate_sensitivities(at.problem, at.theta, own, data, null, apart=whole)
    found = {u.name: i for i, u in enumerate(apart.unknowns)}
    a, b = exact.evaluate(theta), apart.evaluate(same)
    assert a.hessian is not None and b.hessian is not None
    delay = found["sensor_delay.d"]
    assert b.hessian[delay, delay] == pytest.approx(a.hessian[-1, -1], rel=1e-9)
