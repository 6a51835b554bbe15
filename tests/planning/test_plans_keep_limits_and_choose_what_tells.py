"""A plan keeps its limits, excites what is asked for, beats an unplanned flight, and says what it
will not know."""

from __future__ import annotations

import itertools
import re
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from greybox.errors import FitError, GreyboxError, UnknownNameError
from greybox.estimation.fit import fit
from greybox.model.dynamics import StateSpaceModel
from greybox.model.effects import effect_by_name
from greybox.model.parameter import Parameter
from greybox.model.vehicle import Vehicle
from greybox.model.vehicle_template import template_text
from greybox.planning import plan
from greybox.planning.excitation_blocks import excitation_blocks, fit_in
from greybox.planning.information import Information, Score, choose, errors, information
from greybox.planning.limits import Limits
from greybox.planning.options import demand_lengths, left_over
from greybox.planning.own_plan import LONGEST_SAMPLES, plan_own
from greybox.planning.planning_case import planning_case
from greybox.planning.setpoints import csv, setpoints
from greybox.symbolic import Layout, Signal

LIMITS = Limits(
    box=(3.0, 2.0, 2.0), floor=0.4, speed=2.0, tilt=np.radians(25.0), command=(0.1, 0.9)
)


def vehicle(**changes: object) -> Vehicle:
    """The template; as a file of schema /1, whose bare numbers are exact and whose fits know no
    wall at the triangle inequality (these flights say little of the yaw inertia, and a noise-free
    fit goes as far as it may)."""
    return Vehicle.from_dict(
        tomllib.loads(template_text("x")) | {"schema": "greybox.vehicle/1"} | changes
    )


@pytest.fixture(scope="module")
def made():
    return plan(vehicle(), effects=["rotor_drag", "command_delay"], seconds=25.0, limits=LIMITS)


def test_a_plan_shows_itself_in_twelve_lines_and_as_a_frame(made):
    assert len(repr(made).splitlines()) <= 12
    assert set(made.errors) <= {str(v) for v in made.to_frame().iloc[:, 0]}


def test_the_expected_flight_keeps_every_limit(made):
    assert LIMITS.broken(made.log) == []
    use = LIMITS.used(made.log)
    assert use["x"] <= 1.5 and use["y"] <= 1.0 and 0.4 <= use["lowest"] <= use["highest"] <= 2.0
    assert (
        use["speed"] <= 2.0 and use["tilt"] <= np.radians(25.0) and use["commands_outside"] <= 0.01
    )
    assert use["speed"] > 0.5, "a plan that hardly moves is no plan"
    assert made.seconds == 25.0


def test_setpoints_are_the_flight_that_was_judged(made):
    (steps,) = made.flights
    columns = setpoints(steps, LIMITS, 0.01, 9.81)
    log = made.log.flights[0].segments[0].channels
    assert all(v.shape == (2500,) for v in columns.values())
    away = np.hypot(columns["sp_x"] - log["x"], columns["sp_y"] - log["y"])
    assert np.sqrt(np.mean(away**2)) < 0.4
    # From home to home, without a jump of the setpoint.
    for a in "xyz":
        place = columns[f"sp_{a}"]
        assert place[0] == pytest.approx(LIMITS.home["xyz".index(a)])
        assert place[-1] == pytest.approx(place[0], abs=0.03)
        assert np.abs(np.diff(place)).max() < 0.05
        np.testing.assert_allclose(columns[f"sp_v{a}"][5:-5], np.gradient(place, 0.01)[5:-5])
    assert set(columns["manoeuvre"]) == {1.0, 2.0, 3.0, 4.0, 5.0}
    text = csv(columns).splitlines()
    assert text[0].split(",") == list(columns) and len(text) == 2501
    read = np.loadtxt(text[1:], delimiter=",")
    np.testing.assert_allclose(read, np.stack(list(columns.values()), axis=1), rtol=1e-9)


