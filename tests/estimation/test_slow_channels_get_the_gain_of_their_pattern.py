"""A channel that comes at a tenth of the rate gets the gain of the pattern that the channels
repeat."""

from __future__ import annotations

import functools

import numpy as np
import pytest

from greybox import build_model, fit
from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.channel_pattern import LONGEST, pattern_of
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.filtering import Filter
from greybox.estimation.fit import Fit
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.predictors.kalman import Kalman
from greybox.estimation.problem import Problem, make_problem
from greybox.estimation.settling import Settling, held
from tests.simulated import flights, vehicle

EFFECTS = ("motor_lag", "command_delay", "rotor_drag", "rotational_damping")
SLOW = 10


@functools.cache
def logs(first_seed: int) -> Dataset:
    """Flights at 100 Hz without velocity whose positions come at 10 Hz, each flight with another
    phase."""
    whole: Dataset | None = None
    for i, flight in enumerate(flights(2, 8.0, first_seed)):
        segment = flight.segments[0]
        one = {n: np.array(v) for n, v in segment.channels.items() if n not in ("vx", "vy", "vz")}
        for n in "xyz":
            one[n][(np.arange(segment.n) - 3 * i) % SLOW != 0] = np.nan
        single = dataset_from_arrays(segment.t, one, name=flight.name)
        whole = single if whole is None else whole + single
    assert whole is not None
    return whole


@functools.cache
def fitted() -> Fit:
    data = logs(40)
    return fit(build_model(vehicle(), data.channels, EFFECTS), data)


def at_estimates(data: Dataset, predictor: Innovation | Kalman) -> Problem:
    found = fitted()
    return make_problem(
        build_model(vehicle(), data.channels, EFFECTS),
        data,
        predictor=predictor,
        criterion=Gaussian(),
        values={n: e.value for n, e in found.parameters.items()},
        noise={n: level for n, (level, _, _) in found.noise.items()},
        estimate_noise=False,
    )


def test_the_shortest_pattern_is_found_in_spite_of_lost_samples():
    rng = np.random.default_rng(0)
    mask = np.ones((1000, 3))
    assert pattern_of(mask).length == 1
    mask[np.arange(1000) % 7 != 2, 1] = 0
    mask[np.arange(1000) % 14 != 4, 2] = 0
    mask[rng.random(1000) < 0.02] = 0
    found = pattern_of(mask)
    assert found.length == 14
    np.testing.assert_array_equal(np.flatnonzero(found.there[:, 1]), [2, 9])
    np.testing.assert_array_equal(np.flatnonzero(found.there[:, 2]), [4])


def test_a_channel_that_never_comes_is_none_of_the_usual_ones():
    mask = np.ones((100, 2))
    mask[:, 1] = 0
    np.testing.assert_array_equal(pattern_of(mask).there, [[True, False]])


def test_channels_without_a_pattern_are_all_there_as_before():
    mask = np.ones((1000, 2))
    mask[np.random.default_rng(1).random(1000) < 0.4, 1] = 0
    found = pattern_of(mask)
    assert found.length == 1 <= LONGEST
    assert found.there.all()


def test_the_settled_covariances_are_those_of_the_kalman_recursion():
    rng = np.random.default_rng(3)
    a, g, c, d = (
        rng.normal(size=(4, 4)) / 2,
        rng.normal(size=(4, 2)),
        rng.normal(size=(3, 4)),
        rng.normal(size=(3, 2)),
    )
    q, r = np.array([1.0, 0.5]), np.array([0.1, 0.2, 0.3])
    mask = np.ones((500, 3))
    mask[np.arange(500) % 5 != 0, 0] = 0
    mask[np.arange(500) % 5 != 3, 2] = 0
    pattern = pattern_of(mask)
    found = Settling(values=(a, g, c, d), q=q, r=r, weak=np.full(4, 1e10)).settled(pattern)
    p = np.eye(4)
    for t in range(500):
        m = mask[t] != 0
        if t >= 495:
            np.testing.assert_allclose(found[t % 5].P, p, rtol=1e-7, atol=1e-9)
        s = c[m] @ p @ c[m].T + (d[m] * q) @ d[m].T + np.diag(r[m])
        n = a @ p @ c[m].T + (g * q) @ d[m].T
        p = a @ p @ a.T + (g * q) @ g.T - n @ np.linalg.solve(s, n.T)
        p = 0.5 * (p + p.T)


