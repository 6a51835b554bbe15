"""Spikes do not reach the estimate and what persists does; clocks, gaps and garbage are outlived; a
descent is one."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mpc_export.tube.descent import BLIND, BRAKE, SLOW, SPEED, Descent, Watch, longest_without_pose
from mpc_export.tube.gate import PARTLY, REACH, Gate, plausible
from mpc_export.tube.rival import CLEARLY, Known, Rival, likelier
from tests.mpc_export.tube.test_controller_flies_and_survives import fly, pilot
from tests.mpc_export.tube.wild import SOON

PLACE = ("x", "y", "z")


def gate():
    """A place, known to 4 mm, and one rate, known to 0.02 rad/s."""
    return Gate([PLACE, PLACE, PLACE, ("p",)], np.diag([0.004, 0.004, 0.004, 0.02]) ** 2)


def seen(weigh, place, rate=0.0, there=(1, 1, 1, 1)):
    return weigh(np.array([place, 0.0, 0.0, rate]), np.array(there, dtype=float)).tolist()


def test_a_spike_is_not_believed_and_the_next_sample_is():
    weigh = gate()
    assert seen(weigh, 0.01) == [1.0, 1.0]
    for spike in (0.5, -7.0, 1e6, 1e300):
        assert seen(weigh, spike) == [0.0, 1.0]
        assert seen(weigh, 0.01) == [1.0, 1.0]


def test_a_sensor_without_a_number_blinds_no_other():
    assert seen(gate(), math.nan) == [0.0, 1.0]


def test_what_persists_is_believed_after_a_few_samples():
    weigh = gate()
    shares = [seen(weigh, 0.5)[0] for _ in range(8)]
    first = shares.index(1.0)
    assert 2 <= first <= 6
    assert shares[first:] == [1.0] * (8 - first)
    assert shares[:2] == [0.0, 0.0]


def test_a_jerk_that_a_vehicle_can_do_counts_in_part_and_then_in_full():
    weigh = gate()
    size = 3.0 * REACH * 0.02
    assert seen(weigh, 0.0, size)[1] == pytest.approx(1.0 / 3.0)
    assert size < PARTLY * REACH * 0.02
    assert [seen(weigh, 0.0, size)[1] for _ in range(3)] == [pytest.approx(2.0 / 3.0), 1.0, 1.0]
    # and one that swings goes on to count, nearly in full at its worst
    assert min(seen(weigh, 0.0, size * math.cos(0.5 * k))[1] for k in range(100)) > 0.8


def test_after_a_gap_more_is_possible():
    long, short = gate(), gate()
    for _ in range(10):
        assert seen(long, 9.9, there=(0, 0, 0, 1)) == [1.0, 1.0]
    assert seen(long, 0.3)[0] == 1.0
    assert seen(short, 0.3)[0] == 0.0


def test_infinite_numbers_and_quaternions_without_length_are_missing():
    columns = ("x", "qw", "qx", "qy", "qz", "p")
    found = plausible(columns, np.array([np.inf, 1.0, 0.0, 0.0, 0.0, 2.0]))
    np.testing.assert_array_equal(found, [np.nan, 1.0, 0.0, 0.0, 0.0, 2.0])
    for wrong in ([0.0] * 4, [1e200] * 4, [np.nan, 0.0, 0.0, 0.0]):
        found = plausible(columns, np.array([1.0, *wrong, 2.0]))
        np.testing.assert_array_equal(found, [1.0, np.nan, np.nan, np.nan, np.nan, 2.0])


def test_a_descent_begins_as_the_vehicle_moves_and_ends_straight_down():
    way = Descent(
        time=2.0, position=np.array([1.0, 2.0, 1.5]), velocity=np.array([3.0, -1.0, 0.5]), yaw=0.4
    )
    times = np.arange(2.0, 6.0, 1e-3)
    path = way.sample(times)
    np.testing.assert_allclose(path.position[0], [1.0, 2.0, 1.5])
    np.testing.assert_allclose(path.velocity[0], [3.0, -1.0, 0.5])
    np.testing.assert_allclose(path.velocity[-1], [0.0, 0.0, -SPEED], atol=1e-12)
    np.testing.assert_allclose(np.diff(path.position, axis=0) / 1e-3, path.velocity[:-1], atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(path.acceleration[0]), BRAKE)
    assert path.yaw.tolist() == [0.4] * len(times)


def test_a_reason_counts_when_it_holds_more_often_than_not():
    watch = Watch()
    assert not any(watch(0.1, {"why": (k % 2 == 0, 0.3)}) for k in range(20))
    found = [watch(0.1, {"why": (k % 3 != 0, 0.3)}) for k in range(20)]
    assert found[0] is None
    assert "why" in found
    assert Watch()(0.02, {"why": (False, 0.0)}) is None, "what does not hold is no reason"


def known(x=0.0):
    return Known(np.full(3, x), np.zeros(0), np.zeros((0, 0)), np.zeros((2, 0)))


def test_a_rival_is_believed_where_it_explains_all_samples_better_and_by_more_than_one_sensor_can():
    rival, weigh = Rival(), gate()
    worst = weigh.surprise(np.array([1e9, 0.0, 0.0, 0.0]), np.ones(4))
    assert worst == weigh.surprise(np.array([math.nan, 0.0, 0.0, 0.0]), np.ones(4)) > CLEARLY
    assert weigh.surprise(np.array([1e9, 0.0, 0.0, 0.0]), np.array([0.0, 1.0, 1.0, 1.0])) == 0.0
    rival.begins(known())
    rival.goes_on(known(), worst)
    assert not rival.believed
    rival.goes_on(known(), worst)
    assert rival.believed
    rival.goes_on(known(), -0.1)
    assert rival.known is None
    assert not rival.believed
    rival.begins(known(math.inf))
    assert rival.known is None


def test_the_rival_that_explains_clearly_more_speaks_for_both_and_the_unpushed_one_else():
    pushed, bare = Rival(), Rival()
    assert not likelier(pushed, bare).believed
    bare.begins(known())
    assert likelier(pushed, bare) is bare, "the other was given up"
    pushed.begins(known())
    assert likelier(pushed, bare) is bare, "a tie"
    pushed.evidence = 1.01 * CLEARLY
    assert likelier(pushed, bare) is pushed
    bare.goes_on(known(), -1.0)
    assert likelier(pushed, bare) is pushed


# -------------------------------------------------------------------------------------- in flight


@pytest.fixture
def controller():
    return pilot()


def kinds(controller):
    return {e.what for e in controller.events}


def test_spikes_in_the_position_do_not_move_the_vehicle(controller):
    rng = np.random.default_rng(1)
    path, commands = fly(
        controller,
        300,
        seen=lambda k, y: y | {"x": y["x"] + 0.5} if k > 50 and rng.random() < 0.05 else y,
    )
    assert kinds(controller) == {"not believed: x, y, z"}
    np.testing.assert_allclose(path, np.tile([0.0, 0.0, 1.0], (300, 1)), atol=1e-3)
    assert np.isfinite(commands).all()


def test_a_force_that_was_learned_outlives_an_estimate_that_is_replaced(controller):
    names, force, found = controller.filter.states.names, 0.05, []
    rows = [i for i, name in enumerate(names) if name.startswith("velocity")]
    at = names.index("disturbance.force.x")

    def seen(k, y):
        found.append(controller.estimate[at])
        if k == 200:
            controller.estimate[rows] += 3.0
        return y

    fly(controller, 260, force=force, seen=seen)
    assert "the filter starts anew" in kinds(controller)
    assert found[200] == pytest.approx(force, rel=0.02), "it was learned"
    assert min(found[210:]) > 0.5 * force


@pytest.mark.parametrize("block", ["position", "velocity", "attitude", "rate", "disturbance"])
@pytest.mark.parametrize("size", [20.0, 1e6, 1e213])
def test_an_estimate_that_was_thrown_away_is_replaced_before_the_vehicle_is(
    controller, block, size
):
    rows = [i for i, name in enumerate(controller.filter.states.names) if name.startswith(block)]

    def seen(k, y):
        if k == 60 and block == "attitude":
            controller.estimate[rows] = [0.0, 1.0, 0.0, 0.0]
        elif k == 60:
            controller.estimate[rows] += size
        return y

    path, _ = fly(controller, 200, seen=seen)
    restarts = [e.time for e in controller.events if e.what == "the filter starts anew"]
    assert restarts
    assert max(restarts) <= 0.01 * (60 + SOON)
    assert np.abs(path[-1] - [0.0, 0.0, 1.0]).max() < 0.05
    assert not controller.descending


def test_an_estimate_that_was_denied_stays_so_where_everything_is_believed_since(controller):
    """Upside down, while the gate is wide: beyond the tilt, too, as long as it is believed."""
    rows = [i for i, n in enumerate(controller.filter.states.names) if n.startswith("attitude")]

    def seen(k, y):
        if k == 60:
            controller.estimator.gate.wide += 20.0
            controller.estimator.gate.calm += 20.0
            controller.estimate[rows] = [0.0, 1.0, 0.0, 0.0]
            controller.estimator._denied = True
        return y

    fly(controller, 60 + 2 * SOON, seen=seen)
    assert kinds(controller) == {
        "the filter starts anew",
        "a limit is not held by the plan: the tilt",
    }


def test_measurements_that_deny_every_estimate_replace_none(controller):
    rng = np.random.default_rng(4)

    def seen(k, y):
        return {c: v + rng.normal(0.0, 100.0) for c, v in y.items()} if 60 <= k < 80 else y

    fly(controller, 60 + 21, seen=seen)
    assert kinds(controller) >= {"not believed: x, y, z", "not believed: p"}
    assert "the filter starts anew" not in kinds(controller)


def test_garbage_never_raises_and_never_leaves_the_limits(controller):
    rng = np.random.default_rng(2)
    wild = (np.nan, np.inf, -np.inf, 0.0, 1e3, -1e9, 1e308)

    def seen(k, y):
        if k < 50 or k >= 150:
            return y
        return {c: wild[rng.integers(len(wild))] if rng.random() < 0.3 else v for c, v in y.items()}

    path, commands = fly(controller, 200, seen=seen)
    assert np.isfinite(path).all()
    assert np.isfinite(commands).all()
    assert commands.min() >= controller.problem.command_min
    assert commands.max() <= controller.problem.command_max
    assert np.abs(np.diff(commands, axis=0)).max() <= controller.problem.rate_max + 1e-6
    assert controller.events


def told(controller, steps, clock, called=lambda k: True):
    """Hover with a clock of its own; where the controller is not called the command is held."""
    f = controller.filter
    controller.start()
    x, u, path = controller.estimate.copy(), controller.u.copy(), []
    for k in range(steps):
        y = f["h"](x, u, f.parameter_values).full().ravel()
        measured = dict(zip(f.outputs.names, y.tolist()))
        new = np.array(controller.sample(clock(k), measured)) if called(k) else u
        x = f["f_d"](x, u, f.parameter_values).full().ravel()
        path.append(x[:3])
        assert np.isfinite(new).all()
        u = new
    return np.array(path)


@pytest.mark.parametrize("jump", [1e3, -1.0, math.nan])
def test_a_clock_that_jumps_is_not_followed(controller, jump):
    path = told(controller, 120, lambda k: 0.01 * k + (jump if k >= 60 else 0.0))
    np.testing.assert_allclose(path, np.tile([0.0, 0.0, 1.0], (120, 1)), atol=1e-6)
    assert "the clock jumps" in kinds(controller)
    # time goes on by samples: the last plan begins where it would without the jump
    assert math.isnan(jump) or controller.plan.time == pytest.approx(1.20, abs=0.011)


def test_a_jittering_clock_is_no_event_and_calls_that_do_not_come_are(controller):
    rng = np.random.default_rng(3)
    jitter = rng.uniform(-0.003, 0.003, 200)
    told(controller, 200, lambda k: 0.01 * k + jitter[k])
    assert not controller.events
    assert controller.count == 200
    told(controller, 200, lambda k: 0.01 * k, called=lambda k: not 60 <= k < 70)
    assert kinds(controller) == {"calls did not come"}
    assert controller.count == 200
    assert controller.plan.time == pytest.approx(2.0, abs=0.011)


def test_a_solver_that_stays_away_and_returns(controller):
    def seen(k, y):
        controller.solver.data["penalty"][()] = (
            np.nan if 100 <= k < 200 else controller.problem.penalty
        )
        return y

    path, commands = fly(controller, 400, force=0.02, seen=seen)
    assert len(controller.events) == 50  # four times as long as a plan
    assert np.abs(path[100:] - [0, 0, 1]).max() < 0.05
    assert np.abs(path[-1] - [0, 0, 1]).max() < 5e-3
    assert controller.plan.time == pytest.approx(4.0, abs=0.021)
    assert np.isfinite(commands).all()


@pytest.mark.parametrize(("every", "first"), [(2, 1), (10, 3)])
def test_a_pose_that_is_slower_than_the_plan_is_no_reason_to_come_down(controller, every, first):
    lost = dict.fromkeys(PLACE, math.nan)
    path, _ = fly(controller, 200, seen=lambda k, y: y if k % every == first else y | lost)
    assert not controller.descending
    np.testing.assert_allclose(path, np.tile([0.0, 0.0, 1.0], (200, 1)), atol=0.01)


def test_a_filter_carries_on_without_a_pose_while_it_is_sure_of_its_place(controller):
    lost = dict.fromkeys(("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz"), math.nan)
    path, _ = fly(controller, 200, seen=lambda k, y: y | lost if 50 <= k < 100 else y)
    assert not controller.descending
    np.testing.assert_allclose(path, np.tile([0.0, 0.0, 1.0], (200, 1)), atol=0.02)
    functions, columns = controller.filter, controller.model.dynamics.innovation_columns
    assert (
        longest_without_pose(functions, columns)
        == controller.estimator.blind
        == pytest.approx(BLIND)
    )
    pushed = replace(
        functions, noise=replace(functions.noise, filtered=1e4 * functions.noise.filtered)
    )
    assert SLOW <= longest_without_pose(pushed, columns) < BLIND
    # Satellites: a position that is known to 10 cm with every measurement is not lost without one.
    known = functions.noise.covariance.copy()
    place = [i for i, n in enumerate(functions.error_states.names) if "position" in n]
    known[place, place] += 0.1**2
    vague = replace(functions, noise=replace(functions.noise, covariance=known))
    assert longest_without_pose(vague, columns) > SLOW


def test_without_a_position_it_comes_down_and_says_so(controller):
    lost = dict.fromkeys(PLACE, math.nan)
    path, _ = fly(controller, 300, seen=lambda k, y: y | lost if k >= 50 else y)
    assert [e.what for e in controller.events] == [
        "descent declared: position or attitude not measured"
    ]
    assert (
        0.5 + controller.estimator.blind
        <= controller.events[0].time
        <= 0.55 + controller.estimator.blind
    )
    fall = np.diff(path[200:, 2]) / 0.01
    np.testing.assert_allclose(fall, -SPEED, atol=0.05)
    assert np.abs(path[:, :2]).max() < 0.02
    controller.start()
    assert not controller.descending