def test_a_table_keeps_clocks_and_small_signals():
    t = 0.0025 * np.arange(100_000)
    small = 1e-7 * np.sin(t)
    text = csv({"t": t, "moment": small}).splitlines()
    read = np.loadtxt(text[1:], delimiter=",")
    np.testing.assert_allclose(np.diff(read[:, 0]), 0.0025, rtol=1e-4)
    np.testing.assert_allclose(read[:, 1], small, rtol=1e-9)


def test_the_plan_tells_more_than_hover_and_figure_of_eight(made):
    assert made.efficiency > 2.0
    assert made.errors["command_delay.d"][0] < 0.5 * made.naive["command_delay.d"][0]
    assert "times as long" in made.comparison


def test_look_alikes_are_judged_in_both_directions(made):
    (pair,) = [p for p in made.pairs if set(p.effects) == {"command_delay", "motor_lag"}]
    assert pair.separated and pair.overlap > 0.5
    (other,) = [p for p in made.pairs if set(p.effects) == {"command_delay", "rotor_drag"}]
    assert other.overlap < 0.2


@pytest.fixture(scope="module")
def scaled(made):
    """The plan's subject with the mass known, so that nothing but noise is left to decide the
    common scale."""
    return planning_case(
        vehicle(),
        effects=["rotor_drag", "command_delay"],
        free=[n for n in made.subject.free if n != "mass"],
    )


@pytest.fixture(scope="module")
def fitted(made, scaled):
    """A fit to the noise-free expected flight, at the same noise levels."""
    return fit(
        scaled.dynamics,
        made.log,
        free=scaled.free,
        values=scaled.values,
        estimate_noise=False,
        initialisation="nominal",
    )


def test_information_is_that_of_the_fits_own_error_bars(made, scaled, fitted):
    assert fitted.converged
    expected = errors(scaled, information(scaled, made.log))
    for n in scaled.free:
        assert fitted[n].std_fisher == pytest.approx(expected[n][0], rel=0.1), n


def test_what_was_known_before_counts_and_twice_as_long_is_root_two(made):
    double = information(made.subject, made.log)
    double = Information(names=double.names, matrix=2 * double.matrix)
    once, twice = made.errors["command_delay.d"], errors(made.subject, double)["command_delay.d"]
    # The prior of the scale has a little part in it.
    assert once[0] / twice[0] == pytest.approx(np.sqrt(2), rel=1e-3)
    assert all(
        std <= made.subject.known_before.get(n, np.inf) * (1 + 1e-9)
        for n, (std, _) in made.errors.items()
    )


def test_only_ratios_are_said_to_be_seen_where_nothing_fixes_the_scale(made):
    assert any("only as a ratio" in c.text and "mass" in c.names for c in made.unidentified)
    assert not np.isfinite(made.errors["mass"][1])


def test_the_choice_is_the_best_of_all_where_all_can_be_tried():
    rng = np.random.default_rng(3)
    s = planning_case(vehicle(), free=["inertia.xx", "inertia.yy", "inertia.zz"])
    scale = np.array([s.declared[n].scale for n in s.free])
    told = {}
    for k in range(5):
        a = rng.standard_normal((3, 2)) / scale[:, None]
        told[str(k)] = Information(names=s.free, matrix=a @ a.T)
    score = Score(s, s.free)
    chosen = choose(told, 6, score)
    allowed = [
        c for c in itertools.combinations_with_replacement(told, 6) if max(map(c.count, c)) <= 2
    ]
    best = max(score(sum(told[n].matrix for n in c)) for c in allowed)
    assert score(sum(told[n].matrix for n in chosen)) == pytest.approx(best, abs=2e-3)


def test_setpoints_only_needs_no_injected_signal(made):
    every = excitation_blocks(made.subject.flying, LIMITS, seconds=5.0)
    plain = excitation_blocks(made.subject.flying, LIMITS, seconds=5.0, setpoints_only=True)
    assert not any(p.injected for p in plain) and {p.name for p in plain} == {
        p.name for p in every if not p.injected
    }
    columns = setpoints([(p, 1.0) for p in plain], LIMITS, 0.01, 9.81)
    assert not any(columns[f"inj_{n}"].any() for n in ("roll", "pitch", "yaw", "thrust"))


