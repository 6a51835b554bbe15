"""From its first sample a filter weighs readings by how well the start is known, whatever the
process noise."""

from __future__ import annotations

import functools

import casadi as ca
import numpy as np
import pytest

from greybox import build_model, fit
from greybox.data import Dataset, dataset_from_arrays
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.filtering import Filter, Filtered
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.predictors.kalman import Kalman
from greybox.estimation.problem import Problem, make_problem
from greybox.estimation.settling import FIRST, stretches
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.dynamics import StateSpaceModel
from greybox.model.parameter import Parameter
from greybox.plants.flight_log import fly, member
from greybox.plants.noise import ProcessNoise
from greybox.plants.presets import controller_for, nano
from greybox.symbolic import Layout, Signal
from tests import gusty
from tests.simulated import vehicle

DT = 0.05


@functools.cache
def cart() -> StateSpaceModel:
    """A cart with friction, pushed; position and speed are seen, its speed is shaken."""
    return StateSpaceModel(
        name="cart",
        states=Layout([Signal(name="x", unit="m"), Signal(name="v", unit="m/s")]),
        inputs=Layout([Signal(name="f", unit="N")]),
        outputs=Layout([Signal(name="x", unit="m"), Signal(name="v", unit="m/s")]),
        parameters=(
            Parameter(name="m", unit="kg", nominal=1.5, lower=0.1, upper=10, scale=1.0),
            Parameter(name="b", unit="N s/m", nominal=0.3, lower=0.0, upper=10, scale=0.5),
        ),
        dynamics=lambda t, x, u, p: [x[1], (u[0] - p["b"] * x[1]) / p["m"]],
        measurement=lambda t, x, u, p: [x[0], x[1]],
        noise_states=("v",),
        initial={"x": 0.0, "v": 0.0},
        initial_sigma={"x": 2.0, "v": 1.0},
        sensor_sigma={"x": 0.2, "v": 0.3},
    )


