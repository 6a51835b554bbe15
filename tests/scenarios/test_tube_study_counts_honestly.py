"""The tube study counts what it says: limits, coverage of sets, paired costs; its shortcuts change
nothing."""

import numpy as np
import pytest

from mpc_export.mission import OBSTACLE_COURSE
from scenarios.studies import tube_coverage, tube_flights, tube_mpc, tube_tuning


def record(seed, *, margin=0.01, tilt=0.8, crashed=False, cost=0.2, controller="tube-10"):
    return {
        "controller": controller,
        "seed": seed,
        "crashed": crashed,
        "margins": {"wall": margin, "ceiling": np.inf},
        "tilt": tilt,
        "rmse": 0.04,
        "cost": cost,
        "events": 0,
        "median_ms": 3.0,
        "p99_ms": 5.0,
    }


def test_the_table_of_the_route_is_the_course():
    route, times = tube_flights.route(), np.array([0.0, 1.23, 4.56, OBSTACLE_COURSE.duration])
    table, course = route.sample(times), OBSTACLE_COURSE.sample(times)
    for name, values in vars(course).items():
        np.testing.assert_allclose(vars(table)[name], values, atol=1e-12)
    # past the end of the table it rests
    assert route.sample(np.array([1e3])).velocity == pytest.approx(np.zeros((1, 3)))


def test_planes_move_toward_the_path_and_only_where_they_exist():
    route = tube_flights.route()
    still, moved = (route.planes(route.times, v) for v in (0.0, 0.003))
    there = (still[..., :3] != 0).any(axis=-1)
    assert there.any(axis=0).all()  # every plane is met somewhere
    assert not there.all()
    np.testing.assert_allclose((still - moved)[there, 3], 0.003)
    np.testing.assert_array_equal(still[~there], moved[~there])


def test_a_crash_crosses_and_tilts_and_a_tilt_alone_crosses_nothing():
    assert not tube_flights.crossed(record(1))
    assert tube_flights.crossed(record(1, margin=-1e-6))
    steep = record(1, tilt=OBSTACLE_COURSE.tilt_max + 1e-6)
    assert tube_flights.tilted(steep)
    assert not tube_flights.crossed(steep)
    lost = record(1, crashed=True)
    assert tube_flights.crossed(lost)
    assert tube_flights.tilted(lost)


def test_costs_are_compared_on_seeds_that_both_flew():
    rows = [record(s, cost=0.2 + 0.01 * s) for s in range(5)]
    rows += [record(s, cost=0.21 + 0.01 * s, controller="constant") for s in range(2, 9)]
    gap, error, n = tube_mpc.paired(rows, "tube-10", "constant")
    assert n == 3
    assert gap == pytest.approx(-0.01)
    assert error == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(tube_mpc.paired(rows, "tube-10", "nominal")[0])


def test_the_summary_tests_a_level_against_its_own_flights():
    rows = [record(s, margin=-1.0 if s < 6 else 1.0) for s in range(20)]
    line = tube_mpc.summary(rows).splitlines()[1]
    assert line.split()[:3] == ["tube-10", "20", "0.300"]
    assert "0.011" in line  # P(X >= 6), X ~ B(20, 0.1)


def test_coverage_of_true_gaussians_is_nominal_and_of_half_as_wide_ones_is_not():
    rng = np.random.default_rng(0)
    roots = rng.standard_normal((12, 12)) * 0.2 + np.eye(12)
    covariance = roots @ roots.T
    away = rng.standard_normal((4000, 2, 12)) @ roots.T
    stated = np.broadcast_to(covariance, (4000, 2, 12, 12))
    for levels in tube_coverage.shares(away, stated).values():
        for level, share in levels.items():
            np.testing.assert_allclose(share, level, atol=0.02)
    np.testing.assert_allclose(tube_coverage.widths(away, stated), 1.0, atol=0.08)
    narrow = tube_coverage.shares(away, stated / 4)["position"]
    assert (narrow[0.95] < 0.75).all()
    np.testing.assert_allclose(tube_coverage.widths(away, stated / 4), 0.5, atol=0.04)


def test_the_doubt_about_a_share_is_that_of_independent_flights():
    rng = np.random.default_rng(1)
    flights, each = 60, 20
    away = rng.standard_normal((flights * each, 2, 12))
    stated = np.broadcast_to(np.eye(12), (flights * each, 2, 12, 12))
    own = tube_coverage.errors(away, stated, flights)["position"][0.68]
    expected = np.sqrt(0.68 * 0.32 / (flights * each))
    np.testing.assert_allclose(own[:2], expected, rtol=0.3)
    # branches of one flight that are alike count once
    alike = np.repeat(away[::each], each, axis=0)
    own = tube_coverage.errors(alike, stated, flights)["position"][0.68]
    np.testing.assert_allclose(own[:2], np.sqrt(each) * expected, rtol=0.3)


def test_what_was_tuned_is_not_tuned_again(tmp_path):
    tuning = tube_tuning.Tuning(tmp_path, hybrid=None, report=lambda text: pytest.fail(text))
    tuning._keep("rehearsed", [(0.5, 12), (1.0, 4), (1.5, 1)])
    tuning._keep("constant", [(0.001, 7), (0.0025, 1)])
    tuning._keep("lengths", [8, 9, 10] * tube_tuning.TUNING)
    again = tube_tuning.Tuning(tmp_path, hybrid=None, report=lambda text: pytest.fail(text))
    sizes = [again.deviations(v) for v in (0.2, 0.1, 0.05)]
    assert 0.5 < sizes[0] < sizes[1] < sizes[2] < 2.5
    assert 0.001 < again.moved(0.1) < 0.0035
    assert again.by_boole(0.1) == pytest.approx(2.678, abs=1e-3)  # 27 touched samples a flight
