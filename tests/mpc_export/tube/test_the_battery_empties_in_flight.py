"""A battery that empties in flight: told or not, the tube holds its place, and says what it knows."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from greybox.cli import main
from greybox.model.noise import with_disturbance
from greybox.residual.files import save_model
from mpc_export.tube.controller import TubeController
from mpc_export.tube.descent import Way
from mpc_export.tube.in_process import TubeInC
from mpc_export.tube.library import Still
from mpc_export.tube.problem import TubeProblem
from mpc_export.tube.stopping import stopping
from mpc_export.tube.target import Planning, too_short
from mpc_export.tube.told import PRESENT
from tests.residual import hybrid_cases

FULL, EMPTY = 4.2, 3.3
"""Volts at the beginning and the end; training saw 3.7 to 3.9."""
PLACE = (0.1, -0.2, 1.0, 0.3)
NOT_TOLD, REFUSED, UNTRAINED, SLACK, HEAVY = (1 << k for k in range(15, 20))


@functools.cache
def model():
    """The disturbed craft, its rotors' speed proportional to the voltage."""
    dynamics = with_disturbance(
        hybrid_cases.craft(("motor_lag", "command_delay", "rotor_drag", "battery_sag")),
        ("force", "torque"),
        time=2.0,
    )
    found = hybrid_cases.craft_model(dynamics).with_values(
        {"battery_sag.c_V": 1.0, "command_delay.d": 0.013, "motor_lag.tau": 0.04}
    )
    changes = {
        "domain": {"vbat": (3.7, 3.9), "vx": (-2.5, 1.0)},
        "reference_inputs": np.array([0.7, 0.7, 0.7, 0.7, 3.8]),
    }
    for name, value in changes.items():
        object.__setattr__(found, name, value)
    return found


def made(linear):
    return TubeController(
        model=model(),
        problem=TubeProblem(
            dt=0.05 if linear else 0.02, horizon=5 if linear else 8, planes=2, rate_max=0.2
        ),
        reference=Still(PLACE),
        kappa=(2.0, 2.0, 2.0),
    )


pilot = functools.cache(made)


def flown(one, own, seconds, volts, told=lambda time, now: {"vbat": now}):
    """Distance (n,) from the place of the model itself at `volts` (time), sensors noisy, and what is
    said by the end of every sample."""
    f, rng = own.filter, np.random.default_rng(0)
    own.start()
    one.start()
    x, u, away, said = own.estimate.copy(), own.u.copy(), [], []
    for k in range(round(seconds / f.dt)):
        now = volts(k * f.dt)
        y = f["h"](x, u, [now]).full().ravel()
        y += 0.3 * np.sqrt(np.diag(f.noise.innovation)).min() * rng.standard_normal(len(y))
        new = one.sample(k * f.dt, dict(zip(f.outputs.names, y)) | told(k * f.dt, now))
        x, u = f["f_d"](x, u, [now]).full().ravel(), np.array(new)
        away.append(np.linalg.norm(x[:3] - PLACE[:3]))
        said.append(one.said[-1] if isinstance(one, TubeInC) else None)
    return np.array(away), said


def empties(time, seconds=12.0):
    return FULL + (EMPTY - FULL) * min(time / seconds, 1.0)


def untold(time, now):
    return {}


def events(own):
    return [e.what for e in own.events]


@pytest.mark.slow
@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("real", ["float", "double"])
def test_the_library_holds_its_place_while_the_battery_empties(tmp_path, real, linear):
    own = pilot(linear)
    one = TubeInC(own, tmp_path, real=real, linear=linear)
    away, said = flown(one, own, 15.0, empties)
    assert away[100:].max() < 0.02
    assert not any(s & (NOT_TOLD | REFUSED | HEAVY) for s in said)
    assert all(bool(s & UNTRAINED) != (3.7 <= empties(0.01 * k) <= 3.9) for k, s in enumerate(said))
    away, said = flown(one, own, 15.0, empties, untold)
    assert away[200:].max() < 0.02
    assert all(s & NOT_TOLD for s in said) and said[-1] & UNTRAINED
    # what was lost is no force: tilt and torque lose as much (a quarter of the weight, held as one)
    push = one.estimate[own.filter.states.names.index("disturbance.force.z")]
    assert abs(push) < 0.02 * 9.81 * own.model.values["mass"]


def test_so_does_the_controller_and_says_it_once():
    own = pilot(False)
    sooner = functools.partial(empties, seconds=3.0)
    away, _ = flown(own, own, 3.5, sooner)
    assert away[100:].max() < 0.02
    assert own.p[0] == EMPTY
    assert set(events(own)) == {"vbat is beyond what was seen in training"}
    away, _ = flown(own, own, 8.0, sooner, untold)
    assert away[200:].max() < 0.02
    assert own.p[0] == pytest.approx(EMPTY, abs=0.05)
    assert events(own).count("vbat is not known") == 1