def rides(
    count: int, *, n: int = 200, shaken: float = 0.0, seed: int = 0, every: int = 1
) -> Dataset:
    """Rides from unknown starts; x comes every so many samples."""
    whole: Dataset | None = None
    for i in range(count):
        rng = np.random.default_rng(seed + i)
        force = np.repeat(rng.uniform(-3, 3, n // 20), 20)
        x, rows = rng.normal(size=2) * [2.0, 1.0], []
        for k in range(n):
            rows.append([x[0] + 0.2 * rng.normal(), x[1] + 0.3 * rng.normal()])
            decay = np.exp(-0.3 / 1.5 * DT)
            ends = force[k] / 0.3 + (x[1] - force[k] / 0.3) * decay
            middle = force[k] / 0.3 * DT + (x[1] - force[k] / 0.3) * (1 - decay) * 1.5 / 0.3
            x = np.array([x[0] + middle, ends + shaken * rng.normal()])
        seen = np.array(rows)
        seen[np.arange(n) % every != i % every, 0] = np.nan
        one = dataset_from_arrays(
            DT * np.arange(n), {"f": force, "x": seen[:, 0], "v": seen[:, 1]}, name=f"ride{i}"
        )
        whole = one if whole is None else whole + one
    assert whole is not None
    return whole


def problem(
    data: Dataset, predictor: Innovation | Kalman, level: float, **choices: object
) -> Problem:
    noise = {"noise.process.v": level / DT}  # an acceleration, held for a sample
    return make_problem(
        cart(), data, predictor=predictor, criterion=Gaussian(), noise=noise, **choices
    )  # type: ignore


def test_stretches_cover_every_sample_once_and_grow_with_time():
    for n, length in ((5, 1), (1000, 1), (1000, 10), (77, 7), (100_000, 64)):
        plan = list(stretches(n, length))
        assert [s.begin for s in plan[1:]] == [s.end for s in plan[:-1]]
        assert plan[0].begin == 0
        assert plan[-1].end == n
        assert all(s.node >= s.begin and s.node % length in (0, s.begin % length) for s in plan)
    assert len(list(stretches(1_000_000, 1))) < 50


@pytest.mark.parametrize("level", [1e-6, 0.05])
def test_gains_of_a_linear_model_are_those_of_the_kalman_filter(level):
    """A plain Kalman loop from the spread of the start; between the nodes the gain of the nearest
    one."""
    own = problem(rides(1), Innovation(), level)
    found = Innovation().gains(own, own.start, False)[0]
    lin, (x, window) = (
        own.prepared(Innovation()).linearisation,
        own.prepared(Innovation()).reference,
    )
    a, g, c, _ = lin.values(x, window, own.base, DT)
    q, r = (level / DT) ** 2, np.diag([0.04, 0.09])
    p, nodes = np.diag([4.0, 1.0]), {s.node for s in stretches(200, 1)}
    checked = 0
    for t in range(200):
        s = c @ p @ c.T + r
        k = a @ p @ c.T @ np.linalg.inv(s)
        if t in nodes and t < 200:
            row = found.pattern[t]
            table, covariance, _ = found.tables()
            np.testing.assert_allclose(table.gain[row], k, rtol=1e-3, atol=1e-7)
            np.testing.assert_allclose(covariance[row], s, rtol=1e-4)
            checked += 1
        p = a @ p @ a.T + q * g @ g.T - k @ s @ k.T
    assert checked > FIRST


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("level", [1e-6, 0.05])
def test_the_likelihood_of_a_linear_model_is_that_of_the_kalman_filter(level, every):
    """The gain of a stretch is held, that of the Kalman filter follows: a tenth of a unit a
    ride."""
    data = rides(5, shaken=level, every=every)
    held, exact = (problem(data, p, level) for p in (Innovation(), Kalman()))
    assert held.n == exact.n, "no start is an unknown"
    assert held.evaluate(held.start, 0).cost == pytest.approx(
        exact.evaluate(exact.start, 0).cost, abs=0.5
    )


def test_derivatives_through_the_gains_of_the_start_are_exact():
    for every in (1, 4):
        own = problem(rides(2, shaken=0.05, every=every), Innovation(), 0.03)
        theta = own.start + 0.05 * np.random.default_rng(1).normal(size=own.n) * own.scale
        gradient = own.evaluate(theta).gradient
        assert gradient is not None
        for j, scale in enumerate(own.scale):
            h = np.zeros(own.n)
            h[j] = 1e-5 * scale
            numeric = (own.evaluate(theta + h, 0).cost - own.evaluate(theta - h, 0).cost) / (
                2e-5 * scale
            )
            assert gradient[j] == pytest.approx(numeric, rel=1e-6, abs=1e-5)


def blown(predictor: Innovation | Kalman, count: int) -> Problem:
    """The model of gusty carts at the truth."""
    return make_problem(
        gusty.model(),
        gusty.rides(count),
        predictor=predictor,
        criterion=Gaussian(),
        noise=gusty.LEVELS,
        free=["disturbance.v.T"],
    )


def test_a_gust_that_blew_before_the_flight_is_as_likely_as_one_that_comes_later():
    """The start of a Gauss-Markov process is its stationary state, as large as its level and time
    say. A spread that does not know them lets whatever is constant in a flight, a bias or a steady
    force, pay for the first gust."""
    own = blown(Innovation(), 60)
    assert not any(u.kind == "initial" for u in own.unknowns), "the filter carries it"
    size = np.zeros(gusty.ROWS)
    for block in own.predictor.blocks(own, own.start, False):
        assert block.covariance is not None
        size += [
            e @ np.linalg.solve(block.covariance[i], e)
            for e, i in zip(block.e, block.pattern, strict=True)
        ]
    assert size[:4].mean() / (60 * 2) == pytest.approx(1.0, abs=0.2)
    assert size[30:].mean() / (60 * 2) == pytest.approx(1.0, abs=0.1)


def test_a_lasting_gust_starts_alike_in_every_filter_and_its_slopes_are_exact():
    own, exact = blown(Innovation(), 3), blown(Kalman(), 3)
    assert own.evaluate(own.start, 0).cost == pytest.approx(
        exact.evaluate(exact.start, 0).cost, abs=0.3
    )
    gradient = own.evaluate(own.start).gradient
    assert gradient is not None
    for j, scale in enumerate(own.scale):
        h = np.zeros(own.n)
        h[j] = 1e-5 * scale
        numeric = (own.evaluate(own.start + h, 0).cost - own.evaluate(own.start - h, 0).cost) / (
            2e-5 * scale
        )
        assert gradient[j] == pytest.approx(numeric, rel=1e-6, abs=1e-5), own.unknowns[j].name


@pytest.mark.parametrize("predictor", ["simulation", "multiple-shooting"])
def test_a_gust_whose_start_is_an_unknown_is_as_large_as_one_that_a_filter_carries(predictor):
    """Its prior is the stationary state at the start values of level and time constant, a sensor's
    and a speed's stay."""
    for time in (gusty.TIME, gusty.TIME / 4):
        own = make_problem(
            gusty.model(),
            gusty.rides(2),
            predictor=predictor,
            noise=gusty.LEVELS,
            free=["b"],
            values={"disturbance.v.T": time},
        )
        for k, record in enumerate(own.records):
            sigma = [u.sigma for u in own.unknowns if u.flight == f"record {k}"]
            assert sigma == own.start_sigma(k).tolist()
            size = (
                gusty.LEVELS["noise.process.disturbance.v"]
                / (1 - np.exp(-2 * gusty.DT / time)) ** 0.5
            )
            assert sigma == pytest.approx([*record.x0_sigma[:2], size])


def test_rides_that_were_not_fitted_are_foretold_as_well_as_those_that_were():
    """No process noise: 40 starts of a ride each are not worse than those of the fit."""
    found = fit(cart(), rides(10), values={"m": 1.2, "b": 0.4})
    assert found["m"].value == pytest.approx(1.5, abs=4 * found["m"].std)
    told = problem(
        rides(40, seed=100),
        Innovation(),
        1e-6,
        values={n: e.value for n, e in found.parameters.items()},
    )
    theta = told.start.copy()
    for name, (level, _, _) in found.noise.items():
        place = told.place(name)
        assert place is not None
        theta[place] = np.log(level)
    held_out = -told.evaluate(theta, 0).likelihood / (40 * 200)
    assert held_out == pytest.approx(found.loglik / found.n_samples, abs=0.05)


def test_a_start_that_readings_do_not_tell_is_an_unknown():
    """Without a compass and at hover nothing tells the heading: a flight that moves does."""
    whole = flights(1, 40)
    alone = {
        n: v
        for n, v in whole.flights[0].segments[0].channels.items()
        if not n.startswith(("q", "v"))
    }
    alone["q"] = whole.flights[0].segments[0].channels["q"]
    data = dataset_from_arrays(whole.flights[0].segments[0].t, alone, name="blind")
    own = make_problem(
        build_model(vehicle(), data.channels, ()),
        data,
        predictor=Innovation(),
        criterion=Gaussian(),
    )
    unknown = {u.name for u in own.unknowns if u.kind == "initial"}
    assert "d_attitude.z" in unknown
    assert not {"d_position.x", "d_rate.x", "d_rate.z"} & unknown
    assert own.spreads is not None
    for name, spread in zip(own.dynamics.error_states.names, own.spreads[0], strict=True):
        assert (spread == 0.0) == (name in unknown), name


# -------------------------------------------------------------------------------- a whole vehicle


@functools.cache
def flights(count: int, first_seed: int) -> Dataset:
    """Flights of a simulator without gusts: sensors are noisy, nothing else is."""
    plant = nano([], process=ProcessNoise())
    seeds = list(range(first_seed, first_seed + count))
    log = fly(
        plant,
        controller_for(plant),
        RandomWaypoints(),
        rich_excitation(),
        6.0,
        seed=seeds,
        warm_up=1.0,
    )
    whole: Dataset | None = None
    for i in range(count):
        one = {k: v for k, v in member(log, i).items() if not k.startswith("omega")}
        single = dataset_from_arrays(one.pop("t"), one, name=f"calm{first_seed + i}")
        whole = single if whole is None else whole + single
    assert whole is not None
    return whole


def loglik(found: Filtered) -> float:
    """Gaussian log likelihood per sample."""
    total = 0.0
    for g, s in enumerate(found.covariance):
        e = found.innovations[found.gains.pattern == g]
        there = found.gains.there[g].sum()
        total -= 0.5 * float((e * np.linalg.solve(s, e.T).T).sum())
        total -= 0.5 * len(e) * float(np.linalg.slogdet(s)[1] + there * np.log(2 * np.pi))
    return total / found.record.n


@pytest.mark.slow
def test_held_out_flights_of_a_simulator_without_gusts_are_as_likely_as_those_of_the_fit():
    train, held = flights(2, 40), flights(2, 60)
    found = fit(build_model(vehicle(), train.channels, ()), train)
    assert found.converged
    runner = Filter(found.model)
    known = np.mean([loglik(runner.run(f.segments[0])) for f in train])
    new = np.mean([loglik(runner.run(f.segments[0])) for f in held])
    assert known == pytest.approx(found.loglik / found.n_samples, rel=1e-3)
    assert new == pytest.approx(known, rel=0.01)
    # What a filter without the spread of the start does with the same flight and the same model.
    settled = runner.settling.gains(runner.run(held.flights[0].segments[0]).record, None)
    first = held.flights[0].segments[0]
    blind = runner.run(first, x0=runner.run(first).record.x0)
    np.testing.assert_array_equal(blind.gains.pattern, settled.pattern)
    assert loglik(blind) < new - 10.0
    assert blind.sigma.shape == blind.innovations.shape


def test_a_pushed_mass_in_casadi_is_the_cart():
    """The rides follow the model: without noise both agree."""
    x, p = ca.DM([0.4, -0.2]), ca.DM([1.5, 0.3])
    after = cart().step(0, x, ca.DM([[2.0]]), p, ca.DM([0.0]), DT)
    decay = np.exp(-0.2 * DT)
    assert float(after[1]) == pytest.approx(2 / 0.3 + (-0.2 - 2 / 0.3) * decay, abs=1e-8)
