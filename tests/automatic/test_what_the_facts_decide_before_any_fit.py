"""Clocks that wander turn on kinematic noise; of two numbers of which flights show the ratio the
better known is held."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from greybox.automatic.decide import _Comparison, decide
from greybox.automatic.facts import facts_of
from greybox.automatic.fit import prepare
from greybox.automatic.setting import Given
from greybox.data import Dataset
from greybox.data.checks.finding import WANDER
from greybox.frames import numeric
from greybox.model.vehicle import Vehicle
from tests.automatic.craft import IMU, POSE, RATES, flight, flights, flown, vehicle

SEED, SECONDS = (7,), 20.0


def wandering(drift: float) -> Dataset:
    """A flight whose attitude falls behind its gyro by `drift` [s] from its first to its last
    sample."""
    columns = dict(flown(SEED, SECONDS)[0])
    t = columns["t"]
    late = t - drift * (t - t[0]) / (t[-1] - t[0])
    turned = np.column_stack([np.interp(late, t, columns[n]) for n in ("qw", "qx", "qy", "qz")])
    turned /= np.linalg.norm(turned, axis=1)[:, None]
    columns |= dict(zip(("qw", "qx", "qy", "qz"), turned.T, strict=True))
    return flight(columns, "run0", (*RATES, "qw", "qx", "qy", "qz"))


def decided(
    data: Dataset, given: Given | None = None, craft: Vehicle | None = None, **sigma: float
):
    """What is decided of flights that are too short to leave a part out, with the facts of the
    whole flight."""
    own = craft or vehicle(**sigma)
    ready = prepare(own, data)
    facts = facts_of(ready.data, own, ready.report)
    short = Dataset(flights=tuple(f.between(0.0, 4.0) or f for f in data))
    return facts, decide(own, short, facts, given or Given())


@pytest.mark.parametrize(("drift", "noise"), [(0.0, False), (0.06, True)])
def test_clocks_that_wander_turn_on_kinematic_noise(drift, noise):
    facts, found = decided(wandering(drift))
    assert (facts.wander > WANDER) is noise
    assert found.recipe.kinematic_noise is noise
    (said,) = [d for d in found.decisions if "kinematics" in d.about]
    assert said.choice == ("yes" if noise else "no")
    assert f"{1e3 * facts.sample * facts.wander:.1f} ms" in said.reason


def estimated(late: int) -> Dataset:
    """A flight whose roll and pitch come so many samples before the gyro, its heading does not."""
    (columns,) = flown(seeds=(1,))
    columns = dict(columns)
    names = ("qw", "qx", "qy", "qz")
    angles = numeric("euler", np.column_stack([columns[n] for n in names]))
    angles[:, :2] = np.roll(angles[:, :2], -late, axis=0)
    columns |= dict(zip(names, numeric("from_euler", angles).T, strict=True))
    whole = {n: v[: len(v) - late] for n, v in columns.items()}
    return flight(whole, "run0", (*RATES, *names))


def test_an_estimator_turns_on_kinematic_noise_and_is_said_as_what_it_is():
    facts, found = decided(estimated(8))
    assert facts.wander == 0.0 and facts.axes_apart == pytest.approx(8.0, abs=1.5)
    assert found.recipe.kinematic_noise
    (said,) = [d for d in found.decisions if "kinematics" in d.about]
    assert said.reason.startswith("an estimator's attitude") and "drift" not in said.reason


def test_kinematic_noise_that_was_refused_stays_off():
    _, found = decided(wandering(0.06), Given(kinematic_noise=False))
    assert not found.recipe.kinematic_noise
    assert not [d for d in found.decisions if "kinematics" in d.about]


def test_where_no_gyro_is_nothing_is_said_to_drift_apart():
    (columns,) = flown(SEED, SECONDS)
    facts, found = decided(Dataset(flights=flight(dict(columns), "run0", POSE).flights))
    assert "gyro" not in facts.sensors
    (said,) = [d for d in found.decisions if "kinematics" in d.about]
    assert said.choice == "no" and "no gyro is there" in said.reason
    assert "apart by" not in said.reason


@pytest.mark.parametrize("channels", [(*RATES, *POSE), POSE])
def test_noise_of_an_imu_is_said_only_where_one_is(channels):
    (columns,) = flown(SEED, SECONDS)
    data = Dataset(flights=flight(dict(columns), "run0", channels).flights)
    facts = facts_of(data, vehicle(), prepare(vehicle(), data).report)
    said: list[str] = []
    setting = SimpleNamespace(given=Given(), facts=facts)
    deciding = SimpleNamespace(setting=setting, note=lambda about, *rest: said.append(about))
    white = SimpleNamespace(likelihood=SimpleNamespace(settings={"noise_parts": []}))
    _Comparison._say_noise(deciding, white, "the innovations of the IMU are white")
    assert said == (["noise of the IMU"] if facts.has_imu else [])


def test_no_flight_long_enough_takes_the_base_set_and_says_so():
    _, found = decided(flights())
    assert found.candidate is None
    assert found.recipe.effect_names == ("motor_lag", "command_delay", "gyro_bias")
    (said,) = [d for d in found.decisions if d.about == "effects"]
    assert "every flight is shorter than 5 s" in said.reason


def test_the_better_known_of_two_numbers_of_which_only_the_ratio_shows_is_held_and_considered():
    for mass, held in ((0.01, "mass"), (0.9, "thrust.c2")):
        _, found = decided(flights(), mass=mass)
        assert found.recipe.options.fixed == (held,)
        assert found.recipe.options.considered == (held,)
        (said,) = [d for d in found.decisions if d.about == held]
        assert "only its ratio" in said.reason


def test_a_map_that_is_linear_in_the_command_is_its_slope():
    own = vehicle(mass=0.01)
    c0, c1, c2 = own.actuator.thrust
    linear = replace(own, actuator=replace(own.actuator, thrust=(c0, c2, c1)))
    _, found = decided(flights(IMU, seeds=(1,)), craft=linear)
    assert found.recipe.options.considered == ("mass",)
    (said,) = [d for d in found.decisions if d.about == "mass"]
    assert "its ratio to thrust.c1" in said.reason


def test_the_trim_of_a_single_flight_is_no_other_flights():
    """A new flight finds its own from the value of the one that was fitted, within what the vehicle
    file says."""
    both, exact = flights(), vehicle()
    one = Dataset(flights=both.flights[:1])
    trim = ("center_of_mass.x", "center_of_mass.y")
    unsure = replace(
        exact, center_of_mass=tuple(replace(c, sigma=1e-3) for c in exact.center_of_mass)
    )

    def own(data, craft, **choices):
        return decided(data, Given(choices=choices), craft)[1].recipe.options.per_flight

    assert own(one, unsure) == trim
    assert own(both, unsure) == own(one, exact) == ()
    assert own(one, unsure, shared=trim) == ()
    assert own(one, unsure, shared=("thrust.c2",)) == trim, "another choice decides nothing of it"
    assert own(one, unsure, shared=trim[:1]) == trim[1:]
    assert own(one, unsure, fixed=trim[:1]) == trim[1:]


def test_disturbance_states_only_where_a_sensor_can_feel_them():
    assert decided(flights())[1].recipe.options.disturbance == ("torque",)
    assert decided(flights((*IMU, *POSE)))[1].recipe.options.disturbance == ("force", "torque")


@pytest.mark.parametrize(
    ("choices", "about"),
    [
        ({"disturbance": ()}, "disturbance states"),
        ({"fixed": ()}, "mass"),
        ({"free": ("mass", "inertia.xx")}, "mass"),
    ],
)
def test_each_given_choice_overrules_exactly_its_decision(choices, about):
    plain, said = (decided(flights(), g, mass=0.01)[1] for g in (Given(), Given(choices=choices)))
    assert [d for d in plain.decisions if d.about != about] == list(said.decisions)
    for name, value in choices.items():
        assert vars(said.recipe.options)[name] == value
    others = (
        set(vars(plain.recipe.options))
        - set(choices)
        - ({"fixed", "considered"} if about == "mass" else set())
    )
    for name in others:
        assert vars(said.recipe.options)[name] == vars(plain.recipe.options)[name]


def test_given_effects_and_adaptation_are_taken():
    _, found = decided(flights(), Given(effects=("motor_lag", "gyro_bias"), adapt=2.0))
    assert found.recipe.effect_names == ("motor_lag", "gyro_bias")
    assert found.recipe.adapt == 2.0
    assert {d.about for d in found.decisions} <= {"effects", "disturbance states"}


def test_what_is_considered_seeded_or_started_stays_as_it_was_said():
    given = Given(choices={"considered": ("thrust.c2",), "seed": 5, "initialisation": "nominal"})
    options = decided(flights(), given, mass=0.01)[1].recipe.options
    assert (options.considered, options.seed, options.initialisation) == (
        ("thrust.c2",),
        5,
        "nominal",
    )


def test_measured_rotor_speeds_as_input_get_no_effect_of_the_command_but_a_delay():
    _, found = decided(
        flights((*RATES, "omega1", "omega2", "omega3", "omega4")), Given(input="speed")
    )
    assert found.recipe.input == "speed"
    assert found.recipe.effect_names == ("command_delay", "gyro_bias")