def test_a_value_is_bounded_by_what_the_model_can_hover_with():
    (one,) = pilot(False).estimator.told.own
    assert 0.7 * one.reference < one.low < 0.85 * one.reference  # it hovers at 0.73 of 0.95
    assert one.high > 10 * one.reference
    assert one.ratio == pytest.approx(one.values / one.reference, rel=1e-6)
    assert "vbat [V]" in one.says() and "3.7 to 3.9 in training" in one.says()


@pytest.mark.slow
def test_a_value_that_cannot_be_is_refused_and_the_last_one_stays(tmp_path):
    own = pilot(False)
    one = TubeInC(own, tmp_path, real="float")
    wrong = {50: 3800.0, 60: -3.8, 70: np.inf, 80: 0.0}

    def told(time, now):
        return {"vbat": wrong.get(round(time / 0.01), now)}

    away, said = flown(one, own, 2.0, lambda time: 3.8, told)
    assert away[100:].max() < 0.02
    assert [k for k, s in enumerate(said) if s & REFUSED] == sorted(wrong)
    flown(own, own, 2.0, lambda time: 3.8, told)
    assert events(own).count("vbat cannot be used") == 4 and own.p[0] == 3.8


@pytest.mark.slow
def test_a_value_is_known_for_a_while_and_not_after_it_was_called_unknown(tmp_path):
    own = pilot(False)
    one = TubeInC(own, tmp_path, real="float")

    def once(time, now):
        return {"vbat": now} if time == 0.0 else {}

    _, said = flown(one, own, PRESENT + 1.0, lambda time: 3.8, once)
    late = [k for k, s in enumerate(said) if s & NOT_TOLD]
    assert late[0] == pytest.approx(PRESENT / 0.01, abs=2) and len(late) == len(said) - late[0]
    one.start()
    one.sample(0.0, {"vbat": 3.8})
    assert not one.said[-1] & NOT_TOLD
    one._tell(0, one._c(np.nan))
    one.sample(0.01, {})
    assert one.said[-1] & NOT_TOLD


@pytest.mark.parametrize("load", [0.0, 0.3])
def test_a_value_that_is_told_late_takes_back_what_it_explains(load):
    """Of a load nothing: that stays a push."""
    own = pilot(False)
    names, weight = own.filter.states.names, 9.81 * own.model.values["mass"]
    at = names.index("disturbance.force.z")
    own.start()
    own.estimate[at] = -load * weight
    for k in range(2000):
        own.estimator._hear(0.01 * k, {})
    assert abs(own.estimate[at]) < 1e-3 * weight
    guessed = own.p[0]
    assert (guessed < 3.7) == (load > 0)
    own.estimator._hear(20.0, {"vbat": 3.8})
    assert own.p[0] == 3.8
    assert own.estimate[at] == pytest.approx(-load * weight, abs=1e-3 * weight)


@pytest.mark.slow
def test_a_third_of_the_weight_more_is_said(tmp_path):
    """Where the voltage is told, what is missing is a load or broken rotors: nobody knows which."""
    own = pilot(False)
    one = TubeInC(own, tmp_path, real="float")
    heavy = own.model.values["mass"] * 9.81
    for share, says in ((0.2, False), (0.4, True)):
        for flier in (own, one):
            own.start()
            one.start()
            f, x, u = own.filter, own.estimate.copy(), own.u.copy()
            for k in range(150):
                x[f.states.names.index("disturbance.force.z")] = -share * heavy
                y = f["h"](x, u, [4.2]).full().ravel()
                new = flier.sample(0.01 * k, dict(zip(f.outputs.names, y)) | {"vbat": 4.2})
                x, u = f["f_d"](x, u, [4.2]).full().ravel(), np.array(new)
            if flier is one:
                assert bool(one.said[-1] & HEAVY) == says
            else:
                assert any(w.startswith("pushed down by a third") for w in events(own)) == says


def walls(own, planes):
    """The same planes at all times; the rest bind nothing."""
    every = np.zeros((own.problem.horizon + 1, own.problem.planes, 4))
    every[..., 3] = 1.0
    every[:, : len(planes)] = planes
    return lambda times: every


def not_held(own):
    """Which limits plans did not hold, one text a plan."""
    begin = "a limit is not held by the plan: "
    return [e.removeprefix(begin) for e in events(own) if e.startswith(begin)]


@pytest.mark.slow
@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize(
    ("planes", "slack"),
    [
        ([[1.0, 0.0, 0.0, 5.0]], False),
        ([[1.0, 0.0, 0.0, -5.0], [-1.0, 0.0, 0.0, -5.0]], True),  # nowhere
        ([[1.0, 0.0, 0.0, -0.4]], True),  # it begins half a metre beyond
    ],
)
def test_planes_that_the_plan_does_not_hold_are_said(tmp_path, linear, planes, slack):
    own = made(linear)
    own.planes = walls(own, planes)
    one = TubeInC(own, tmp_path, real="float", linear=linear)
    _, said = flown(one, own, 0.3, lambda time: 3.8)
    says = sum(bool(s & SLACK) for s in said)
    assert says >= 0.3 / own.problem.dt - 1 if slack else says == 0
    flown(own, own, 0.3, lambda time: 3.8)
    assert (len(not_held(own)) > 5 - 3 * linear) == slack
    assert {which for e in not_held(own) for which in e.split(", ")} <= {"plane 0", "plane 1"}