def test_time_that_whole_manoeuvres_leave_is_said(made):
    assert not any("asked for" in w for w in made.warnings)
    heard = []
    found = plan(
        vehicle(),
        effects=["motor_lag"],
        seconds=5.0,
        piece=2.0,
        limits=LIMITS,
        setpoints_only=True,
        say=heard.append,
    )
    assert found.seconds == pytest.approx(4.0)
    assert "5 s were asked for" in heard[0] and "4 s: --seconds 6" in heard[0]
    assert heard[0] in found.warnings and heard[0] in found.summary()
    assert left_over(24.0, 5.0) and not left_over(24.0, 4.8) and not left_over(60.0, 5.0)


def test_every_piece_starts_and_ends_at_home():
    s = planning_case(vehicle(), effects=["battery_sag"])
    every = excitation_blocks(s.flying, LIMITS, seconds=5.0)
    kinds = {p.kind for p in every}
    assert {"multisine", "doublets", "3-2-1-1", "coupled", "height", "speed", "battery"} <= kinds
    for p in every:
        for t in (0.0, 5.0):
            if p.offset:
                np.testing.assert_allclose(p.offset(t, 1.0), 0.0, atol=1e-9)


def test_multisines_of_different_inputs_are_orthogonal():
    s = planning_case(vehicle())
    (p,) = [
        p for p in excitation_blocks(s.flying, LIMITS, seconds=5.0) if p.name == "all_multisine"
    ]
    t = np.arange(0, 5, 0.005)
    table = np.array([p.twist(float(v), 1.0) for v in t])
    r = np.corrcoef(table.T)
    assert np.abs(r - np.eye(4)).max() < 0.15


def test_a_piece_is_made_smaller_until_it_fits():
    s = planning_case(vehicle())
    narrow = Limits(box=(4.0, 4.0, 2.5), speed=3.0, tilt=np.radians(8.0), command=(0.1, 0.9))
    by_name = {p.name: p for p in excitation_blocks(s.flying, LIMITS, seconds=5.0)}
    wide, small = (
        fit_in(s.flying, [by_name["roll_multisine"]], room)[0] for room in (LIMITS, narrow)
    )
    assert wide is not None and small is not None
    assert small.amplitude < wide.amplitude


def test_an_experiment_that_leaves_its_limits_as_a_whole_is_none():
    tank = StateSpaceModel(
        name="tank",
        states=Layout([Signal(name="h", unit="m")]),
        inputs=Layout([Signal(name="q", unit="m^3/s")]),
        outputs=Layout([Signal(name="h", unit="m")]),
        parameters=(
            Parameter(name="a", unit="1/m^2", nominal=1.0, lower=0.1, upper=9.0, scale=1.0),
        ),
        dynamics=lambda t, x, u, p: [p["a"] * u[0]],
        measurement=lambda t, x, u, p: [x[0]],
        noise_states=("h",),
        initial_sigma={"h": 0.1},
        sensor_sigma={"h": 0.01},
    )
    limits = {"h": (-3.0, 5.0)}
    even = plan_own(tank, {"q": (-1.0, 1.0)}, limits=limits, seconds=20.0, sample_time=0.05)
    height = even.log.flights[0].segments[0].channels["h"]
    assert -3.0 <= height.min() < height.max() <= 5.0
    # It fills: each piece begins empty.
    with pytest.raises(FitError, match="not one after the other"):
        plan_own(tank, {"q": (0.0, 1.0)}, limits=limits, seconds=20.0, sample_time=0.05)


