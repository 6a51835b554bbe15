"""A row that the logger lost took its command along: the sample that this command reaches is
trusted more, exactly so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from greybox.data import dataset_from_arrays
from greybox.estimation.criteria.gaussian import Gaussian
from greybox.estimation.differences import with_candidate_sensitivities
from greybox.estimation.fit import fit
from greybox.estimation.gain import stationary
from greybox.estimation.lost_commands import LOST, Pushes, lost_commands
from greybox.estimation.predictors.innovation import Innovation
from greybox.estimation.problem import make_problem
from greybox.estimation.record import lost_bits, make_records
from greybox.excitation.injection import rich_excitation
from greybox.excitation.waypoints import RandomWaypoints
from greybox.model.model import build_model
from greybox.model.vehicle import read_vehicle
from greybox.plants.flight_log import fly
from greybox.plants.presets import controller_for, x250
from greybox.plants.vehicle_file import write_vehicle

SIGMA = {"inertia": 0.2, "thrust.c2": 0.2, "torque.c2": 0.3}


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """(vehicle, whole log, the same with three rows in a hundred lost and their commands held)."""
    plant = x250()
    log = fly(
        plant, controller_for(plant), RandomWaypoints(), rich_excitation(), 6.0, seed=4, warm_up=1.0
    )
    log = {k: v for k, v in log.items() if not k.startswith("omega")}
    t = log.pop("t")
    gone = np.random.default_rng(0).random(t.size) < 0.03
    gone[:2] = gone[-2:] = False
    gone[1:] &= ~gone[:-1]
    holed = {k: np.where(gone, np.nan, v) for k, v in log.items()}
    for i in range(1, 5):
        holed[f"u{i}"] = np.where(gone, np.concatenate([[0.0], log[f"u{i}"][:-1]]), log[f"u{i}"])
    vehicle = read_vehicle(
        write_vehicle(tmp_path_factory.mktemp("v") / "v.toml", plant, sigma=SIGMA)
    )
    return vehicle, dataset_from_arrays(t, log), dataset_from_arrays(t, holed), gone


def problem_of(vehicle, data, effects=(), **choices):
    model = build_model(vehicle, data.channels, effects, sample_time=0.01)
    return make_problem(
        model, data, predictor=Innovation(), criterion=Gaussian(), use_compiler=False, **choices
    )


def late_by(whole, holed, gone, rows):
    """The flight with what is measured written so many rows later than it was; rows stay lost with
    their commands."""
    out = dict(holed.segments[0].channels)
    n = np.arange(gone.size)
    for name, v in whole.segments[0].channels.items():
        if name[0] != "u":
            out[name] = np.where(gone, np.nan, np.interp(n - rows, n, v))
    return dataset_from_arrays(whole.segments[0].t, out)


@pytest.mark.parametrize("effects", [(), ("command_delay",)])
def test_rows_know_how_long_ago_the_last_two_rows_were_lost(flight, effects):
    vehicle, whole, holed, gone = flight
    problem = problem_of(vehicle, holed, effects)
    (record,) = problem.records
    bits = lost_bits(record.patterns).max(axis=1)[record.pattern]
    reach = problem.dynamics.window[0] + 1
    assert reach == (1 if not effects else 12)
    for k in np.flatnonzero(~gone):
        ago = [k - 1 - i for i in np.flatnonzero(gone[:k])[::-1]][:2]
        assert bits[k] == sum(1 << i for i in ago if i < reach)
    (record,) = problem_of(vehicle, whole, effects).records
    assert not lost_bits(record.patterns).any()


def test_a_slow_sensor_is_not_a_lost_row(flight):
    vehicle, whole, _, _ = flight
    segment = whole.segments[0]
    slow = {k: v.copy() for k, v in segment.channels.items()}
    for name in slow:
        if name[0] != "u":
            slow[name][1::2] = np.nan
        else:
            slow[name][1::2] = slow[name][::2]
    problem = problem_of(vehicle, dataset_from_arrays(segment.t, slow))
    assert not any(
        lost_bits(r.patterns).any()
        for r in make_records(problem.engine, dataset_from_arrays(segment.t, slow))
    )


def test_the_gain_is_best_for_the_state_after_the_sample():
    """With the lost command as part of the state, of which only the rest is corrected."""
    rng = np.random.default_rng(1)
    a, g, c, d = (
        np.eye(2) * 0.9,
        rng.normal(size=(2, 1)),
        rng.normal(size=(3, 2)),
        rng.normal(size=(3, 1)),
    )
    q, r = np.array([0.3]), np.array([0.1, 0.2, 0.4])
    b, h = rng.normal(size=(3, 2, 4)), rng.normal(size=(3, 3, 4))
    b[2], h[0], h[2] = 0.0, 0.0, 0.0
    usual = stationary(
        (a, g, c, d), q, r, np.full(2, 1e9), lost=Pushes(B=b, H=h, early=np.zeros((2, 4)))
    )
    off = b[0]
    for i in (0, 1):
        big = np.block(
            [[usual.P + off @ off.T, off], [off.T, np.eye(4)]]
        )  # of the state and the command
        see, go = np.column_stack([c, h[i + 1]]), np.column_stack([a, b[i + 1]])
        s = see @ big @ see.T + (d * q) @ d.T + np.diag(r)
        k = (go @ big @ see.T + (g * q) @ d.T) @ np.linalg.inv(s)
        gain, covariance, _, _ = usual.gain(np.full(3, 1.0 + (1 << i)))
        assert gain == pytest.approx(k, rel=1e-10)
        assert covariance == pytest.approx(s, rel=1e-10)
        off = (go - k @ see) @ np.vstack([off, np.eye(4)])
    assert usual.lost.weights[0].tolist() == [1.0, 1.0]
    assert usual.gain(np.ones(3))[1] == pytest.approx(usual.S)
    both = usual.gain(np.full(3, 4.0))[1] - usual.S
    assert both == pytest.approx(sum(usual.gain(np.full(3, v))[1] - usual.S for v in (2.0, 3.0)))


def test_gains_where_nothing_arrives_are_the_usual_ones():
    zero = np.zeros((4, 2, 1))
    b = zero.copy()
    b[1] = 1.0
    usual = stationary(
        (np.eye(2) * 0.9, np.eye(2), np.eye(2), np.zeros((2, 2))),
        np.ones(2),
        np.ones(2),
        np.full(2, 1e9),
        lost=Pushes(B=b, H=zero, early=zero[0]),
    )
    patterns = np.array(
        [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [3.0, 3.0], [0.0, 3.0], [5.0, 5.0], [8.0, 8.0]]
    )
    few, which = usual.distinct(patterns)
    assert few[which].tolist() == [[0, 0], [1, 1], [1, 1], [3, 3], [0, 3], [1, 1], [3, 3]]
    for m, i in zip(patterns, which, strict=True):
        assert np.array_equal(usual.gain(m)[0], usual.gain(few[i])[0])


DELAYS = [("command_delay", d) for d in (0.0, 0.01, 0.02)] + [
    ("sensor_delay", 0.01),
    ("pose_delay", 0.01),
]


@pytest.mark.parametrize(("effect", "delay"), DELAYS)
def test_the_likelihood_does_not_jump_where_a_delay_passes_a_whole_sample(flight, effect, delay):
    vehicle, _, holed, _ = flight
    problem = problem_of(vehicle, holed.split_by_time(at=2.0)[0], (effect,))
    theta = problem.start.copy()
    at = [u.name for u in problem.unknowns].index(f"{effect}.d")
    cost = []
    for d in (delay, delay + 1e-10):
        theta[at] = d
        cost.append(problem.evaluate(theta, 0).cost)
    assert abs(cost[1] - cost[0]) < 1e-3
    if delay == 0.0:
        without = problem_of(vehicle, holed.split_by_time(at=2.0)[0])
        assert cost[0] == pytest.approx(without.evaluate(without.start, 0).cost, abs=1e-6)


def test_a_delay_is_seen_as_well_where_a_few_rows_are_lost(flight):
    """Its score test: a jump of the likelihood at no delay once took all of it."""
    vehicle, whole, holed, gone = flight
    tested = {}
    for name, data in (
        ("whole", late_by(whole, whole, gone & False, 0.3)),
        ("holed", late_by(whole, holed, gone, 0.3)),
    ):
        at = fit(
            build_model(vehicle, data.channels, (), sample_time=0.01), data, initialisation="noise"
        )
        large = build_model(vehicle, data.channels, ("command_delay",), sample_time=0.01)
        problem, theta = with_candidate_sensitivities(
            at.problem, at.theta, large, data, {"command_delay.d": 0.0}
        )
        value = problem.evaluate(theta)
        h, g = value.hessian, value.gradient
        rest = np.linalg.solve(h[:-1, :-1], np.column_stack([h[:-1, -1], g[:-1]]))
        information, score = h[-1, -1] - h[-1, :-1] @ rest[:, 0], g[-1] - h[-1, :-1] @ rest[:, 1]
        tested[name] = score**2 / information, information
    assert tested["whole"][0] > 50.0
    assert tested["holed"][0] > 0.7 * tested["whole"][0]
    assert tested["holed"][1] == pytest.approx(tested["whole"][1], rel=0.4)


def test_of_a_linear_record_half_arrives_one_row_earlier(flight):
    vehicle, whole, _, _ = flight
    moved = {}
    for hold in ("zero", "linear"):
        other = replace(vehicle, actuator=replace(vehicle.actuator, hold=hold))
        problem = problem_of(other, whole)
        x, window = problem.prepared(Innovation()).reference
        pushes = lost_commands(problem.dynamics).at(
            x, window, problem.parameters_of(problem.start, None), problem.dt
        )
        moved[hold] = [np.abs(v).sum() for v in (pushes.B[0], pushes.early)]
    assert moved["zero"][1] == 0.0
    assert moved["linear"] == pytest.approx([moved["zero"][0] / 2] * 2, rel=1e-3)


@pytest.mark.parametrize(("delay", "rows"), [(0.0, [0]), (0.02, [2]), (0.015, [1, 2])])
def test_a_lost_command_moves_what_commands_move_when_they_arrive(flight, delay, rows):
    vehicle, whole, _, _ = flight
    effects = ("command_delay",) if delay else ()
    problem = problem_of(
        vehicle, whole, effects, values={"command_delay.d": delay} if delay else None
    )
    x, window = problem.prepared(Innovation()).reference
    pushes = lost_commands(problem.dynamics).at(
        x, window, problem.parameters_of(problem.start, None), problem.dt
    )
    at = {n: i for i, n in enumerate(problem.dynamics.error_states.names)}
    spread = np.sqrt((pushes.B**2).sum(axis=2))
    # Four independent commands, LOST of the mean command u each: rate = dt lever 2 c2 u LOST u
    # sqrt(4) / J.
    u = problem.means["u1"]
    expected = problem.dt * 0.088 * 2 * 4.2 * u * LOST * u * 2 / 2.1e-3
    moved = spread[:, at["d_rate.x"]]
    assert moved.sum() == pytest.approx(expected, rel=0.05)
    assert np.flatnonzero(moved > 1e-6 * expected).tolist() == rows
    i = rows[-1]
    assert spread[i, at["d_velocity.x"]] < 0.05 * spread[i, at["d_velocity.z"]]


@pytest.mark.parametrize("effects", [(), ("motor_lag", "command_delay", "pose_delay")])
def test_the_gradient_stays_exact(flight, effects):
    vehicle, _, holed, _ = flight
    values = (
        {"command_delay.d": 0.013, "motor_lag.tau": 0.03, "pose_delay.d": 0.012}
        if effects
        else None
    )
    problem = problem_of(vehicle, holed.split_by_time(at=1.5)[0], effects, values=values)
    assert any(lost_bits(r.patterns).any() for r in problem.records)
    theta = problem.start
    value = problem.evaluate(theta)
    checked = {
        "inertia.xx",
        "thrust.c2",
        "noise.process.torque.y",
        "noise.process.force.z",
        "noise.sensor.q",
        *(values or ()),
    }
    for i, u in enumerate(problem.unknowns):
        if u.name not in checked:
            continue
        step = np.zeros(problem.n)
        step[i] = 1e-5 * u.scale
        slope = (
            problem.evaluate(theta + step, 0).cost - problem.evaluate(theta - step, 0).cost
        ) / (2 * step[i])
        assert abs(slope - value.gradient[i]) < 1e-4 * max(abs(slope), 1.0 / u.scale), u.name


@pytest.mark.slow
def test_late_commands_are_charged_to_the_sample_that_they_reach(flight):
    """Charged to the row after the lost one, late commands made a lag of no length likelier than
    none."""
    vehicle, whole, holed, gone = flight
    late = late_by(whole, holed, gone, 2)
    likelihood = []
    for effects in (("command_delay",), ("command_delay", "motor_lag")):
        model = build_model(vehicle, late.channels, effects, sample_time=0.01)
        found = fit(model, late, initialisation="noise", values={"command_delay.d": 0.0195})
        likelihood.append(found.loglik)
        (block,) = found.problem.predictor.blocks(found.problem, found.theta, False)
        arrival = np.flatnonzero(gone)[:-3] + 3
        arrival = arrival[~gone[arrival]]
        squares = np.array(
            [
                block.e[k] @ np.linalg.solve(block.covariance[block.pattern[k]], block.e[k])
                for k in arrival
            ]
        )
        assert 0.5 < squares.mean() / block.e.shape[1] < 1.5
    assert likelihood[1] - likelihood[0] < 2.0


def test_lost_rows_do_not_pass_for_torque_noise(flight):
    vehicle, whole, holed, _ = flight
    model = build_model(vehicle, whole.channels, (), sample_time=0.01)
    level = {
        name: fit(model, data, initialisation="noise").noise["noise.process.torque.x"][0]
        for name, data in (("whole", whole), ("holed", holed))
    }
    assert level["holed"] == pytest.approx(level["whole"], rel=0.25)


@pytest.mark.parametrize(
    ("one", "free", "held"),
    [
        ("gyro_bias.b_x", ("gyro_bias.b_x",), ()),
        ("gyro_bias.b_x", ("gyro_bias.b_x",), ("noise.process", "noise.sensor")),
        ("noise.sensor.q", (), ()),
    ],
)
@pytest.mark.parametrize("lost", [False, True], ids=["whole", "holed"])
def test_the_gradient_stays_exact_where_nothing_moves_the_gain(flight, lost, one, free, held):
    vehicle, whole, holed, _ = flight
    data = (holed if lost else whole).split_by_time(at=1.0)[0]
    problem = problem_of(vehicle, data, ("gyro_bias",), free=free, held_noise=held)
    value, theta = problem.evaluate(problem.start), problem.start
    place = [u.name for u in problem.unknowns].index(one)
    step = 1e-4 * problem.scale[place] * np.eye(problem.n)[place]
    ends = [problem.evaluate(theta + s * step, 0).cost for s in (1, -1)]
    assert value.gradient[place] == pytest.approx((ends[0] - ends[1]) / 2 / step[place], rel=1e-5)