def test_stopping_takes_what_the_model_takes():
    own = pilot(False)
    stops = stopping(own)
    assert stops.trained == 2.5 and stops.seconds == pytest.approx(0.16)
    assert stops.brakes == pytest.approx(9.80665 * np.tan(own.problem.tilt_max))
    assert 0.04 + 0.013 + 0.02 < stops.before < 0.3  # two stages, the delay, and the turn
    needed = stops.needed(1.3, 0.02)
    assert (needed - 1) * 0.02 < stops.before + 1.3 / stops.brakes <= needed * 0.02
    said = too_short(own, Planning(horizon=8))
    assert said.startswith("tube: 0.16 s are too short to stop at a plane from the trained 2.5 m/s")
    assert f"--horizon {stops.needed(2.5, 0.02)} (a Cortex-M7 carries 10)" in said


def limited(own, command_max, **values):
    """The pilot with another limit of its commands, and other values of its model."""
    names = ("solver", "filter", "functions", "_column")
    curve = {f"thrust.{n}": v for n, v in values.items()}
    model = {n: getattr(own.model, n) for n in ("dynamics", "sample_time", "domain")}
    return SimpleNamespace(
        problem=replace(own.problem, command_max=command_max),
        model=SimpleNamespace(values=dict(own.model.values) | curve, **model),
        **{n: getattr(own, n) for n in names},
    )


def test_what_is_left_to_brake_with_is_of_the_thrust_that_the_curve_gives():
    own = pilot(False)
    hover = float(np.mean(own.solver.stages.steady[1]))
    for share in (1.0, 0.9):
        assert stopping(limited(own, share * hover)) is None  # it hovers with all that it has
    line = stopping(limited(own, 1.05 * hover, c0=0.0, c1=2.0, c2=0.0))
    square = stopping(limited(own, 1.05 * hover, c0=0.0, c1=0.0, c2=4.0))
    assert line.brakes == pytest.approx(9.80665 * np.sqrt(1.05**2 - 1.0))
    assert square.brakes == pytest.approx(9.80665 * np.sqrt(1.05**4 - 1.0))


class Dash:
    """Faster and faster along x for 1.5 s, then at speed [m/s]."""

    def __init__(self, speed):
        self.speed = speed

    def sample(self, time):
        t, zero = np.asarray(time, dtype=float), np.zeros(len(time))
        x = np.where(t < 1.5, t * t / 3.0, t - 0.75)
        change = np.where(t < 1.5, 1.0 / 1.5, 0.0)
        along = [self.speed * v for v in (x, np.clip(t / 1.5, 0.0, 1.0), change)]
        place = np.column_stack([along[0], zero, zero + 1.0])
        velocity, push = (np.column_stack([v, zero, zero]) for v in along[1:])
        return Way(position=place, velocity=velocity, acceleration=push, yaw=zero)


def beyond(horizon, speed):
    """By how much a dash passes a wall [m], and how often the plan says so."""
    own = TubeController(
        model=model(),
        problem=TubeProblem(dt=0.02, horizon=horizon, planes=2),
        reference=Dash(speed),
    )
    own.planes = walls(own, [[1.0, 0.0, 0.0, 1.2 * speed]])
    f, most = own.filter, -np.inf
    own.start()
    x, u = own.estimate.copy(), own.u.copy()
    for k in range(205):
        y = f["h"](x, u, [3.8]).full().ravel()
        new = own.sample(0.01 * k, dict(zip(f.outputs.names, y)) | {"vbat": 3.8})
        x, u = f["f_d"](x, u, [3.8]).full().ravel(), np.array(new)
        most = max(most, x[0] - 1.2 * speed)
    return most, len(not_held(own))


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.6, 1.3])
def test_a_plan_as_long_as_stopping_takes_holds_a_wall_and_a_shorter_one_says_that_it_does_not(
    speed,
):
    needed = stopping(pilot(False)).needed(speed, 0.02)
    assert beyond(needed, speed)[0] < 0.002
    passed, said = beyond(needed - 4, speed)
    assert passed > 0.03 and said > 5


@pytest.mark.slow
def test_the_export_says_what_the_horizon_stops_from(tmp_path, capsys):
    save_model(model(), tmp_path / "model.json")
    arguments = ["export", str(tmp_path / "model.json"), "--out", str(tmp_path / "craft")]
    arguments += ["--float", "--even-so", "--target"]
    assert main([*arguments, "tube"]) == 0
    assert (
        "0.2 s are too short to stop at a plane from the trained 2.5 m/s" in capsys.readouterr().out
    )
    words = (tmp_path / "craft" / "tube" / "README.md").read_text()
    for word in ("_tube_parameter", "CRAFT_TUBE_SLACK", "CRAFT_TUBE_NOT_TOLD", "vbat [V]"):
        assert word in words
    assert main([*arguments, "tube", "--horizon", "60"]) == 0
    assert "too short" not in capsys.readouterr().out