def test_limits_that_say_nothing_of_commands_keep_those_of_the_vehicle():
    whole = vehicle()
    actuator = replace(whole.actuator, u_min=0.1, u_max=0.9)
    found = plan(
        replace(whole, actuator=actuator),
        effects=["rotor_drag"],
        seconds=10.0,
        limits=Limits(box=(5.0, 5.0, 3.0)),
        setpoints_only=True,
    )
    assert found.limits.box == (5.0, 5.0, 3.0)
    assert found.limits.command == pytest.approx((0.116, 0.884))
    assert found.to_dict()["limits"]["command"] == pytest.approx([0.116, 0.884])


def test_a_model_brings_its_values_and_what_its_flights_told(fitted):
    after = planning_case(model=fitted.model, effects=["rotor_drag"])
    assert after.known_before["command_delay.d"] == pytest.approx(
        fitted["command_delay.d"].std, rel=1e-3
    )
    assert after.values["command_delay.d"] == fitted["command_delay.d"].value
    assert set(after.wanted) == {"rotor_drag.k_x", "rotor_drag.k_y"}


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"effects": ["rotor_drug"]}, UnknownNameError, "rotor_drag"),
        ({"seconds": 1.0}, GreyboxError, "--seconds"),
        ({"flights": 7, "seconds": 10.0}, GreyboxError, "flights"),
        ({"free": ["masse"]}, UnknownNameError, "mass"),
        ({"sensors": ["sonar"]}, UnknownNameError, "gyro"),
        ({"values": {"mass": -1.0}}, GreyboxError, "bounds"),
        ({"limits": Limits(command=(0.6, 0.7))}, GreyboxError, "hover"),
    ],
)
def test_bad_wishes_are_one_line(options, error, words):
    with pytest.raises(error) as caught:
        plan(vehicle(), **({"effects": ["rotor_drag"], "limits": LIMITS} | options))
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_an_effect_of_ones_own_is_planned_for_as_it_is():
    """`--for magnet --effects-file own.py` hands it on so."""
    own = effect_by_name("rotor_drag")
    with pytest.raises(GreyboxError, match="too short a flight"):
        plan(vehicle(), effects=[own], seconds=1.0)


@pytest.mark.parametrize(
    ("lengths", "words"),
    [
        ({"seconds": 4.0}, "--piece is longer than --seconds; expected 2 s <= --piece"),
        ({"seconds": 20.0, "piece": 1.0}, "too short a --piece"),
        ({"seconds": 1.0, "piece": 1.0}, "too short a flight"),
        ({"seconds": 3601.0}, "too long a flight"),
    ],
)
def test_which_of_two_lengths_is_wrong_is_said(lengths, words):
    """A flight of 4 s was called too short where its pieces of 5 s were too long for it."""
    with pytest.raises(GreyboxError) as caught:
        plan(vehicle(), effects=["rotor_drag"], **lengths)
    assert str(caught.value).startswith(words)


@pytest.mark.parametrize("step", [1e-5, 1e-3, 0.01, 1.0, 60.0])
def test_the_lengths_that_are_proposed_are_taken(step):
    """A model with a step of 1 s was told to ask for 5 s, which are 5 samples."""
    ends = {"shortest": (20 * step, "20 samples"), "longest": LONGEST_SAMPLES * step}
    with pytest.raises(GreyboxError) as caught:
        demand_lengths("an experiment", 1e9, 5.0, **ends)
    seconds, piece = re.findall(r"Usual fix: --seconds (\S+) --piece (\S+)", str(caught.value))[0]
    demand_lengths("an experiment", float(seconds), float(piece), **ends)


def test_limits_without_room_are_refused():
    for bad in (
        {"box": (0.1, 4.0, 2.5)},
        {"floor": 3.0},
        {"speed": 0.0},
        {"tilt": 1.5},
        {"command": (0.9, 0.1)},
    ):
        with pytest.raises(GreyboxError, match="no room"):
            Limits(**bad)
    with pytest.raises(GreyboxError, match="exact"):
        plan(
            vehicle(
                mass=0.5,
                inertia_sigma=[0.0] * 3,
                effects={},
                actuator={"thrust": [0, 0, 5.0], "torque": [0, 0, 0.08]},
            )
        )