def test_slopes_of_the_settled_covariances_are_central_differences():
    rng = np.random.default_rng(4)
    values = [rng.normal(size=s) / 2 for s in ((4, 4), (4, 2), (3, 4), (3, 2))]
    way = [rng.normal(size=v.shape) for v in values]
    q, r, weak = np.array([1.0, 0.5]), np.array([0.1, 0.2, 0.3]), np.full(4, 1e6)
    mask = np.ones((90, 3))
    mask[np.arange(90) % 3 != 0, 0] = 0
    pattern = pattern_of(mask)

    def at(h: float) -> Settling:
        return Settling(
            values=tuple(v + h * w for v, w in zip(values, way, strict=True)), q=q, r=r, weak=weak
        )

    exact = Settling(
        values=tuple(values),
        q=q,
        r=r,
        weak=weak,
        slopes=tuple(w[None] for w in way),
        dq=np.zeros((1, 2)),
        dr=np.zeros((1, 3)),
    ).settled(pattern)
    for own, ahead, behind in zip(
        exact, at(1e-6).settled(pattern), at(-1e-6).settled(pattern), strict=True
    ):
        assert own.dP is not None
        np.testing.assert_allclose(own.dP[0], (ahead.P - behind.P) / 2e-6, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_a_fit_finds_the_noise_and_the_truth_and_foretells_as_the_extended_kalman_filter_does():
    found = fitted()
    assert found.converged
    assert found.noise["noise.sensor.position.x"][0] == pytest.approx(1e-3, rel=0.3)
    for data in (logs(40), logs(60)):
        fast, exact = (at_estimates(data, p) for p in (Innovation(), Kalman()))
        per_sample = [-p.evaluate(p.start, 0).likelihood / found.n_samples for p in (fast, exact)]
        assert per_sample[0] == pytest.approx(per_sample[1], abs=0.05)


@pytest.mark.slow
def test_gains_of_all_channels_foretell_worse_and_less_white():
    """What the filter did before: the covariance of a filter that has all channels all the time."""
    runner = Filter(fitted().model)
    rows = []
    for flight in logs(60):
        segment = flight.segments[0]
        own = runner.run(segment)
        scores = []
        for gains in (runner.settling.gains(own.record, None), held(runner.riccati, own.record)):
            table, covariance, _ = gains.tables()
            run = runner.engine.run(
                x0=own.record.x0,
                inputs=own.record.inputs,
                outputs=own.record.outputs,
                mask=own.record.mask,
                pattern=gains.pattern,
                gains=table,
                p=own.p,
                dt=own.record.dt,
            )
            assert run.innovations is not None
            late = np.arange(own.record.n) >= 400  # the start is another matter
            e, s = run.innovations[late], covariance[gains.pattern[late]]
            z = e / np.sqrt(np.diagonal(s, axis1=1, axis2=2))
            at = np.flatnonzero(own.record.mask[late, 0])
            again = float(np.mean(z[at[1:], :3] * z[at[:-1], :3]) / np.mean(z[at, :3] ** 2))
            likelihood = -0.5 * np.mean(
                np.einsum("ni,nij,nj->n", e, np.linalg.inv(s), e) + np.linalg.slogdet(s)[1]
            )
            scores.append((float(likelihood), abs(again)))
        rows.append(scores)
    own_gain, all_gain = np.mean(rows, axis=0)
    assert own_gain[0] > all_gain[0] + 0.5
    assert own_gain[1] < 0.5 * all_gain[1]
